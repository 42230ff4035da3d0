"""The manifest of the shipped dataset: every number recomputed from the very files that are shipped."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from tasks.datasets import garments
from tasks.garments.check import quality
from tasks.values import Poses

GARMENTS = ("tshirt", "dress")
FILES = ("body.npz", *(f"{name}.npz" for name in GARMENTS))


def describe(folder: Path, *, every: int) -> dict:
    """Files with size and sha256, and per garment its size, storage error and quality, clip by clip.

    every: depth inside the body is measured at each `every`-th frame of a clip, strain and speed at all.
    """
    return {"files": {name: file_facts(folder / name) for name in FILES}} | {
        "garments": {name: garment_facts(folder, name, every=every) for name in GARMENTS}
    }


def file_facts(path: Path) -> dict:
    """Bytes and sha256 of a file."""
    data = path.read_bytes()
    return {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}


def garment_facts(folder: Path, name: str, *, every: int) -> dict:
    """Sizes, the storage's largest error and the numbers of tasks.garments.check for all frames and for each clip."""
    motion = garments.load(garment=name, path=str(folder), weights="nearest")
    body, poses = garments.read_body(folder / "body.npz"), garments.read_poses(folder / f"{name}.npz")
    step = float(np.load(folder / f"{name}.npz", allow_pickle=False)["step"])
    clips, measured = {}, []
    for clip, frames in zip(motion.clip_names, motion.clips(), strict=True):
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
        "strain_abs_p99": round(float(np.percentile(strain, 99)), 4),
        "clips": clips,
    }


def rounded(numbers: dict[str, float]) -> dict[str, float]:
    """Six digits are enough to read and to compare."""
    return {name: round(value, 6) for name, value in numbers.items()}
