"""Overlapping parts of a skeleton and how much every bone follows each of them."""

from __future__ import annotations

from itertools import combinations
from typing import Annotated, Literal

import numpy as np

from tasks.errors import InputError
from tasks.motion.skeletons import carrying, model_root, subtree
from tasks.values import Parts, Skeleton, Skinning

LIMBS = 4  # the paper's five parts are a torso and four limbs
SIMILAR = 0.8  # limbs on one joint whose sizes differ by less are a pair


def find_parts(
    skeleton: Skeleton,
    skinning: Skinning,
    *,
    kind: Literal["auto", "whole", "named"],
    named: Annotated[
        list[str],
        "named or kind != 'named': one part or more, as 'arms=arm_l,arm_r', with kind=named",
        "not named or kind == 'named': nothing without kind=named",
    ],
    overlap: Annotated[int, "[0, inf)"],
    affinity: Annotated[float, "[0, 1)"],
) -> Parts:
    """Parts for partwise matching (GaussiAnimate 3.3 and 4.1: five overlapping parts, user-defined where wanted).

    kind: ``auto`` is a torso and the four largest limbs, ``whole`` one part with every joint (FullMM), ``named`` takes
    ``named``, a list of "part=joint,joint,..." with the names of ``skeleton``.
    overlap: how many joints of each limb, counted from its root, the torso shares (``auto`` only).
    affinity: a bone follows a part if at least this share of its skin weight (W^T S) lies on the part's joints; a bone
    that no part reaches goes to its best part. Columns of the returned affinity (P, B) sum to one.

    Joints that move no skin, such as helpers of an animator's rig, belong to no part. An automatic part without bones
    is dropped (its joints move nothing that the bones can show). Raises InputError for a named part without bones,
    unknown part or joint names, and joints that move skin but are in no part.
    """
    moves = carrying(skeleton)
    if kind == "whole":
        groups = {"whole": moves}
    elif kind == "named":
        groups = _named(skeleton, moves, named)
    else:
        groups = _automatic(skeleton, moves, overlap)
    names, joints = tuple(groups), np.stack(list(groups.values()))
    follows = _affinity(bone_affinity(skinning.weights, skeleton.weights), joints, affinity)
    empty = follows[:, skinning.weights.sum(0) > 0].sum(1) == 0
    if empty.any() and kind == "named":
        name = names[int(empty.argmax())]
        raise InputError(
            "parts.named", expected="bones in every part", found=f"none in '{name}'", do="merge it with its neighbour"
        )
    names = tuple(n for n, e in zip(names, empty, strict=True) if not e)
    joints, follows = joints[~empty], follows[~empty]
    roots = np.array([_part_root(skeleton, part) for part in joints], np.int32)
    return Parts(names=names, joints=joints, roots=roots, affinity=follows.astype(np.float32))


def bone_affinity(weights: np.ndarray, skin: np.ndarray) -> np.ndarray:
    """How much each free-form bone follows each joint: row-normalised W^T S.

    weights: (N, B) of the bones; skin: (N, J) of the skeleton -> (B, J), rows sum to one.
    """
    shared = weights.astype(np.float64).T @ skin
    return shared / np.maximum(shared.sum(1, keepdims=True), 1e-12)


def _affinity(of_joint: np.ndarray, joints: np.ndarray, threshold: float) -> np.ndarray:
    """(B, J) and (P, J) -> (P, B): shares below the threshold dropped, the best kept, columns summing to one."""
    share = joints.astype(np.float64) @ of_joint.T
    keep = (share >= threshold) & (share > 0) | (share == share.max(0))
    kept = np.where(keep, np.maximum(share, 1e-12), 0.0)
    return kept / kept.sum(0)


def _automatic(skeleton: Skeleton, moves: np.ndarray, overlap: int) -> dict[str, np.ndarray]:
    """Torso and limbs. A part is named after its root joint, so that a table can be read."""
    below = subtree(skeleton.parents)
    limbs = _limb_roots(skeleton, moves)
    depth = _depth(skeleton.parents)
    torso = moves.copy()
    for limb in limbs:
        torso &= ~(below[limb] & (depth >= depth[limb] + overlap))
    groups = {"torso": torso}
    for limb in limbs:
        groups[skeleton.names[limb]] = below[limb] & moves
    return groups


def _limb_roots(skeleton: Skeleton, moves: np.ndarray) -> list[int]:
    """Roots of at most four limbs, in joint order: the largest by the length of their bones, pairs kept together."""
    parents, below = np.asarray(skeleton.parents), subtree(skeleton.parents)
    up = np.where(parents < 0, np.arange(len(parents)), parents)
    length = np.linalg.norm(skeleton.joints - skeleton.joints[up], axis=1).astype(np.float64)
    size = below @ np.where(moves, length, 0.0)
    limbs = _disjoint_limbs(parents, below, size, moves, model_root(skeleton))
    units = _pairs(limbs, parents, size)
    chosen = max(
        (sum(some, ()) for n in range(len(units) + 1) for some in combinations(units, n)),
        key=lambda some: (len(some), size[list(some)].sum()) if len(some) <= LIMBS else (-1, 0.0),
    )
    return sorted(chosen)


def _disjoint_limbs(parents: np.ndarray, below: np.ndarray, size: np.ndarray, moves: np.ndarray, top: int) -> list[int]:
    """Disjoint subtrees, among them the four whose smallest is as large as it can be, each grown towards the root as
    long as it meets no other. Some smaller ones come along, so that a pair's second is there to be chosen."""
    inner = below[top] & moves & (np.arange(len(parents)) != top)
    sizes = np.unique(size[inner & (size > 0)])[::-1]
    ends, enough = np.zeros(0, int), 0.0
    for threshold in sizes:
        if threshold < enough:
            break
        large = inner & (size >= threshold)
        smallest = np.flatnonzero(large & ((below & large).sum(1) == 1))  # no other large subtree inside
        if len(smallest) > len(ends):
            ends = smallest
            if len(ends) >= LIMBS and not enough:
                enough = SIMILAR * threshold
    limbs = []
    for joint in ends:
        while parents[joint] != top and below[parents[joint], ends].sum() == 1:
            joint = parents[joint]
        limbs.append(int(joint))
    return limbs


def _pairs(limbs: list[int], parents: np.ndarray, size: np.ndarray) -> list[tuple[int, ...]]:
    """Limbs of similar size on one joint, such as two legs, as pairs, closest sizes first; the rest alone."""
    ratio = {
        (a, b): min(size[a], size[b]) / max(size[a], size[b])
        for a, b in combinations(limbs, 2)
        if parents[a] == parents[b]
    }
    left, units = set(limbs), []
    for a, b in sorted(ratio, key=lambda pair: -ratio[pair]):
        if ratio[a, b] >= SIMILAR and {a, b} <= left:
            units.append((a, b))
            left -= {a, b}
    return units + [(limb,) for limb in sorted(left)]


def _part_root(skeleton: Skeleton, part: np.ndarray) -> int:
    """The joint that a part is aligned about: the lowest one above all its joints, not above the model's root."""
    below = subtree(skeleton.parents)
    above = np.flatnonzero(below[:, part].all(1))
    lowest, top = int(above[-1]), model_root(skeleton)  # parents stand before children
    return top if below[lowest, top] else lowest


def _depth(parents: np.ndarray) -> np.ndarray:
    depth = np.zeros(len(parents), int)
    for j, p in enumerate(parents):
        depth[j] = 0 if p < 0 else depth[p] + 1
    return depth


def _named(skeleton: Skeleton, moves: np.ndarray, named: list[str]) -> dict[str, np.ndarray]:
    """The user's parts: "part=joint,joint"."""
    index = {name: j for j, name in enumerate(skeleton.names)}
    groups: dict[str, np.ndarray] = {}
    for entry in named:
        part, equals, members = entry.partition("=")
        chosen = [m.strip() for m in members.split(",") if m.strip()]
        if not equals or not part.strip() or not chosen:
            raise InputError("parts.named", expected='"part=joint,joint,..."', found=f'"{entry}"')
        if part.strip() in groups:
            raise InputError("parts.named", expected="every part once", found=f"'{part.strip()}' twice")
        unknown = [m for m in chosen if m not in index]
        if unknown:
            raise InputError(
                "parts.named",
                expected=f"joints of the skeleton ({', '.join(skeleton.names)})",
                found=f"'{unknown[0]}' in part '{part.strip()}'",
            )
        groups[part.strip()] = np.isin(np.arange(len(moves)), [index[m] for m in chosen])
    forgotten = moves & ~np.any(list(groups.values()), axis=0) & (skeleton.weights.sum(0) > 0)
    if forgotten.any():
        names = ", ".join(np.array(skeleton.names)[forgotten])
        raise InputError("parts.named", expected="every joint that moves skin in some part", found=f"missing {names}")
    return groups
