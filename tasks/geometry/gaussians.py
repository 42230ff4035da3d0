"""Gaussians in motion, frame by frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tasks.geometry import rotations
from tasks.values import Gaussians, Reconstruction


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
