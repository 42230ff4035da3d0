"""Linear blend skinning."""

from __future__ import annotations

import numpy as np


def skin(rest: np.ndarray, weights: np.ndarray, transforms: np.ndarray) -> np.ndarray:
    """x_fn = sum_b w_nb T_fb v_n. rest: (N, 3); weights: (N, B); transforms: (F, B, 3, 4) -> (F, N, 3) float32.

    Blends matrices with one product over bones per frame, so memory stays at one frame's blended transforms.
    """
    weights = np.ascontiguousarray(weights, np.float32)
    homogeneous = np.concatenate([rest, np.ones((len(rest), 1))], axis=1).astype(np.float32)  # (N, 4)
    out = np.empty((len(transforms), len(rest), 3), np.float32)
    for f, t in enumerate(transforms.astype(np.float32, copy=False)):
        blended = (weights @ t.reshape(len(t), 12)).reshape(-1, 3, 4)
        np.einsum("nij,nj->ni", blended, homogeneous, out=out[f])
    return out
