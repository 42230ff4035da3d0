"""Everything that is checked about input data before a stage sees it: bad data ends here in one clear line.

Errors say file, field, expected, found and what to do. What later stages cope with (several components, open surfaces,
doubled vertices, faces without area) is not an error; :func:`notes` lists it for the report.
"""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path

import numpy as np

from tasks.errors import InputError
from tasks.geometry import kinematics
from tasks.geometry.measure import diagonal
from tasks.geometry.neighbours import components, mesh_edges
from tasks.geometry.skinning import skin
from tasks.values import About, Motion, Rig

LEAST_POINTS = 4  # three points and a frame of reference: below this no rigid transform is defined
RIG_NOTED = 1e-3  # of the diagonal
SIZES = 1e-5, 1e9  # of a shape's diagonal: outside, small absolute numbers and float32's squares would decide results
STILL = 1e-6  # of the diagonal: float32 cannot hold a motion smaller than this
COARSE = 1e-3  # of the diagonal: a step between neighbouring float32 numbers that would show
# what numpy and zipfile raise for damaged, encrypted or foreign archives (NotImplementedError is a RuntimeError)
UNREADABLE = (ValueError, EOFError, OSError, KeyError, RuntimeError, MemoryError, zipfile.BadZipFile, zlib.error)


def existing_path(path: str, *, expected: str) -> Path:
    """The path as a Path, ``~`` expanded. Raises InputError when it is empty or nothing is there."""
    if not path or not path.strip():
        raise InputError("dataset.path", expected=expected, found="an empty path", do="set dataset.path=FILE")
    found = Path(path).expanduser()
    if not found.exists():
        where = "no such file or folder" + ("" if found.parent.exists() else f" (and no folder {found.parent})")
        raise InputError(path, expected=expected, found=where, do="check dataset.path")
    if not (found.is_file() or found.is_dir()):  # reading a pipe would wait for ever
        raise InputError(path, expected=expected, found="neither a file nor a folder", do="check dataset.path")
    return found


def read_bytes(path: Path, *, expected: str, count: int = -1) -> bytes:
    """The file's content, or its first `count` bytes. InputError for a folder, an empty file, one not to be read."""
    if path.is_dir():
        raise InputError(str(path), expected=expected, found="a folder", do="name a file in it")
    try:
        with path.open("rb") as stream:
            data = stream.read(count)
    except OSError as error:
        found = f"a file that cannot be read ({error.strerror})"
        raise InputError(str(path), expected=expected, found=found, do="check its permissions") from None
    if not data:
        raise InputError(str(path), expected=expected, found="an empty file", do="make or download it again")
    return data


def read_npz(path: Path, *, required: tuple[str, ...], optional: tuple[str, ...] = ()) -> dict[str, np.ndarray]:
    """The named arrays of an .npz, others unread. Never unpickles: arrays of objects are an InputError."""
    head = read_bytes(path, expected="an .npz file", count=4)
    if not zipfile.is_zipfile(path):
        found = "a truncated .npz" if head == b"PK\x03\x04" else "something else"
        raise InputError(str(path), expected="an .npz file (numpy.savez)", found=found, do="make or download it again")
    try:
        archive = np.load(path, allow_pickle=False)
    except UNREADABLE as error:
        raise InputError(
            str(path), expected="a readable .npz", found=_line(error), do="make or download it again"
        ) from None
    with archive:
        missing = [key for key in required if key not in archive.files]
        if missing:
            raise InputError(
                str(path),
                expected=f"the keys {', '.join(required)}",
                found=f"{', '.join(sorted(archive.files)) or 'no keys'}",
                do=f"add {', '.join(missing)}",
            )
        wanted = [*required, *(key for key in optional if key in archive.files)]
        return {key: _read_array(archive, path, key) for key in wanted}


def motion(
    where: str,
    *,
    name: str,
    points: np.ndarray,
    faces: np.ndarray | None,
    fps: float,
    unit: str,
    clip_start: np.ndarray | None = None,
    clip_names: list[str] | None = None,
    rest: np.ndarray | None = None,
    rig: Rig | None = None,
) -> Motion:
    """A Motion whose every field has been checked. where: the file, for messages. Without clips it is one clip.

    Raises InputError for wrong shapes and types, NaN or infinite coordinates, a shape so far from the origin that
    float32 loses it, one too small or too large to be computed with, faces out of range, malformed clips, fewer than
    two frames or four points, and a sequence that does not move.
    """
    points = real(f"{where}: vertices", points, shape="(frames, points, 3)", last=3)
    _check(len(points) >= 2, f"{where}: vertices", "at least 2 frames", len(points), "give a moving sequence")
    _check(points.shape[1] >= LEAST_POINTS, f"{where}: vertices", f"at least {LEAST_POINTS} points", points.shape[1])
    _finite(f"{where}: vertices", points)
    _resolved(f"{where}: vertices", points)
    if faces is not None:
        faces = triangles(f"{where}: faces", faces, points.shape[1])
    start, names = clips(where, clip_start, clip_names, frames=len(points), only=name)
    _check(bool(np.isfinite(fps)) and fps > 0, f"{where}: fps", "a rate above zero", fps, "set dataset.fps")
    _moves(where, points)
    return Motion(name, points, faces, start, names, float(fps), unit, rest, rig)


def real(where: str, array: np.ndarray, *, shape: str, last: int) -> np.ndarray:
    """The array as contiguous float32 of as many axes as `shape` names, the last of length `last`."""
    array = np.asarray(array)
    if array.dtype.kind not in "fiu":
        raise InputError(where, expected="real numbers", found=f"dtype {array.dtype}", do="save it as float32")
    axes = shape.count(",") + 1
    if array.ndim != axes or array.shape[-1] != last:
        raise InputError(where, expected=f"shape {shape}", found=f"{array.shape}")
    with np.errstate(over="ignore"):  # too large for float32 becomes inf, which the finite check names
        return np.ascontiguousarray(array, np.float32)


def triangles(where: str, faces: np.ndarray, points: int) -> np.ndarray:
    """Faces as (T, 3) int32, every index a point."""
    faces = np.asarray(faces)
    _check(faces.dtype.kind in "iu", where, "whole numbers", f"dtype {faces.dtype}", "save it as int32")
    _check(faces.ndim == 2 and faces.shape[1] == 3, where, "triangles (T, 3)", faces.shape, "triangulate the mesh")
    _check(len(faces) > 0, where, "at least one triangle", "none", "load it as points with dataset.faces=false")
    bad = np.flatnonzero(((faces < 0) | (faces >= points)).any(1))
    if len(bad):
        one_based = faces.min() == 1 and faces.max() == points
        raise InputError(
            where,
            expected=f"indices 0 to {points - 1}",
            found=f"{faces[bad[0]].tolist()} in face {bad[0]} ({len(bad)} such faces)",
            do="they seem to count from 1: subtract 1" if one_based else "check that faces belong to these vertices",
        )
    return np.ascontiguousarray(faces, np.int32)


def clips(
    where: str, start: np.ndarray | None, names: list[str] | None, *, frames: int, only: str
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Clip boundaries (C+1,) int64 and C different names; without boundaries one clip called `only`."""
    if start is None:
        return np.array([0, frames], np.int64), (only,)
    start = np.asarray(start)
    rising = (
        start.dtype.kind in "iu"
        and start.ndim == 1
        and len(start) >= 2
        and start[0] == 0
        and start[-1] == frames
        and bool(np.all(np.diff(start.astype(np.int64)) > 0))
    )
    _check(rising, f"{where}: clip_start", f"rising frame numbers from 0 to {frames}", start.tolist())
    if names is None:
        names = [f"clip{c:03d}" for c in range(len(start) - 1)]
    _check(len(names) == len(start) - 1, f"{where}: clip_names", f"{len(start) - 1} names", f"{len(names)}")
    twice = sorted({n for n in names if names.count(n) > 1})
    _check(not twice, f"{where}: clip_names", "different names", f"{', '.join(twice)} more than once")
    return start.astype(np.int64), tuple(names)


def texts(where: str, array: np.ndarray) -> list[str]:
    """A one-dimensional array of strings as a list."""
    _check(array.dtype.kind in "US" and array.ndim == 1, where, "strings", f"dtype {array.dtype}, shape {array.shape}")
    return [t.decode("utf-8", "replace") if isinstance(t, bytes) else str(t) for t in array.tolist()]


def number(where: str, array: np.ndarray) -> float:
    """The one number that an array holds."""
    _check(array.dtype.kind in "fiu" and array.size == 1, where, "one number", f"{array.dtype} {array.shape}")
    return float(array.reshape(-1)[0])


def about(motion: Motion) -> About:
    """The data's name and :func:`notes`, for the report."""
    return About(motion.name, tuple(notes(motion)))


def notes(motion: Motion) -> list[str]:
    """What is unusual about the data though later stages cope with it, one line each, for the report."""
    found = []
    shape = motion.points[0]
    doubled = len(shape) - len(np.unique(shape, axis=0))
    if doubled:
        found.append(f"{doubled} of {len(shape)} points lie exactly on another in the first frame")
    if motion.faces is None:
        found.append("no faces: neighbours are the nearest points")
    else:
        found += _mesh_notes(shape, motion.faces)
    still = [
        name
        for name, frames in zip(motion.clip_names, motion.clips(), strict=True)
        if _largest_shift(motion.points[frames]) <= STILL * diagonal(shape)
    ]
    if still:
        found.append(f"clips that do not move: {', '.join(still)}")
    bound = motion.rig is not None and motion.rest is not None and len(motion.rig.weights)
    if bound and (error := rig_error(motion)) > RIG_NOTED:
        found.append(f"the given skeleton alone leaves up to {100 * error:.2g} % of the diagonal unexplained")
    return found


def rig_error(motion: Motion) -> float:
    """Largest distance, over the diagonal, of the points from skinning by the data's own skeleton, on up to 16 frames.

    It is more than rounding where the data's joints scale or where points move by more than their joints."""
    rig = motion.rig
    frames = np.unique(np.linspace(0, motion.frames - 1, 16).astype(int))
    pose = kinematics.forward(rig.parents, rig.joints, rig.rotations[frames], rig.translations[frames])
    shift = skin(motion.rest, rig.weights, pose) - motion.points[frames]
    return float(np.linalg.norm(shift, axis=2).max()) / diagonal(motion.points[0])


def _mesh_notes(shape: np.ndarray, faces: np.ndarray) -> list[str]:
    found = []
    edges = mesh_edges(faces)
    on_face = np.unique(faces)
    count, _ = components(edges, len(shape))
    parts = count - (len(shape) - len(on_face))  # a point on no face counts as a component of its own
    if parts > 1:
        found.append(f"{parts} separate components")
    if len(on_face) < len(shape):
        found.append(f"{len(shape) - len(on_face)} points are on no face")
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    _, uses = np.unique(pairs, axis=0, return_counts=True)
    if (uses == 1).any():
        found.append(f"open surface: {int((uses == 1).sum())} boundary edges")
    if (uses > 2).any():
        found.append(f"{int((uses > 2).sum())} edges with more than two faces")
    a, b, c = (shape[faces[:, i]].astype(np.float64) for i in range(3))
    flat = np.linalg.norm(np.cross(b - a, c - a), axis=1) <= 1e-12 * diagonal(shape) ** 2
    if flat.any():
        found.append(f"{int(flat.sum())} faces without area")
    return found


def _read_array(archive: np.lib.npyio.NpzFile, path: Path, key: str) -> np.ndarray:
    try:
        return archive[key]
    except UNREADABLE as error:
        pickled = isinstance(error, ValueError) and "allow_pickle" in str(error)
        raise InputError(
            f"{path}: {key}",
            expected="a plain array",
            found="pickled Python objects, which are never loaded" if pickled else f"damaged data ({_line(error)})",
            do="save numbers or strings, not objects" if pickled else "make or download the file again",
        ) from None


def _finite(where: str, points: np.ndarray) -> None:
    bad = [f for f, frame in enumerate(points) if not np.isfinite(frame).all()]
    if bad:
        vertex = int(np.flatnonzero(~np.isfinite(points[bad[0]]).all(1))[0])
        raise InputError(
            where,
            expected="finite numbers",
            found=f"{points[bad[0], vertex].tolist()} at frame {bad[0]}, vertex {vertex} ({len(bad)} such frames)",
            do="repair or leave out these frames",
        )


def _resolved(where: str, points: np.ndarray) -> None:
    """Far from the origin, neighbouring float32 numbers lie farther apart than the shape's details."""
    reach = [float(np.abs(frame).max()) for frame in points]
    frame = int(np.argmax(reach))
    if np.spacing(np.float32(reach[frame])) > COARSE * max(diagonal(points[0]), diagonal(points[-1])) > 0:
        raise InputError(
            where,
            expected="a shape near the origin",
            found=f"coordinates up to {reach[frame]:.3g} at frame {frame} of a shape {diagonal(points[0]):.3g} across, "
            "too far for float32",
            do="subtract the centre of the first frame from all frames, and a path that leads so far",
        )


def _moves(where: str, points: np.ndarray) -> None:
    size = max(diagonal(points[0]), diagonal(points[-1]))
    _check(size > 0, f"{where}: vertices", "points apart from each other", "all points in one place")
    expected = f"a shape {SIZES[0]:g} to {SIZES[1]:g} units across"
    _check(SIZES[0] <= size <= SIZES[1], f"{where}: vertices", expected, f"{size:.3g}", "scale all coordinates")
    if _largest_shift(points) <= STILL * size:
        raise InputError(
            f"{where}: vertices",
            expected="a moving sequence",
            found=f"{len(points)} frames that are all the same",
            do="give a sequence in which something moves",
        )


def _largest_shift(points: np.ndarray) -> float:
    return max(float(np.abs(frame - points[0]).max()) for frame in points)


def _check(ok: bool, where: str, expected: str, found: object, do: str = "") -> None:
    if not ok:
        text = str(found)
        raise InputError(where, expected=expected, found=text if len(text) <= 200 else text[:200] + "...", do=do)


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:160] or type(error).__name__
