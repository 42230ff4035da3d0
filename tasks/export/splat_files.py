"""Files of Gaussians: the .ply of 3D Gaussian Splatting (Kerbl et al. 2023) and the 32-byte .splat of web viewers.

.ply: binary little-endian floats x y z, f_dc_0..2 and f_rest_* (spherical harmonics, all of red, then green, then
blue), opacity (before the sigmoid), scale_0..2 (logarithms), rot_0..3 (w x y z).
.splat: position and scale as float32, colour and opacity as RGBA bytes, quaternion as bytes (128 is 0): no spherical
harmonics beyond degree 0, half a grey level and half a degree of rounding.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from tasks.geometry.gaussians import at_frame
from tasks.values import Animation, Files, Gaussians, Poses, Reconstruction, Skeleton, Skinning

FOLDER = "export"  # in a report
C0 = 0.28209479177387814  # the basis function of degree 0
SURE = 1e-6  # opacities nearer to 0 or 1 than this have no finite logit in the file
SPLAT = np.dtype([("place", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("turn", "u1", 4)])


def gaussians_ply(reconstruction: Reconstruction, *, name: str) -> Files:
    """The canonical Gaussians and those of every frame as .ply files; see :func:`reconstruction_files`."""
    return Files.of({f"{FOLDER}/{name}/{path}": data for path, data in reconstruction_files(reconstruction, "ply")})


def gaussians_splat(reconstruction: Reconstruction, *, name: str) -> Files:
    """The canonical Gaussians and those of every frame as .splat files; see :func:`reconstruction_files`."""
    return Files.of({f"{FOLDER}/{name}/{path}": data for path, data in reconstruction_files(reconstruction, "splat")})


def reconstruction_files(reconstruction: Reconstruction, format: str) -> Iterator[tuple[str, bytes]]:
    """The canonical Gaussians, those of every frame, and when each frame is, as (path, bytes).

    canonical.FORMAT, frames/000000.FORMAT, …, motion.json: fps, unit, times and clips.
    """
    yield f"canonical.{format}", _bytes(reconstruction.gaussians, format)
    for f in range(len(reconstruction.points)):
        yield f"frames/{f:06d}.{format}", _bytes(at_frame(reconstruction, f), format)
    starts = reconstruction.clip_start[:-1].tolist()
    clips = [{"name": n, "start": s} for n, s in zip(reconstruction.clip_names, starts, strict=True)]
    about = {"name": reconstruction.name, "fps": reconstruction.fps, "unit": reconstruction.unit, "clips": clips}
    about["times"] = [round(float(t), 7) for t in reconstruction.times]
    yield "motion.json", (json.dumps(about, indent=1) + "\n").encode()


def rigged_ply(
    reconstruction: Reconstruction,
    skinning: Skinning,
    skeleton: Skeleton,
    poses: Poses,
    animation: Animation | None = None,
    *,
    name: str,
) -> Files:
    """The canonical Gaussians and what moves them, a row of the rig for each Gaussian.

    rigged.ply with its means at ``skinning.rest``, and rig.npz, plain arrays: of the bones weights (N, B) and
    transforms (F, B, 3, 4) on canonical points; of the skeleton joint_names (J,), joint_parents (J,), joints (J, 3),
    joint_weights (N, J), rotations (F, J, 3, 3), translations (F, J, 3), clip_start (C+1,). With an animation the
    transforms are its bones, and are left out for a method that moves none.
    Raises ValueError where the rig is of other points.
    """
    gaussians = reconstruction.gaussians
    if len(skinning.rest) != len(gaussians.means):
        raise ValueError(f"{len(skinning.rest)} points of the rig against {len(gaussians.means)} Gaussians")
    moved = skinning.transforms if animation is None else animation.bones
    stream = io.BytesIO()
    np.savez_compressed(
        stream,
        **({} if moved is None else {"transforms": moved}),
        weights=skinning.weights,
        joint_names=np.array(skeleton.names),
        joint_parents=skeleton.parents,
        joints=skeleton.joints,
        joint_weights=skeleton.weights,
        rotations=poses.rotations,
        translations=poses.translations,
        clip_start=poses.clip_start,
    )
    at_rest = _bytes(replace(gaussians, means=skinning.rest), "ply")
    return Files.of({f"{FOLDER}/{name}/rigged.ply": at_rest, f"{FOLDER}/{name}/rig.npz": stream.getvalue()})


def _bytes(gaussians: Gaussians, format: str) -> bytes:
    return WRITERS[format](gaussians)


def _to_ply(gaussians: Gaussians) -> bytes:
    count = len(gaussians.means)
    columns = {"x y z": gaussians.means, "nx ny nz": np.zeros((count, 3))}
    columns["f_dc_0 f_dc_1 f_dc_2"] = gaussians.sh[:, 0]
    rest = gaussians.sh[:, 1:].transpose(0, 2, 1).reshape(count, -1)  # all of red, then green, then blue
    columns[" ".join(f"f_rest_{i}" for i in range(rest.shape[1]))] = rest
    sure = np.clip(gaussians.opacities.astype(np.float64), SURE, 1 - SURE)[:, None]
    columns["opacity"] = np.log(sure / (1 - sure))
    columns["scale_0 scale_1 scale_2"] = np.log(np.broadcast_to(gaussians.scales, (count, 3)))
    columns["rot_0 rot_1 rot_2 rot_3"] = _quaternions(gaussians)
    names = [name for group in columns for name in group.split()]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    header += [*(f"property float {name}" for name in names), "end_header", ""]
    return "\n".join(header).encode() + np.concatenate(list(columns.values()), axis=1).astype("<f4").tobytes()


def _to_splat(gaussians: Gaussians) -> bytes:
    rows = np.zeros(len(gaussians.means), SPLAT)
    rows["place"] = gaussians.means
    rows["scale"] = np.broadcast_to(gaussians.scales, (len(rows), 3))
    rgba = np.concatenate([0.5 + C0 * gaussians.sh[:, 0], gaussians.opacities[:, None]], axis=1)
    rows["rgba"] = np.rint(255 * np.clip(rgba, 0, 1))
    turns = _quaternions(gaussians)
    rows["turn"] = np.clip(np.rint(128 + 128 * turns / np.linalg.norm(turns, axis=1, keepdims=True)), 0, 255)
    return rows.tobytes()


def _quaternions(gaussians: Gaussians) -> np.ndarray:
    if gaussians.quaternions is None:
        return np.tile(np.array([1, 0, 0, 0], np.float32), (len(gaussians.means), 1))
    return gaussians.quaternions


WRITERS = {"ply": _to_ply, "splat": _to_splat}
