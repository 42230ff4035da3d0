"""Rotations in three dimensions.

Matrices (..., 3, 3), unit quaternions (..., 4) as w x y z, rotation vectors (..., 3) in radians.
"""

from __future__ import annotations

import numpy as np


def project_so3(matrices: np.ndarray) -> np.ndarray:
    """The nearest rotations in the Frobenius norm. matrices: (..., 3, 3) -> (..., 3, 3), determinant +1.

    For H = U S V^T it is U diag(1, 1, det(U V^T)) V^T (the paper's eq. 4 prints U V^T, which may reflect).
    """
    u, _, vt = np.linalg.svd(matrices)
    u[..., :, 2] *= np.sign(np.linalg.det(u) * np.linalg.det(vt))[..., None]
    return u @ vt


def geodesic(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angle in radians between rotations a and b, (..., 3, 3) broadcast -> (...).

    Taken from the chord |A - B| = 2 sqrt(2) sin(angle / 2): exact near zero, where arccos of the trace is not.
    """
    chord = np.linalg.norm(np.asarray(a) - np.asarray(b), axis=(-2, -1))
    return 2.0 * np.arcsin(np.clip(chord / (2.0 * np.sqrt(2.0)), 0.0, 1.0))


def from_rotation_vector(v: np.ndarray) -> np.ndarray:
    """Exponential map: (..., 3) rotation vectors in radians -> (..., 3, 3) (Rodrigues)."""
    v = np.asarray(v)
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    k = skew(v)
    small = angle < 1e-6
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 1.0 - angle**2 / 6.0, np.sin(safe) / safe)
    b = np.where(small, 0.5 - angle**2 / 24.0, (1.0 - np.cos(safe)) / safe**2)
    return np.eye(3, dtype=v.dtype) + a * k + b * (k @ k)


def to_rotation_vector(r: np.ndarray) -> np.ndarray:
    """Logarithm: (..., 3, 3) -> (..., 3), angle in [0, pi]. Goes over quaternions, so it holds near pi too."""
    q = to_quaternion(r)
    q = np.where(q[..., :1] < 0, -q, q)
    sin_half = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sin_half, q[..., :1])
    return q[..., 1:] * np.where(sin_half < 1e-8, 2.0, angle / np.where(sin_half < 1e-8, 1.0, sin_half))


def skew(v: np.ndarray) -> np.ndarray:
    """(..., 3) -> (..., 3, 3) with skew(v) w = v x w."""
    out = np.zeros((*v.shape, 3), v.dtype)
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    out[..., 0, 1], out[..., 0, 2] = -z, y
    out[..., 1, 0], out[..., 1, 2] = z, -x
    out[..., 2, 0], out[..., 2, 1] = -y, x
    return out


def to_quaternion(r: np.ndarray) -> np.ndarray:
    """(..., 3, 3) -> (..., 4), w x y z, unit length, the largest component positive (Shepperd's choice of pivot)."""
    r = np.asarray(r)
    m00, m11, m22 = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    # four times the outer product of q with itself, row by row: every row is q up to scale
    rows = np.empty((*r.shape[:-2], 4, 4), r.dtype)
    rows[..., 0, 0] = 1 + m00 + m11 + m22
    rows[..., 1, 1] = 1 + m00 - m11 - m22
    rows[..., 2, 2] = 1 - m00 + m11 - m22
    rows[..., 3, 3] = 1 - m00 - m11 + m22
    rows[..., 0, 1] = rows[..., 1, 0] = r[..., 2, 1] - r[..., 1, 2]
    rows[..., 0, 2] = rows[..., 2, 0] = r[..., 0, 2] - r[..., 2, 0]
    rows[..., 0, 3] = rows[..., 3, 0] = r[..., 1, 0] - r[..., 0, 1]
    rows[..., 1, 2] = rows[..., 2, 1] = r[..., 0, 1] + r[..., 1, 0]
    rows[..., 1, 3] = rows[..., 3, 1] = r[..., 0, 2] + r[..., 2, 0]
    rows[..., 2, 3] = rows[..., 3, 2] = r[..., 1, 2] + r[..., 2, 1]
    pivot = np.argmax(np.diagonal(rows, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(rows, pivot[..., None, None], axis=-2)[..., 0, :]
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def from_quaternion(q: np.ndarray) -> np.ndarray:
    """(..., 4) w x y z, need not be unit length -> (..., 3, 3)."""
    q = np.asarray(q)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    w, x, y, z = (q[..., i] for i in range(4))
    out = np.empty((*q.shape[:-1], 3, 3), q.dtype)
    out[..., 0, 0] = 1 - 2 * (y * y + z * z)
    out[..., 0, 1] = 2 * (x * y - w * z)
    out[..., 0, 2] = 2 * (x * z + w * y)
    out[..., 1, 0] = 2 * (x * y + w * z)
    out[..., 1, 1] = 1 - 2 * (x * x + z * z)
    out[..., 1, 2] = 2 * (y * z - w * x)
    out[..., 2, 0] = 2 * (x * z - w * y)
    out[..., 2, 1] = 2 * (y * z + w * x)
    out[..., 2, 2] = 1 - 2 * (x * x + y * y)
    return out
