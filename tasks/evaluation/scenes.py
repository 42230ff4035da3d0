"""What a rendered scene holds, and whether its cameras see the surface where it is."""

from __future__ import annotations

import cv2
import numpy as np

from tasks.evaluation.metrics import declared
from tasks.values import Capture, Metrics, Motion


def evaluate_scene(capture: Capture, views: Capture, motion: Motion) -> Metrics:
    """Counts, the subject's share of the training images, and how many of the true vertices project onto the subject
    (all of them, to a pixel: a vertex on the outline may share its pixel with no ray)."""
    on = np.concatenate([_on_subject(c, motion) for c in (capture, views)])
    found = {
        "images_count": float(len(capture.images)),
        "views_count": float(len(views.images)),
        "frames_count": float(motion.frames),
        "fill_pct": 100.0 * float(capture.images[..., 3].mean(dtype=np.float64)) / 255,
        "on_subject_pct": 100.0 * float(on.mean()),
    }
    return declared(found, motion.unit)


def _on_subject(capture: Capture, motion: Motion) -> np.ndarray:
    """Share of the vertices on the subject, image by image. (I,)"""
    height, width = capture.size
    out = np.empty(len(capture.images))
    for i, image in enumerate(capture.images):
        view, points = capture.view[i].astype(np.float64), motion.points[capture.frame[i]]
        local = (points @ view[:3, :3].T + view[:3, 3]) @ capture.intrinsics[i].astype(np.float64).T
        column, row = np.floor(local[:, :2] / local[:, 2:]).astype(int).T
        inside = (local[:, 2] > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        near = cv2.dilate((image[..., 3] > 0).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        out[i] = near[row[inside], column[inside]].sum() / len(points)
    return out
