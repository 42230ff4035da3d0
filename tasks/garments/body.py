"""The body that wears the garments: Anny (Apache-2.0, its data CC0) at rest, +Y up, facing +Z, soles at y = 0."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Annotated

import numpy as np

from tasks.errors import InputError
from tasks.geometry.neighbours import components, mesh_edges
from tasks.values import Motion, Rig

PREFIX = "mixamorig:"
EXTRA = ("anny", "newton", "warp", "pybullet_data")  # modules of the extra `garments`
DIGITS = ("Thumb", "Index", "Middle", "Ring", "Pinky")  # these follow their hand


def anny_body(
    *,
    gender: Annotated[float, "[0, 1]"],
    age: Annotated[float, "[0, 1]"],
    muscle: Annotated[float, "[0, 1]"],
    weight: Annotated[float, "[0, 1]"],
    height: Annotated[float, "[0, 1]"],
    proportions: Annotated[float, "[0, 1]"],
) -> Motion:
    """The body as a motion of one frame, its rest pose, with the `mixamo` rig, fingers merged into hands: 22 joints.

    The settings are Anny's phenotypes, each 0..1. Only the skin is kept (no eyes, teeth or tongue). The first start of
    Anny takes minutes and leaves a cache of some 800 MB. Raises InputError without the extra `garments`.
    """
    check_extra()
    import anny
    import torch

    model = anny.Anny(rig="mixamo")
    labels = ("gender", "age", "muscle", "weight", "height", "proportions")
    phenotype = dict(zip(labels, (gender, age, muscle, weight, height, proportions), strict=True))
    with torch.no_grad():
        out = model(phenotype_kwargs={name: torch.tensor([value]) for name, value in phenotype.items()})
    vertices = _upright(out["rest_vertices"][0].numpy())
    heads = _upright(out["rest_bone_heads"][0].numpy())
    ground = np.array([0.0, vertices[:, 1].min(), 0.0])
    vertices, heads = vertices - ground, heads - ground
    names = [name.removeprefix(PREFIX) for name in model.bone_labels]
    weights = np.zeros((len(vertices), len(names)))
    rows = np.arange(len(vertices))[:, None]
    np.add.at(weights, (rows, model.vertex_bone_indices.numpy()), model.vertex_bone_weights.numpy())
    names, parents, heads, weights = merge_digits(names, list(model.bone_parents), heads, weights)
    faces = model.faces.numpy()
    kept, faces = largest_component(faces, len(vertices))
    vertices, weights = vertices[kept].astype(np.float32), weights[kept].astype(np.float32)
    rig = Rig(
        names=tuple(names),
        parents=np.array(parents, np.int32),
        joints=heads.astype(np.float32),
        weights=weights / weights.sum(1, keepdims=True),
        rotations=np.tile(np.eye(3, dtype=np.float32), (1, len(names), 1, 1)),
        translations=np.zeros((1, len(names), 3), np.float32),
    )
    return Motion("anny", vertices[None], faces, np.array([0, 1]), ("rest",), 30.0, "m", vertices, rig)


def check_extra() -> None:
    """Raises InputError, before anything is begun, where the extra `garments` is not installed."""
    missing = [module for module in EXTRA if find_spec(module) is None]
    if missing:
        raise InputError(
            "make_garments",
            expected="the extra `garments`, which simulates cloth",
            found=f"no module {', '.join(missing)}",
            do="python -m pip install -c constraints.txt -e '.[garments]'",
        )


def merge_digits(names: list[str], parents: list[int], heads: np.ndarray, weights: np.ndarray):
    """Fingers and thumbs give their weights to the hand. -> names, parents, heads, weights of the joints that stay."""
    target = np.arange(len(names))
    for joint, name in enumerate(names):  # parents stand before their children
        if any(digit in name for digit in DIGITS):
            target[joint] = target[parents[joint]]
    kept = [joint for joint in range(len(names)) if target[joint] == joint]
    place = {joint: new for new, joint in enumerate(kept)}
    merged = np.zeros((len(weights), len(kept)))
    for joint in range(len(names)):
        merged[:, place[int(target[joint])]] += weights[:, joint]
    up = [-1 if parents[joint] < 0 else place[parents[joint]] for joint in kept]
    return [names[joint] for joint in kept], up, heads[kept], merged


def largest_component(faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices of the largest connected part, and its faces renumbered."""
    _, label = components(mesh_edges(faces), count)
    kept = np.flatnonzero(label == np.argmax(np.bincount(label)))
    number = np.full(count, -1)
    number[kept] = np.arange(len(kept))
    faces = number[faces]
    return kept, faces[(faces >= 0).all(1)].astype(np.int32)


def _upright(points: np.ndarray) -> np.ndarray:
    """Anny has +Z up and faces -Y."""
    return np.stack([points[:, 0], points[:, 2], -points[:, 1]], axis=1)
