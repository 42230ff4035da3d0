"""What cameras saw beside what is rendered for them."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from tasks.drawing import render
from tasks.values import Capture

SIDE = 240  # of a picture, in pixels
CAPTION = 22
GAIN = 4.0  # differences are shown so many times as strong
ROWS = 3
SHEET, SHEET_ROWS, THUMB = 8, 3, 120  # images in a row, rows of training images, pixels of each


def views_figure(truth: Capture, rendered: Mapping[str, Capture], *, theme: str = "light") -> np.ndarray:
    """Some views in rows: the true image, each rendering; with one rendering also its difference, four times as strong.

    truth: (I, H, W, 4) images; rendered: label -> the same views -> (H', W', 3) uint8 RGB.
    """
    chosen = np.unique(np.linspace(0, len(truth.images) - 1, ROWS + 2).round().astype(int)[1:-1])
    true = on_background(truth, chosen)
    columns = {"truth": true} | {name: on_background(capture, chosen) for name, capture in rendered.items()}
    if len(rendered) == 1:
        (only,) = rendered.values()
        columns[f"difference x {GAIN:g}"] = np.clip(GAIN * np.abs(true - on_background(only, chosen)), 0, 1)
    width, height = SIDE * len(columns), SIDE * len(chosen) + CAPTION
    canvas = render.blank(width, height, theme)
    scale = render.SUPERSAMPLE
    for c, (name, images) in enumerate(columns.items()):
        room = SIDE - 12
        render.text(
            canvas, name, (c * SIDE + SIDE / 2, CAPTION - 7), align="middle", bold=c == 0, theme=theme, room=room
        )
        for r, image in enumerate(images):
            big = cv2.resize(image, (SIDE * scale, SIDE * scale), interpolation=cv2.INTER_AREA)
            top, left = (CAPTION + r * SIDE) * scale, c * SIDE * scale
            canvas[top : top + SIDE * scale, left : left + SIDE * scale] = render.to_bytes(big)
    return render.finish(canvas)


def contact_sheet(capture: Capture, views: Capture, *, theme: str = "light") -> np.ndarray:
    """A row of held-out views below rows of training images, evenly over time -> (H', W', 3) uint8 RGB."""
    rows = [(capture, n) for n in np.array_split(_evenly(len(capture.images), SHEET_ROWS * SHEET), SHEET_ROWS)]
    rows.append((views, _evenly(len(views.images), SHEET)))
    pictures = [on_background(source, chosen) for source, chosen in rows]
    canvas = render.blank(SHEET * THUMB, len(rows) * THUMB + CAPTION, theme)
    scale = render.SUPERSAMPLE
    for r, images in enumerate(pictures):
        top = (r * THUMB + (CAPTION if r == len(rows) - 1 else 0)) * scale
        for c, image in enumerate(images):
            big = cv2.resize(image, (THUMB * scale, THUMB * scale), interpolation=cv2.INTER_AREA)
            left = c * THUMB * scale
            canvas[top : top + THUMB * scale, left : left + THUMB * scale] = render.to_bytes(big)
    line = (len(rows) - 1) * THUMB + CAPTION - 7
    render.text(canvas, "held out", (SHEET * THUMB / 2, line), align="middle", theme=theme, room=SHEET * THUMB)
    return render.finish(canvas)


def _evenly(count: int, wanted: int) -> np.ndarray:
    return np.unique(np.linspace(0, count - 1, min(count, wanted)).round().astype(int))


def on_background(capture: Capture, chosen: np.ndarray) -> np.ndarray:
    """Images over the capture's background, RGB in 0..1. (I, H, W, 3) float32."""
    images = capture.images[chosen].astype(np.float32) / 255
    alpha = images[..., 3:]
    return images[..., :3] * alpha + (1 - alpha) * capture.background.astype(np.float32)
