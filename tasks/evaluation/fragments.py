"""How torn the skin weights of the bones are: what fig. 8 of the paper shows in pictures."""

from __future__ import annotations

import numpy as np

from tasks.geometry.neighbours import components, mesh_edges, nearest_edges
from tasks.values import Canonical, Skinning

HELD = 0.25  # weight from which a point belongs to a bone
NEIGHBOURS = 10  # of a bare point


def bone_fragments(canonical: Canonical, skinning: Skinning) -> float:
    """Mean number of connected pieces of the points that a bone holds by at least a quarter; 1 is a bone in one piece.

    Neighbours are mesh edges or, for bare points, the ten nearest at rest. Bones that hold nothing do not count.
    """
    points, faces = canonical.points, canonical.faces
    edges = nearest_edges(points, NEIGHBOURS) if faces is None else mesh_edges(faces)
    pieces = []
    for weight in skinning.weights.T:
        held = weight >= HELD
        if held.any():
            inside = np.full(len(points), -1)
            inside[held] = np.arange(held.sum())
            kept = inside[edges]
            pieces.append(components(kept[(kept >= 0).all(1)], int(held.sum()))[0])
    return float(np.mean(pieces)) if pieces else 0.0
