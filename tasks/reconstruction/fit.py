"""Consistent Gaussians from images (GA 3.1): one canonical set and a deformation, fitted to all images at once."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Annotated, Literal

from tasks.values import Capture, Reconstruction
from tasks.workspace import Workspace


def fit(
    capture: Capture,
    *,
    deformation: Literal["nodes", "mlp"],
    backend: Annotated[
        Literal["numba", "gsplat", "reference"],
        "backend != 'gsplat' or deformation == 'mlp': numba with deformation=nodes",
    ],
    iterations: Annotated[int, "[1, inf)"],
    largest: Annotated[int, "[1, inf)"],
    start: Literal["hull", "ball"],
    reference: Annotated[int, "[0, inf)"] | None,
    hull_views: Annotated[int, "[1, inf)"],
    hull_agree: Annotated[float, "[0, 1]"],
    hull_cells: Annotated[int, "[1, inf)"],
    static: Annotated[float, "[0, 1]"],
    grown: Annotated[float, "[0, 1]", "grown >= static: at least static"],
    coarsest: Annotated[float, "(0, 1]"],
    full: Annotated[float, "[0, 1]"],
    blur: Annotated[float, "[0, inf)"],
    gaussians: Annotated[int, "[1, inf)"],
    max_gaussians: Annotated[int, "[1, inf)", "max_gaussians >= gaussians: at least gaussians"],
    growth: Annotated[float, "[0, inf)"],
    divide_every: Annotated[int, "[1, inf)"],
    divide_until: Annotated[float, "[0, 1]"],
    least_shown: Annotated[float, "[0, inf)"],
    sh_degree: Annotated[int, "[0, 3]"],
    structure: Annotated[float, "[0, 1]"],
    cover: Annotated[float, "[0, inf)"],
    arap: Literal["off", "own", "svd"],
    arap_weight: Annotated[float, "[0, inf)"],
    distance_weight: Annotated[float, "[0, inf)"],
    rigidity_end: Annotated[float, "[0, 1]"],
    neighbours: Annotated[int, "[1, inf)"],
    carriers: Annotated[int, "[1, inf)"],
    images_per_knot: Annotated[float, "(0, inf)"],
    frames_per_knot: Annotated[float, "(0, inf)"],
    smooth_weight: Annotated[float, "[0, inf)"],
    depth: Annotated[int, "[1, inf)"],
    width: Annotated[int, "[1, inf)"],
    skip: Annotated[int, "[0, inf)"],
    deltas: Annotated[bool, "not deltas or deformation == 'mlp': false with deformation=nodes"],
    rate_means: Annotated[float, "(0, inf)"],
    rate_scales: Annotated[float, "(0, inf)"],
    rate_opacities: Annotated[float, "(0, inf)"],
    rate_colours: Annotated[float, "(0, inf)"],
    rate_deformation: Annotated[float, "(0, inf)"],
    rate_end: Annotated[float, "(0, inf)"],
    averaged: Annotated[float, "[0, 1]"],
    seed: int,
    workspace: Workspace,
) -> Reconstruction:
    """Fits Gaussians and their motion to a capture by Adam, one image a step.

    deformation: ``nodes`` (see :mod:`nodes`) or ``mlp``, the paper's network (:mod:`mlp`). backend: of the rasteriser;
    ``gsplat`` runs on CUDA. iterations: steps, the only budget: the same seed gives the same bits at any speed.
    largest: images with a longer side are scaled down to it.

    Start: the visual ``hull`` of the hull_views images round the reference frame (null: chosen, see
    :func:`hull_start`), inside at least the share hull_agree of the masks, hull_cells along its longest
    side; or a ``ball``.
    Curriculum: see :class:`Schedule` for static, grown, coarsest, full (shares). blur: variance in pixels^2 that
    every Gaussian's image has too much at the start and loses evenly until the share full.
    Density: ``gaussians`` at the start; every divide_every steps, up to the share divide_until of the iterations, those
    that are pulled hardest are divided, and the number grows by the share ``growth`` up to max_gaussians. In place of
    the first division with all frames in use, and of the last, hidden ones go: those of which the training images show
    less than the share least_shown of what they show of the mean Gaussian (:mod:`visibility`); 0 leaves all.
    sh_degree: 0 to 3. structure, cover: weights of 1 - SSIM (GA eq. 2) and of the alpha's error.
    Rigidity (GA eq. 3 and 4): over ``neighbours`` of ``carriers`` (the nodes; or points spread over the thing, moved by
    the network). ``own``: each carrier's own rotation, ``svd``: the one that fits best; weights for ARAP and for kept
    distances, which fall to the share rigidity_end of themselves.
    images_per_knot, frames_per_knot: of the nodes' splines, whichever puts the knots further apart, at least a frame;
    smooth_weight: of the squared second differences of knots. depth, width, skip: the network's; deltas: it
    also changes scale and opacity. rate_…: Adam's, for a thing of about unit size; all fall to the share rate_end.
    averaged: the share of the last iterations of which the mean is the result.

    Checkpoints lie in the workspace every minute; a fit that is run again goes on from there and ends with the same
    bits. Raises InputError for a capture that cannot be fitted, for a loss that is not
    finite (with the term and the iteration), and when the memory's cap is passed.
    """
    recipe = {k: v for k, v in locals().items() if k not in ("capture", "workspace")}
    from tasks.reconstruction.fitting import run

    return run(capture, SimpleNamespace(**recipe), workspace)
