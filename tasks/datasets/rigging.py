"""From decoded skins to a Motion: one scale, one tree, rotations relative to rest."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product
from typing import Literal

import numpy as np

from tasks.datasets import validate
from tasks.errors import InputError
from tasks.geometry import kinematics, rigid
from tasks.geometry.measure import diagonal
from tasks.geometry.rotations import project_so3
from tasks.geometry.skinning import skin
from tasks.values import Motion, Rig

DETACHED = (
    0.1  # of the diagonal: feet of IK rigs leave their parent's frame by 0.14 and more, shoulders by 0.08 at most
)


@dataclass(frozen=True)
class Decoded:
    """A skinned, animated character as its file has it.

    where: the file, for messages; rest: (V, 3) in mesh space; faces: (T, 3); weights: (V, J); names: J;
    parents: (J,), -1 for each of the roots, in any order; joints: (J, 3) rest positions in mesh space;
    skin: (F, J, 3, 4) float64, joint world transform times inverse bind matrix; clip_start: (C+1,).
    """

    where: str
    name: str
    rest: np.ndarray
    faces: np.ndarray
    weights: np.ndarray
    names: list[str]
    parents: np.ndarray
    joints: np.ndarray
    skin: np.ndarray
    clip_start: np.ndarray
    clip_names: list[str]
    fps: float


def to_motion(decoded: Decoded, *, hierarchy: Literal["attached", "authored"], unit: str) -> Motion:
    """Poses the character and brings its skeleton into the form of :class:`Rig`.

    Mesh space is often smaller than the posed character (100 times for FBX units) and lies on its back (z up); rest
    shape and joints are scaled and turned into the posed character's space, so that skin transforms become rigid and
    start near the identity. Joints that move no vertex and carry none that does are left out. hierarchy: see
    :func:`single_tree`. Rotations and translations go through :func:`kinematics.local_poses`, so forward kinematics
    and linear blend skinning give the points again, up to what is not rigid in the skin transforms (animated scale).
    """
    weights = _weights(decoded)
    transforms, scale = _unit_scale(decoded, weights)
    turn = _upright(transforms, weights)
    rest, joints = scale * decoded.rest @ turn.T, scale * decoded.joints @ turn.T
    transforms[..., :3] = transforms[..., :3] @ turn.T
    points = skin(rest, weights, transforms)
    order, parents = single_tree(decoded.parents, joints, weights, transforms, diagonal(points[0]), hierarchy=hierarchy)
    rotation = project_so3(transforms[:, order, :, :3])
    position = rigid.apply(transforms[:, order], joints[order])
    placed = rigid.make(rotation, position - (rotation @ joints[order][..., None])[..., 0])
    rotations, translations = kinematics.local_poses(parents, joints[order], placed)
    rig = Rig(
        names=tuple(decoded.names[j] for j in order),
        parents=parents,
        joints=joints[order].astype(np.float32),
        weights=weights[:, order].astype(np.float32),
        rotations=rotations.astype(np.float32),
        translations=translations.astype(np.float32),
    )
    return validate.motion(
        decoded.where,
        name=decoded.name,
        points=points,
        faces=decoded.faces,
        fps=decoded.fps,
        unit=unit,
        clip_start=decoded.clip_start,
        clip_names=decoded.clip_names,
        rest=rest.astype(np.float32),
        rig=rig,
    )


def single_tree(
    parents: np.ndarray,
    joints: np.ndarray,
    weights: np.ndarray,
    transforms: np.ndarray,
    size: float,
    *,
    hierarchy: Literal["attached", "authored"],
) -> tuple[np.ndarray, np.ndarray]:
    """One tree out of an authored forest: (indices of the joints kept, in order; their parents (K,) int32).

    authored: the file's parents, further roots under the largest tree's root.
    attached: a joint that leaves its parent's frame by more than a tenth of the diagonal `size` is not attached to it
    (feet of IK rigs hang on the world's root so that they stay on the ground); such a joint and what hangs on it go
    under the joint with which they share most skin. A root that moves no vertex and has one child is left out.
    """
    attached = hierarchy == "attached"
    parents = np.array(parents, np.int64)
    if attached:
        parents[_leaves_parent(parents, joints, transforms, size)] = -1
    kept = _prune(parents, weights.sum(0) > 0, drop_roots=attached)
    root_of = _roots(parents)
    roots = sorted({int(root_of[j]) for j in kept}, key=lambda r: (-np.sum(root_of[kept] == r), r))
    main, joined = roots[0], np.isin(np.arange(len(parents)), kept) & (root_of == roots[0])
    waiting = roots[1:]
    while waiting:
        if attached:
            root, host = _closest(waiting, root_of, joined, weights, joints)
        else:
            root, host = waiting[0], main
        parents[root] = host
        joined |= (root_of == root) & np.isin(np.arange(len(parents)), kept)
        waiting.remove(root)
    order = _depth_first(parents, kept, main)
    place = {int(j): k for k, j in enumerate(order)}
    return order, np.array([place.get(int(parents[j]), -1) for j in order], np.int32)


def check_tree(where: str, parents: np.ndarray) -> None:
    """Raises InputError unless every parent is a joint or -1 and no joint is its own ancestor."""
    above = np.asarray(parents, np.int64)
    if ((above < -1) | (above >= len(above))).any():
        raise InputError(where, expected=f"-1 or 0 to {len(above) - 1}", found=str(above.tolist()))
    for _ in range(len(above)):
        above = np.where(above >= 0, np.asarray(parents, np.int64)[above], -1)
    if (above >= 0).any():
        raise InputError(where, expected="a tree", found=f"a cycle through joint {int(np.flatnonzero(above >= 0)[0])}")


def _weights(decoded: Decoded) -> np.ndarray:
    total = decoded.weights.sum(1)
    bad = np.flatnonzero(~(total > 0) | ~np.isfinite(total) | (decoded.weights < 0).any(1))
    if len(bad):
        raise InputError(
            f"{decoded.where}: weights",
            expected="skin weights of at least zero with a sum above zero",
            found=f"vertex {bad[0]} with sum {total[bad[0]]:g} ({len(bad)} such vertices)",
            do="bind every vertex to a joint",
        )
    return decoded.weights / total[:, None]


def _unit_scale(decoded: Decoded, weights: np.ndarray) -> tuple[np.ndarray, float]:
    """Skin transforms with the scale taken out, and the scale: the median over joints that move skin."""
    if not np.isfinite(decoded.skin).all():
        frame, joint = np.argwhere(~np.isfinite(decoded.skin).all((2, 3)))[0]
        found = f"NaN or infinity at frame {frame}, joint {decoded.names[joint]}"
        raise InputError(f"{decoded.where}: skin matrices", expected="finite numbers", found=found)
    volume = np.linalg.det(decoded.skin[:, weights.sum(0) > 0, :, :3])
    scale = float(np.cbrt(np.median(volume)))
    if not scale > 0:
        raise InputError(
            f"{decoded.where}: skin matrices", expected="turning and scaling", found="mirroring or nothing"
        )
    transforms = decoded.skin.copy()
    transforms[..., :3] /= scale
    return transforms, scale


def _upright(transforms: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The quarter turns about the axes that come nearest to how the skin is turned on average, (3, 3)."""
    share = weights.sum(0) / weights.sum()
    mean = np.einsum("fjab,j->ab", transforms[..., :3], share) / len(transforms)
    return max(_quarter_turns(), key=lambda turn: round(float((turn * mean).sum()), 6))


def _quarter_turns() -> list[np.ndarray]:
    """The 24 rotations that map axes to axes, the identity first, so that it wins ties."""
    signs = [np.diag(s) for s in product((1.0, -1.0), repeat=3)]
    turns = [sign @ np.eye(3)[list(order)] for order in permutations(range(3)) for sign in signs]
    return [turn for turn in turns if np.linalg.det(turn) > 0]


def _leaves_parent(parents: np.ndarray, joints: np.ndarray, transforms: np.ndarray, size: float) -> np.ndarray:
    """(J,) bool: the joint's offset in its parent's frame varies by more than DETACHED."""
    up = np.where(parents < 0, np.arange(len(parents)), parents)
    position = rigid.apply(transforms, joints)
    turned = np.swapaxes(transforms[:, up, :, :3], -1, -2)
    offset = (turned @ (position - position[:, up])[..., None])[..., 0]
    return np.abs(offset - offset.mean(0)).max((0, 2)) > DETACHED * size


def _prune(parents: np.ndarray, used: np.ndarray, *, drop_roots: bool) -> np.ndarray:
    """Joints that move skin or carry one that does. Changes `parents` of a dropped root's child to -1."""
    alive = np.ones(len(parents), bool)
    while True:
        children = np.bincount(parents[alive & (parents >= 0)], minlength=len(parents))
        idle = alive & ~used & ((children == 0) | (drop_roots & (parents < 0) & (children == 1)))
        if not idle.any():
            return np.flatnonzero(alive)
        alive &= ~idle
        parents[np.isin(parents, np.flatnonzero(idle))] = -1


def _roots(parents: np.ndarray) -> np.ndarray:
    """(J,) the root above each joint."""
    root = np.arange(len(parents))
    while (parents[root] >= 0).any():
        root = np.where(parents[root] >= 0, parents[root], root)
    return root


def _closest(
    waiting: list[int], root_of: np.ndarray, joined: np.ndarray, weights: np.ndarray, joints: np.ndarray
) -> tuple[int, int]:
    """The waiting tree that shares most skin with a joined joint, and that joint; without any, the nearest joint."""
    hosts = np.flatnonzero(joined)
    best = (-1.0, -np.inf, -1, -1)
    for root in waiting:
        own = weights[:, root_of == root].sum(1)
        shared = np.minimum(own[:, None], weights[:, hosts]).sum(0)
        near = -np.linalg.norm(joints[hosts] - joints[root], axis=1)
        pick = np.lexsort((near, shared))[-1]
        best = max(best, (float(shared[pick]), float(near[pick]), root, int(hosts[pick])))
    return best[2], best[3]


def _depth_first(parents: np.ndarray, kept: np.ndarray, root: int) -> np.ndarray:
    order, stack = [], [root]
    while stack:
        j = stack.pop()
        order.append(j)
        stack += [int(c) for c in kept[::-1] if parents[c] == j]
    return np.array(order)
