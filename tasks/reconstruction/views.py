"""Gaussians in motion as a camera sees them, and put into other poses."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from scipy.sparse import csr_matrix

from tasks.errors import InputError
from tasks.geometry import rotations
from tasks.values import Animation, Capture, Gaussians, Motion, Reconstruction, Skinning


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


def at_frame(reconstruction: Reconstruction, frame: int) -> Gaussians:
    """The Gaussians of one frame. Colours stay in the world's frame: coefficients of degree 1 and up do not turn."""
    rest, f = reconstruction.gaussians, frame
    scales, opacities, quaternions = rest.scales, rest.opacities, rest.quaternions
    if reconstruction.scaling is not None:
        scales = scales * reconstruction.scaling[f][:, None]
    if reconstruction.opacity is not None:
        opacities = opacities * reconstruction.opacity[f]
    if reconstruction.rotations is not None and quaternions is not None:
        turned = rotations.from_quaternion(reconstruction.rotations[f]) @ rotations.from_quaternion(quaternions)
        quaternions = rotations.to_quaternion(turned).astype(np.float32)
    return replace(rest, means=reconstruction.points[f], scales=scales, opacities=opacities, quaternions=quaternions)


def pose_gaussians(
    reconstruction: Reconstruction, animation: Animation, motion: Motion, skinning: Skinning
) -> Reconstruction:
    """The Gaussians in the poses of an animation, frame for frame of the motion that it was made for.

    animation.points: (F, N, 3) of the reconstruction's N Gaussians. Where they are stretched, each turns as the bones
    that carry it: the rotation nearest to its blended transform. What the fit found for single frames (scaling,
    opacity) is left behind; times run evenly from 0 to 1. Raises InputError where the points are not the Gaussians.
    """
    expected, found = reconstruction.points.shape[1], animation.points.shape[1]
    if expected != found:
        raise InputError(
            "pose_gaussians", expected=f"a point for each of {expected} Gaussians", found=f"{found} points"
        )
    turned = None
    if reconstruction.gaussians.quaternions is not None and animation.bones is not None:
        turned = _turned(skinning.weights, animation.bones)
    return replace(
        reconstruction,
        points=animation.points,
        rotations=turned,
        scaling=None,
        opacity=None,
        times=np.linspace(0.0, 1.0, len(animation.points)).astype(np.float32),
        fps=motion.fps,
        clip_start=motion.clip_start,
        clip_names=motion.clip_names,
        rig=motion.rig,
    )


def _turned(weights: np.ndarray, bones: np.ndarray) -> np.ndarray:
    """Quaternions (F, N, 4) of the rotations nearest to the blended bones. weights: (N, B); bones: (F, B, 3, 4)."""
    sparse = csr_matrix(np.asarray(weights, np.float64))
    out = np.empty((len(bones), len(weights), 4), np.float32)
    for f, bone in enumerate(bones):
        blended = sparse @ bone[:, :, :3].reshape(-1, 9).astype(np.float64)
        out[f] = rotations.to_quaternion(rotations.project_so3(blended.reshape(-1, 3, 3)))
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
