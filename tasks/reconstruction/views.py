"""Gaussians in motion as a camera sees them, and put into other poses."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from tasks.errors import InputError
from tasks.geometry import rotations
from tasks.geometry.gaussians import at_frame
from tasks.values import Animation, Capture, Gaussians, Reconstruction

NEIGHBOURS = 8  # whose motion says how a Gaussian turns


def render_views(
    reconstruction: Reconstruction, capture: Capture, *, backend: Literal["numba", "gsplat", "reference"]
) -> Capture:
    """The Gaussians seen by the capture's cameras in its frames: the same capture with rendered images.

    Straight colour and alpha, as in every capture; a pixel that sees nothing is black with alpha 0. Raises InputError
    where the capture has frames that the reconstruction has not, and see :func:`rasterize` for the backends.
    """
    frames = len(reconstruction.points)
    if len(capture.frame) and int(capture.frame.max()) >= frames:
        raise InputError(
            f"{capture.name}: frames", expected=f"numbers below {frames}", found=str(int(capture.frame.max()))
        )
    images = np.empty((len(capture.frame), *capture.size, 4), np.uint8)
    for i, f in enumerate(capture.frame):
        posed = at_frame(reconstruction, int(f))
        images[i] = _image(posed, capture.view[i], capture.intrinsics[i], capture.size, backend)
    return replace(capture, images=images, has_alpha=True)


def pose_gaussians(reconstruction: Reconstruction, animation: Animation) -> Reconstruction:
    """The Gaussians in the poses of an animation, frame for frame.

    animation.points: (F, N, 3) of the reconstruction's N Gaussians. Where they are stretched, each turns as its
    neighbours do round it, which holds for every method, with bones or without. What the fit found for single frames
    (scaling, opacity) is left behind; the frames are one clip, times run evenly from 0 to 1. Raises InputError where
    the points are not the Gaussians.
    """
    rest, count = reconstruction.gaussians, len(animation.points)
    if animation.points.shape[1] != len(rest.means):
        found = f"{animation.points.shape[1]} points"
        raise InputError("pose_gaussians", expected=f"a point for each of {len(rest.means)} Gaussians", found=found)
    return replace(
        reconstruction,
        points=animation.points,
        rotations=None if rest.quaternions is None else _turned(rest.means, animation.points),
        scaling=None,
        opacity=None,
        times=np.linspace(0.0, 1.0, count).astype(np.float32),
        clip_start=np.array([0, count], np.int64),
        clip_names=("posed",),
        rig=None,
    )


def _turned(rest: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Quaternions (F, N, 4) of the rotations that best carry each point's neighbourhood from rest to every frame."""
    near = cKDTree(rest).query(rest, min(NEIGHBOURS + 1, len(rest)))[1][:, 1:]  # without the point itself
    before = (rest[near] - rest[:, None]).astype(np.float64)
    out = np.empty((*points.shape[:2], 4), np.float32)
    for f, posed in enumerate(points):
        after = (posed[near] - posed[:, None]).astype(np.float64)
        turns = rotations.project_so3(np.einsum("nki,nkj->nij", after, before))
        out[f] = rotations.to_quaternion(turns)
    return out


def _image(gaussians: Gaussians, view: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int], backend: str):
    """(H, W, 4) uint8, straight colour and alpha."""
    import torch

    from tasks.reconstruction.rasterize import rasterize

    device = "cuda" if backend == "gsplat" and torch.cuda.is_available() else "cpu"
    names = ("means", "scales", "opacities", "sh", "quaternions")
    arrays = [getattr(gaussians, name) for name in names] + [view, intrinsics, np.zeros(3)]
    *given, turn, view, intrinsics, black = (
        None if a is None else torch.as_tensor(np.ascontiguousarray(a, np.float32), device=device) for a in arrays
    )
    with torch.no_grad():
        rgb, alpha, _ = rasterize(*given, view, intrinsics, size, black, turn, backend)
        straight = torch.where(alpha[..., None] > 0, rgb / alpha[..., None].clamp(min=1e-6), 0.0)
        image = torch.cat([straight, alpha[..., None]], dim=2).clamp(0.0, 1.0)
        return (255.0 * image + 0.5).to(torch.uint8).cpu().numpy()
