"""The skeleton and poses that came with the data (SMPL, Mixamo, glTF), used as given."""

from __future__ import annotations

from tasks.errors import InputError
from tasks.values import Canonical, Motion, Poses, Rig, Skeleton


def given_skeleton(train: Motion, canonical: Canonical) -> Skeleton:
    """The data's own tree, rest joints and skin weights. Raises InputError where the data brings none, or where the
    canonical shape is not the rest shape that they are defined on."""
    rig = _rig(train)
    if canonical.frame != -1:
        raise InputError(
            "skeleton",
            expected="the data's rest shape as canonical shape",
            found=f"training frame {canonical.frame}",
            do="set skeleton.canonical=rest",
        )
    return Skeleton(rig.names, rig.parents, rig.joints, rig.weights)


def given_poses(motion: Motion, canonical: Canonical, skeleton: Skeleton) -> Poses:
    """The data's own rotations and translations, frame by frame. Raises InputError where the data brings none or
    where they belong to another skeleton."""
    rig = _rig(motion)
    if rig.names != skeleton.names or rig.rotations.shape[1] != len(skeleton.parents):
        found = f"{len(rig.names)} joints of the data's own"
        raise InputError("poses", expected=f"the skeleton's {len(skeleton.names)} joints", found=found)
    return Poses(rig.rotations, rig.translations, motion.clip_start)


def _rig(motion: Motion) -> Rig:
    if motion.rig is None:
        raise InputError(
            f"dataset {motion.name}",
            expected="a skeleton that comes with the data",
            found="none",
            do="choose skeleton=curve, which estimates one",
        )
    return motion.rig
