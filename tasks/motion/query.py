"""What is asked of poses before a method works on them."""

from __future__ import annotations

import numpy as np

from tasks.errors import InputError
from tasks.values import Poses, Skeleton

TOLERANCE = 1e-3  # largest entry of |R^T R - I|: float32 rotations that went through files stay far below it


def check_poses(poses: Poses, skeleton: Skeleton, where: str) -> None:
    """Raises InputError unless the poses fit the skeleton: joint count, shapes, finite numbers, true rotations."""
    frames, joints = len(poses.rotations), len(skeleton.parents)
    for name, array, shape in (
        ("rotations", poses.rotations, (frames, joints, 3, 3)),
        ("translations", poses.translations, (frames, joints, 3)),
    ):
        if array.shape != shape:
            raise InputError(
                f"{where}.{name}",
                expected=f"shape {shape}: the skeleton's {joints} joints in its order",
                found=f"shape {array.shape}",
                do="fit or retarget the poses to the skeleton that the database was built with",
            )
        bad = ~np.isfinite(array).reshape(frames, -1).all(1)
        if bad.any():
            raise InputError(f"{where}.{name}", expected="finite numbers", found=f"NaN or inf in frame {bad.argmax()}")
    r = poses.rotations.astype(np.float64)
    off = np.abs(np.swapaxes(r, -1, -2) @ r - np.eye(3)).max((-1, -2))
    wrong = (off > TOLERANCE) | (np.linalg.det(r) < 0)
    if wrong.any():
        f, j = np.argwhere(wrong)[0]
        at = f"frame {f}, joint {skeleton.names[j]}"
        raise InputError(
            f"{where}.rotations",
            expected="rotation matrices (R^T R = I, determinant +1)",
            found=f"|R^T R - I| = {off[f, j]:.3g}, determinant {np.linalg.det(r[f, j]):.3g} at {at}",
            do="project them to the nearest rotations first",
        )
    if poses.clip_start[0] != 0 or poses.clip_start[-1] != frames or np.any(np.diff(poses.clip_start) <= 0):
        raise InputError(f"{where}.clip_start", expected=f"rising from 0 to {frames}", found=str(poses.clip_start))
