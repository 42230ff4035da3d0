"""The numbers of a case: every metric's unit and direction is declared here, once.

A vertex error is the distance between a result's point and the true one. Lengths are reported in millimetres where the
data is in metres and in the data's own unit elsewhere; percentages are of the canonical bounding box's diagonal.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from tasks.geometry import measure
from tasks.values import Animation, Canonical, Metrics, Motion

FRAMES_AT_ONCE = 64  # bounds the memory of float64 differences; sums are per frame, so it does not change a bit


@dataclass(frozen=True)
class Metric:
    """label: a column's heading; kind: what it measures, which decides its unit (see :func:`unit_of`);
    better: which way is good ("one": the nearer to 1 the better, "none": information, never ranked);
    text: one line for readers; digits: decimals in tables, or None for three significant ones."""

    label: str
    kind: Literal[
        "length",
        "speed",
        "percent",
        "ratio",
        "count",
        "decibel",
        "hours",
        "seconds",
        "milliseconds",
        "rate",
        "memory",
        "angle",
    ]
    better: Literal["lower", "higher", "one", "none"]
    text: str
    digits: int | None = None


METRICS: dict[str, Metric] = {
    "rmse": Metric("RMSE", "length", "lower", "vertex RMSE on unseen clips, sqrt(sum |d|^2 / (F N))"),
    "rmse_pct": Metric("RMSE", "percent", "lower", "the same in % of the canonical bounding box's diagonal", 2),
    "rmse_coordinate": Metric("RMSE per coordinate", "length", "lower", "sqrt(sum |d|^2 / (3 F N))"),
    "confidence_spearman": Metric(
        "confidence",
        "ratio",
        "higher",
        "rank correlation of the expected error with the true one, over unseen frames",
        2,
    ),
    "outside_pct": Metric(
        "outside", "percent", "none", "unseen frames farther off than 95 % of left-out training ones", 1
    ),
    "query_distance": Metric(
        "distance to the database", "angle", "none", "mean over frames and their nearest windows, one part's joints", 1
    ),
    "part_rmse": Metric("RMSE of a part", "length", "lower", "the same over one part's vertices in one clip"),
    "rmse_spread": Metric("± clip left out", "length", "none", "standard deviation of RMSE, one training clip missing"),
    "rmse_left_out": Metric("RMSE, clips left out", "length", "lower", "mean over training clips, each unseen"),
    "rmse_left_out_spread": Metric("± over these clips", "length", "none", "standard deviation of the same"),
    "gain_pct": Metric("gain", "percent", "higher", "how far a method's RMSE lies below the row's, in % of it", 1),
    "max_error": Metric("largest error", "length", "lower", "largest vertex error of any point in any frame"),
    "velocity_rmse": Metric("velocity RMSE", "speed", "lower", "RMSE of the points' velocities, inside clips"),
    "speed_ratio": Metric("speed ratio", "ratio", "one", "mean speed of the result over the true one: liveliness", 2),
    "bones_rmse": Metric("bones RMSE", "length", "lower", "compression: bones alone on the frames they were fitted to"),
    "bones_rmse_pct": Metric("bones RMSE", "percent", "lower", "the same in % of the diagonal", 3),
    "skeleton_rmse": Metric("skeleton RMSE", "length", "lower", "LBS of the skeleton alone on the training frames"),
    "skeleton_rmse_pct": Metric("skeleton RMSE", "percent", "lower", "the same in % of the diagonal", 2),
    "bones_count": Metric("bones", "count", "none", "number of free-form bones B", 0),
    "bone_fragments": Metric("pieces a bone", "ratio", "lower", "connected pieces of the points that a bone holds", 2),
    "joints_count": Metric("joints", "count", "none", "number of joints J", 0),
    "joint_f1": Metric("joint F1", "ratio", "higher", "joints matched to true ones within 5 % of the diagonal", 3),
    "joint_f1_fine": Metric("joint F1, 2.5 %", "ratio", "higher", "the same within 2.5 %", 3),
    "joint_precision": Metric("joint precision", "ratio", "higher", "share of the joints found that match", 3),
    "joint_recall": Metric("joint recall", "ratio", "higher", "share of the true joints that are matched", 3),
    "link_f1": Metric("link F1", "ratio", "higher", "parent links between matched joints", 3),
    "j2j_pct": Metric("J2J", "percent", "lower", "Chamfer distance joint to joint, % of the diagonal", 2),
    "j2b_pct": Metric("J2B", "percent", "lower", "Chamfer distance joint to bone", 2),
    "b2b_pct": Metric("B2B", "percent", "lower", "Chamfer distance bone to bone", 2),
    "psnr": Metric("PSNR", "decibel", "higher", "peak signal-to-noise ratio of rendered images", 2),
    "ssim": Metric("SSIM", "ratio", "higher", "structural similarity of rendered images", 3),
    "ssim_down": Metric("SSIM, shrunk", "ratio", "higher", "the same of images first shrunk to about 256 pixels", 3),
    "flip": Metric("FLIP", "ratio", "lower", "perceived difference of rendered images (LDR-FLIP)", 4),
    "lpips": Metric("LPIPS", "ratio", "lower", "learned perceptual distance of rendered images", 4),
    "path_pct": Metric(
        "path error", "percent", "lower", "Gaussians' paths to those of the true surface, % of diagonal", 2
    ),
    "path_start_pct": Metric("off the surface", "percent", "lower", "the same at the reference time alone", 2),
    "optimise_hours": Metric("optimisation", "hours", "lower", "time to optimise one scene", 2),
    "time_ratio": Metric("time ratio", "ratio", "lower", "benchmarks: seconds on the wall, ours / the peer's", 4),
    "cpu_ratio": Metric("processor time ratio", "ratio", "lower", "the same for the processor time of all threads", 4),
    "rmse_ratio": Metric("RMSE ratio", "ratio", "lower", "vertex RMSE, ours / the peer's", 3),
    "time_to_peer_rmse_ratio": Metric(
        "time ratio at peer's RMSE",
        "ratio",
        "lower",
        "seconds of our quickest settings that reach the peer's RMSE / its",
        4,
    ),
    "held_out_rmse_ratio": Metric(
        "held-out RMSE ratio", "ratio", "lower", "on unseen frames, weights frozen, ours / its", 3
    ),
    "forward_ratio": Metric("drawing ratio", "ratio", "lower", "milliseconds to draw, ours / the peer's", 4),
    "step_ms": Metric("step", "milliseconds", "lower", "milliseconds to draw and to take all gradients, median"),
    "peer_step_ms": Metric("peer's step", "milliseconds", "none", "the same of the peer"),
    "forward_ms": Metric("drawing", "milliseconds", "lower", "milliseconds to draw alone, median"),
    "peer_forward_ms": Metric("peer's drawing", "milliseconds", "none", "the same of the peer"),
    "seconds": Metric("time", "seconds", "lower", "seconds on the wall, median"),
    "peer_seconds": Metric("peer's time", "seconds", "none", "the same of the peer"),
    "cpu_seconds": Metric("processor time", "seconds", "lower", "processor time of all threads, median"),
    "peer_cpu_seconds": Metric("peer's processor time", "seconds", "none", "the same of the peer"),
    "memory": Metric("memory", "memory", "lower", "memory at the peak on top of what was in use before", 0),
    "peer_memory": Metric("peer's memory", "memory", "none", "the same of the peer", 0),
    "peer_rmse_pct": Metric("peer's RMSE", "percent", "none", "the peer's bones on the frames they were fitted to", 3),
    "peer_bones_count": Metric("peer's bones", "count", "none", "number of bones that the peer found", 0),
    "points_exponent": Metric("growth with points", "ratio", "lower", "time ~ points ^ this: 1 is linear", 2),
    "frames_exponent": Metric("growth with frames", "ratio", "lower", "time ~ frames ^ this", 2),
    "points_count": Metric("points", "count", "none", "points; of a series of runs, in its largest", 0),
    "images_count": Metric("training images", "count", "none", "images to train on", 0),
    "views_count": Metric("held-out images", "count", "none", "images of views that are held out", 0),
    "fill_pct": Metric("filled", "percent", "none", "share of the training images that the subject covers", 1),
    "on_subject_pct": Metric(
        "vertices on the subject", "percent", "higher", "vertices whose pixel, or one beside it, is covered", 2
    ),
    "frames_count": Metric("frames", "count", "none", "frames; of a series of runs, in its largest", 0),
    "deep_pct": Metric("inside", "percent", "lower", "cloth vertices more than 2 mm inside the body", 3),
    "depth_995": Metric("depth", "length", "lower", "99.5 % of the cloth is no deeper inside; negative: outside", 2),
    "strain_p99_pct": Metric("strain", "percent", "lower", "99 % of the edges are strained by no more", 2),
    "speed_max": Metric("fastest", "speed", "none", "the greatest speed of any vertex"),
    "fps": Metric("poses", "rate", "higher", "poses a second, one after another, no look-ahead, to posed points", 0),
    "p99_ms": Metric("99 % within", "milliseconds", "lower", "time that 99 % of these poses stay under", 2),
    "clip_fps": Metric("whole clips", "rate", "higher", "frames a second when clips are matched as a whole", 0),
    "query_ms": Metric("query", "milliseconds", "lower", "search for one new pose, all parts, largest database", 2),
    "recall_at_7": Metric("recall at 7", "ratio", "higher", "share of the 7 truly nearest windows that are found", 3),
    "build_seconds": Metric("build", "seconds", "lower", "seconds to make a database of 10,000 frames ready", 2),
    "curve_leaves": Metric("leaves", "count", "none", "ends of the curve skeleton", 0),
    "curve_junctions": Metric("junctions", "count", "none", "nodes where three or more branches meet", 0),
    "curve_cycles": Metric("cycles", "count", "lower", "loops of the curve skeleton", 0),
    "curve_inside_pct": Metric("inside", "percent", "higher", "share of the curve's nodes inside the body", 1),
    "curve_mapped_pct": Metric("mapped once", "percent", "higher", "surface vertices that belong to one node", 1),
    "peer_curve_leaves": Metric("peer's leaves", "count", "none", "ends of the peer's curve skeleton", 0),
    "peer_curve_limbs": Metric("peer's limbs", "count", "none", "its ends without branches as short as ours drop", 0),
    "peer_curve_junctions": Metric("peer's junctions", "count", "none", "its nodes of three or more branches", 0),
    "peer_curve_cycles": Metric("peer's cycles", "count", "none", "its loops", 0),
    "peer_curve_inside_pct": Metric("peer's inside", "percent", "none", "share of its nodes inside the body", 1),
    "peer_curve_mapped_pct": Metric("peer's mapped once", "percent", "none", "vertices that belong to one node", 1),
}

_FIXED_UNITS = {
    "angle": "deg",
    "percent": "%",
    "ratio": "ratio",
    "count": "count",
    "decibel": "dB",
    "hours": "h",
    "seconds": "s",
    "milliseconds": "ms",
    "rate": "1/s",
    "memory": "MB",
}


def metric_of(name: str) -> Metric:
    """The declaration behind a metric's name; "rmse@walk" is rmse on the clip walk."""
    return METRICS[name.split("@", 1)[0]]


def unit_of(kind: str, data_unit: str) -> tuple[str, float]:
    """The unit a kind of number is reported in and the factor that takes it there from the data's unit."""
    if kind not in ("length", "speed"):
        return _FIXED_UNITS[kind], 1.0
    unit, factor = ("mm", 1000.0) if data_unit == "m" else ("unit", 1.0)
    return (f"{unit}/s" if kind == "speed" else unit), factor


def score(value: float, better: str) -> float:
    """A number that is smaller for a better value: what ranks compare."""
    if better == "one":
        return abs(math.log(value)) if value > 0 else math.inf
    return -value if better == "higher" else value


def evaluate(animation: Animation, test: Motion, canonical: Canonical) -> Metrics:
    """The numbers of a result against the unseen clips.

    animation.points: (F, N, 3), the result on the frames of ``test``. The metrics ``rmse`` and ``rmse_pct`` are also
    given for each test clip, as "rmse@clip". Velocities are left out where no clip has two frames, the speed ratio
    where the truth stands still. Raises ValueError where the result has another shape than the truth or is not finite.
    """
    return declared(_animation_numbers(animation.points, test, measure.diagonal(canonical.points)), test.unit)


def declared(found: dict[str, float], data_unit: str) -> Metrics:
    """Numbers in the data's unit as metrics in the units that they are reported in."""
    units = {name: unit_of(metric_of(name).kind, data_unit) for name in found}
    return Metrics(
        names=tuple(found),
        units=tuple(units[name][0] for name in found),
        values=np.array([found[name] * units[name][1] for name in found], np.float64),
    )


def squared_errors(points: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Squared vertex errors in float64. points, truth: (F, N, 3) -> (F, N)."""
    if points.shape != truth.shape:
        raise ValueError(f"a result of shape {points.shape} cannot be held against a truth of shape {truth.shape}")
    out = np.empty(points.shape[:2], np.float64)
    for a in range(0, len(points), FRAMES_AT_ONCE):
        piece = slice(a, a + FRAMES_AT_ONCE)
        out[piece] = np.sum((points[piece].astype(np.float64) - truth[piece]) ** 2, axis=-1)
    if not np.isfinite(out).all():
        raise ValueError(f"the result is not finite in frame {int(np.argmin(np.isfinite(out).all(1)))}")
    return out


def frame_rmse(points: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Vertex RMSE of each frame. points, truth: (F, N, 3) -> (F,)."""
    return np.sqrt(squared_errors(points, truth).mean(1))


def clip_keys(names: tuple[str, ...]) -> list[str]:
    """Names that tell clips apart: their own, with their number where two share a name."""
    if len(set(names)) == len(names):
        return list(names)
    return [f"{name}#{c}" for c, name in enumerate(names)]


def _animation_numbers(points: np.ndarray, test: Motion, diagonal: float) -> dict[str, float]:
    squared = squared_errors(points, test.points)
    rmse = math.sqrt(squared.mean())
    found = {
        "rmse": rmse,
        "rmse_pct": 100.0 * rmse / diagonal,
        "rmse_coordinate": rmse / math.sqrt(3.0),
        "max_error": math.sqrt(squared.max()),
    }
    found.update(_velocity_numbers(points, test))
    for key, clip in zip(clip_keys(test.clip_names), test.clips(), strict=True):
        clip_rmse = math.sqrt(squared[clip].mean())
        found[f"rmse@{key}"] = clip_rmse
        found[f"rmse_pct@{key}"] = 100.0 * clip_rmse / diagonal
    return found


def _velocity_numbers(points: np.ndarray, test: Motion) -> dict[str, float]:
    """Differences of neighbouring frames times the frame rate; never across a clip's end."""
    error, speed, true_speed, count = 0.0, 0.0, 0.0, 0
    for clip in test.clips():
        for f in range(clip.start + 1, clip.stop):
            made = points[f].astype(np.float64) - points[f - 1]
            true = test.points[f].astype(np.float64) - test.points[f - 1]
            error += float(np.sum((made - true) ** 2))
            speed += float(np.linalg.norm(made, axis=-1).sum())
            true_speed += float(np.linalg.norm(true, axis=-1).sum())
            count += len(made)
    if count == 0:
        return {}
    found = {"velocity_rmse": test.fps * math.sqrt(error / count)}
    if true_speed > 0:
        found["speed_ratio"] = speed / true_speed
    return found
