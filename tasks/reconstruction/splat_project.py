"""Kernels that project Gaussians and shade them, and the way back for their gradients.

The formulas are those of :mod:`tasks.reconstruction.rasterize_reference`, one Gaussian at a time.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from tasks.reconstruction.rasterize import EPS2D, MARGIN, MIN_ALPHA, NEAR
from tasks.reconstruction.splat_blend import (
    DEPTH,
    EXTENT_X,
    EXTENT_Y,
    MOMENTS,
    OPACITY,
    RED,
    A,
    B,
    C,
    X,
    Y,
)

SH_0 = 0.28209479177387814
SLACK = 1e-3  # pixels and share that an extent is widened by, so that rounding cuts nothing off


@njit(cache=True, nogil=True, error_model="numpy")
def project(first, last, means, scales, opacities, sh, quaternions, view, intrinsics, size, splats):
    """Rows first..last-1 of splats (N, SPLAT); depth is infinite where not drawn. quaternions: None for spheres."""
    real = means.dtype.type
    height, width = size
    basis, unit = np.empty(16, means.dtype), np.empty(3, means.dtype)
    centre = camera_centre(view)
    for i in range(first, last):
        s = splats[i]
        s[DEPTH] = np.inf
        x, y, z = camera_point(means[i], view)
        if not (z > real(NEAR) and opacities[i] >= real(MIN_ALPHA)):
            continue
        u, v, _, _ = slopes(x, y, z, intrinsics, height, width)
        if quaternions is None:
            cxx, cxy, cyy = flat_covariance(scales[i, 0], u, v, z, intrinsics)
        else:
            turn = quaternion_matrix(quaternions[i])
            cxx, cxy, cyy = square(frame(turn, u, v, z, view, intrinsics), scales[i])
        cxx += real(EPS2D)
        cyy += real(EPS2D)
        scale = real(1.0) / (cxx * cyy - cxy * cxy)
        s[X] = intrinsics[0, 0] * x / z + intrinsics[0, 2]
        s[Y] = intrinsics[1, 1] * y / z + intrinsics[1, 2]
        s[A], s[B], s[C] = cyy * scale, -cxy * scale, cxx * scale
        s[OPACITY] = opacities[i]
        reach = real(2.0) * math.log(opacities[i] / real(MIN_ALPHA))
        s[EXTENT_X] = math.sqrt(reach * cxx) * real(1 + SLACK) + real(SLACK)
        s[EXTENT_Y] = math.sqrt(reach * cyy) * real(1 + SLACK) + real(SLACK)
        inside = s[X] + s[EXTENT_X] > 0 and s[X] - s[EXTENT_X] < width
        if not (inside and s[Y] + s[EXTENT_Y] > 0 and s[Y] - s[EXTENT_Y] < height):
            continue
        s[DEPTH] = z
        direction(means[i], centre, unit)
        sh_basis(unit, sh.shape[1], basis)
        for k in range(3):
            value = real(0.5)
            for j in range(sh.shape[1]):
                value += basis[j] * sh[i, j, k]
            s[RED + k] = max(value, real(0.0))


@njit(cache=True, nogil=True, error_model="numpy")
def camera_point(mean, view):
    """A mean in the camera's frame."""
    x = view[0, 0] * mean[0] + view[0, 1] * mean[1] + view[0, 2] * mean[2] + view[0, 3]
    y = view[1, 0] * mean[0] + view[1, 1] * mean[1] + view[1, 2] * mean[2] + view[1, 3]
    z = view[2, 0] * mean[0] + view[2, 1] * mean[1] + view[2, 2] * mean[2] + view[2, 3]
    return x, y, z


@njit(cache=True, nogil=True, error_model="numpy")
def camera_centre(view):
    """Where the camera stands: -R^T t."""
    out = np.zeros(3, view.dtype)
    for k in range(3):
        for j in range(3):
            out[k] -= view[j, k] * view[j, 3]
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def slopes(x, y, z, intrinsics, height, width):
    """x/z and y/z held to the image and a margin; 1 or 0 each: whether it is free."""
    real = intrinsics.dtype.type
    edge_x, edge_y = real(MARGIN * 0.5 * width), real(MARGIN * 0.5 * height)
    u, v = x / z, y / z
    low_u, high_u = (
        -(intrinsics[0, 2] + edge_x) / intrinsics[0, 0],
        (real(width) - intrinsics[0, 2] + edge_x) / intrinsics[0, 0],
    )
    low_v, high_v = (
        -(intrinsics[1, 2] + edge_y) / intrinsics[1, 1],
        (real(height) - intrinsics[1, 2] + edge_y) / intrinsics[1, 1],
    )
    held_u, held_v = min(max(u, low_u), high_u), min(max(v, low_v), high_v)
    return held_u, held_v, real(held_u == u), real(held_v == v)


@njit(cache=True, nogil=True, error_model="numpy")
def flat_covariance(scale, u, v, z, intrinsics):
    """s^2 J J^T: a sphere's projected covariance."""
    gx, gy = scale * intrinsics[0, 0] / z, scale * intrinsics[1, 1] / z
    return gx * gx * (1 + u * u), gx * gy * u * v, gy * gy * (1 + v * v)


@njit(cache=True, nogil=True, error_model="numpy")
def quaternion_matrix(q):
    """The rotation of a quaternion w x y z of any length."""
    out = np.empty((3, 3), q.dtype)
    length = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    w, x, y, z = q[0] / length, q[1] / length, q[2] / length, q[3] / length
    out[0, 0], out[0, 1], out[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    out[1, 0], out[1, 1], out[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    out[2, 0], out[2, 1], out[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def image_slope(u, v, z, view, intrinsics):
    """J times the view's rotation, (2, 3)."""
    out = np.empty((2, 3), view.dtype)
    for k in range(3):
        out[0, k] = intrinsics[0, 0] / z * (view[0, k] - u * view[2, k])
        out[1, k] = intrinsics[1, 1] / z * (view[1, k] - v * view[2, k])
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def frame(turn, u, v, z, view, intrinsics):
    """A Gaussian's axes in the image: J times the view's rotation times its own, (2, 3)."""
    m = image_slope(u, v, z, view, intrinsics)
    out = np.zeros((2, 3), view.dtype)
    for r in range(2):
        for k in range(3):
            for j in range(3):
                out[r, k] += m[r, j] * turn[j, k]
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def square(axes, scale):
    """axes diag(scale^2) axes^T as xx, xy, yy."""
    xx = xy = yy = axes.dtype.type(0.0)
    for k in range(3):
        a, b = axes[0, k] * scale[k], axes[1, k] * scale[k]
        xx += a * a
        xy += a * b
        yy += b * b
    return xx, xy, yy


@njit(cache=True, nogil=True, error_model="numpy")
def direction(mean, centre, unit):
    """The unit direction from the camera to a mean; returns their distance."""
    x, y, z = mean[0] - centre[0], mean[1] - centre[1], mean[2] - centre[2]
    length = math.sqrt(x * x + y * y + z * z)
    unit[0], unit[1], unit[2] = x / length, y / length, z / length
    return length


@njit(cache=True, nogil=True, error_model="numpy")
def sh_basis(unit, count, out):
    """The first `count` real spherical harmonics of a direction."""
    real = unit.dtype.type
    x, y, z = unit[0], unit[1], unit[2]
    out[0] = real(SH_0)
    if count > 1:
        c = real(0.4886025119029199)
        out[1], out[2], out[3] = -c * y, c * z, -c * x
    if count > 4:
        c = real(1.0925484305920792)
        out[4], out[5], out[7] = c * x * y, -c * y * z, -c * x * z
        out[6] = real(0.31539156525252005) * (2 * z * z - x * x - y * y)
        out[8] = real(0.5462742152960396) * (x * x - y * y)
    if count > 9:
        c, d = real(0.5900435899266435), real(0.4570457994644658)
        out[9] = -c * y * (3 * x * x - y * y)
        out[10] = real(2.890611442640554) * x * y * z
        out[11] = -d * y * (4 * z * z - x * x - y * y)
        out[12] = real(0.3731763325901154) * z * (2 * z * z - 3 * x * x - 3 * y * y)
        out[13] = -d * x * (4 * z * z - x * x - y * y)
        out[14] = real(1.445305721320277) * z * (x * x - y * y)
        out[15] = -c * x * (x * x - 3 * y * y)


@njit(cache=True, nogil=True, error_model="numpy")
def sh_slope(unit, count, out):
    """Slopes of the basis along x, y, z, (count, 3)."""
    real = unit.dtype.type
    x, y, z = unit[0], unit[1], unit[2]
    out[:] = real(0.0)
    if count > 1:
        c = real(0.4886025119029199)
        out[1, 1], out[2, 2], out[3, 0] = -c, c, -c
    if count > 4:
        c, d, e = real(1.0925484305920792), real(0.31539156525252005), real(0.5462742152960396)
        out[4, 0], out[4, 1] = c * y, c * x
        out[5, 1], out[5, 2] = -c * z, -c * y
        out[6, 0], out[6, 1], out[6, 2] = -2 * d * x, -2 * d * y, 4 * d * z
        out[7, 0], out[7, 2] = -c * z, -c * x
        out[8, 0], out[8, 1] = 2 * e * x, -2 * e * y
    if count > 9:
        c, d = real(0.5900435899266435), real(0.4570457994644658)
        e, f, g = real(2.890611442640554), real(0.3731763325901154), real(1.445305721320277)
        out[9, 0], out[9, 1] = -6 * c * x * y, -3 * c * (x * x - y * y)
        out[10, 0], out[10, 1], out[10, 2] = e * y * z, e * x * z, e * x * y
        out[11, 0], out[11, 1], out[11, 2] = 2 * d * x * y, -d * (4 * z * z - x * x - 3 * y * y), -8 * d * y * z
        out[12, 0], out[12, 1], out[12, 2] = -6 * f * x * z, -6 * f * y * z, f * (6 * z * z - 3 * x * x - 3 * y * y)
        out[13, 0], out[13, 1], out[13, 2] = -d * (4 * z * z - 3 * x * x - y * y), 2 * d * x * y, -8 * d * x * z
        out[14, 0], out[14, 1], out[14, 2] = 2 * g * x * z, -2 * g * y * z, g * (x * x - y * y)
        out[15, 0], out[15, 1] = -3 * c * (x * x - y * y), 6 * c * x * y


@njit(cache=True, nogil=True, error_model="numpy")
def project_backward(
    first,
    last,
    means,
    scales,
    sh,
    quaternions,
    view,
    intrinsics,
    size,
    order,
    splats,
    pair_start,
    moments,
    gradients,
):
    """Gradients of the drawn Gaussians order[first:last]; splats and pairs are in that order too.

    gradients: arrays shaped as means, scales, opacities, sh and quaternions (or None), zero before.
    """
    real = means.dtype.type
    of_means, of_scales, of_opacities, of_sh, of_quaternions = gradients
    total, shift = np.empty(MOMENTS, means.dtype), np.zeros(3, means.dtype)
    basis, basis_slope = np.empty(16, means.dtype), np.empty((16, 3), means.dtype)
    unit, centre = np.empty(3, means.dtype), camera_centre(view)
    for row in range(first, last):
        i = order[row]
        s = splats[row]
        total[:] = real(0.0)
        for pair in range(pair_start[row], pair_start[row + 1]):
            for k in range(MOMENTS):
                total[k] += moments[pair, k]
        of_opacities[i] = -total[4] / s[OPACITY]
        x, y, z = camera_point(means[i], view)
        u, v, free_u, free_v = slopes(x, y, z, intrinsics, size[0], size[1])
        hxx, hxy, hyy = of_covariance(s[A], s[B], s[C], total[7], total[8], total[9])
        if quaternions is None:
            of_scales[i, 0], du, dv, dz = back_flat(scales[i, 0], u, v, z, intrinsics, hxx, hxy, hyy)
        else:
            du, dv, dz = back_turned(
                scales[i], quaternions[i], u, v, z, view, intrinsics, hxx, hxy, hyy, of_scales[i], of_quaternions[i]
            )
        dx, dy = du * free_u / z, dv * free_v / z
        dz += total[3] - dx * x / z - dy * y / z
        gx = -(s[A] * total[5] + s[B] * total[6]) * intrinsics[0, 0] / z
        gy = -(s[B] * total[5] + s[C] * total[6]) * intrinsics[1, 1] / z
        dz -= gx * x / z + gy * y / z
        for k in range(3):
            if s[RED + k] <= real(0.0):
                total[k] = real(0.0)  # held at zero
            of_sh[i, 0, k] = real(SH_0) * total[k]
        if sh.shape[1] > 1:  # else the direction does not matter, and the call would cost more than all the rest
            back_shade(means[i], centre, sh[i], total, unit, basis, basis_slope, of_sh[i], shift)
        for k in range(3):
            of_means[i, k] = (dx + gx) * view[0, k] + (dy + gy) * view[1, k] + dz * view[2, k] + shift[k]


@njit(cache=True, nogil=True, error_model="numpy")
def of_covariance(a, b, c, mxx, mxy, myy):
    """-K G K with K the inverse covariance and G the gradient by it, from the moments of sigma's slope."""
    half = type_of(a, 0.5)
    gxx, gxy, gyy = half * mxx, half * mxy, half * myy
    txx, txy = a * gxx + b * gxy, a * gxy + b * gyy
    tyx, tyy = b * gxx + c * gxy, b * gxy + c * gyy
    return -(txx * a + txy * b), -(txx * b + txy * c), -(tyx * b + tyy * c)


@njit(cache=True, nogil=True, error_model="numpy")
def type_of(like, value):
    """A constant in the floating type of another number, which keeps float32 sums in float32."""
    return type(like)(value)


@njit(cache=True, nogil=True, error_model="numpy")
def back_flat(scale, u, v, z, intrinsics, hxx, hxy, hyy):
    """Gradients by scale, u, v and z (through 1/z^2 alone) of :func:`flat_covariance`."""
    gx, gy = scale * intrinsics[0, 0] / z, scale * intrinsics[1, 1] / z
    xx, xy, yy = hxx * gx * gx, 2 * hxy * gx * gy, hyy * gy * gy
    value = xx * (1 + u * u) + xy * u * v + yy * (1 + v * v)
    return 2 * value / scale, 2 * xx * u + xy * v, 2 * yy * v + xy * u, -2 * value / z


@njit(cache=True, nogil=True, error_model="numpy")
def back_turned(scale, q, u, v, z, view, intrinsics, hxx, hxy, hyy, of_scale, of_quaternion):
    """Gradients by u, v and z (through J alone); those by scale and quaternion are written."""
    real = scale.dtype.type
    turn = quaternion_matrix(q)
    axes = frame(turn, u, v, z, view, intrinsics)
    m = image_slope(u, v, z, view, intrinsics)
    of_axes = np.empty((2, 3), scale.dtype)
    for k in range(3):
        a, b = axes[0, k] * scale[k], axes[1, k] * scale[k]
        da, db = 2 * (hxx * a + hxy * b), 2 * (hxy * a + hyy * b)
        of_scale[k] = da * axes[0, k] + db * axes[1, k]
        of_axes[0, k], of_axes[1, k] = da * scale[k], db * scale[k]
    of_turn, of_m = np.zeros((3, 3), scale.dtype), np.zeros((2, 3), scale.dtype)
    for r in range(2):
        for j in range(3):
            for k in range(3):
                of_m[r, j] += of_axes[r, k] * turn[j, k]
                of_turn[j, k] += m[r, j] * of_axes[r, k]
    back_quaternion(q, of_turn, of_quaternion)
    du = dv = dz = real(0.0)
    for k in range(3):
        du -= of_m[0, k] * view[2, k] * intrinsics[0, 0] / z
        dv -= of_m[1, k] * view[2, k] * intrinsics[1, 1] / z
        dz -= (of_m[0, k] * m[0, k] + of_m[1, k] * m[1, k]) / z
    return du, dv, dz


@njit(cache=True, nogil=True, error_model="numpy")
def back_quaternion(q, g, out):
    """The gradient by a quaternion of any length, from that by its rotation matrix."""
    length = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    w, x, y, z = q[0] / length, q[1] / length, q[2] / length, q[3] / length
    dw = 2 * (x * (g[2, 1] - g[1, 2]) + y * (g[0, 2] - g[2, 0]) + z * (g[1, 0] - g[0, 1]))
    dx = 2 * (y * (g[0, 1] + g[1, 0]) + z * (g[0, 2] + g[2, 0]) + w * (g[2, 1] - g[1, 2]) - 2 * x * (g[1, 1] + g[2, 2]))
    dy = 2 * (x * (g[0, 1] + g[1, 0]) + z * (g[1, 2] + g[2, 1]) + w * (g[0, 2] - g[2, 0]) - 2 * y * (g[0, 0] + g[2, 2]))
    dz = 2 * (x * (g[0, 2] + g[2, 0]) + y * (g[1, 2] + g[2, 1]) + w * (g[1, 0] - g[0, 1]) - 2 * z * (g[0, 0] + g[1, 1]))
    along = w * dw + x * dx + y * dy + z * dz
    out[0], out[1] = (dw - w * along) / length, (dx - x * along) / length
    out[2], out[3] = (dy - y * along) / length, (dz - z * along) / length


@njit(cache=True, nogil=True, error_model="numpy")
def back_shade(mean, centre, sh, total, unit, basis, basis_slope, of_sh, of_mean):
    """Gradients by the coefficients and, through the direction, by the mean. total: gradient by the colour."""
    real = mean.dtype.type
    count = len(sh)
    distance = direction(mean, centre, unit)
    sh_basis(unit, count, basis)
    sh_slope(unit, count, basis_slope)
    of_mean[:] = real(0.0)
    for j in range(1, count):
        along = real(0.0)
        for k in range(3):
            of_sh[j, k] = basis[j] * total[k]
            along += sh[j, k] * total[k]
        for axis in range(3):
            of_mean[axis] += basis_slope[j, axis] * along
    along = of_mean[0] * unit[0] + of_mean[1] * unit[1] + of_mean[2] * unit[2]
    for axis in range(3):
        of_mean[axis] = (of_mean[axis] - unit[axis] * along) / distance
