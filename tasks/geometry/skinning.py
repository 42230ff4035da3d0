"""Linear blend skinning."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix


def skin(rest: np.ndarray, weights: np.ndarray, transforms: np.ndarray) -> np.ndarray:
    """x_fn = sum_b w_nb T_fb v_n. rest: (N, 3); weights: (N, B); transforms: (F, B, 3, 4) -> (F, N, 3) float32.

    Weights are mostly zeros, so the blended matrices are a sparse product, frame by frame; unlike a dense one it adds
    in one order whatever the number of threads.
    """
    sparse = csr_matrix(np.asarray(weights, np.float64))
    homogeneous = np.concatenate([rest, np.ones((len(rest), 1))], axis=1)  # (N, 4)
    out = np.empty((len(transforms), len(rest), 3), np.float32)
    for f, t in enumerate(transforms):
        blended = (sparse @ t.reshape(len(t), 12).astype(np.float64)).reshape(-1, 3, 4)
        out[f] = np.einsum("nij,nj->ni", blended, homogeneous)
    return out
