"""Kernels that sort projected Gaussians into tiles of 8 x 8 pixels and blend them there, forward and backward.

A tile's pixels are one flat loop of 64 on small arrays without branches: that is what compilers turn into wide
instructions, three times faster than loops over rows. No two tiles write to the same place, so there are no atomics
and the result is the same to the bit for any number of threads.

A projected Gaussian is a row of `splats`, those of one place together (which halves the time of 100,000: they do not
fit the cache); a pair is a Gaussian in a tile. Pairs are numbered by Gaussian, so that a Gaussian's share of the
gradient is summed over consecutive rows, and listed by tile.
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
# rows of a tile's pixels, in one array so that the compiler sees that they do not overlap: their place, the
# transmittance so far (0 once the pixel is full), sums of colour, depth and alpha (on the way back: slopes by them),
# on the way back: the sum of w u that is still to come
AT_X, AT_Y, LIGHT, OF_RED, OF_GREEN, OF_BLUE, OF_FAR, OF_COVER, BEHIND = range(9)
STATES = 9
# exp(-s) = p(s)^8 for 0 <= s <= CUT, beyond which alpha < MIN_ALPHA; relative error below 2e-8
CUT = 5.6
_FIT = np.polynomial.chebyshev.Chebyshev.interpolate(lambda s: np.exp(-s / 8), 6, domain=[0, CUT])
P0, P1, P2, P3, P4, P5, P6 = (float(c) for c in _FIT.convert(kind=np.polynomial.Polynomial).coef)

FAST = {"reassoc", "contract", "nsz", "arcp"}  # sums in any order, fixed when compiled; NaN stays NaN


@njit(cache=True, nogil=True, error_model="numpy")
def tile_box(splat, across, down):
    """First and last column and row of the tiles under a Gaussian's extent; empty where it is out of the image."""
    left = math.ceil(splat[X] - splat[EXTENT_X] - 0.5) // TILE
    right = math.floor(splat[X] + splat[EXTENT_X] - 0.5) // TILE
    top = math.ceil(splat[Y] - splat[EXTENT_Y] - 0.5) // TILE
    bottom = math.floor(splat[Y] + splat[EXTENT_Y] - 0.5) // TILE
    return max(left, 0), min(right, across - 1), max(top, 0), min(bottom, down - 1)


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
def touches(splat, reach, column, row):
    """True where some pixel of a tile may lie within sigma <= reach."""
    dx0 = column * TILE + 0.5 - splat[X]
    dy0 = row * TILE + 0.5 - splat[Y]
    return least(splat[A], splat[B], splat[C], dx0, dx0 + (TILE - 1), dy0, dy0 + (TILE - 1)) <= reach


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
def list_pairs(splats, near_first, across, down, pair_start):
    """Pairs by tile: (tiles + 1,) where each tile's begin, (P,) their Gaussians from near to far, (P,) their numbers.

    near_first: (N,) the rows of splats from near to far; pair_start: (N + 1,) number of each row's first pair.
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
    for i in near_first:
        for pair in range(pair_start[i], pair_start[i + 1]):
            place = filled[tile_of[pair]]
            filled[tile_of[pair]] += 1
            splat_of[place] = i
            number_of[place] = pair
    return tile_start, splat_of, number_of


@njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST)
def blend(first, last, across, splats, tile_start, splat_of, background, rgb, alpha, depth, tile_end):
    """Blends tiles first..last-1. rgb: (H, W, 3); alpha, depth: (H, W); tile_end: where each tile was full."""
    real = splats.dtype.type
    height, width = alpha.shape
    p0, p1, p2, p3, p4, p5, p6 = real(P0), real(P1), real(P2), real(P3), real(P4), real(P5), real(P6)
    zero, half, cut = real(0.0), real(0.5), real(CUT)
    max_alpha, min_alpha, floor = real(MAX_ALPHA), real(MIN_ALPHA), real(MIN_TRANSMITTANCE)
    pixels = np.empty((STATES, PIXELS), splats.dtype)
    for tile in range(first, last):
        x0, y0 = tile % across * TILE, tile // across * TILE
        for p in range(PIXELS):
            pixels[AT_X, p] = real(x0 + p % TILE) + half
            pixels[AT_Y, p] = real(y0 + p // TILE) + half
            pixels[LIGHT, p] = real(1.0)
            for k in range(OF_RED, BEHIND):
                pixels[k, p] = zero
        place = tile_start[tile]
        while place < tile_start[tile + 1]:
            s = splats[splat_of[place]]
            x, y, a, b, c, o = s[X], s[Y], half * s[A], s[B], half * s[C], s[OPACITY]
            r, g, bl, z = s[RED], s[GREEN], s[BLUE], s[DEPTH]
            for p in range(PIXELS):
                dx = pixels[AT_X, p] - x
                dy = pixels[AT_Y, p] - y
                sigma = min(a * dx * dx + c * dy * dy + b * dx * dy, cut)
                e = p0 + sigma * (p1 + sigma * (p2 + sigma * (p3 + sigma * (p4 + sigma * (p5 + sigma * p6)))))
                e = e * e
                e = e * e
                e = min(o * (e * e), max_alpha)
                w = pixels[LIGHT, p] * (e if e >= min_alpha else zero)
                after = pixels[LIGHT, p] - w
                w = w if after > floor else zero
                pixels[LIGHT, p] = after if after > floor else zero
                pixels[OF_RED, p] += w * r
                pixels[OF_GREEN, p] += w * g
                pixels[OF_BLUE, p] += w * bl
                pixels[OF_COVER, p] += w
                pixels[OF_FAR, p] += w * z
            place += 1
            if (place - tile_start[tile]) % CHECK == 0:
                left = zero
                for p in range(PIXELS):
                    left += pixels[LIGHT, p]
                if left == zero:
                    break
        tile_end[tile] = place
        for p in range(PIXELS):
            i, j = y0 + p // TILE, x0 + p % TILE
            if i < height and j < width:
                rest = real(1.0) - pixels[OF_COVER, p]
                rgb[i, j, 0] = pixels[OF_RED, p] + rest * background[0]
                rgb[i, j, 1] = pixels[OF_GREEN, p] + rest * background[1]
                rgb[i, j, 2] = pixels[OF_BLUE, p] + rest * background[2]
                alpha[i, j] = pixels[OF_COVER, p]
                depth[i, j] = pixels[OF_FAR, p] / pixels[OF_COVER, p] if pixels[OF_COVER, p] > zero else zero


@njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST)
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
    height, width = images[1].shape
    p0, p1, p2, p3, p4, p5, p6 = real(P0), real(P1), real(P2), real(P3), real(P4), real(P5), real(P6)
    zero, half, one, cut = real(0.0), real(0.5), real(1.0), real(CUT)
    max_alpha, min_alpha, floor = real(MAX_ALPHA), real(MIN_ALPHA), real(MIN_TRANSMITTANCE)
    pixels = np.empty((STATES, PIXELS), splats.dtype)
    for tile in range(first, last):
        if tile_start[tile] == tile_end[tile]:
            continue
        x0, y0 = tile % across * TILE, tile // across * TILE
        for p in range(PIXELS):
            i, j = y0 + p // TILE, x0 + p % TILE
            pixels[AT_X, p], pixels[AT_Y, p], pixels[LIGHT, p] = real(j) + half, real(i) + half, one
            if i < height and j < width:
                pixel_slopes(i, j, p, background, images, slopes, pixels)
            else:
                for k in range(OF_RED, STATES):
                    pixels[k, p] = zero
        for place in range(tile_start[tile], tile_end[tile]):
            s = splats[splat_of[place]]
            x, y, a, b, c, o = s[X], s[Y], half * s[A], s[B], half * s[C], s[OPACITY]
            r, g, bl, z = s[RED], s[GREEN], s[BLUE], s[DEPTH]
            m0, m1, m2, m3, m4, m5, m6, m7, m8, m9 = zero, zero, zero, zero, zero, zero, zero, zero, zero, zero
            for p in range(PIXELS):
                dx = pixels[AT_X, p] - x
                dy = pixels[AT_Y, p] - y
                sigma = min(a * dx * dx + c * dy * dy + b * dx * dy, cut)
                e = p0 + sigma * (p1 + sigma * (p2 + sigma * (p3 + sigma * (p4 + sigma * (p5 + sigma * p6)))))
                e = e * e
                e = e * e
                e = o * (e * e)
                q = min(e, max_alpha)
                q = q if q >= min_alpha else zero
                before = pixels[LIGHT, p]
                w = before * q
                after = before - w
                w = w if after > floor else zero
                q = q if after > floor else zero
                pixels[LIGHT, p] = after if after > floor else zero
                of_red, of_green, of_blue = pixels[OF_RED, p], pixels[OF_GREEN, p], pixels[OF_BLUE, p]
                of_far = pixels[OF_FAR, p]
                u = r * of_red + g * of_green + bl * of_blue + z * of_far + pixels[OF_COVER, p]
                pixels[BEHIND, p] -= w * u
                t = q * (pixels[BEHIND, p] / (one - q)) - w * u  # the slope by sigma: -alpha times that by alpha
                t = t if e <= max_alpha else zero
                m0 += w * of_red
                m1 += w * of_green
                m2 += w * of_blue
                m3 += w * of_far
                m4 += t
                m5 += t * dx
                m6 += t * dy
                m7 += t * dx * dx
                m8 += t * dx * dy
                m9 += t * dy * dy
            m = moments[number_of[place]]
            m[0], m[1], m[2], m[3], m[4], m[5], m[6], m[7], m[8], m[9] = m0, m1, m2, m3, m4, m5, m6, m7, m8, m9


@njit(cache=True, nogil=True, error_model="numpy")
def pixel_slopes(i, j, p, background, images, slopes, pixels):
    """The loss's slopes by what a pixel sums up (colour, alpha, alpha times depth), and the sum of w u over it all."""
    real = pixels.dtype.type
    rgb, alpha, depth = images
    of_rgb, of_alpha, of_depth = slopes
    rest = real(1.0) - alpha[i, j]
    cover, far, total = of_alpha[i, j], real(0.0), real(0.0)
    for k in range(3):
        pixels[OF_RED + k, p] = of_rgb[i, j, k]
        cover -= of_rgb[i, j, k] * background[k]
        total += of_rgb[i, j, k] * (rgb[i, j, k] - rest * background[k])
    if alpha[i, j] > real(0.0):
        far = of_depth[i, j] / alpha[i, j]
        cover -= far * depth[i, j]
    pixels[OF_COVER, p], pixels[OF_FAR, p] = cover, far
    pixels[BEHIND, p] = total + alpha[i, j] * (cover + far * depth[i, j])
