"""A small software renderer for figures: smooth triangles, spheres, skeletons and text, with no display and no GPU.

A canvas is an (H, W, 3) uint8 RGB image at ``SUPERSAMPLE`` times the final size; :func:`finish` brings it down.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numba import njit

from tasks.drawing.colours import INK, PAPER

SUPERSAMPLE = 2

_KEY = np.array([-0.45, 0.62, 0.64], np.float32)  # from the upper left, in front
_FILL = np.array([0.75, 0.10, 0.65], np.float32)


@dataclass(frozen=True)
class Camera:
    """rotation: (3, 3), rows right, up, towards the viewer; centre: (3,) the point in the middle of the image;
    scale: canvas pixels a unit of length at the centre; distance: of the eye from the centre, 0 for parallel rays;
    width, height: of the canvas in pixels."""

    rotation: np.ndarray
    centre: np.ndarray
    scale: float
    distance: float
    width: int
    height: int

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(N, 3) -> pixels (N, 2), x right and y down, and nearness (N,), greater is nearer, linear on the screen."""
        local = (np.asarray(points, np.float64) - self.centre) @ self.rotation.T
        grow = self._grow(local[:, 2])
        x = self.width / 2 + self.scale * grow * local[:, 0]
        y = self.height / 2 - self.scale * grow * local[:, 1]
        return np.stack([x, y], axis=-1), (grow if self.distance else local[:, 2])

    def _grow(self, towards: np.ndarray) -> np.ndarray:
        if not self.distance:
            return np.ones_like(towards)
        return self.distance / np.maximum(self.distance - towards, 1e-3 * self.distance)

    def at(self, centre: np.ndarray) -> Camera:
        """The same view of another place."""
        return replace(self, centre=np.asarray(centre, np.float64))


def look(
    points: np.ndarray,
    *,
    azimuth: float,
    elevation: float,
    width: int,
    height: int,
    distance: float = 0.0,
    margin: float = 0.06,
) -> Camera:
    """A camera that holds all points. points: (N, 3), +Y up; azimuth, elevation: of the eye in radians, azimuth 0 looks
    from +Z, growing towards +X; width, height: final pixels; distance: of the eye in bounding radii, 0 for parallel
    rays; margin: of the image left free on each side."""
    sa, ca, se, ce = np.sin(azimuth), np.cos(azimuth), np.sin(elevation), np.cos(elevation)
    rotation = np.array([[ca, 0, -sa], [-se * sa, ce, -se * ca], [ce * sa, se, ce * ca]])
    local = np.asarray(points, np.float64) @ rotation.T
    low, high = local.min(0), local.max(0)
    radius = float(np.linalg.norm(high - low)) / 2 or 1.0
    camera = Camera(
        rotation=rotation,
        centre=(low + high) / 2 @ rotation,
        scale=1.0,
        distance=distance * radius,
        width=width * SUPERSAMPLE,
        height=height * SUPERSAMPLE,
    )
    pixels, _ = camera.project(points)
    reach = np.abs(pixels - [camera.width / 2, camera.height / 2]).max(0) + 1e-9 * radius
    room = (1 - 2 * margin) * np.array([camera.width, camera.height]) / 2
    return replace(camera, scale=float((room / reach).min()))


def longish(points: np.ndarray) -> bool:
    """Whether a shape is half as long again as broad, seen from above. points: (N, 3), +Y up."""
    spread = np.linalg.eigvalsh(np.cov(np.asarray(points, np.float64)[:, [0, 2]].T))
    return bool(spread[1] > 1.5**2 * spread[0])


def broadside(points: np.ndarray, turn: float = 0.55) -> float:
    """The azimuth that sees a shape at its widest, turned by ``turn`` radians for depth. points: (N, 3), +Y up."""
    ground = np.asarray(points, np.float64)[:, [0, 2]]
    _, axes = np.linalg.eigh(np.cov(ground.T))
    x, z = axes[:, 0] if axes[1, 0] >= 0 else -axes[:, 0]  # the thin direction, on the side of +Z
    return float(np.arctan2(x, z)) + turn


def blank(width: int, height: int, theme: str = "light") -> np.ndarray:
    """An empty canvas for an image of that size. -> (SUPERSAMPLE height, SUPERSAMPLE width, 3)."""
    canvas = np.empty((height * SUPERSAMPLE, width * SUPERSAMPLE, 3), np.uint8)
    canvas[:] = to_bytes(PAPER[theme])
    return canvas


def finish(canvas: np.ndarray) -> np.ndarray:
    """The canvas at its final size."""
    size = (canvas.shape[1] // SUPERSAMPLE, canvas.shape[0] // SUPERSAMPLE)
    return cv2.resize(canvas, size, interpolation=cv2.INTER_AREA)


def png(image: np.ndarray) -> bytes:
    """An (H, W, 3) uint8 RGB image as a PNG file."""
    done, data = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    if not done:
        raise ValueError(f"an image of shape {image.shape} could not be written as PNG")
    return data.tobytes()


def to_bytes(colour: np.ndarray | tuple) -> np.ndarray:
    """RGB in 0..1 -> uint8."""
    return np.round(np.clip(np.asarray(colour, np.float64), 0, 1) * 255).astype(np.uint8)


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Area-weighted unit normals. vertices: (V, 3); faces: (T, 3) -> (V, 3); zero where a vertex has no area."""
    corners = vertices[faces].astype(np.float64)
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = faces.ravel()
    total = [np.bincount(flat, np.repeat(area[:, c], 3), len(vertices)) for c in range(3)]
    normals = np.stack(total, axis=-1)
    return normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-30)


def paint_mesh(
    canvas: np.ndarray,
    camera: Camera,
    vertices: np.ndarray,
    faces: np.ndarray,
    colours: np.ndarray,
    *,
    opacity: float = 1.0,
    rim: float = 0.0,
) -> None:
    """Paints a smooth, lit surface into the canvas. vertices: (V, 3); faces: (T, 3); colours: (V, 3) or (3,);
    opacity: of surfaces seen head on; rim: added to it where the surface turns away, which draws a glass's outline."""
    pixels, near = camera.project(vertices)
    weight = near if camera.distance else np.ones_like(near)
    face, inside, depth = rasterise(pixels, near, weight, faces.astype(np.int32), camera.height, camera.width)
    hit = face >= 0
    corners = faces[face[hit]]  # (M, 3)
    share = inside[hit][..., None]  # (M, 3, 1)
    normals = (vertex_normals(vertices, faces) @ camera.rotation.T).astype(np.float32)
    colours = np.broadcast_to(np.asarray(colours, np.float32), (len(vertices), 3))
    _blend(
        canvas,
        hit,
        (normals[corners] * share).sum(1),
        (colours[corners] * share).sum(1),
        _crevices(depth, hit, camera),
        opacity,
        rim,
    )


def paint_points(canvas: np.ndarray, camera: Camera, points: np.ndarray, colours: np.ndarray, radius: float) -> None:
    """Paints points as lit spheres. points: (N, 3); colours: (N, 3) or (3,); radius: in units of length."""
    pixels, near = camera.project(points)
    local = (np.asarray(points, np.float64) - camera.centre) @ camera.rotation.T
    size = camera.scale * radius * (near if camera.distance else np.ones_like(near))
    owner, normals, depth = _spheres(pixels, local[:, 2], size, float(radius), camera.height, camera.width)
    hit = owner >= 0
    colours = np.broadcast_to(np.asarray(colours, np.float32), (len(points), 3))
    _blend(canvas, hit, normals[hit], colours[owner[hit]], _crevices(depth, hit, camera), 1.0, 0.0)


def paint_skeleton(
    canvas: np.ndarray,
    camera: Camera,
    joints: np.ndarray,
    parents: np.ndarray,
    colours: np.ndarray,
    *,
    size: float,
    theme: str = "light",
) -> None:
    """Paints a tree of joints, far ones first. joints: (J, 3); parents: (J,), -1 for the root; colours: (J, 3), a bone
    has its lower joint's; size: of a joint in final pixels."""
    pixels, near = camera.project(joints)
    edge = np.asarray(INK[theme]) * 0.9
    unit = size * SUPERSAMPLE
    bones = [(float(near[j] + near[p]) / 2, j, int(p)) for j, p in enumerate(parents) if p >= 0]
    things = [*bones, *((float(n) + 1e-6, j, -1) for j, n in enumerate(near))]
    for _, j, p in sorted(things):
        if p >= 0:
            _bone(canvas, pixels[p], pixels[j], unit, colours[j], edge)
        else:
            grow = 1.35 if parents[j] < 0 else 1.0
            disc(canvas, pixels[j] / SUPERSAMPLE, 0.62 * size * grow, edge)
            disc(canvas, pixels[j] / SUPERSAMPLE, 0.40 * size * grow, colours[j] if parents[j] >= 0 else np.ones(3))


def disc(canvas: np.ndarray, at: tuple[float, float], radius: float, colour: np.ndarray) -> None:
    """Paints a disc. at, radius: in final pixels; colour: RGB in 0..1."""
    x, y, r = (round(v * SUPERSAMPLE * 16) for v in (*at, radius))
    cv2.circle(canvas, (x, y), r, to_bytes(colour).tolist(), -1, cv2.LINE_AA, 4)


def text(
    canvas: np.ndarray,
    words: str,
    at: tuple[float, float],
    *,
    size: float = 15,
    align: str = "left",
    bold: bool = False,
    theme: str = "light",
    room: float = np.inf,
) -> None:
    """Writes a line. at: left end, middle or right end of its base line (``align``) in final pixels; size: in final
    pixels, less where the line would be wider than ``room``. Letters outside Latin-1 may be missing."""
    scale = size * SUPERSAMPLE / 30.0
    thick = max(1, round(scale * (2.2 if bold else 1.1)))
    (width, _), _ = cv2.getTextSize(words, cv2.FONT_HERSHEY_SIMPLEX, scale, thick)
    if width > room * SUPERSAMPLE:
        scale *= room * SUPERSAMPLE / width
        (width, _), _ = cv2.getTextSize(words, cv2.FONT_HERSHEY_SIMPLEX, scale, thick)
    x = at[0] * SUPERSAMPLE - {"left": 0.0, "middle": width / 2, "right": width}[align]
    where = (round(x), round(at[1] * SUPERSAMPLE))
    cv2.putText(
        canvas, words, where, cv2.FONT_HERSHEY_SIMPLEX, scale, to_bytes(INK[theme]).tolist(), thick, cv2.LINE_AA
    )


@njit(cache=True, nogil=True)
def rasterise(pixels, near, weight, faces, height, width):
    """Which triangle is seen at each pixel's centre.

    pixels: (V, 2) x right, y down, the first pixel's centre at (0.5, 0.5); near: (V,) greater is nearer, linear on the
    screen; weight: (V,) 1 / depth for perspective-correct shares, ones for parallel rays; faces: (T, 3) int32.
    -> (H, W) int32 face or -1, (H, W, 3) float32 shares of its corners, (H, W) float32 nearness (-inf where empty).
    A centre on an edge belongs to the triangle; of equally near triangles the first is seen.
    """
    face = np.full((height, width), -1, np.int32)
    shares = np.zeros((height, width, 3), np.float32)
    depth = np.full((height, width), -np.inf, np.float32)
    for t in range(len(faces)):
        i, j, k = faces[t, 0], faces[t, 1], faces[t, 2]
        ax, ay, bx, by = pixels[i, 0], pixels[i, 1], pixels[j, 0], pixels[j, 1]
        cx, cy = pixels[k, 0], pixels[k, 1]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0.0 or not np.isfinite(area):
            continue
        x0 = max(int(np.ceil(min(ax, bx, cx) - 0.5)), 0)
        x1 = min(int(np.floor(max(ax, bx, cx) - 0.5)), width - 1)
        y0 = max(int(np.ceil(min(ay, by, cy) - 0.5)), 0)
        y1 = min(int(np.floor(max(ay, by, cy) - 0.5)), height - 1)
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                px, py = x + 0.5, y + 0.5
                u = ((bx - px) * (cy - py) - (by - py) * (cx - px)) / area
                v = ((cx - px) * (ay - py) - (cy - py) * (ax - px)) / area
                w = 1.0 - u - v
                if u < 0.0 or v < 0.0 or w < -1e-12:
                    continue
                z = np.float32(u * near[i] + v * near[j] + w * near[k])
                if z <= depth[y, x]:
                    continue
                depth[y, x] = z
                face[y, x] = t
                u, v, w = u * weight[i], v * weight[j], w * weight[k]
                total = u + v + w
                shares[y, x, 0], shares[y, x, 1], shares[y, x, 2] = u / total, v / total, w / total
    return face, shares, depth


@njit(cache=True, nogil=True)
def _spheres(pixels, towards, size, radius, height, width):
    """Which sphere is seen at each pixel's centre. towards: (N,) height above the image plane; size: (N,) radius in
    pixels -> (H, W) int32 owner or -1, (H, W, 3) float32 normals, (H, W) float32 nearness."""
    owner = np.full((height, width), -1, np.int32)
    normals = np.zeros((height, width, 3), np.float32)
    depth = np.full((height, width), -np.inf, np.float32)
    for n in range(len(pixels)):
        r = max(size[n], 0.71)  # never lost between pixels
        x0, x1 = max(int(pixels[n, 0] - r), 0), min(int(pixels[n, 0] + r) + 1, width - 1)
        y0, y1 = max(int(pixels[n, 1] - r), 0), min(int(pixels[n, 1] + r) + 1, height - 1)
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                dx, dy = (x + 0.5 - pixels[n, 0]) / r, (y + 0.5 - pixels[n, 1]) / r
                inside = 1.0 - dx * dx - dy * dy
                if inside < 0.0:
                    continue
                up = np.sqrt(inside)
                z = np.float32(towards[n] + radius * up)
                if z > depth[y, x]:
                    depth[y, x] = z
                    owner[y, x] = n
                    normals[y, x, 0], normals[y, x, 1], normals[y, x, 2] = dx, -dy, up
    return owner, normals, depth


def _crevices(depth: np.ndarray, hit: np.ndarray, camera: Camera) -> np.ndarray:
    """How much a pixel lies behind its neighbourhood, 0..1 (Luft et al. 2006, unsharp masking of the depth buffer):
    darkens folds and contacts as ambient occlusion would. -> (M,) for the pixels hit."""
    if not hit.any():
        return np.zeros(0, np.float32)
    z = np.where(hit, depth, 0.0).astype(np.float32)
    sigma = 0.012 * max(camera.height, camera.width)
    mass = cv2.GaussianBlur(hit.astype(np.float32), (0, 0), sigma)
    behind = cv2.GaussianBlur(z, (0, 0), sigma)[hit] / mass[hit] - z[hit]
    spread = np.float32(np.ptp(z[hit])) or np.float32(1.0)
    return np.clip(behind / (0.10 * spread), 0.0, 1.0)


def _blend(
    canvas: np.ndarray,
    hit: np.ndarray,
    normals: np.ndarray,
    colours: np.ndarray,
    crevices: np.ndarray,
    opacity: float,
    rim: float,
) -> None:
    """Lights the pixels hit and lays them over the canvas. normals: (M, 3) in the camera's frame."""
    normals = normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-9)
    normals = np.where(normals[:, 2:] < 0, -normals, normals)  # both sides of a cloth are lit
    key, fill = (np.clip(normals @ (light / np.linalg.norm(light)), 0, None) for light in (_KEY, _FILL))
    light = (0.42 + 0.55 * key + 0.16 * fill + 0.06 * normals[:, 1]) * (1.0 - 0.45 * crevices)
    shine = 0.10 * key**24
    lit = np.clip(colours**2.2 * light[:, None] + shine[:, None], 0, 1) ** (1 / 2.2)
    alpha = np.clip(opacity + rim * (1.0 - normals[:, 2]) ** 2, 0, 1)[:, None]
    canvas[hit] = to_bytes(alpha * lit + (1 - alpha) * canvas[hit] / 255.0)


def _bone(canvas: np.ndarray, a: np.ndarray, b: np.ndarray, unit: float, colour: np.ndarray, edge: np.ndarray) -> None:
    """A spindle from parent a to child b, widest near the parent."""
    along = b - a
    length = float(np.linalg.norm(along))
    if length < 1e-6:
        return
    side = np.array([-along[1], along[0]]) / length
    for wide, fill in ((0.34 * unit + 0.11 * unit, edge), (0.34 * unit, colour)):
        shape = np.stack([a, a + 0.18 * along + wide * side, b + 0.3 * wide * side, b - 0.3 * wide * side])
        shape = np.concatenate([shape, [a + 0.18 * along - wide * side]])
        cv2.fillPoly(canvas, [np.round(shape * 16).astype(np.int32)], to_bytes(fill).tolist(), cv2.LINE_AA, 4)
