"""What loose cloth and soft tissue answer to beside the pose: how the model is tilted and how it moves."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from tasks.geometry.rotations import to_rotation_vector


def root_dynamics(root: np.ndarray, pivot: np.ndarray, clip_start: np.ndarray, fps: float) -> np.ndarray:
    """Gravity, velocity, acceleration and angular velocity of the model's root, in the root's own axes.

    root: (F, 3, 4) transform of the root joint on canonical points; pivot: (3,) the joint's canonical position
    -> (F, 4, 3) float64: unit vector up, unit/s, unit/s^2, rad/s. Differences never reach over a clip's end.
    """
    rotation = root[:, :, :3].astype(np.float64)
    position = rotation @ pivot + root[:, :, 3]
    out = np.zeros((len(root), 4, 3))
    for a, b in pairwise(clip_start):
        to_local = np.swapaxes(rotation[a:b], -1, -2)
        out[a:b, 0] = to_local[:, :, 1]
        if b - a < 2:
            continue
        velocity = np.gradient(position[a:b], axis=0) * fps
        turn = to_rotation_vector(to_local[:-1] @ rotation[a + 1 : b]) * fps  # between neighbouring frames
        out[a:b, 1] = (to_local @ velocity[..., None])[..., 0]
        out[a:b, 2] = (to_local @ (np.gradient(velocity, axis=0) * fps)[..., None])[..., 0]
        out[a:b, 3] = (np.concatenate([turn[:1], turn]) + np.concatenate([turn, turn[-1:]])) / 2
    return out
