"""A rig seen from one of its own poses: that pose becomes its rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tasks.geometry import kinematics, rigid
from tasks.values import Rig


def rebased(rig: Rig, at: Rig, frame: int) -> Rig:
    """The rig with pose ``frame`` of ``at`` as its rest: the same world transforms, taken from that pose on.

    at: the same tree, perhaps with other frames (training frames, where rig holds unseen ones).
    joints become their positions in that pose; rotations (F, J, 3, 3) and translations (F, J, 3) the way from it.
    """
    pose = slice(frame, frame + 1)
    start = kinematics.forward(at.parents, at.joints, at.rotations[pose], at.translations[pose]).astype(np.float64)
    joints = kinematics.joint_positions(start, at.joints)[0]
    world = kinematics.forward(rig.parents, rig.joints, rig.rotations, rig.translations)
    moved = rigid.compose(world.astype(np.float64), rigid.inverse(start))
    rotations, translations = kinematics.local_poses(rig.parents, joints, moved)
    parts = {"joints": joints, "rotations": rotations, "translations": translations}
    return replace(rig, **{name: value.astype(np.float32) for name, value in parts.items()})
