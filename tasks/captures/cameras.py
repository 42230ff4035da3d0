"""Cameras round a subject: OpenCV's axes (x right, y down, z forward), centres of pixels at +0.5."""

from __future__ import annotations

import numpy as np

MARGIN = 0.98  # of half the image: how far out a point may lie and count as inside
HIGHEST = np.deg2rad(80.0)  # cameras right above have no "up"


def look_at(eyes: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """World-to-camera matrices of cameras that look at their targets with +Y up. eyes, targets: (I, 3) -> (I, 4, 4)."""
    forward = np.asarray(targets, np.float64) - eyes
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    view = np.tile(np.eye(4), (len(forward), 1, 1))
    view[:, :3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    view[:, :3, 3] = -(view[:, :3, :3] @ np.asarray(eyes, np.float64)[:, :, None])[:, :, 0]
    return view


def pinhole(size: int, field_of_view: float) -> np.ndarray:
    """Intrinsics of a square image. size: pixels; field_of_view: degrees across -> (3, 3)."""
    focal = size / 2 / np.tan(np.deg2rad(field_of_view) / 2)
    return np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])


def eyes(view: np.ndarray) -> np.ndarray:
    """Where cameras stand. view: (I, 4, 4) -> (I, 3)."""
    rotation = np.asarray(view, np.float64)[:, :3, :3]
    return -(np.swapaxes(rotation, 1, 2) @ np.asarray(view, np.float64)[:, :3, 3:])[:, :, 0]


def project(points: np.ndarray, view: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Pixels of points seen by one camera. points: (N, 3); view: (4, 4); intrinsics: (3, 3) -> (N, 2)."""
    local = np.asarray(points, np.float64) @ view[:3, :3].T + view[:3, 3]
    image = local @ np.asarray(intrinsics, np.float64).T
    return image[:, :2] / image[:, 2:]


def hemisphere(count: int, seed: int) -> np.ndarray:
    """Directions towards random cameras, evenly over the upper hemisphere but for its top. -> (count, 3)"""
    random = np.random.default_rng(seed)
    azimuth, height = random.uniform(0, 2 * np.pi, count), random.uniform(0, np.sin(HIGHEST), count)
    return _directions(azimuth, height)


def ring(count: int, *, low: float, high: float, turn: float) -> np.ndarray:
    """Directions towards cameras on a ring, by turns at the lower and the higher elevation. low, high: degrees; turn:
    where the ring starts, in steps between neighbours. -> (count, 3)"""
    azimuth = 2 * np.pi * (np.arange(count) + turn) / count
    return _directions(azimuth, np.sin(np.deg2rad(np.where(np.arange(count) % 2, high, low))))


def _directions(azimuth: np.ndarray, height: np.ndarray) -> np.ndarray:
    flat = np.sqrt(1 - height**2)
    return np.stack([flat * np.sin(azimuth), height, flat * np.cos(azimuth)], axis=1)


def uncut_distance(points: np.ndarray, target: np.ndarray, direction: np.ndarray, half_width: float) -> float:
    """How far from its target a camera must stand for all points to be in its image.

    points: (N, 3); target: (3,); direction: (3,) from target to camera; half_width: of the image at distance one.
    """
    view = look_at((target + direction)[None], target[None])[0]
    local = np.asarray(points, np.float64) @ view[:3, :3].T + view[:3, 3]
    beyond_target = local[:, 2] - 1.0  # the camera of `view` stands at distance one
    return float((np.abs(local[:, :2]).max(1) / (MARGIN * half_width) - beyond_target).max())
