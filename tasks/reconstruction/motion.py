"""The paths of Gaussians as a moving shape, for the stages that follow."""

from __future__ import annotations

from tasks.values import Motion, Reconstruction


def motion_of(reconstruction: Reconstruction) -> Motion:
    """Bare points, one for every Gaussian, transparent ones too, so that what poses the points can pose the Gaussians.

    The rest shape is the canonical set; the rig comes along where the capture had one, without skin weights.
    """
    return Motion(
        name=reconstruction.name,
        points=reconstruction.points,
        faces=None,
        clip_start=reconstruction.clip_start,
        clip_names=reconstruction.clip_names,
        fps=reconstruction.fps,
        unit=reconstruction.unit,
        rest=reconstruction.gaussians.means,
        rig=reconstruction.rig,
    )
