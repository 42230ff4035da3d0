"""Colours for figures: RGB in 0..1, float32."""

from __future__ import annotations

import cv2
import numpy as np

CLAY = np.array([0.78, 0.80, 0.83], np.float32)  # a surface that carries no number
INK = {"light": (0.13, 0.14, 0.17), "dark": (0.92, 0.93, 0.95)}
PAPER = {"light": (1.0, 1.0, 1.0), "dark": (0.075, 0.085, 0.105)}

# pale to dark with evenly falling lightness (CIELAB), so that equal steps of error look equal; also in grey print
_ERROR_LAB = np.array([[93, 0, 2], [80, 10, 38], [64, 42, 48], [46, 58, 34], [29, 48, 2], [13, 26, -22]], np.float32)
_WEIGHT_LAB = np.array(
    [[93, 0, 2], [80, -22, 8], [64, -32, -4], [46, -20, -24], [29, 6, -40], [13, 20, -30]], np.float32
)
# told apart also by readers who confuse red and green (after Okabe and Ito 2008, softened for shading)
_PARTS = ("#4c86c6", "#e8963a", "#4aa67c", "#c75b7a", "#8f78c4", "#c9b13f", "#5bb9c9", "#a5694a", "#7f8c99", "#d98cc0")


def error_map(values: np.ndarray) -> np.ndarray:
    """Colours of errors between 0 and 1 (clipped). values: (...) -> (..., 3)."""
    return _along(_ERROR_LAB, values)


def weight_map(values: np.ndarray) -> np.ndarray:
    """Colours of weights and shares between 0 and 1 (clipped). values: (...) -> (..., 3)."""
    return _along(_WEIGHT_LAB, values)


def part_colours(count: int) -> np.ndarray:
    """Colours for a few groups. -> (count, 3); repeats after ten."""
    rgb = [[int(h[i : i + 2], 16) / 255 for i in (1, 3, 5)] for h in _PARTS]
    return np.array([rgb[i % len(rgb)] for i in range(count)], np.float32)


def bone_colours(count: int) -> np.ndarray:
    """Colours for many groups: hues a golden angle apart, three lightnesses. -> (count, 3)."""
    index = np.arange(count)
    hue = index * np.pi * (3 - np.sqrt(5))
    lightness, chroma = 66.0 + 12.0 * (index % 3 - 1), 36.0
    lab = np.stack([lightness, chroma * np.cos(hue), chroma * np.sin(hue)], axis=-1)
    return _from_lab(lab.astype(np.float32))


def _along(table: np.ndarray, values: np.ndarray) -> np.ndarray:
    at = np.clip(np.asarray(values, np.float32), 0, 1) * (len(table) - 1)
    steps = np.arange(len(table), dtype=np.float32)
    lab = np.stack([np.interp(at.ravel(), steps, table[:, c]) for c in range(3)], axis=-1)
    return _from_lab(lab).reshape(*at.shape, 3)


def _from_lab(lab: np.ndarray) -> np.ndarray:
    if len(lab) == 0:
        return np.zeros((0, 3), np.float32)
    return np.clip(cv2.cvtColor(lab.reshape(-1, 1, 3).astype(np.float32), cv2.COLOR_Lab2RGB)[:, 0], 0, 1)
