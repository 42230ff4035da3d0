"""Skin weights of a given skeleton, fitted to training frames."""

from __future__ import annotations

import numpy as np
from numba import njit

from tasks.geometry.parallel import for_chunks

POINT_CHUNK = 256
STEPS = 500


def fit_weights(
    points: np.ndarray, rest: np.ndarray, transforms: np.ndarray, start: np.ndarray, *, influences: int, keep: float
) -> np.ndarray:
    """Weights w >= 0, sum w = 1, at most ``influences`` non-zeros, that bring the skinned rest shape closest to points.

    points: (F, N, 3); rest: (N, 3); transforms: (F, J, 3, 4); start: (N, J) weights to stay near where the frames do
    not tell, keep: how near, as a share of the mean curvature of the point's problem -> (N, J) float32.

    |sum_j w_j T_fj v - x_f|^2 summed over frames is w^T G w - 2 b^T w per point, where G needs the frames only through
    sum_f T_fj^T T_fk: its cost does not grow with the points. Solved by projected gradient onto the simplex, then
    again on the largest ``influences``. All is seen from the shape's centre, for G, and with it the pull to ``start``,
    would grow with the distance from the origin.
    """
    frames, joints = transforms.shape[:2]
    centre = rest.mean(0, dtype=np.float64)
    rest, points, transforms = rest - centre, points - centre, transforms.astype(np.float64)
    transforms[..., 3] += transforms[..., :3] @ centre - centre
    flat = transforms.transpose(0, 2, 1, 3).reshape(frames * 3, joints * 4)
    pairs = (flat.T @ flat).reshape(joints, 4, joints, 4)
    targets = (flat.T @ points.astype(np.float64).transpose(0, 2, 1).reshape(frames * 3, -1)).reshape(joints, 4, -1)
    homogeneous = np.concatenate([rest, np.ones((len(rest), 1))], axis=1).astype(np.float64)
    first = start.astype(np.float64)
    out = np.empty_like(first)

    def work(a: int, b: int) -> None:
        v = homogeneous[a:b]
        gram = np.einsum("na,jakb,nb->njk", v, pairs, v, optimize=True)
        linear = np.einsum("na,jan->nj", v, targets[:, :, a:b])
        stay = keep * np.trace(gram, axis1=1, axis2=2) / joints
        gram[:, np.arange(joints), np.arange(joints)] += stay[:, None]
        linear += stay[:, None] * first[a:b]
        w = first[a:b].copy()
        _descend(gram, linear, np.ones_like(w, bool), w)
        cut = np.sort(w, axis=1)[:, -min(influences, joints), None]
        allowed = (w >= cut) & (w > 0)
        w = np.where(allowed, w, 0.0)
        w /= w.sum(1, keepdims=True)
        _descend(gram, linear, allowed, w)
        out[a:b] = w

    for_chunks(work, len(rest), POINT_CHUNK)
    return out.astype(np.float32)


@njit(cache=True, nogil=True)
def _descend(gram, linear, allowed, weights):
    """Accelerated projected gradient (Beck and Teboulle 2009) on each point's simplex of allowed joints, in place."""
    joints = gram.shape[1]
    gradient, ahead, fresh = np.empty(joints), np.empty(joints), np.empty(joints)
    for n in range(len(gram)):
        bound = 0.0
        for r in range(joints):
            bound = max(bound, np.abs(gram[n, r]).sum())
        if not bound > 0.0:
            continue
        ahead[:] = weights[n]
        speed = 1.0
        for _ in range(STEPS):
            for r in range(joints):
                total = -linear[n, r]
                for c in range(joints):
                    total += gram[n, r, c] * ahead[c]
                gradient[r] = total
            for r in range(joints):
                fresh[r] = ahead[r] - gradient[r] / bound if allowed[n, r] else -1e30
            _onto_simplex(fresh)
            faster = 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * speed * speed))
            moved = 0.0
            for r in range(joints):
                step = fresh[r] - weights[n, r]
                moved = max(moved, abs(step))
                ahead[r] = fresh[r] + (speed - 1.0) / faster * step
                weights[n, r] = fresh[r]
            speed = faster
            if moved < 1e-7:
                break


@njit(cache=True, nogil=True)
def _onto_simplex(w):
    """The nearest point with w >= 0 and sum w = 1, in place (Duchi et al. 2008)."""
    order = np.sort(w)[::-1]
    total, level = 0.0, 0.0
    for i in range(len(order)):
        total += order[i]
        candidate = (total - 1.0) / (i + 1)
        if order[i] > candidate:
            level = candidate
    for i in range(len(w)):
        w[i] = max(w[i] - level, 0.0)
