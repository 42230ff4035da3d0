"""An estimated skeleton against a true one: the measures of RigNet's evaluation (Xu et al. 2020, section 6.2).

Joints are matched one to one so that the summed distance is least (Hungarian); a match counts when it is nearer than a
share of the shape's diagonal. What RigNet and its followers print as "IoU", 2 hits / (estimated + true), is the F1
score, and is called so here.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from tasks.errors import InputError
from tasks.geometry.rotations import geodesic
from tasks.values import Rig

NEAR, NEARER = 0.05, 0.025  # a match counts within these shares of the diagonal
_BONE_SAMPLES = 0.005  # spacing of points along bones, as a share of the diagonal
_OWNS = 0.5  # a joint moves skin when it outweighs all others together somewhere


def counting_joints(rig: Rig, degrees: float) -> tuple[np.ndarray, np.ndarray]:
    """The joints that motion can reveal: they move skin and somewhere turn more than ``degrees`` from the parent.
    Where the rig has no skin weights, all count that turn.

    Returns positions (K, 3) and parents (K,): the nearest ancestor that counts, or -1.
    """
    identity = np.eye(3, dtype=rig.rotations.dtype)
    turn = np.degrees(geodesic(rig.rotations, identity).max(axis=0))
    counts = turn > degrees
    if len(rig.weights):
        counts &= rig.weights.max(axis=0) > _OWNS
    keep = np.flatnonzero(counts)
    new = np.full(len(counts), -1)
    new[keep] = np.arange(len(keep))
    above = _ancestors(rig.parents, counts)[keep]
    return rig.joints[keep], np.where(above < 0, -1, new[above])


def joint_scores(
    joints: np.ndarray, parents: np.ndarray, true_joints: np.ndarray, true_parents: np.ndarray, diagonal: float
) -> dict[str, float]:
    """All measures of one estimate; parents are -1 for roots (several are allowed). Positions (J, 3) and (K, 3).

    precision, recall, f1 within 5 % of ``diagonal``, the same with suffix ``_fine`` within 2.5 %; link_f1: F1 of the
    undirected links between a matched joint and its nearest matched ancestor (1.0 where neither side has a link);
    j2j, j2b, b2b: Chamfer distances joint to joint, joint to bone and bone to bone in % of the diagonal, each the
    mean of both directions.
    """
    if len(joints) == 0 or len(true_joints) == 0:
        found = f"{len(joints)} and {len(true_joints)}"
        raise InputError("joint scores", expected="at least one estimated and one true joint", found=found)
    rows, columns, distance = match(joints, true_joints)
    scores: dict[str, float] = {}
    for suffix, share in (("", NEAR), ("_fine", NEARER)):
        hits = int(np.sum(distance <= share * diagonal))
        scores["precision" + suffix] = hits / len(joints)
        scores["recall" + suffix] = hits / len(true_joints)
        scores["f1" + suffix] = 2.0 * hits / (len(joints) + len(true_joints))
    near = distance <= NEAR * diagonal
    scores["link_f1"] = link_f1(parents, true_parents, rows[near], columns[near])
    bones, true_bones = (
        sample_bones(j, p, _BONE_SAMPLES * diagonal) for j, p in ((joints, parents), (true_joints, true_parents))
    )
    percent = 100.0 / diagonal
    scores["j2j"] = percent * 0.5 * (one_way(joints, true_joints) + one_way(true_joints, joints))
    scores["j2b"] = percent * 0.5 * (one_way(joints, true_bones) + one_way(true_joints, bones))
    scores["b2b"] = percent * 0.5 * (one_way(bones, true_bones) + one_way(true_bones, bones))
    return scores


def match(joints: np.ndarray, true_joints: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One-to-one matching of least summed distance: estimated index, true index, distance; min(J, K) of each."""
    cost = np.linalg.norm(joints[:, None].astype(np.float64) - true_joints[None], axis=-1)
    rows, columns = linear_sum_assignment(cost)
    return rows, columns, cost[rows, columns]


def link_f1(parents: np.ndarray, true_parents: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> float:
    """F1 of parent links among matched joints: row r of the estimate is joint c of the truth. Links are undirected,
    since where the root lies is a convention; joints without a partner are skipped on the way up."""
    to_true = np.full(len(parents), -1)
    to_true[rows] = columns
    matched = np.zeros(len(true_parents), bool)
    matched[columns] = True
    up, true_up = _ancestors(parents, to_true >= 0), _ancestors(true_parents, matched)
    links = {frozenset((int(to_true[r]), int(to_true[up[r]]))) for r in rows if up[r] >= 0}
    true_links = {frozenset((int(c), int(true_up[c]))) for c in columns if true_up[c] >= 0}
    if not links and not true_links:
        return 1.0
    return 2.0 * len(links & true_links) / (len(links) + len(true_links))


def sample_bones(joints: np.ndarray, parents: np.ndarray, spacing: float) -> np.ndarray:
    """Points every ``spacing`` or closer along the segments joint - parent, ends included; joints alone where no bone
    is. -> (S, 3)."""
    points = [joints.astype(np.float64)]
    for j, p in enumerate(parents):
        if p >= 0:
            steps = max(1, int(np.ceil(np.linalg.norm(joints[j] - joints[p]) / spacing)))
            t = np.linspace(0.0, 1.0, steps + 1)[1:-1, None]
            points.append((1.0 - t) * joints[p] + t * joints[j])
    return np.concatenate(points)


def one_way(a: np.ndarray, b: np.ndarray) -> float:
    """Mean distance from each of a to the nearest of b."""
    return float(cKDTree(b).query(a)[0].mean())


def _ancestors(parents: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """(J,) nearest proper ancestor that is wanted, or -1; parents need not stand before their children."""
    out = np.full(len(parents), -1)
    for j in range(len(parents)):
        p = parents[j]
        while p >= 0 and not wanted[p]:
            p = parents[p]
        out[j] = p
    return out
