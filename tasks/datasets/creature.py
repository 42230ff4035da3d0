"""The embedded default: a procedural animal and a procedural figure in a skirt, with true secondary motion.

Nothing is downloaded and nothing is stored: shape, skeleton, skin weights, clips and the swing of the soft parts all
follow from a few numbers and a seed, so that every stage has a truth to be held against.
"""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType
from typing import Annotated, Literal

import numpy as np
from scipy.sparse import csr_matrix

from tasks.datasets import creature_animal, creature_figure
from tasks.datasets import creature_shape as shape
from tasks.datasets.creature_dynamics import Limbs, Masses, displace
from tasks.datasets.creature_motion import Puppet
from tasks.datasets.creature_soft import masses_of
from tasks.geometry import kinematics, rigid
from tasks.values import Motion, Rig

SUBJECTS: dict[str, ModuleType] = {"animal": creature_animal, "figure": creature_figure}
FPS = 30.0
LEAD = 40  # frames simulated before each clip and thrown away: gaits start in full swing, gestures at rest


def load(
    *,
    subject: Literal["animal", "figure"],
    frames_per_clip: Annotated[int, "[16, 600]"],
    vertices: Annotated[int, "[3000, 50000]"],
    softness: Annotated[float, "[0, 3]"],
    seed: int,
) -> Motion:
    """A moving creature in metres at 30 frames a second, +Y up, with its true rig (Motion.rig) and rest shape.

    frames_per_clip: mean length of a clip; vertices: how many the mesh is to have, met within some
    per cent; softness: 1 as designed, 0 leaves linear blend skinning of the rig exactly, more swings more;
    seed: varies how far and how fast each clip moves.
    """
    kind = SUBJECTS[subject]
    tree = kind.joints()
    names = tuple(tree)
    parents = np.array([-1 if p is None else names.index(p) for p, _ in tree.values()], np.int32)
    joints = np.array([at for _, at in tree.values()])
    parts = kind.parts()
    rest, faces = shape.build_surface(parts, vertices)
    rest = rest.astype(np.float32).astype(np.float64)
    weights = skin_weights(kind, parts, rest, faces, names, parents).astype(np.float32)
    masses = soft_masses(kind, parts, rest, weights) if softness > 0 else []
    rng = np.random.default_rng(seed)
    pieces, rotations, translations = [], [], []
    for length, clip in kind.CLIPS.values():
        frames = round(frames_per_clip * length)
        puppet = perform(clip, names, parents, joints, frames, rng)
        r = puppet.rotations.astype(np.float32)
        x = np.zeros((*r.shape[:2], 3), np.float32)
        x[:, 0] = puppet.root - joints[0]
        pieces.append(deform(rest, weights, names, parents, joints, r, x, masses, parts, softness)[LEAD:])
        rotations.append(r[LEAD:])
        translations.append(x[LEAD:])
    start = np.concatenate([[0], np.cumsum([len(p) for p in pieces])]).astype(np.int64)
    rig = Rig(
        names, parents, joints.astype(np.float32), weights, np.concatenate(rotations), np.concatenate(translations)
    )
    return Motion(
        name=subject,
        points=np.concatenate(pieces),
        faces=faces,
        clip_start=start,
        clip_names=tuple(kind.CLIPS),
        fps=FPS,
        unit="m",
        rest=rest.astype(np.float32),
        rig=rig,
    )


def skin_weights(
    kind: ModuleType, parts: list, vertices: np.ndarray, faces: np.ndarray, names: tuple[str, ...], parents: np.ndarray
) -> np.ndarray:
    """True skin weights, (N, J): nearness to the parts, a skirt's share of the legs, then smoothed over the surface."""
    weights = shape.hold_of_joints(parts, vertices, names, parents)
    if hasattr(kind, "drape"):
        weights = kind.drape(weights, vertices, parts, names)
    return shape.smooth_weights(vertices, faces, weights, 0.015)


def soft_masses(kind: ModuleType, parts: list, vertices: np.ndarray, weights: np.ndarray) -> list[Masses]:
    """The masses of every soft region."""
    nearest = shape.part_distances(parts, vertices).argmin(0)
    return [masses_of(s, parts, nearest, vertices, weights) for s in kind.soft()]


def perform(
    clip, names: tuple[str, ...], parents: np.ndarray, joints: np.ndarray, frames: int, rng: np.random.Generator
) -> Puppet:
    """Poses of one clip with its lead before it; the seed varies tempo and gain."""
    tempo, gain = 1.0 + 0.1 * rng.uniform(), 1.0 + 0.1 * rng.uniform(-1, 1)
    t = (np.arange(frames + LEAD) - LEAD) / FPS
    puppet = Puppet(names, parents, joints, len(t))
    clip(puppet, t * tempo, (frames - 1) / FPS, gain)
    return puppet


def deform(
    vertices: np.ndarray, weights: np.ndarray, names: tuple[str, ...], parents: np.ndarray, joints: np.ndarray,
    rotations: np.ndarray, translations: np.ndarray, masses: list[Masses], parts: list, softness: float,
) -> np.ndarray:  # fmt: skip
    """Linear blend skinning plus the swing of the soft parts, (F, N, 3) float32."""
    bones = kinematics.forward(parents, joints.astype(np.float32), rotations, translations)
    # float64 and sparse: a dense product would change in the last bit with the number of BLAS threads
    few, flat = csr_matrix(weights.astype(np.float64)), bones.astype(np.float64).reshape(len(bones), -1, 12)
    points = np.stack([rigid.apply((few @ b).reshape(-1, 3, 4), vertices) for b in flat]).astype(np.float32)
    for m in masses:
        limbs = limbs_of([p for p in parts if p.joint in m.avoid], names, bones)
        moved = np.flatnonzero(np.diff(m.spread.indptr))
        own = replace(m, spread=m.spread[moved])
        points[:, moved] = displace(own, bones, points[:, moved], limbs, fps=FPS, softness=softness)
    return points


def limbs_of(picked: list, names: tuple[str, ...], bones: np.ndarray) -> Limbs:
    """The capsules of parts that soft masses must stay out of, carried by their joints."""
    rest = np.array([(p.a, p.b) for p in picked]).reshape(-1, 2, 3)
    radii = np.array([(p.ra, p.rb) for p in picked]).reshape(-1, 2)
    own = bones[:, [names.index(p.joint) for p in picked]].astype(np.float64)
    return Limbs(rigid.apply(own[:, :, None], rest), rest, radii)
