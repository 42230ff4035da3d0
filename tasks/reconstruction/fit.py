"""Consistent Gaussians from images (GA 3.1): one canonical set and a deformation, fitted to all images at once."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Literal

from tasks.errors import InputError
from tasks.values import Capture, Reconstruction
from tasks.workspace import Workspace


def fit(
    capture: Capture,
    *,
    deformation: Literal["nodes", "mlp"],
    backend: Literal["numba", "gsplat", "reference"],
    iterations: int,
    largest: int,
    start: Literal["hull", "ball"],
    reference: int | None,
    hull_views: int,
    hull_agree: float,
    hull_cells: int,
    static: float,
    grown: float,
    coarsest: float,
    full: float,
    gaussians: int,
    max_gaussians: int,
    growth: float,
    divide_every: int,
    divide_until: float,
    least_shown: float,
    sh_degree: int,
    structure: float,
    cover: float,
    arap: Literal["off", "own", "svd"],
    arap_weight: float,
    distance_weight: float,
    rigidity_end: float,
    neighbours: int,
    carriers: int,
    images_per_knot: float,
    frames_per_knot: float,
    smooth_weight: float,
    depth: int,
    width: int,
    skip: int,
    deltas: bool,
    rate_means: float,
    rate_scales: float,
    rate_opacities: float,
    rate_colours: float,
    rate_deformation: float,
    rate_end: float,
    averaged: float,
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
    Curriculum: see :class:`Schedule` for static, grown, coarsest, full (shares).
    Density: ``gaussians`` at the start; every divide_every steps, up to the share divide_until of the iterations, those
    that are pulled hardest are divided, and the number grows by the share ``growth`` up to max_gaussians. In place of
    the last division hidden ones go: those of which the training images show less than the share least_shown of what
    they show of the mean Gaussian (:mod:`visibility`); 0 leaves all.
    sh_degree: 0 to 3. structure, cover: weights of 1 - SSIM (GA eq. 2) and of the alpha's error.
    Rigidity (GA eq. 3 and 4): over ``neighbours`` of ``carriers`` (the nodes; or points spread over the thing, moved by
    the network). ``own``: each carrier's own rotation, ``svd``: the one that fits best; weights for ARAP and for kept
    distances, which fall to the share rigidity_end of themselves.
    images_per_knot, frames_per_knot: of the nodes' splines, whichever puts the knots further apart, at least a frame;
    smooth_weight: of the squared second differences of knots. depth, width, skip: the network's; deltas: it
    also changes scale and opacity. rate_…: Adam's, for a thing of about unit size; all fall to the share rate_end.
    averaged: the share of the last iterations of which the mean is the result.

    Checkpoints lie in the workspace every minute; a fit that is run again goes on from there and ends with the same
    bits. Raises InputError for a capture that cannot be fitted, for settings that make no sense, for a loss that is not
    finite (with the term and the iteration), and when the memory's cap is passed.
    """
    recipe = {k: v for k, v in locals().items() if k not in ("capture", "workspace")}
    _check(recipe)
    from tasks.reconstruction.fitting import run

    return run(capture, SimpleNamespace(**recipe), workspace)


def _check(recipe: dict) -> None:
    """Raises InputError for the first setting that makes no sense."""
    whole = ("iterations", "largest", "hull_views", "hull_cells", "gaussians", "divide_every", "neighbours", "carriers")
    rules = [(n, recipe[n] >= 1, "1 or more") for n in (*whole, "depth", "width")]
    shares = ("hull_agree", "static", "grown", "full", "divide_until", "structure", "averaged", "rigidity_end")
    rules += [(n, 0.0 <= recipe[n] <= 1.0, "a share, 0 to 1") for n in shares]
    rates = [n for n in recipe if n.startswith("rate_")]
    weights = ("cover", "arap_weight", "distance_weight", "smooth_weight")
    rules += [
        (n, recipe[n] > 0, "a positive number") for n in (*rates, "coarsest", "images_per_knot", "frames_per_knot")
    ]
    rules += [(n, recipe[n] >= 0, "0 or more") for n in (*weights, "growth", "least_shown")]
    rules += [
        ("sh_degree", 0 <= recipe["sh_degree"] <= 3, "0, 1, 2 or 3"),
        ("coarsest", recipe["coarsest"] <= 1, "at most 1"),
        ("max_gaussians", recipe["max_gaussians"] >= recipe["gaussians"], f"at least {recipe['gaussians']}"),
        ("grown", recipe["grown"] >= recipe["static"], f"at least static, {recipe['static']}"),
        ("backend", recipe["backend"] != "gsplat" or recipe["deformation"] == "mlp", "numba with deformation=nodes"),
        ("deltas", not (recipe["deltas"] and recipe["deformation"] == "nodes"), "false with deformation=nodes"),
    ]
    for name, good, expected in rules:
        if not good:
            raise InputError(f"reconstruction.{name}", expected=expected, found=str(recipe[name]))
