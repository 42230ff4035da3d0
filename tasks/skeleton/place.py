"""A shape brought near the origin before joints are looked for.

Bones are extrapolated as a turn about the origin and a shift, each by itself: far from the origin a small turn is a
long way, and the two no longer go together.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tasks.geometry.measure import diagonal
from tasks.values import Canonical, Curve, Motion, Skinning, Surface

FAR = 2.0  # diagonals: shapes whose centroid lies nearer to the origin are left where they are


def near_origin(
    train: Motion, canonical: Canonical, skinning: Skinning, surface: Surface, curve: Curve
) -> tuple[Motion, Canonical, Skinning, Surface, Curve, np.ndarray]:
    """All of them moved so that the canonical shape's centroid is the origin, where it lies far off; and where the
    origin of the moved ones was before, (3,) float32, to be added to every place found among them."""
    centroid = canonical.points.mean(axis=0, dtype=np.float64)
    if np.linalg.norm(centroid) <= FAR * diagonal(canonical.points):
        return train, canonical, skinning, surface, curve, np.zeros(3, np.float32)
    origin = centroid.astype(np.float32)
    moved = skinning.transforms.astype(np.float64)
    moved[..., 3] += moved[..., :3] @ origin.astype(np.float64) - origin
    return (
        replace(train, points=train.points - origin),
        replace(canonical, points=canonical.points - origin),
        replace(skinning, rest=skinning.rest - origin, transforms=moved.astype(np.float32)),
        replace(surface, vertices=surface.vertices - origin),
        replace(curve, nodes=curve.nodes - origin),
        origin,
    )
