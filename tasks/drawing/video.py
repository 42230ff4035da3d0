"""Small looping videos, of a test clip with truth and methods side by side: animated WebP, which browsers just play."""

from __future__ import annotations

import math
from collections.abc import Mapping

import cv2
import numpy as np

from tasks.drawing import figures, plot, render
from tasks.drawing.colours import CLAY, error_map
from tasks.evaluation.metrics import frame_rmse, squared_errors, unit_of
from tasks.values import Motion

SIDE = 250  # pixels of a panel
DRIVEN = 420  # of one that stands alone
RATE = 12.5  # frames a second at most
LONGEST = 64  # frames
LARGEST = 1_400_000  # bytes
QUALITIES = (85, 70, 50, 35, 20)  # of WebP, the first that stays below LARGEST


def clip_video(
    test: Motion, results: Mapping[str, np.ndarray], diagonal: float, *, focus: str, azimuth: float
) -> tuple[bytes, str]:
    """The unseen clip on which ``focus`` has its median error, all panels coloured by vertex error on one scale.

    results: label -> (F, N, 3) on the frames of ``test``; diagonal: of the canonical bounding box. Long clips are cut
    after ``LONGEST`` frames. -> the WebP file, and a line that says what it shows.
    """
    clip = _median_clip(test, results[focus])
    frames, seconds = _frames(test, clip)
    truth = test.points[frames]
    unit, factor = unit_of("length", test.unit)
    if unit == "unit":  # says nothing by itself
        unit, factor = "% of diagonal", 100.0 / diagonal
    errors = {name: factor * np.sqrt(squared_errors(points[frames], truth)) for name, points in results.items()}
    top = plot.round_up(float(np.quantile(np.stack(list(errors.values())), 0.99)), (1, 1.5, 2, 3, 4, 5, 6, 8, 10))
    shape = figures.shape_of(truth[0], test.faces)
    centres = truth.mean(1, dtype=np.float64)
    camera = _camera(truth - centres[:, None], azimuth)

    def picture(i: int) -> np.ndarray:
        at = camera.at(camera.centre + centres[i])
        panels = [figures.panel(shape, at, truth[i], CLAY, [f"truth, {test.clip_names[clip]}"], "light")]
        for name, points in results.items():
            panels.append(
                figures.panel(shape, at, points[frames[i]], error_map(errors[name][i] / top), [name], "light")
            )
        sheet = figures.grid(panels, 2 if len(panels) == 4 else 3, "light")
        scale = figures.colour_bar(len(sheet), error_map, top, unit, "light")
        return render.finish(figures.beside([sheet, scale], "light"))

    caption = f"{test.name}, unseen clip {test.clip_names[clip]}: darker is further off, up to {top:g} {unit}"
    return animated([picture(i) for i in range(len(frames))], seconds), caption


def driven_video(points: np.ndarray, faces: np.ndarray | None, fps: float, *, azimuth: float) -> bytes:
    """A shape in motion, the eye going along. points: (F, N, 3); faces: (T, 3) or None. -> the WebP file."""
    step = max(1, math.ceil(fps / RATE - 1e-9))
    shown = points[::step][:LONGEST]
    shape = figures.shape_of(shown[0], faces)
    centres = shown.mean(1, dtype=np.float64)
    camera = _camera(shown - centres[:, None], azimuth, DRIVEN)
    views = [camera.at(camera.centre + centre) for centre in centres]
    pictures = [figures.panel(shape, v, p, CLAY, [], "light") for v, p in zip(views, shown, strict=True)]
    return animated([render.finish(picture) for picture in pictures], step / fps)


def animated(pictures: list[np.ndarray], seconds: float) -> bytes:
    """Pictures (H, W, 3) uint8 RGB, each shown for some seconds, as a looping WebP of at most ``LARGEST`` bytes if a
    lower quality brings it there."""
    animation = cv2.Animation()
    animation.frames = [cv2.cvtColor(picture, cv2.COLOR_RGB2BGR) for picture in pictures]
    animation.durations = [round(1000 * seconds)] * len(pictures)
    animation.loop_count = 0  # for ever
    for quality in QUALITIES:
        done, data = cv2.imencodeanimation(".webp", animation, [cv2.IMWRITE_WEBP_QUALITY, quality])
        if not done:
            raise ValueError(f"{len(pictures)} pictures of shape {pictures[0].shape} could not be written as WebP")
        if data.nbytes <= LARGEST:
            break
    return data.tobytes()


def _median_clip(test: Motion, points: np.ndarray) -> int:
    """The clip whose error is the median of all clips'."""
    errors = frame_rmse(points, test.points) ** 2
    by_clip = [math.sqrt(float(errors[clip].mean())) for clip in test.clips()]
    return int(np.argsort(by_clip, kind="stable")[len(by_clip) // 2])


def _frames(test: Motion, clip: int) -> tuple[np.ndarray, float]:
    """Which frames of a clip are shown, and for how many seconds each."""
    step = max(1, math.ceil(test.fps / RATE - 1e-9))
    there = test.clips()[clip]
    return np.arange(there.start, there.stop, step)[:LONGEST], step / test.fps


def _camera(points: np.ndarray, azimuth: float, side: int = SIDE) -> render.Camera:
    """A camera that holds all frames (F, N, 3), each moved to its own centre."""
    size = {"width": side, "height": side, "distance": figures.EYE, "margin": 0.02}
    return render.look(points.reshape(-1, 3), azimuth=azimuth, elevation=figures.ELEVATION, **size)
