"""The skeleton and poses that came with the data (SMPL, Mixamo, glTF), used as given."""

from __future__ import annotations

import numpy as np

from tasks.errors import InputError
from tasks.geometry import kinematics
from tasks.geometry.measure import diagonal, vertex_rmse
from tasks.geometry.rebase import rebased
from tasks.geometry.sparse_weights import fit_weights
from tasks.values import Canonical, Motion, Poses, Rig, Skeleton

INFLUENCES = 4  # joints a point may follow, as SMPL has it
EXCHANGES = 8  # tries to replace one of them by a better one
RESEMBLES = 0.03  # of the diagonal: a shape no further from a frame, point by point, is that frame


def given_skeleton(train: Motion, canonical: Canonical) -> Skeleton:
    """The data's own tree and skin weights, its joints where they are in the canonical shape: at rest, or in the
    training frame that was chosen.

    Where the data's skeleton comes without weights, since no mesh belongs to it (joint rotations beside images), they
    are fitted to how the points move in the training frames: the sparse convex weights with which the joints' own
    transforms follow best (Le & Deng 2012, eq. 3). A rest shape then counts as posed like the training frame that it
    resembles, if it does (Gaussians at rest lie as in their reference frame), else like the skeleton at rest. Raises
    InputError where the data brings no skeleton.
    """
    rig = _at(_rig(train), train, canonical)
    weights = rig.weights if len(rig.weights) else _fitted_weights(rig, train, canonical)
    return Skeleton(rig.names, rig.parents, rig.joints, weights)


def _fitted_weights(rig: Rig, train: Motion, canonical: Canonical) -> np.ndarray:
    joints = kinematics.forward(rig.parents, rig.joints, rig.rotations, rig.translations)
    return fit_weights(canonical.points, train.points, joints, influences=INFLUENCES, exchanges=EXCHANGES)


def given_poses(motion: Motion, train: Motion, canonical: Canonical, skeleton: Skeleton) -> Poses:
    """The data's own rotations and translations from the canonical pose on, frame by frame. Raises InputError where
    the data brings none or where they belong to another skeleton."""
    rig = _rig(motion)
    if rig.names != skeleton.names or rig.rotations.shape[1] != len(skeleton.parents):
        found = f"{len(rig.names)} joints of the data's own"
        raise InputError("poses", expected=f"the skeleton's {len(skeleton.names)} joints", found=found)
    rig = _at(rig, train, canonical)
    return Poses(rig.rotations, rig.translations, motion.clip_start)


def _at(rig: Rig, train: Motion, canonical: Canonical) -> Rig:
    """The rig from the canonical pose on."""
    frame = canonical.frame if canonical.frame >= 0 or len(rig.weights) else _resembled(train, canonical)
    return rig if frame < 0 else rebased(rig, _rig(train), frame)


def _resembled(train: Motion, canonical: Canonical) -> int:
    """The training frame that the canonical shape is, or -1."""
    apart = [vertex_rmse(frame[None], canonical.points[None]) for frame in train.points]
    nearest = int(np.argmin(apart))
    return nearest if apart[nearest] < RESEMBLES * diagonal(canonical.points) else -1


def _rig(motion: Motion) -> Rig:
    if motion.rig is None:
        raise InputError(
            f"dataset {motion.name}",
            expected="a skeleton that comes with the data",
            found="none",
            do="choose skeleton=curve, which estimates one",
        )
    return motion.rig
