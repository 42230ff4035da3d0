"""Where Gaussians start: the visual hull of the masks round a reference time, or a ball where there are no masks."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from tasks.errors import InputError
from tasks.values import Capture

INSIDE = 128  # alpha from which a pixel belongs to the thing
COARSE = 40  # cells along a side of the cube that is searched for the thing
TRIED = 12  # reference times that are compared
LEAST_CELLS = 30  # a hull of fewer cells is no start


@dataclass(frozen=True)
class Start:
    """points: (M, 3), on the hull's skin, or in the ball; spacing: between neighbours, in the data's unit;
    frame: the reference frame; recall: share of the masks that the hull covers, 0 to 1."""

    points: np.ndarray
    spacing: float
    frame: int
    recall: float


def hull_start(capture: Capture, *, frame: int | None, views: int, agree: float, cells: int) -> Start:
    """The skin of the visual hull of the ``views`` images nearest in time to a reference frame.

    A point is inside when at least the share ``agree`` of the masks hold it; outside an image counts as outside its
    mask. frame: the reference, or None for the one of twelve whose hull covers its own masks best: the thing hardly
    moves there. cells: along the longest side of the hull's box. Raises InputError where no masks agree.
    """
    centre, radius = whereabouts(capture)
    frames = np.unique(capture.frame)
    tried = [frame] if frame is not None else frames[np.linspace(0, len(frames) - 1, TRIED).astype(int)].tolist()
    found = [(*_cells(capture, f, views, agree, centre - radius, 2 * radius / COARSE, (COARSE,) * 3), f) for f in tried]
    inside, recall, frame = max(found, key=lambda c: c[1])
    if np.count_nonzero(inside) < LEAST_CELLS:
        raise InputError(
            f"{capture.name}: masks",
            expected=f"a common volume of the {views} masks round frame {frame}",
            found=f"{np.count_nonzero(inside)} of {inside.size} cells",
            do="check cameras and alpha, or set reconstruction.start=ball",
        )
    where = np.argwhere(inside)
    step = 2 * radius / COARSE
    low, high = centre - radius + step * (where.min(0) - 1), centre - radius + step * (where.max(0) + 2)
    fine = float((high - low).max() / cells)
    inside, recall = _cells(capture, frame, views, agree, low, fine, tuple(np.ceil((high - low) / fine).astype(int)))
    points = low + fine * (np.argwhere(_skin(inside)) + 0.5)
    return Start(points.astype(np.float32), fine, int(frame), recall)


def ball_start(capture: Capture, *, frame: int | None, count: int, rng: np.random.Generator) -> Start:
    """Points evenly spread in the ball that the cameras look at."""
    centre, radius = whereabouts(capture)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    points = centre + radius * rng.random((count, 1)) ** (1 / 3) * direction
    frames = np.unique(capture.frame)
    middle = int(frames[len(frames) // 2]) if frame is None else frame
    return Start(points.astype(np.float32), float(radius * (4.2 / count) ** (1 / 3)), middle, 0.0)


def whereabouts(capture: Capture) -> tuple[np.ndarray, float]:
    """Centre and radius of a ball that holds the thing: the point nearest to the rays through the middle of all masks
    (of all images where there are none), and the widest mask (half the image) seen at its distance."""
    h, w = capture.size
    low, high = np.zeros((len(capture.images), 2)), np.tile([w, h], (len(capture.images), 1)).astype(float)
    if capture.has_alpha:
        for i, image in enumerate(capture.images):
            mask = image[..., 3] >= INSIDE
            rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
            if len(rows):
                low[i], high[i] = (columns[0], rows[0]), (columns[-1] + 1, rows[-1] + 1)
    focal = np.stack([capture.intrinsics[:, 0, 0], capture.intrinsics[:, 1, 1]], axis=1).astype(float)
    middle = ((low + high) / 2 - capture.intrinsics[:, :2, 2]) / focal
    turn, shift = capture.view[:, :3, :3].astype(float), capture.view[:, :3, 3].astype(float)
    eye = -np.einsum("iab,ia->ib", turn, shift)
    ray = np.einsum("iab,ia->ib", turn, np.concatenate([middle, np.ones((len(middle), 1))], axis=1))
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
    # rays that are all alike leave the depth open: a faint pull to the eyes' own distance from the origin settles it
    faint = 1e-6 * len(ray)
    system = across.sum(0) + faint * np.eye(3)
    centre = np.linalg.solve(system, np.einsum("iab,ib->a", across, eye))
    distance = np.linalg.norm(eye - centre, axis=1)
    half = np.linalg.norm((high - low) / 2 / focal, axis=1)
    return centre, float(np.quantile(half * distance, 0.95)) * 1.1


def nearest_views(capture: Capture, frame: int, count: int) -> np.ndarray:
    """The ``count`` images nearest in time to a frame, in its own clip where it has enough; all of the frame's own."""
    clip = np.searchsorted(capture.clip_start, capture.frame, side="right")
    own = int(np.searchsorted(capture.clip_start, frame, side="right"))
    far = np.abs(capture.times[capture.frame] - capture.times[frame]) + 10.0 * (clip != own)
    order = np.argsort(far, kind="stable")
    return np.sort(order[: max(count, int(np.count_nonzero(capture.frame == frame)))])


def _cells(
    capture: Capture, frame: int, views: int, agree: float, low: np.ndarray, step: float, shape: tuple
) -> tuple[np.ndarray, float]:
    """Cells inside enough masks, (X, Y, Z) bool, and the share of the masks' pixels that some such cell covers."""
    chosen = nearest_views(capture, frame, views)
    masks = np.ascontiguousarray(capture.images[chosen, :, :, 3] >= INSIDE)
    camera = np.concatenate([capture.intrinsics[chosen] @ capture.view[chosen, :3]]).astype(np.float64)
    need = int(np.ceil(agree * len(chosen) - 1e-9))
    inside = _carve(masks, camera, low.astype(np.float64), step, shape, need)
    covered = _cover(masks, camera, low.astype(np.float64), step, inside)
    return inside, float(covered.sum() / max(masks.sum(), 1))


def _skin(inside: np.ndarray) -> np.ndarray:
    """Inside cells of which one of the six neighbours is outside."""
    padded = np.pad(inside, 1)
    hidden = inside.copy()
    for axis in range(3):
        for shift in (-1, 1):
            hidden &= np.roll(padded, shift, axis)[1:-1, 1:-1, 1:-1]
    return inside & ~hidden


@numba.njit(cache=True, nogil=True)
def _carve(masks, camera, low, step, shape, need):
    inside = np.zeros(shape, np.bool_)
    views, height, width = masks.shape
    for x in range(shape[0]):
        px = low[0] + step * (x + 0.5)
        for y in range(shape[1]):
            py = low[1] + step * (y + 0.5)
            for z in range(shape[2]):
                pz = low[2] + step * (z + 0.5)
                votes = 0
                for v in range(views):
                    if votes + views - v < need:
                        break
                    c = camera[v]
                    depth = c[2, 0] * px + c[2, 1] * py + c[2, 2] * pz + c[2, 3]
                    if depth <= 0.0:
                        continue
                    column = int(np.floor((c[0, 0] * px + c[0, 1] * py + c[0, 2] * pz + c[0, 3]) / depth))
                    row = int(np.floor((c[1, 0] * px + c[1, 1] * py + c[1, 2] * pz + c[1, 3]) / depth))
                    if 0 <= column < width and 0 <= row < height and masks[v, row, column]:
                        votes += 1
                inside[x, y, z] = votes >= need
    return inside


@numba.njit(cache=True, nogil=True)
def _cover(masks, camera, low, step, inside):
    """Mask pixels under the square that each inside cell draws."""
    covered = np.zeros(masks.shape, np.bool_)
    views, height, width = masks.shape
    for x in range(inside.shape[0]):
        for y in range(inside.shape[1]):
            for z in range(inside.shape[2]):
                if not inside[x, y, z]:
                    continue
                px, py, pz = low[0] + step * (x + 0.5), low[1] + step * (y + 0.5), low[2] + step * (z + 0.5)
                for v in range(views):
                    c = camera[v]
                    depth = c[2, 0] * px + c[2, 1] * py + c[2, 2] * pz + c[2, 3]
                    if depth <= 0.0:
                        continue
                    column = (c[0, 0] * px + c[0, 1] * py + c[0, 2] * pz + c[0, 3]) / depth
                    row = (c[1, 0] * px + c[1, 1] * py + c[1, 2] * pz + c[1, 3]) / depth
                    # rows of K [R|t] are not unit length: the focal length is the first row's part across the third
                    reach = 0.6 * step * np.sqrt(c[0, 0] ** 2 + c[0, 1] ** 2 + c[0, 2] ** 2) / depth
                    for r in range(max(int(row - reach), 0), min(int(row + reach) + 1, height)):
                        for k in range(max(int(column - reach), 0), min(int(column + reach) + 1, width)):
                            covered[v, r, k] = masks[v, r, k]
    return covered
