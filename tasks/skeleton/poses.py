"""Poses of a fixed skeleton from observed points: inverse kinematics (GA eq. 6)."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from tasks.errors import InputError
from tasks.geometry import kinematics
from tasks.geometry.moments import skin_moments
from tasks.skeleton.inverse_kinematics import solve_poses, transforms_of, warm_start
from tasks.values import Canonical, Motion, Poses, Skeleton


def fit_poses(
    motion: Motion,
    canonical: Canonical,
    skeleton: Skeleton,
    *,
    steps: Annotated[int, "[0, inf)"],
    damping: Annotated[float, "[0, inf)"],
    stiffness: Annotated[float, "[0, inf)"],
) -> Poses:
    """Local rotations and root translation per frame that bring the skinned canonical shape onto the points.

    GA eq. 6 with two changes: the root's translation is solved too (the paper omits it), and the Chamfer term to a
    curve skeleton per frame is left out: with a surface observed point by point it adds no information, and a curve
    skeleton of every frame would cost F times the most expensive part of this stage. Frames are independent, so the
    same call poses training frames and, as a query, test frames. Joints do not stretch: ``translations`` is zero but
    for the root's. Gauss-Newton from a Procrustes start; see :mod:`tasks.skeleton.inverse_kinematics`.

    steps: Gauss-Newton steps; damping: Levenberg-Marquardt term as a share of each joint's own second moment;
    stiffness: how strongly a segment whose own points leave its turn open starts from its parent's.
    Raises InputError where motion, canonical and skeleton differ in their number of points.
    """
    count = len(canonical.points)
    if motion.points.shape[1] != count or len(skeleton.weights) != count:
        found = f"motion {motion.points.shape[1]}, weights {len(skeleton.weights)}"
        raise InputError("poses", expected=f"{count} points as in the canonical shape", found=found)
    origin = canonical.points.mean(0, dtype=np.float64)  # near the origin, second moments keep their digits
    parents, joints = np.asarray(skeleton.parents), skeleton.joints - origin
    moments = skin_moments(canonical.points - origin, skeleton.weights, motion.points - origin.astype(np.float32))
    world, root = warm_start(parents, joints, moments, stiffness)
    world, root = solve_poses(parents, joints, moments, world, root, steps=steps, damping=damping)
    rotations, translations = kinematics.local_poses(parents, joints, transforms_of(parents, joints, world, root))
    translations[:, 1:] = 0.0  # rounding only: the tree does not stretch
    return Poses(rotations.astype(np.float32), translations.astype(np.float32), motion.clip_start)
