"""Which images a fit looks at, when, and how large.

First those round the reference time, with nothing moving; then a window of time that grows from there until it holds
every clip. Without it Gaussians of one limb are caught by the images of another.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tasks.reconstruction.hull import INSIDE, Start, nearest_views
from tasks.values import Capture

EDGE = 5  # frames at an end of the window that every other step goes to while it grows


@dataclass(frozen=True)
class Schedule:
    """iterations: of the fit; static, grown: shares of them at which things begin to move and at which the window holds
    all; coarsest, full: share of the size at the start, and share of the iterations from which it is the whole size."""

    iterations: int
    static: float
    grown: float
    coarsest: float
    full: float

    def moving(self, iteration: int) -> bool:
        """True once the deformation is learned."""
        return iteration >= self.static * self.iterations

    def growth(self, iteration: int) -> float:
        """How far the window has grown, 0 to 1."""
        along = iteration / self.iterations
        return float(np.clip((along - self.static) / max(self.grown - self.static, 1e-9), 0.0, 1.0))

    def sizes(self) -> list[float]:
        """The shares of the size, each twice the one before."""
        steps = max(0, round(float(np.log2(1.0 / self.coarsest))))
        return [0.5 ** (steps - k) for k in range(steps + 1)]

    def size(self, iteration: int) -> int:
        """Which of :meth:`sizes` an iteration uses; they change at even distances."""
        steps = len(self.sizes()) - 1
        return min(steps, int(steps * self.sharpness(iteration)))

    def sharpness(self, iteration: int) -> float:
        """How far along the way to images of the whole size an iteration is, 0 to 1."""
        return min(1.0, iteration / max(self.full * self.iterations, 1e-9))


class Window:
    """The frames of each clip that are in use: they grow from an entry frame outwards."""

    def __init__(self, capture: Capture, start: Start, views: int) -> None:
        self._frame, self._clip_start = capture.frame, capture.clip_start
        near = capture.frame[nearest_views(capture, start.frame, views)]
        self.first_images = np.flatnonzero(np.isin(capture.frame, near))
        self._own = int(np.searchsorted(capture.clip_start, start.frame, side="right")) - 1
        self._entries = _entries(capture, start, self._own)
        bounds = self._bounds(self._own)
        inside = near[(near >= bounds[0]) & (near < bounds[1])]
        self._least = int(np.abs(inside - start.frame).max())

    def frames(self, growth: float) -> list[tuple[int, int]]:
        """First and last frame in use of every clip; last before first for a clip that has not begun."""
        found = []
        for clip, entry in enumerate(self._entries):
            low, high = self._bounds(clip)
            reach = growth * max(entry - low, high - 1 - entry)
            if clip == self._own:
                reach = max(reach, self._least)
            elif growth == 0.0:
                found.append((low, low - 1))
                continue
            found.append((max(low, int(np.ceil(entry - reach))), min(high - 1, int(entry + reach))))
        return found

    def images(self, frames: list[tuple[int, int]]) -> np.ndarray:
        """The images of the frames in use."""
        used = np.zeros(len(self._frame), bool)
        for low, high in frames:
            used |= (self._frame >= low) & (self._frame <= high)
        return np.flatnonzero(used)

    def edge(self, frames: list[tuple[int, int]]) -> np.ndarray:
        """The images of the frames that came in last, at ends of the window that go on growing."""
        late = np.zeros(len(self._frame), bool)
        for clip, (low, high) in enumerate(frames):
            first, end = self._bounds(clip)
            near_low = (self._frame >= low) & (self._frame < low + EDGE) & (low > first)
            near_high = (self._frame <= high) & (self._frame > high - EDGE) & (high < end - 1)
            late |= (near_low | near_high) & (low <= high)
        return np.flatnonzero(late)

    def _bounds(self, clip: int) -> tuple[int, int]:
        return int(self._clip_start[clip]), int(self._clip_start[clip + 1])


def _entries(capture: Capture, start: Start, own: int) -> list[int]:
    """The frame of each clip whose masks look most like the start's points: that pose is the nearest to it. A clip
    without masks is entered at its first frame with an image."""
    entries = []
    for clip, (low, high) in enumerate(zip(capture.clip_start[:-1], capture.clip_start[1:], strict=True)):
        images = np.flatnonzero((capture.frame >= low) & (capture.frame < high))
        if clip == own:
            entries.append(start.frame)
        elif len(images) == 0:
            entries.append(int(low))
        elif not capture.has_alpha:
            entries.append(int(capture.frame[images].min()))
        else:
            alike = np.array([_alike(capture, i, start) for i in images])
            frames = capture.frame[images]
            mean = np.bincount(frames - low, alike) / np.maximum(np.bincount(frames - low), 1)
            entries.append(int(low + mean.argmax()))
    return entries


def _alike(capture: Capture, i: int, start: Start) -> float:
    """Intersection over union of an image's mask and the start's points, both on a grid as coarse as the points."""
    view, k = capture.view[i].astype(float), capture.intrinsics[i].astype(float)
    seen = start.points @ view[:3, :3].T + view[:3, 3]
    seen = seen[seen[:, 2] > 0]
    if len(seen) == 0:
        return 0.0
    cell = max(1, int(np.ceil(1.5 * start.spacing * k[0, 0] / np.median(seen[:, 2]))))
    h, w = -(-capture.size[0] // cell), -(-capture.size[1] // cell)
    at = (seen[:, :2] / seen[:, 2:] * k[[0, 1], [0, 1]] + k[:2, 2]) // cell
    at = at[((at >= 0) & (at < [w, h])).all(1)].astype(int)
    drawn = np.zeros((h, w), bool)
    drawn[at[:, 1], at[:, 0]] = True
    mask = capture.images[i, cell // 2 :: cell, cell // 2 :: cell, 3] >= INSIDE
    drawn = drawn[: mask.shape[0], : mask.shape[1]]
    return float((drawn & mask).sum() / max((drawn | mask).sum(), 1))
