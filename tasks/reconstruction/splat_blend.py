"""Kernels that sort projected Gaussians into tiles of 8 x 8 pixels and blend them there, forward and backward.

A tile's pixels are one flat loop of 64 on small arrays without branches: that is what compilers turn into wide
instructions, three times faster than loops over rows. No two tiles write to the same place, so there are no atomics
and the result is the same to the bit for any number of threads.

A projected Gaussian is a row of `splats`, in the order of depth; a pair is a Gaussian in a tile. Pairs are numbered by
Gaussian (so that a Gaussian's share of the gradient is summed over consecutive rows) and listed by tile.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from tasks.reconstruction.rasterize import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE

TILE = 8
PIXELS = TILE * TILE
CHECK = 8  # Gaussians between two looks at whether a tile is full
# columns of splats: centre, inverse covariance a b c, opacity, colour, depth, half extent in pixels
X, Y, A, B, C, OPACITY, RED, GREEN, BLUE, DEPTH, EXTENT_X, EXTENT_Y = range(12)
SPLAT = 12
# columns of a pair's gradient: of colour and depth, and moments 1, x, y, xx, xy, yy of the gradient of sigma
MOMENTS = 10
# exp(-s) = p(s)^8 for 0 <= s <= CUT, beyond which alpha < MIN_ALPHA; relative error below 2e-8
CUT = 5.6
_FIT = np.polynomial.chebyshev.Chebyshev.interpolate(lambda s: np.exp(-s / 8), 6, domain=[0, CUT])
P0, P1, P2, P3, P4, P5, P6 = (float(c) for c in _FIT.convert(kind=np.polynomial.Polynomial).coef)

FAST = {"reassoc", "contract", "nsz", "arcp"}  # sums in any order, fixed when compiled; NaN stays NaN


@njit(cache=True, nogil=True)
def tile_box(splat, across, down):
    """First and last column and row of the tiles under a Gaussian's extent; empty where it is out of the image."""
    left = math.ceil(splat[X] - splat[EXTENT_X] - 0.5) // TILE
    right = math.floor(splat[X] + splat[EXTENT_X] - 0.5) // TILE
    top = math.ceil(splat[Y] - splat[EXTENT_Y] - 0.5) // TILE
    bottom = math.floor(splat[Y] + splat[EXTENT_Y] - 0.5) // TILE
    return max(left, 0), min(right, across - 1), max(top, 0), min(bottom, down - 1)


@njit(cache=True, nogil=True)
def least(a, b, c, dx0, dx1, dy0, dy1):
    """Smallest (a dx^2 + c dy^2) / 2 + b dx dy in a box: zero inside, else on an edge that faces the centre."""
    if dx0 <= 0 <= dx1 and dy0 <= 0 <= dy1:
        return 0.0
    best = np.inf
    if dx0 > 0 or dx1 < 0:
        dx = dx0 if dx0 > 0 else dx1
        dy = min(max(-b * dx / c, dy0), dy1)
        best = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
    if dy0 > 0 or dy1 < 0:
        dy = dy0 if dy0 > 0 else dy1
        dx = min(max(-b * dy / a, dx0), dx1)
        best = min(best, 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy)
    return best


@njit(cache=True, nogil=True)
def touches(splat, reach, column, row):
    """True where some pixel of a tile may lie within sigma <= reach."""
    dx0 = column * TILE + 0.5 - splat[X]
    dy0 = row * TILE + 0.5 - splat[Y]
    return least(splat[A], splat[B], splat[C], dx0, dx0 + (TILE - 1), dy0, dy0 + (TILE - 1)) <= reach


@njit(cache=True, nogil=True)
def count_pairs(first, last, splats, across, down, counts):
    """Tiles of each Gaussian first..last-1 into counts."""
    for i in range(first, last):
        left, right, top, bottom = tile_box(splats[i], across, down)
        reach = math.log(splats[i, OPACITY] / MIN_ALPHA) * 1.0001 + 1e-4
        found = 0
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                found += touches(splats[i], reach, column, row)
        counts[i] = found


@njit(cache=True, nogil=True)
def list_pairs(splats, across, down, pair_start):
    """Pairs by tile: (tiles + 1,) where each tile's begin, (P,) their Gaussians from near to far, (P,) their numbers.

    pair_start: (N + 1,) number of each Gaussian's first pair.
    """
    count = len(splats)
    tile_of = np.empty(pair_start[count], np.int32)
    tile_start = np.zeros(across * down + 1, np.int64)
    for i in range(count):
        left, right, top, bottom = tile_box(splats[i], across, down)
        reach = math.log(splats[i, OPACITY] / MIN_ALPHA) * 1.0001 + 1e-4
        pair = pair_start[i]
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                if touches(splats[i], reach, column, row):
                    tile_of[pair] = row * across + column
                    tile_start[row * across + column + 1] += 1
                    pair += 1
    for tile in range(across * down):
        tile_start[tile + 1] += tile_start[tile]
    filled = tile_start[:-1].copy()
    splat_of = np.empty(len(tile_of), np.int32)
    number_of = np.empty(len(tile_of), np.int32)
    for i in range(count):
        for pair in range(pair_start[i], pair_start[i + 1]):
            place = filled[tile_of[pair]]
            filled[tile_of[pair]] += 1
            splat_of[place] = i
            number_of[place] = pair
    return tile_start, splat_of, number_of


@njit(cache=True, nogil=True, fastmath=FAST)
def blend(first, last, across, splats, tile_start, splat_of, background, rgb, alpha, depth, tile_end):
    """Blends tiles first..last-1. rgb: (H, W, 3); alpha, depth: (H, W); tile_end: where each tile was full."""
    real = splats.dtype.type
    height, width = alpha.shape
    p0, p1, p2, p3, p4, p5, p6 = real(P0), real(P1), real(P2), real(P3), real(P4), real(P5), real(P6)
    zero, half, cut = real(0.0), real(0.5), real(CUT)
    max_alpha, min_alpha, floor = real(MAX_ALPHA), real(MIN_ALPHA), real(MIN_TRANSMITTANCE)
    px, py = np.empty(PIXELS, splats.dtype), np.empty(PIXELS, splats.dtype)
    light = np.empty(PIXELS, splats.dtype)  # transmittance so far; 0 once the pixel is full
    red, green, blue = np.empty(PIXELS, splats.dtype), np.empty(PIXELS, splats.dtype), np.empty(PIXELS, splats.dtype)
    cover, far = np.empty(PIXELS, splats.dtype), np.empty(PIXELS, splats.dtype)
    for tile in range(first, last):
        x0, y0 = tile % across * TILE, tile // across * TILE
        for p in range(PIXELS):
            px[p] = real(x0 + p % TILE) + half
            py[p] = real(y0 + p // TILE) + half
            light[p] = real(1.0)
            red[p] = green[p] = blue[p] = cover[p] = far[p] = zero
        place = tile_start[tile]
        while place < tile_start[tile + 1]:
            s = splats[splat_of[place]]
            x, y, a, b, c, o = s[X], s[Y], half * s[A], s[B], half * s[C], s[OPACITY]
            r, g, bl, z = s[RED], s[GREEN], s[BLUE], s[DEPTH]
            for p in range(PIXELS):
                dx = px[p] - x
                dy = py[p] - y
                sigma = min(a * dx * dx + c * dy * dy + b * dx * dy, cut)
                e = p0 + sigma * (p1 + sigma * (p2 + sigma * (p3 + sigma * (p4 + sigma * (p5 + sigma * p6)))))
                e = e * e
                e = e * e
                e = min(o * (e * e), max_alpha)
                w = light[p] * (e if e >= min_alpha else zero)
                after = light[p] - w
                w = w if after > floor else zero
                light[p] = after if after > floor else zero
                red[p] += w * r
                green[p] += w * g
                blue[p] += w * bl
                cover[p] += w
                far[p] += w * z
            place += 1
            if (place - tile_start[tile]) % CHECK == 0:
                left = zero
                for p in range(PIXELS):
                    left += light[p]
                if left == zero:
                    break
        tile_end[tile] = place
        for p in range(PIXELS):
            i, j = y0 + p // TILE, x0 + p % TILE
            if i < height and j < width:
                rest = real(1.0) - cover[p]
                rgb[i, j, 0] = red[p] + rest * background[0]
                rgb[i, j, 1] = green[p] + rest * background[1]
                rgb[i, j, 2] = blue[p] + rest * background[2]
                alpha[i, j] = cover[p]
                depth[i, j] = far[p] / cover[p] if cover[p] > zero else zero


@njit(cache=True, nogil=True, fastmath=FAST)
def blend_backward(
    first,
    last,
    across,
    splats,
    tile_start,
    tile_end,
    splat_of,
    number_of,
    background,
    images,
    slopes,
    moments,
):
    """Gradients of the pairs of tiles first..last-1 into the rows of moments (P, MOMENTS).

    images: rgb, alpha and depth as :func:`blend` left them; slopes: the loss's gradient by each of them. Runs from near
    to far like the way there. With u the loss's slope along a Gaussian's colour, alpha and depth, the slope by its
    alpha is T u - (sum of w u behind it) / (1 - alpha); that sum is the pixel's total less what has gone by.
    """
    real = splats.dtype.type
    p0, p1, p2, p3, p4, p5, p6 = real(P0), real(P1), real(P2), real(P3), real(P4), real(P5), real(P6)
    zero, half, one, cut = real(0.0), real(0.5), real(1.0), real(CUT)
    max_alpha, min_alpha, floor = real(MAX_ALPHA), real(MIN_ALPHA), real(MIN_TRANSMITTANCE)
    px, py = np.empty(PIXELS, splats.dtype), np.empty(PIXELS, splats.dtype)
    light, behind = np.empty(PIXELS, splats.dtype), np.empty(PIXELS, splats.dtype)
    slope = np.empty((5, PIXELS), splats.dtype)
    red, green, blue, cover, far = slope[0], slope[1], slope[2], slope[3], slope[4]
    for tile in range(first, last):
        if tile_start[tile] == tile_end[tile]:
            continue
        x0, y0 = tile % across * TILE, tile // across * TILE
        for p in range(PIXELS):
            px[p] = real(x0 + p % TILE) + half
            py[p] = real(y0 + p // TILE) + half
            light[p] = one
            pixel_slopes(y0 + p // TILE, x0 + p % TILE, p, background, images, slopes, slope, behind)
        for place in range(tile_start[tile], tile_end[tile]):
            s = splats[splat_of[place]]
            x, y, a, b, c, o = s[X], s[Y], half * s[A], s[B], half * s[C], s[OPACITY]
            r, g, bl, z = s[RED], s[GREEN], s[BLUE], s[DEPTH]
            m0, m1, m2, m3, m4, m5, m6, m7, m8, m9 = zero, zero, zero, zero, zero, zero, zero, zero, zero, zero
            for p in range(PIXELS):
                dx = px[p] - x
                dy = py[p] - y
                sigma = min(a * dx * dx + c * dy * dy + b * dx * dy, cut)
                e = p0 + sigma * (p1 + sigma * (p2 + sigma * (p3 + sigma * (p4 + sigma * (p5 + sigma * p6)))))
                e = e * e
                e = e * e
                e = o * (e * e)
                q = min(e, max_alpha)
                q = q if q >= min_alpha else zero
                before = light[p]
                w = before * q
                after = before - w
                w = w if after > floor else zero
                q = q if after > floor else zero
                light[p] = after if after > floor else zero
                u = r * red[p] + g * green[p] + bl * blue[p] + z * far[p] + cover[p]
                behind[p] -= w * u
                t = q * (behind[p] / (one - q)) - w * u  # the slope by sigma: -alpha times that by alpha
                t = t if e <= max_alpha else zero
                m0 += w * red[p]
                m1 += w * green[p]
                m2 += w * blue[p]
                m3 += w * far[p]
                m4 += t
                m5 += t * dx
                m6 += t * dy
                m7 += t * dx * dx
                m8 += t * dx * dy
                m9 += t * dy * dy
            m = moments[number_of[place]]
            m[0], m[1], m[2], m[3], m[4], m[5], m[6], m[7], m[8], m[9] = m0, m1, m2, m3, m4, m5, m6, m7, m8, m9


@njit(cache=True, nogil=True, fastmath=FAST)
def pixel_slopes(i, j, p, background, images, slopes, slope, behind):
    """The loss's slopes by what a pixel sums up (colour, alpha, alpha times depth), and the sum of w u over it all."""
    zero = slope.dtype.type(0.0)
    rgb, alpha, depth = images
    of_rgb, of_alpha, of_depth = slopes
    behind[p] = zero
    if i >= alpha.shape[0] or j >= alpha.shape[1]:
        for k in range(5):
            slope[k, p] = zero
        return
    cover = zero
    rest = slope.dtype.type(1.0) - alpha[i, j]
    for k in range(3):
        slope[k, p] = of_rgb[i, j, k]
        cover -= of_rgb[i, j, k] * background[k]
        behind[p] += of_rgb[i, j, k] * (rgb[i, j, k] - rest * background[k])
    cover += of_alpha[i, j]
    slope[4, p] = zero
    if alpha[i, j] > zero:
        slope[4, p] = of_depth[i, j] / alpha[i, j]
        cover -= slope[4, p] * depth[i, j]
    slope[3, p] = cover
    behind[p] += alpha[i, j] * (cover + slope[4, p] * depth[i, j])
