"""Sums over points that turn every later sum over a skinned mesh into algebra of the size of the skeleton.

With homogeneous canonical points h and weights w, the error of linear blend skinning under transforms T is

    E_f = sum_n |sum_j w_nj T_fj h_n - x_fn|^2 = sum_jk <T_fj K_jk, T_fk> - 2 sum_j <T_fj, Y_fj^T> + xx_f

so once K, Y and xx are known, no point has to be touched again (as SSDR does for its bones, Le & Deng 2012).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tasks.geometry import rigid
from tasks.geometry.parallel import for_chunks
from tasks.geometry.rotations import project_so3

CHUNK = 4096


@dataclass(frozen=True)
class Moments:
    """K: (J, J, 4, 4) = sum_n w_nj w_nk h h^T; Y: (F, J, 4, 3) = sum_n w_nj h x_f^T; xx: (F,) = sum_n |x_f|^2;
    mass: (J, 4) = sum_n w_nj h; count: N. All float64."""

    K: np.ndarray
    Y: np.ndarray
    xx: np.ndarray
    mass: np.ndarray
    count: int


def homogeneous(points: np.ndarray) -> np.ndarray:
    """(N, 3) -> (N, 4) float64 with a last column of ones."""
    return np.concatenate([points, np.ones((len(points), 1))], axis=1, dtype=np.float64)


def skin_moments(rest: np.ndarray, weights: np.ndarray, points: np.ndarray) -> Moments:
    """rest: (N, 3); weights: (N, J); points: (F, N, 3) -> :class:`Moments`."""
    frames, count, joints = len(points), len(rest), weights.shape[1]
    h = homogeneous(rest)

    def part(a: int, b: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        z = (weights[a:b, :, None].astype(np.float64) * h[a:b, None]).reshape(b - a, 4 * joints)
        x = points[:, a:b].astype(np.float64).transpose(1, 0, 2).reshape(b - a, 3 * frames)
        return z.T @ z, z.T @ x, (x * x).reshape(b - a, frames, 3).sum((0, 2)), z.sum(0)

    k, y, xx, mass = (sum(parts) for parts in zip(*for_chunks(part, count, CHUNK), strict=True))
    return Moments(
        K=np.ascontiguousarray(k.reshape(joints, 4, joints, 4).transpose(0, 2, 1, 3)),
        Y=np.ascontiguousarray(y.reshape(joints, 4, frames, 3).transpose(2, 0, 1, 3)),
        xx=xx,
        mass=mass.reshape(joints, 4),
        count=count,
    )


def skin_error(moments: Moments, transforms: np.ndarray) -> np.ndarray:
    """Sum of squared distances per frame. transforms: (F, J, 3, 4) -> (F,) float64, never negative."""
    t = transforms.astype(np.float64)
    joints = t.shape[1]
    rows = t.transpose(0, 2, 1, 3).reshape(len(t), 3, 4 * joints)  # (F, 3, 4J)
    k = moments.K.transpose(0, 2, 1, 3).reshape(4 * joints, 4 * joints)
    y = moments.Y.reshape(len(t), 4 * joints, 3)
    quadratic = np.einsum("fiq,fiq->f", rows @ k, rows)
    linear = np.einsum("fiq,fqi->f", rows, y)
    return np.maximum(quadratic - 2.0 * linear + moments.xx, 0.0)


def fit_rigid(moments: Moments, transforms: np.ndarray, sweeps: int) -> np.ndarray:
    """Rigid transforms that lower the skinning error, one after the other in closed form, the others held (Le & Deng
    2012, eq. 8-13: weighted Procrustes on the residual). transforms: (F, J, 3, 4) -> (F, J, 3, 4) float64."""
    frames, count = transforms.shape[:2]
    rows = transforms.astype(np.float64).transpose(0, 2, 1, 3).reshape(3 * frames, 4 * count)
    k = moments.K.transpose(0, 2, 1, 3).reshape(4 * count, 4 * count)
    for _ in range(sweeps):
        for j in range(count):
            weight = moments.K[j, j, 3, 3]
            if weight < 1e-9:  # no point follows this transform: nothing to fit
                continue
            own = slice(4 * j, 4 * j + 4)
            others = (rows @ k[:, own] - rows[:, own] @ k[own, own]).reshape(frames, 3, 4)
            target = np.swapaxes(moments.Y[:, j], -1, -2) - others  # (F, 3, 4) = sum_n w_j (x - the others' part) h^T
            centre = moments.K[j, j, :3, 3] / weight
            r = project_so3(target[..., :3] - target[..., 3:] * centre)
            rows[:, own] = rigid.make(r, target[..., 3] / weight - r @ centre).reshape(3 * frames, 4)
    return rows.reshape(frames, 3, count, 4).transpose(0, 2, 1, 3)
