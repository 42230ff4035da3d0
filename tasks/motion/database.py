"""The motion database: what is matched (poses of the inner skeleton) beside what is returned (free-form bones)."""

from __future__ import annotations

import numpy as np

from tasks.errors import InputError
from tasks.values import Database, Motion, Poses, Skinning


def build_database(train: Motion, skinning: Skinning, poses: Poses) -> Database:
    """Pairs the training poses with the training bones, frame by frame (GaussiAnimate 3.3, eq. 7).

    Windows of p frames are not copied out: the search cuts them from the frames, inside the clips of ``train``.
    Raises InputError where frames or clips of the three do not agree.
    """
    for where, found in (("skinning.transforms", len(skinning.transforms)), ("poses.rotations", len(poses.rotations))):
        if found != train.frames:
            raise InputError(where, expected=f"the {train.frames} training frames", found=f"{found} frames")
    if not np.array_equal(poses.clip_start, train.clip_start):
        raise InputError(
            "poses.clip_start", expected=str(train.clip_start.tolist()), found=str(poses.clip_start.tolist())
        )
    return Database(poses=poses, bones=np.ascontiguousarray(skinning.transforms, np.float32), fps=float(train.fps))
