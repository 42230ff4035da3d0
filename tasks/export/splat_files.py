"""Files of Gaussians: the .ply of 3D Gaussian Splatting (Kerbl et al. 2023) and the 32-byte .splat of web viewers.

.ply: binary little-endian floats x y z, f_dc_0..2 and f_rest_* (spherical harmonics, all of red, then green, then
blue), opacity (before the sigmoid), scale_0..2 (logarithms), rot_0..3 (w x y z). Other columns are left alone.
.splat: position and scale as float32, colour and opacity as RGBA bytes, quaternion as bytes (128 is 0): no spherical
harmonics beyond degree 0, half a grey level and half a degree of rounding.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from tasks.errors import InputError
from tasks.geometry.gaussians import at_frame
from tasks.values import Animation, Files, Gaussians, Poses, Reconstruction, Skeleton, Skinning

FOLDER = "export"  # in a report
C0 = 0.28209479177387814  # the basis function of degree 0
SURE = 1e-6  # opacities nearer to 0 or 1 than this have no finite logit in the file
TYPES = {"float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8", "uchar": "u1", "uint8": "u1"}
TYPES |= {"char": "i1", "int8": "i1", "short": "<i2", "int16": "<i2", "ushort": "<u2", "uint16": "<u2"}
TYPES |= {"int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4"}
SPLAT = np.dtype([("place", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("turn", "u1", 4)])


def read_gaussians(path: str | Path) -> Gaussians:
    """The Gaussians of a .ply or .splat file. Isotropic ones, whose three scales are equal, come without quaternions.

    Raises InputError for a missing, truncated or other file and for numbers that are not finite.
    """
    file = Path(path).expanduser()
    if not file.is_file():
        raise InputError(str(path), expected="a .ply or .splat file", found="no such file", do="check the path")
    data = file.read_bytes()
    found = _from_splat(file, data) if file.suffix.lower() == ".splat" else _from_ply(file, data)
    for name in ("means", "scales", "opacities", "sh"):
        if not np.isfinite(getattr(found, name)).all():
            raise InputError(f"{path}: {name}", expected="finite numbers", found="NaN or infinity")
    return found


def write_gaussians(gaussians: Gaussians, path: str | Path) -> None:
    """Writes a .ply or .splat file, as its name ends. Raises InputError for another ending."""
    file = Path(path)
    if file.suffix.lower().lstrip(".") not in WRITERS:
        raise InputError(str(path), expected="a name that ends in .ply or .splat", found=file.name)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(_bytes(gaussians, file.suffix.lower().lstrip(".")))


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

    canonical.ply with its means at ``skinning.rest``, and rig.npz, plain arrays: of the bones weights (N, B) and
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
    return Files.of({f"{FOLDER}/{name}/canonical.ply": at_rest, f"{FOLDER}/{name}/rig.npz": stream.getvalue()})


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


def _from_ply(file: Path, data: bytes) -> Gaussians:
    table = _vertices(file, data)

    def columns(*names: str) -> np.ndarray:
        missing = [n for n in names if n not in table.dtype.names]
        if missing:
            found = f"no {', '.join(missing)}"
            raise InputError(str(file), expected="the columns of 3D Gaussian Splatting", found=found)
        return np.stack([table[n].astype(np.float32) for n in names], axis=1)

    rest = sum(n.startswith("f_rest_") for n in table.dtype.names)
    if rest not in (0, 9, 24, 45):
        raise InputError(f"{file}: f_rest", expected="0, 9, 24 or 45 columns", found=str(rest))
    higher = columns(*(f"f_rest_{i}" for i in range(rest))) if rest else np.zeros((len(table), 0), np.float32)
    higher = higher.reshape(len(table), 3, -1).transpose(0, 2, 1)
    sh = np.concatenate([columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None], higher], axis=1)
    opacity = 1 / (1 + np.exp(-columns("opacity")[:, 0].astype(np.float64)))
    scales = np.exp(columns("scale_0", "scale_1", "scale_2"))
    turns = columns("rot_0", "rot_1", "rot_2", "rot_3")
    return _made(columns("x", "y", "z"), scales, turns, opacity.astype(np.float32), sh)


def _vertices(file: Path, data: bytes) -> np.ndarray:
    """The table of vertices, a field for each property."""
    head, end, body = data.partition(b"end_header\n")
    lines = [line.split() for line in head.decode("ascii", "replace").replace("\r", "").split("\n")]
    if not end or lines[0] != ["ply"] or ["format", "binary_little_endian", "1.0"] not in lines:
        found = "an ASCII or big-endian PLY" if lines[0] == ["ply"] else "something else"
        raise InputError(str(file), expected="a binary little-endian PLY of Gaussians", found=found)
    elements = [i for i, line in enumerate(lines) if line[:1] == ["element"]]
    first = lines[elements[0]] if elements else []
    after = lines[elements[0] + 1 : [*elements, len(lines)][1]] if elements else []
    fields = [(line[-1], TYPES.get(line[1])) for line in after if line[:1] == ["property"]]
    if first[1:2] != ["vertex"] or not first[-1].isdigit() or not fields or None in (kind for _, kind in fields):
        found = " ".join(first) or "none"
        raise InputError(str(file), expected="an element vertex of numbers first", found=found)
    kind, count = np.dtype(fields), int(first[-1])
    if len(body) < count * kind.itemsize:
        found = f"{len(body) // kind.itemsize} (the file is truncated)"
        raise InputError(str(file), expected=f"{count} Gaussians", found=found, do="make or download it again")
    return np.frombuffer(body, kind, count)


def _to_splat(gaussians: Gaussians) -> bytes:
    rows = np.zeros(len(gaussians.means), SPLAT)
    rows["place"] = gaussians.means
    rows["scale"] = np.broadcast_to(gaussians.scales, (len(rows), 3))
    rgba = np.concatenate([0.5 + C0 * gaussians.sh[:, 0], gaussians.opacities[:, None]], axis=1)
    rows["rgba"] = np.rint(255 * np.clip(rgba, 0, 1))
    turns = _quaternions(gaussians)
    rows["turn"] = np.clip(np.rint(128 + 128 * turns / np.linalg.norm(turns, axis=1, keepdims=True)), 0, 255)
    return rows.tobytes()


def _from_splat(file: Path, data: bytes) -> Gaussians:
    if not data or len(data) % SPLAT.itemsize:
        found = f"{len(data)} bytes (the file is truncated, or no .splat)"
        raise InputError(str(file), expected=f"{SPLAT.itemsize} bytes a Gaussian", found=found)
    rows = np.frombuffer(data, SPLAT)
    rgba = rows["rgba"].astype(np.float32) / 255
    turns = (rows["turn"].astype(np.float32) - 128) / 128
    return _made(rows["place"], rows["scale"], turns, rgba[:, 3], ((rgba[:, :3] - 0.5) / C0)[:, None])


def _made(means, scales, turns, opacities, sh) -> Gaussians:
    """Scales (N, 3) and quaternions (N, 4), or for spheres (N, 1) and none."""
    size = np.linalg.norm(turns, axis=1, keepdims=True)
    unit = np.where(size > 0, turns / np.maximum(size, 1e-12), np.array([1, 0, 0, 0], np.float32))
    round_ones = len(scales) and (scales == scales[:, :1]).all()
    shape = (scales[:, :1], None) if round_ones else (scales, unit.astype(np.float32))
    return Gaussians(np.array(means), *(None if a is None else np.array(a) for a in shape), opacities, sh)


def _quaternions(gaussians: Gaussians) -> np.ndarray:
    if gaussians.quaternions is None:
        return np.tile(np.array([1, 0, 0, 0], np.float32), (len(gaussians.means), 1))
    return gaussians.quaternions


WRITERS = {"ply": _to_ply, "splat": _to_splat}
