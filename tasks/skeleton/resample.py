"""A curve resampled evenly, branch by branch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Branch:
    """One branch of a curve between two nodes that are not of degree two. ends: (2,) their node numbers; points:
    (S, 3) evenly spaced, both ends included; weights: (S, B) at them; spacing: distance along the branch."""

    ends: tuple[int, int]
    points: np.ndarray
    weights: np.ndarray
    spacing: float


def branch_paths(edges: np.ndarray, count: int) -> list[list[int]]:
    """Node numbers along every branch, from one leaf or junction to the next. edges: (E, 2) of a forest."""
    near: list[list[int]] = [[] for _ in range(count)]
    for a, b in edges.tolist():
        near[a].append(b)
        near[b].append(a)
    ends = [v for v in range(count) if len(near[v]) not in (0, 2)]
    paths = []
    for start in ends:
        for step in near[start]:
            path = [start, step]
            while len(near[path[-1]]) == 2:
                a, b = near[path[-1]]
                path.append(b if a == path[-2] else a)
            if path[-1] > start:
                paths.append(path)
    return paths


def resample(nodes: np.ndarray, edges: np.ndarray, weights: np.ndarray, spacing: float) -> list[Branch]:
    """Every branch with points ``spacing`` apart (as near to it as divides the branch's length), weights interpolated
    along it. nodes: (M, 3); edges: (E, 2); weights: (M, B)."""
    branches = []
    for path in branch_paths(edges, len(nodes)):
        points = nodes[path].astype(np.float64)
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        steps = max(1, round(along[-1] / spacing))
        s = np.linspace(0.0, along[-1], steps + 1)
        values = np.concatenate([points, weights[path]], axis=1)
        at = np.clip(np.searchsorted(along, s, side="right") - 1, 0, len(path) - 2)
        t = ((s - along[at]) / np.maximum(np.diff(along)[at], 1e-300))[:, None]
        mixed = (1.0 - t) * values[at] + t * values[at + 1]
        branches.append(Branch((path[0], path[-1]), mixed[:, :3], mixed[:, 3:], along[-1] / steps))
    return branches
