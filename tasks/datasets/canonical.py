"""The shape that bones and skeleton are defined on."""

from __future__ import annotations

from typing import Literal

import numpy as np

from tasks.errors import InputError
from tasks.geometry.neighbours import mesh_edges, nearest_edges
from tasks.values import Canonical, Motion

NEAREST = 10  # neighbours a point whose distances stand for edges where there are no faces


def canonical(train: Motion, *, choice: Literal["first", "middle", "least_deformed", "rest"]) -> Canonical:
    """Picks the canonical shape from the training frames.

    first, middle: that training frame. least_deformed: the frame f that minimises sum_g sum_e (l_e(f) - l_e(g))^2, the
    summed squared change of edge lengths l to all other training frames g (for bare points, of the distances to the ten
    nearest points of the first frame). rest: the data's own rest shape; InputError where it has none.
    """
    if choice == "rest":
        if train.rest is None:
            raise InputError(
                "canonical",
                expected="a dataset with a rest shape",
                found=f"{train.name}, which has none",
                do="choose first, middle or least_deformed",
            )
        return Canonical(np.asarray(train.rest, np.float32), train.faces, -1, "rest shape of the data")
    frame = {"first": 0, "middle": train.frames // 2}.get(choice)
    if frame is None:
        frame = least_deformed(train)
    return Canonical(np.array(train.points[frame], np.float32), train.faces, frame, f"{choice}, training frame {frame}")


def least_deformed(train: Motion) -> int:
    """The frame whose edge lengths change least towards all others.

    Since sum_g (l(f) - l(g))^2 = F (l(f) - mean l)^2 + const, it is the frame nearest to the mean lengths.
    """
    edges = nearest_edges(train.points[0], NEAREST) if train.faces is None else mesh_edges(train.faces)
    lengths = np.empty((train.frames, len(edges)), np.float32)
    for f, x in enumerate(train.points):
        lengths[f] = np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1)
    mean = lengths.mean(0, dtype=np.float64)
    return int(np.argmin([np.sum((row - mean) ** 2) for row in lengths]))
