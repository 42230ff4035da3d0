"""The nearest rotation as a compiled kernel: thousands of them a step, one small matrix at a time."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def nearest_rotation(m, r):
    """The rotation r that maximises tr(r^T m), through the largest eigenvalue of Horn's quaternion matrix.

    Newton on the characteristic polynomial from above (Theobald 2005); the quaternion is the largest column of the
    adjugate. Where that eigenvalue is (nearly) double the adjugate vanishes and Jacobi rotations take over.
    """
    size = 0.0
    for i in range(3):
        for j in range(3):
            size += m[i, j] * m[i, j]
    if not size > 0.0:
        _set_identity(r)
        return
    q = np.empty((4, 4))
    unit = 1.0 / np.sqrt(size)
    _horn(m, unit, q)
    top = _largest_root(m, unit, q)
    best, length = 0, 0.0
    column = np.empty((4, 4))
    for c in range(4):
        total = 0.0
        for row in range(4):
            column[c, row] = _cofactor(q, top, row, c)
            total += column[c, row] * column[c, row]
        if total > length:
            best, length = c, total
    if length > 1e-12:
        _rotation_of(column[best], r)
    else:
        _jacobi(q, column)
        _rotation_of(column[0], r)


@njit(cache=True, nogil=True)
def _set_identity(r):
    for i in range(3):
        for j in range(3):
            r[i, j] = 1.0 if i == j else 0.0


@njit(cache=True, nogil=True)
def _horn(m, unit, q):
    """Horn's symmetric 4x4 matrix of unit * m."""
    a, b, c = m[0, 0] * unit, m[0, 1] * unit, m[0, 2] * unit
    d, e, f = m[1, 0] * unit, m[1, 1] * unit, m[1, 2] * unit
    g, h, i = m[2, 0] * unit, m[2, 1] * unit, m[2, 2] * unit
    q[0, 0], q[1, 1], q[2, 2], q[3, 3] = a + e + i, a - e - i, e - a - i, i - a - e
    q[0, 1] = q[1, 0] = h - f
    q[0, 2] = q[2, 0] = c - g
    q[0, 3] = q[3, 0] = d - b
    q[1, 2] = q[2, 1] = b + d
    q[1, 3] = q[3, 1] = c + g
    q[2, 3] = q[3, 2] = f + h


@njit(cache=True, nogil=True)
def _largest_root(m, unit, q):
    """Largest root of x^4 - 2 x^2 - 8 det(m) x + det(q), m scaled to Frobenius norm one, so 1 <= x <= sqrt(3)."""
    det = m[0, 0] * (m[1, 1] * m[2, 2] - m[1, 2] * m[2, 1])
    det -= m[0, 1] * (m[1, 0] * m[2, 2] - m[1, 2] * m[2, 0])
    det += m[0, 2] * (m[1, 0] * m[2, 1] - m[1, 1] * m[2, 0])
    c1 = -8.0 * det * unit * unit * unit
    s0 = q[0, 0] * q[1, 1] - q[0, 1] * q[0, 1]
    s1 = q[0, 0] * q[1, 2] - q[0, 2] * q[0, 1]
    s2 = q[0, 0] * q[1, 3] - q[0, 3] * q[0, 1]
    s3 = q[0, 1] * q[1, 2] - q[0, 2] * q[1, 1]
    s4 = q[0, 1] * q[1, 3] - q[0, 3] * q[1, 1]
    s5 = q[0, 2] * q[1, 3] - q[0, 3] * q[1, 2]
    t5 = q[2, 2] * q[3, 3] - q[2, 3] * q[2, 3]
    t4 = q[1, 2] * q[3, 3] - q[1, 3] * q[2, 3]
    t3 = q[1, 2] * q[2, 3] - q[1, 3] * q[2, 2]
    t2 = q[0, 2] * q[3, 3] - q[0, 3] * q[2, 3]
    t1 = q[0, 2] * q[2, 3] - q[0, 3] * q[2, 2]
    t0 = q[0, 2] * q[1, 3] - q[0, 3] * q[1, 2]
    c0 = s0 * t5 - s1 * t4 + s2 * t3 + s3 * t2 - s4 * t1 + s5 * t0
    x = np.sqrt(3.0)
    for _ in range(40):
        square = x * x
        slope = 4.0 * x * square - 4.0 * x + c1
        if slope <= 1e-12:
            break
        step = (square * square - 2.0 * square + c1 * x + c0) / slope
        x -= step
        if abs(step) < 1e-15:
            break
    return x


@njit(cache=True, nogil=True)
def _cofactor(q, top, row, column):
    """Signed minor of q - top I without the given row and column."""
    r0, r1, r2 = (0 if row > 0 else 1), (1 if row > 1 else 2), (2 if row > 2 else 3)
    c0, c1, c2 = (0 if column > 0 else 1), (1 if column > 1 else 2), (2 if column > 2 else 3)
    a = q[r0, c0] - (top if r0 == c0 else 0.0)
    b = q[r0, c1] - (top if r0 == c1 else 0.0)
    c = q[r0, c2] - (top if r0 == c2 else 0.0)
    d = q[r1, c0] - (top if r1 == c0 else 0.0)
    e = q[r1, c1] - (top if r1 == c1 else 0.0)
    f = q[r1, c2] - (top if r1 == c2 else 0.0)
    g = q[r2, c0] - (top if r2 == c0 else 0.0)
    h = q[r2, c1] - (top if r2 == c1 else 0.0)
    i = q[r2, c2] - (top if r2 == c2 else 0.0)
    minor = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    return minor if (row + column) % 2 == 0 else -minor


@njit(cache=True, nogil=True)
def _rotation_of(q, r):
    """Rotation of a quaternion w x y z of any length."""
    s = 2.0 / (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    w, x, y, z = q[0], q[1], q[2], q[3]
    r[0, 0], r[0, 1], r[0, 2] = 1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)
    r[1, 0], r[1, 1], r[1, 2] = s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x)
    r[2, 0], r[2, 1], r[2, 2] = s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y)


@njit(cache=True, nogil=True)
def _jacobi(q, vectors):
    """Cyclic Jacobi on the symmetric 4x4 q (destroyed): vectors[0] becomes the eigenvector of the largest value."""
    for i in range(4):
        for j in range(4):
            vectors[i, j] = 1.0 if i == j else 0.0
    for _ in range(12):
        for i in range(3):
            for j in range(i + 1, 4):
                if abs(q[i, j]) < 1e-300:
                    continue
                theta = (q[j, j] - q[i, i]) / (2.0 * q[i, j])
                t = (1.0 if theta >= 0 else -1.0) / (abs(theta) + np.sqrt(theta * theta + 1.0))
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                for x in range(4):
                    a, b = q[x, i], q[x, j]
                    q[x, i], q[x, j] = c * a - s * b, s * a + c * b
                for x in range(4):
                    a, b = q[i, x], q[j, x]
                    q[i, x], q[j, x] = c * a - s * b, s * a + c * b
                    a, b = vectors[i, x], vectors[j, x]
                    vectors[i, x], vectors[j, x] = c * a - s * b, s * a + c * b
    best = 0
    for i in range(1, 4):
        if q[i, i] > q[best, best]:
            best = i
    for x in range(4):
        vectors[0, x] = vectors[best, x]
