"""What is stated of the dataset: every number recomputed from the very files that are given out."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import numpy as np

from tasks.datasets import garments
from tasks.evaluation.metrics import declared
from tasks.garments.check import quality
from tasks.values import About, Files, Metrics, Poses
from tasks.workspace import Workspace

# what is asked of the dataset: share of vertices more than 2 mm inside the body, strain, metres a second
DEEP, STRAIN, FASTEST = 0.005, 0.15, 25.0


def check_garment(
    body: Files, garment: Files, *, every: Annotated[int, "[1, inf)"], workspace: Workspace
) -> tuple[Metrics, Files, About]:
    """Reads the packed files again and measures them: numbers for the report, the garment's part of the manifest, and
    which of the goals are missed, in words.

    every: depth inside the body is measured at each `every`-th frame of a clip, strain and speed at all.
    """
    for path, data in (*body.items(), *garment.items()):
        (workspace.folder / Path(path).name).write_bytes(data)
    name = Path(garment.paths[0]).stem
    facts = garment_facts(workspace.folder, name, every=every, say=workspace.say)
    numbers = _numbers(facts, "") | {"frames_count": facts["frames"], "points_count": facts["vertices"]}
    for clip, own in facts["clips"].items():
        numbers |= _numbers(own, f"@{clip}") | {f"frames_count@{clip}": own["frames"]}
    part = Files.of({f"{name}.json": json.dumps(facts, indent=1).encode()})
    return declared(numbers, "m"), part, About(name, tuple(_missed(facts)))


def manifest(files: dict[str, Files], facts: dict[str, Files], *, every: Annotated[int, "[1, inf)"]) -> Files:
    """``manifest.json``: size and sha256 of the files, and what :func:`check_garment` found."""
    stated = {
        "depth_measured_at_every": every,
        "files": {Path(path).name: facts_of(data) for n in sorted(files) for path, data in files[n].items()},
        "garments": {name: json.loads(facts[name].items()[0][1]) for name in sorted(facts)},
    }
    folder = next(iter(files.values())).paths[0].rpartition("/")[0]
    return Files.of({f"{folder}/manifest.json": (json.dumps(stated, indent=1) + "\n").encode()})


def facts_of(data: bytes) -> dict:
    """Bytes and sha256 of a file."""
    return {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}


def garment_facts(
    folder: Path, name: str, *, every: int, say: Callable[[str, float], None] = lambda text, fraction: None
) -> dict:
    """Sizes, the storage's largest error and the numbers of tasks.garments.check for all frames and for each clip."""
    motion = garments.load(garment=name, path=str(folder), weights="nearest")
    body, poses = garments.read_body(folder / "body.npz"), garments.read_poses(folder / f"{name}.npz")
    step = float(np.load(folder / f"{name}.npz", allow_pickle=False)["step"])
    clips, measured = {}, []
    for clip, frames in zip(motion.clip_names, motion.clips(), strict=True):
        say(f"clip {clip}", frames.start / motion.frames)
        at = Poses(poses.rotations[frames], poses.translations[frames], np.array([0, frames.stop - frames.start]))
        found = quality(body, at, motion.points[frames], motion.rest, motion.faces, fps=motion.fps, every=every)
        measured.append(found)
        clips[clip] = {"frames": frames.stop - frames.start, **rounded(found.numbers())}
    depth = np.concatenate([found.depth for found in measured])
    strain = np.abs(np.concatenate([found.strain for found in measured]))
    return {
        "frames": motion.frames,
        "vertices": motion.points.shape[1],
        "faces": len(motion.faces),
        "fps": motion.fps,
        "storage_error_mm": round(500 * step, 4),
        "deep_share": round(float((depth > 0.002).mean()), 6),
        "depth_995_mm": round(float(1000 * np.percentile(depth, 99.5)), 6),
        "strain_abs_p99": round(float(np.percentile(strain, 99)), 4),
        "speed_max": max(own["speed_max"] for own in clips.values()),
        "clips": clips,
    }


def rounded(numbers: dict[str, float]) -> dict[str, float]:
    """Six digits are enough to read and to compare."""
    return {name: round(value, 6) for name, value in numbers.items()}


def _numbers(facts: dict, ending: str) -> dict[str, float]:
    """A garment's or a clip's facts by the names of the metrics."""
    found = {
        "deep_pct": 100 * facts["deep_share"],
        "depth_995": facts["depth_995_mm"] / 1000,
        "strain_p99_pct": 100 * facts["strain_abs_p99"],
        "speed_max": facts["speed_max"],
    }
    return {name + ending: value for name, value in found.items()}


def _missed(facts: dict) -> list[str]:
    found = []
    if facts["deep_share"] >= DEEP:
        found.append(f"{100 * facts['deep_share']:.2g} % of the vertices are more than 2 mm inside the body")
    if facts["strain_abs_p99"] >= STRAIN:
        found.append(f"1 % of the edges are strained by more than {100 * facts['strain_abs_p99']:.3g} %")
    for clip, own in facts["clips"].items():
        if own["speed_max"] >= FASTEST:
            found.append(f"clip {clip} explodes: a vertex moves at {own['speed_max']:.3g} m/s")
    return found
