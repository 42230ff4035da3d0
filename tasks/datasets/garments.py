"""Simulated garments on a moving body: a T-shirt and a dress, shipped in ``data/garments`` (see its manifest)."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from tasks.datasets import validate
from tasks.errors import InputError
from tasks.geometry import rigid
from tasks.geometry.kinematics import forward, joint_positions, local_poses
from tasks.geometry.quantise import decode
from tasks.geometry.rotations import from_rotation_vector, project_so3
from tasks.geometry.skinning import skin
from tasks.geometry.weight_transfer import nearest_weights, robust_weights
from tasks.values import Motion, Poses, Rig

BODY = "body.npz"
GARMENT = (
    "codes",
    "step",
    "origin",
    "clip_start",
    "clip_names",
    "fps",
    "rest",
    "faces",
    "joint_turns",
    "root_shift",
)
SKELETON = (
    "joint_names",
    "joint_parents",
    "joints",
    "vertices",
    "faces",
    "weight_index",
    "weight_value",
    "cutting_turns",
)
REPOSITORY = Path(__file__).resolve().parents[2]


def load(*, garment: Literal["tshirt", "dress"], path: str, weights: Literal["robust", "nearest"]) -> Motion:
    """Reads a simulated garment: points in metres at 30 frames a second, its stress-free shape as rest shape, and in
    ``Motion.rig`` the skeleton of the body that wears it, with the true poses.

    path: the folder of the dataset; a relative one is looked for from the working directory, then in the repository.
    weights: how the garment gets the skin weights in the rig: `robust`, transferred from the body by inpainting
    (Abdrashitov et al. 2023), with which LBS is the baseline "robust LBS"; `nearest`, of the nearest body vertex.
    Raises InputError for missing or damaged files.
    """
    folder = _folder(path)
    source = folder / f"{garment}.npz"
    if not source.is_file():
        raise InputError(str(source), expected="a garment's file", found="none", do="run +experiment=make_garments")
    data = validate.read_npz(source, required=GARMENT)
    body = read_body(folder / BODY)
    points = _points(source, data)
    rest = validate.real(f"{source}: rest", data["rest"], shape="(points, 3)", last=3)
    faces = validate.triangles(f"{source}: faces", data["faces"], points.shape[1])
    return validate.motion(
        str(source),
        name=garment,
        points=points,
        faces=faces,
        fps=validate.number(f"{source}: fps", data["fps"]),
        unit="m",
        clip_start=data["clip_start"],
        clip_names=validate.texts(f"{source}: clip_names", data["clip_names"]),
        rest=rest,
        rig=_rig(body, _poses(source, data, len(points), len(body.rig.names)), rest, faces, weights),
    )


def read_body(path: Path) -> Motion:
    """The body that wears the garments, in one frame, the pose in which they are cut; its rest shape, joints and skin
    weights are Anny's."""
    data = validate.read_npz(path, required=SKELETON)
    vertices = validate.real(f"{path}: vertices", data["vertices"], shape="(vertices, 3)", last=3)
    names = validate.texts(f"{path}: joint_names", data["joint_names"])
    joints = validate.real(f"{path}: joints", data["joints"], shape="(joints, 3)", last=3)
    turns = validate.real(f"{path}: cutting_turns", data["cutting_turns"], shape="(joints, 3)", last=3)
    index, value = data["weight_index"].astype(np.int64), data["weight_value"].astype(np.float64)
    if index.shape != value.shape or len(index) != len(vertices) or not 0 <= index.min() <= index.max() < len(names):
        expected = f"joints 0 to {len(names) - 1} for {len(vertices)} vertices"
        raise InputError(f"{path}: weight_index", expected=expected, found=f"shape {index.shape}")
    weights = np.zeros((len(vertices), len(names)))
    np.add.at(weights, (np.arange(len(vertices))[:, None], index), value)
    weights /= weights.sum(1, keepdims=True)
    parents = data["joint_parents"].astype(np.int32)
    rotations = from_rotation_vector(turns.astype(np.float64))[None].astype(np.float32)
    still = np.zeros((1, len(names), 3), np.float32)
    faces = validate.triangles(f"{path}: faces", data["faces"], len(vertices))
    rig = Rig(tuple(names), parents, joints, weights.astype(np.float32), rotations, still)
    posed = skin(vertices, rig.weights, forward(parents, joints, rotations, still))
    return Motion("body", posed, faces, np.array([0, 1]), ("cutting",), 30.0, "m", vertices, rig)


def read_poses(path: Path) -> Poses:
    """The body's poses in a garment's file, from the body's own rest pose: what the garment was simulated over."""
    data = validate.read_npz(path, required=GARMENT)
    return _poses(path, data, len(data["origin"]), data["joint_turns"].shape[1])


def _poses(source: Path, data: dict[str, np.ndarray], frames: int, joints: int) -> Poses:
    turns = validate.real(f"{source}: joint_turns", data["joint_turns"], shape="(frames, joints, 3)", last=3)
    shift = validate.real(f"{source}: root_shift", data["root_shift"], shape="(frames, 3)", last=3)
    if turns.shape[:2] != (frames, joints) or len(shift) != frames:
        found = f"turns of {turns.shape[:2]}, {len(shift)} shifts"
        raise InputError(str(source), expected=f"{joints} turns for each of {frames} frames", found=found)
    translations = np.zeros(turns.shape, np.float32)
    translations[:, 0] = shift
    return Poses(from_rotation_vector(turns.astype(np.float64)).astype(np.float32), translations, data["clip_start"])


def _rig(body: Motion, poses: Poses, rest: np.ndarray, faces: np.ndarray, weights: str) -> Rig:
    """The skeleton as the garment sees it: at rest in the cutting pose, where the garment's rest shape is."""
    own = body.rig
    cutting = forward(own.parents, own.joints, own.rotations, own.translations)
    moved = forward(own.parents, own.joints, poses.rotations, poses.translations)
    joints = joint_positions(cutting, own.joints)[0]
    relative = rigid.compose(moved.astype(np.float64), rigid.inverse(cutting.astype(np.float64)))
    rotations, translations = local_poses(own.parents, joints.astype(np.float64), relative)
    translations[:, 1:] = 0  # the body's joints turn and do not stretch: what is left is rounding
    if weights == "robust":
        skin_weights = robust_weights(body.points[0], body.faces, own.weights, rest, faces)
    else:
        skin_weights = nearest_weights(body.points[0], own.weights, rest)
    return Rig(
        own.names,
        own.parents,
        joints.astype(np.float32),
        skin_weights.astype(np.float32),
        project_so3(rotations).astype(np.float32),
        translations.astype(np.float32),
    )


def _points(source: Path, data: dict[str, np.ndarray]) -> np.ndarray:
    codes, origin = data["codes"], data["origin"]
    frames, count = len(origin), len(data["rest"])
    if codes.dtype != np.uint8 or codes.shape != (2, frames, count, 3):
        expected = f"bytes of shape (2, {frames}, {count}, 3)"
        raise InputError(f"{source}: codes", expected=expected, found=f"{codes.dtype} {codes.shape}")
    start, _ = validate.clips(str(source), data["clip_start"], None, frames=frames, only="")
    step = validate.number(f"{source}: step", data["step"])
    return (decode(codes, start, step) + origin[:, None]).astype(np.float32)


def _folder(path: str) -> Path:
    here = Path(path).expanduser()
    if not here.is_absolute() and not here.exists() and (REPOSITORY / here).exists():
        return REPOSITORY / here
    return validate.existing_path(path, expected="the folder of the dataset, data/garments")
