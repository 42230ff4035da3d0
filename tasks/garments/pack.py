"""The small files of the dataset: points in 16 bits, poses as rotation vectors, the body with sparse weights."""

from __future__ import annotations

import io
from typing import Annotated

import numpy as np

from tasks.geometry.kinematics import forward, joint_positions
from tasks.geometry.quantise import encode
from tasks.geometry.rotations import to_rotation_vector
from tasks.values import Canonical, Files, Motion, Poses

FOLDER = "garments"  # in a report
INFLUENCES = 5  # that Anny's vertices have at most


def pack_body(body: Motion, cutting: Poses) -> Files:
    """``body.npz``; cutting: the pose in which garments are cut."""
    return _npz("body", body_arrays(body, cutting))


def pack_garment(
    body: Motion,
    garment: Canonical,
    poses: dict[str, Poses],
    cloth: dict[str, Motion],
    *,
    step: Annotated[float, "(0, inf)"],
    clips: list[str],
) -> Files:
    """``<garment>.npz`` of the named clips, in that order. poses: of the body, whose last clip is the cloth's frames;
    step: see :func:`garment_arrays`."""
    shown = []
    for clip in clips:
        last = slice(int(poses[clip].clip_start[-2]), None)
        at = Poses(poses[clip].rotations[last], poses[clip].translations[last], cloth[clip].clip_start)
        shown.append((clip, at, cloth[clip].points))
    fps = cloth[clips[0]].fps
    return _npz(garment.source.split()[0], garment_arrays(body, garment, shown, step=step, fps=fps))


def _npz(name: str, arrays: dict[str, np.ndarray]) -> Files:
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return Files.of({f"{FOLDER}/{name}.npz": stream.getvalue()})


def body_arrays(body: Motion, cutting: Poses) -> dict[str, np.ndarray]:
    """What ``body.npz`` holds. cutting: the pose in which garments are cut."""
    rig = body.rig
    index = np.argsort(-rig.weights, axis=1, kind="stable")[:, :INFLUENCES]
    value = np.take_along_axis(rig.weights, index, axis=1)
    return {
        "joint_names": np.array(rig.names),
        "joint_parents": rig.parents,
        "joints": rig.joints,
        "vertices": body.rest,
        "faces": body.faces.astype(np.uint16),
        "weight_index": index.astype(np.uint8),
        "weight_value": np.rint(value * 65535).astype(np.uint16),
        "cutting_turns": to_rotation_vector(cutting.rotations[0].astype(np.float64)).astype(np.float32),
    }


def garment_arrays(
    body: Motion, garment: Canonical, clips: list[tuple[str, Poses, np.ndarray]], *, step: float, fps: float
) -> dict[str, np.ndarray]:
    """What ``<garment>.npz`` holds. clips: name, poses of the body (F, …) and simulated points (F, N, 3) of each; step:
    metres to which coordinates are rounded, relative to the hips."""
    rig = body.rig
    rotations = np.concatenate([poses.rotations for _, poses, _ in clips]).astype(np.float64)
    shift = np.concatenate([poses.translations for _, poses, _ in clips])
    start = np.concatenate([[0], np.cumsum([len(points) for _, _, points in clips])])
    hips = joint_positions(forward(rig.parents, rig.joints, rotations, shift), rig.joints)[:, 0].astype(np.float32)
    points = np.concatenate([points for _, _, points in clips])
    return {
        "codes": encode(points.astype(np.float64) - hips[:, None], start, step),
        "step": np.array(step),
        "origin": hips,
        "clip_start": start,
        "clip_names": np.array([name for name, _, _ in clips]),
        "fps": np.array(fps),
        "rest": garment.points,
        "faces": garment.faces.astype(np.uint16),
        "joint_turns": to_rotation_vector(rotations).astype(np.float32),
        "root_shift": shift[:, 0].astype(np.float32),
    }
