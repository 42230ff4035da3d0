"""What binding asks of a kinematic tree."""

from __future__ import annotations

import numpy as np

from tasks.values import Skeleton


def subtree(parents: np.ndarray) -> np.ndarray:
    """(J, J) bool: [a, b] is true where joint b is a or stands below it."""
    below = np.eye(len(parents), dtype=bool)
    for j in range(len(parents) - 1, 0, -1):
        below[parents[j]] |= below[j]
    return below


def carrying(skeleton: Skeleton) -> np.ndarray:
    """(J,) bool: the joint or one below it moves skin. Helper joints of an animator's rig do not."""
    return (subtree(skeleton.parents) & (skeleton.weights.sum(0) > 0)).any(1)


def model_root(skeleton: Skeleton) -> int:
    """The joint whose frame is the model's: below it lies all the skin, and it moves some or branches.

    That is joint 0 in most skeletons; rigs that hang a character under a still "armature" joint have it further down.
    """
    moves, own = carrying(skeleton), skeleton.weights.sum(0) > 0
    joint = 0
    while not own[joint]:
        children = np.flatnonzero((np.asarray(skeleton.parents) == joint) & moves)
        if len(children) != 1:
            break
        joint = int(children[0])
    return joint
