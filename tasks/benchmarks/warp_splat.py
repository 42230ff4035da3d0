"""A splatting rasteriser in NVIDIA Warp on the processor: the peer of ours, as one writes it in Warp.

The way of 3DGS and gsplat, with the conventions of tasks/reconstruction/rasterize.py: project; a key of tile and depth
for every tile under a Gaussian; radix sort; one thread a pixel blends from near to far; on the way back one thread a
pixel adds to its Gaussians' gradients with atomics; the projection's adjoint is Warp's own. Spheres of one colour.
Imported where it is used: Warp is an extra that only benchmarks (and the making of garments) need.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from tasks.reconstruction import rasterize

wp.config.quiet = True

EPS2D = wp.constant(rasterize.EPS2D)
MAX_ALPHA = wp.constant(0.999)
MIN_ALPHA = wp.constant(1.0 / 255.0)
FLOOR = wp.constant(1e-4)
NEAR = wp.constant(0.01)
SH_0 = wp.constant(0.28209479177387814)
TILE = 8  # a side in pixels; 16 was slower here


@wp.kernel
def project(
    means: wp.array(dtype=wp.vec3),
    scales: wp.array(dtype=float),
    sh: wp.array(dtype=wp.vec3),
    view: wp.mat44,
    lens: wp.vec4,
    size: wp.vec2,
    xy: wp.array(dtype=wp.vec2),
    conics: wp.array(dtype=wp.vec3),
    colours: wp.array(dtype=wp.vec3),
    depths: wp.array(dtype=float),
):
    i = wp.tid()
    p = wp.transform_point(view, means[i])
    z = p[2]
    depths[i] = z
    if z > NEAR:
        margin_x = 0.15 * size[0]
        margin_y = 0.15 * size[1]
        u = wp.clamp(p[0] / z, -(lens[2] + margin_x) / lens[0], (size[0] - lens[2] + margin_x) / lens[0])
        v = wp.clamp(p[1] / z, -(lens[3] + margin_y) / lens[1], (size[1] - lens[3] + margin_y) / lens[1])
        gx = scales[i] * lens[0] / z
        gy = scales[i] * lens[1] / z
        xx = gx * gx * (1.0 + u * u) + EPS2D
        xy_ = gx * gy * u * v
        yy = gy * gy * (1.0 + v * v) + EPS2D
        det = xx * yy - xy_ * xy_
        xy[i] = wp.vec2(lens[0] * p[0] / z + lens[2], lens[1] * p[1] / z + lens[3])
        conics[i] = wp.vec3(yy / det, -xy_ / det, xx / det)
        c = wp.vec3(0.5, 0.5, 0.5) + SH_0 * sh[i]
        colours[i] = wp.vec3(wp.max(c[0], 0.0), wp.max(c[1], 0.0), wp.max(c[2], 0.0))


@wp.func
def tiles(xy: wp.vec2, conic: wp.vec3, opacity: float, across: int, down: int) -> wp.vec4i:
    """First and past the last column and row of the tiles under a Gaussian."""
    det = conic[0] * conic[2] - conic[1] * conic[1]
    reach = 2.0 * wp.log(opacity / MIN_ALPHA)
    rx = wp.sqrt(reach * conic[2] / det)
    ry = wp.sqrt(reach * conic[0] / det)
    return wp.vec4i(
        wp.clamp(int(wp.floor((xy[0] - rx) / float(TILE))), 0, across),
        wp.clamp(int(wp.floor((xy[0] + rx) / float(TILE))) + 1, 0, across),
        wp.clamp(int(wp.floor((xy[1] - ry) / float(TILE))), 0, down),
        wp.clamp(int(wp.floor((xy[1] + ry) / float(TILE))) + 1, 0, down),
    )


@wp.kernel(enable_backward=False)
def count_tiles(
    xy: wp.array(dtype=wp.vec2),
    conics: wp.array(dtype=wp.vec3),
    opacities: wp.array(dtype=float),
    depths: wp.array(dtype=float),
    across: int,
    down: int,
    counts: wp.array(dtype=int),
):
    i = wp.tid()
    if depths[i] > NEAR and opacities[i] >= MIN_ALPHA:
        box = tiles(xy[i], conics[i], opacities[i], across, down)
        counts[i] = (box[1] - box[0]) * (box[3] - box[2])


@wp.kernel(enable_backward=False)
def write_keys(
    xy: wp.array(dtype=wp.vec2),
    conics: wp.array(dtype=wp.vec3),
    opacities: wp.array(dtype=float),
    depths: wp.array(dtype=float),
    starts: wp.array(dtype=int),
    across: int,
    down: int,
    keys: wp.array(dtype=wp.int64),
    values: wp.array(dtype=int),
):
    i = wp.tid()
    at = starts[i]
    if depths[i] > NEAR and opacities[i] >= MIN_ALPHA:
        box = tiles(xy[i], conics[i], opacities[i], across, down)
        near = wp.int64(wp.cast(depths[i], wp.int32))
        for row in range(box[2], box[3]):
            for column in range(box[0], box[1]):
                keys[at] = (wp.int64(row * across + column) << wp.int64(32)) | near
                values[at] = i
                at += 1


@wp.kernel(enable_backward=False)
def find_ranges(keys: wp.array(dtype=wp.int64), count: int, ranges: wp.array(dtype=wp.vec2i)):
    k = wp.tid()
    tile = int(keys[k] >> wp.int64(32))
    if k == 0 or int(keys[k - 1] >> wp.int64(32)) != tile:
        ranges[tile][0] = k
    if k == count - 1 or int(keys[k + 1] >> wp.int64(32)) != tile:
        ranges[tile][1] = k + 1


@wp.kernel(enable_backward=False)
def blend(
    xy: wp.array(dtype=wp.vec2),
    conics: wp.array(dtype=wp.vec3),
    opacities: wp.array(dtype=float),
    colours: wp.array(dtype=wp.vec3),
    depths: wp.array(dtype=float),
    ranges: wp.array(dtype=wp.vec2i),
    values: wp.array(dtype=int),
    across: int,
    background: wp.vec3,
    rgb: wp.array2d(dtype=wp.vec3),
    alpha: wp.array2d(dtype=float),
    depth: wp.array2d(dtype=float),
):
    i, j = wp.tid()
    span = ranges[(i // TILE) * across + j // TILE]
    light = float(1.0)  # noqa: UP018 - in Warp a variable, not a constant
    colour = wp.vec3(0.0, 0.0, 0.0)
    far = float(0.0)  # noqa: UP018
    for k in range(span[0], span[1]):
        g = values[k]
        dx = float(j) + 0.5 - xy[g][0]
        dy = float(i) + 0.5 - xy[g][1]
        q = conics[g]
        sigma = 0.5 * (q[0] * dx * dx + q[2] * dy * dy) + q[1] * dx * dy
        a = wp.min(opacities[g] * wp.exp(-sigma), MAX_ALPHA)
        if a >= MIN_ALPHA:
            after = light * (1.0 - a)
            if after <= FLOOR:
                break
            colour += light * a * colours[g]
            far += light * a * depths[g]
            light = after
    rgb[i, j] = colour + light * background
    alpha[i, j] = 1.0 - light
    if light < 1.0:
        depth[i, j] = far / (1.0 - light)
    else:
        depth[i, j] = 0.0


@wp.kernel(enable_backward=False)
def blend_back(
    xy: wp.array(dtype=wp.vec2),
    conics: wp.array(dtype=wp.vec3),
    opacities: wp.array(dtype=float),
    colours: wp.array(dtype=wp.vec3),
    ranges: wp.array(dtype=wp.vec2i),
    values: wp.array(dtype=int),
    across: int,
    background: wp.vec3,
    rgb: wp.array2d(dtype=wp.vec3),
    alpha: wp.array2d(dtype=float),
    of_rgb: wp.array2d(dtype=wp.vec3),
    of_alpha: wp.array2d(dtype=float),
    of_xy: wp.array(dtype=wp.vec2),
    of_conics: wp.array(dtype=wp.vec3),
    of_opacities: wp.array(dtype=float),
    of_colours: wp.array(dtype=wp.vec3),
):
    i, j = wp.tid()
    span = ranges[(i // TILE) * across + j // TILE]
    slope = of_rgb[i, j]
    cover = of_alpha[i, j] - wp.dot(slope, background)
    behind = wp.dot(slope, rgb[i, j] - (1.0 - alpha[i, j]) * background) + alpha[i, j] * cover
    light = float(1.0)  # noqa: UP018 - in Warp a variable, not a constant
    for k in range(span[0], span[1]):
        g = values[k]
        dx = float(j) + 0.5 - xy[g][0]
        dy = float(i) + 0.5 - xy[g][1]
        q = conics[g]
        sigma = 0.5 * (q[0] * dx * dx + q[2] * dy * dy) + q[1] * dx * dy
        e = wp.exp(-sigma)
        raw = opacities[g] * e
        a = wp.min(raw, MAX_ALPHA)
        if a >= MIN_ALPHA:
            after = light * (1.0 - a)
            if after <= FLOOR:
                break
            u = wp.dot(slope, colours[g]) + cover
            behind -= light * a * u
            wp.atomic_add(of_colours, g, light * a * slope)
            if raw <= MAX_ALPHA:
                of_a = light * u - behind / (1.0 - a)
                of_sigma = -a * of_a
                wp.atomic_add(of_opacities, g, e * of_a)
                wp.atomic_add(of_xy, g, -of_sigma * wp.vec2(q[0] * dx + q[1] * dy, q[1] * dx + q[2] * dy))
                wp.atomic_add(of_conics, g, of_sigma * wp.vec3(0.5 * dx * dx, dx * dy, 0.5 * dy * dy))
            light = after


@dataclass
class WarpSplats:
    """Spheres ready to be drawn. Arrays as for :func:`tasks.reconstruction.rasterize.rasterize`, sh of degree 0."""

    means: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray
    view: np.ndarray
    intrinsics: np.ndarray
    size: tuple[int, int]

    def __post_init__(self) -> None:
        def given(values: np.ndarray, kind) -> wp.array:
            return wp.array(np.ascontiguousarray(values, np.float32), dtype=kind, device="cpu", requires_grad=True)

        self.inputs = (given(self.means, wp.vec3), given(self.scales[:, 0], float), given(self.sh[:, 0], wp.vec3))
        self.opacity = given(self.opacities, float)
        k = self.intrinsics
        camera = wp.mat44(*self.view.astype(np.float32).ravel().tolist())
        lens = wp.vec4(*(float(v) for v in (k[0, 0], k[1, 1], k[0, 2], k[1, 2])))
        self.camera = (camera, lens, wp.vec2(float(self.size[1]), float(self.size[0])))
        self.across, self.down = -(-self.size[1] // TILE), -(-self.size[0] // TILE)
        self.background = wp.vec3(0.0, 0.0, 0.0)

    def forward(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Colour over black, alpha and depth."""
        count, cpu = len(self.means), {"device": "cpu"}
        kinds = (wp.vec2, wp.vec3, wp.vec3, float)
        self.made = tuple(wp.zeros(count, dtype=kind, requires_grad=True, **cpu) for kind in kinds)
        self.tape = wp.Tape()
        with self.tape:
            wp.launch(project, count, [*self.inputs, *self.camera], list(self.made), **cpu)
        xy, conics, colours, depths = self.made
        self._sort(xy, conics, depths)
        self.images = tuple(wp.empty(self.size, dtype=kind, **cpu) for kind in (wp.vec3, float, float))
        seen = [xy, conics, self.opacity, colours, depths, self.ranges, self.values, self.across, self.background]
        wp.launch(blend, self.size, seen, list(self.images), **cpu)
        return tuple(image.numpy() for image in self.images)

    def _sort(self, xy: wp.array, conics: wp.array, depths: wp.array) -> None:
        count, cpu = len(self.means), {"device": "cpu"}
        counts = wp.zeros(count, dtype=int, **cpu)
        seen = [xy, conics, self.opacity, depths]
        wp.launch(count_tiles, count, [*seen, self.across, self.down], [counts], **cpu)
        ends = np.cumsum(counts.numpy(), dtype=np.int32)
        starts = wp.array(ends - counts.numpy(), dtype=int, **cpu)
        pairs = int(ends[-1])
        keys = wp.empty(2 * pairs, dtype=wp.int64, **cpu)  # the sort wants twice the room
        self.values = wp.empty(2 * pairs, dtype=int, **cpu)
        wp.launch(write_keys, count, [*seen, starts, self.across, self.down], [keys, self.values], **cpu)
        wp.utils.radix_sort_pairs(keys, self.values, pairs)
        self.ranges = wp.zeros(self.across * self.down, dtype=wp.vec2i, **cpu)
        wp.launch(find_ranges, pairs, [keys, pairs], [self.ranges], **cpu)

    def backward(self, of_rgb: np.ndarray, of_alpha: np.ndarray) -> tuple[np.ndarray, ...]:
        """Gradients of means, scales, sh and opacities from those of colour and alpha."""
        cpu = {"device": "cpu"}
        slopes = [wp.array(of_rgb, dtype=wp.vec3, **cpu), wp.array(of_alpha, dtype=float, **cpu)]
        xy, conics, colours, _ = self.made
        back = [wp.zeros_like(a, requires_grad=False) for a in (xy, conics, self.opacity, colours)]
        seen = [xy, conics, self.opacity, colours, self.ranges, self.values, self.across, self.background]
        wp.launch(blend_back, self.size, [*seen, *self.images[:2], *slopes], back, **cpu)
        self.tape.backward(grads={xy: back[0], conics: back[1], colours: back[3]})
        found = tuple(a.grad.numpy().copy() for a in self.inputs)
        self.tape.zero()
        return *found, back[2].numpy()
