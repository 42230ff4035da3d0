"""Moving meshes of one topology: an .npz of vertices and faces, or a folder of OBJ or PLY files."""

from __future__ import annotations

import io
import re
from codecs import BOM_UTF8
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from tasks.datasets import validate
from tasks.errors import InputError
from tasks.values import Motion

KINDS = (".obj", ".ply")
EXPECTED = "an .npz file or a folder of .obj or .ply files"


def load(*, path: str, fps: Annotated[float, "(0, inf)"], faces: bool, unit: Literal["unit", "m"]) -> Motion:
    """Reads a mesh sequence.

    path: an .npz with `vertices` (F, V, 3) and `faces` (T, 3), optionally `clip_start` (C+1,), `clip_names` (C,) and
    `fps`; or a folder of OBJ or PLY files, one a frame, in natural order of their names (frame9 before frame10), where
    sub-folders are clips. fps: frames a second where the file does not say. faces: False reads bare points and needs
    no faces. unit: of the coordinates, "unit" when unknown.

    The motion is called after the file or folder. Raises InputError for everything that :mod:`validate` checks and
    for a frame whose points or faces differ from the first.
    """
    source = validate.existing_path(path, expected=EXPECTED)
    if source.is_dir():
        return _folder(source, fps=fps, faces=faces, unit=unit)
    if source.suffix.lower() in KINDS:
        raise InputError(path, expected=EXPECTED, found="a single mesh", do="name the folder that holds the frames")
    return _npz(source, fps=fps, faces=faces, unit=unit)


def read_mesh(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """One OBJ or PLY file: vertices (V, 3) and faces (T, 3) counted from 0."""
    vertices, topology = _read(file)
    return vertices, _triangles(file, topology)


def _npz(path: Path, *, fps: float, faces: bool, unit: str) -> Motion:
    required = ("vertices", "faces") if faces else ("vertices",)
    data = validate.read_npz(path, required=required, optional=("clip_start", "clip_names", "fps"))
    return validate.motion(
        str(path),
        name=path.stem,
        points=data["vertices"],
        faces=data["faces"] if faces else None,
        fps=validate.number(f"{path}: fps", data["fps"]) if "fps" in data else fps,
        unit=unit,
        clip_start=data.get("clip_start"),
        clip_names=validate.texts(f"{path}: clip_names", data["clip_names"]) if "clip_names" in data else None,
    )


def _folder(path: Path, *, fps: float, faces: bool, unit: str) -> Motion:
    runs = _runs(path)
    first = runs[0][1][0]
    reference, topology = _read(first)
    points = []
    for _, files in runs:
        for file in files:
            vertices, here = _read(file)
            if vertices.shape != reference.shape:
                _changed(file, first, "vertices", len(reference), len(vertices))
            if faces and not _same_topology(file, here, first, topology):
                _changed(file, first, "faces", f"the {len(_triangles(first, topology))} faces", "other faces")
            points.append(vertices)
    return validate.motion(
        str(path),
        name=path.resolve().name,
        points=np.stack(points),
        faces=_triangles(first, topology) if faces else None,
        fps=fps,
        unit=unit,
        clip_start=np.concatenate([[0], np.cumsum([len(files) for _, files in runs])]),
        clip_names=[name for name, _ in runs],
    )


def _runs(path: Path) -> list[tuple[str, list[Path]]]:
    """(clip name, its files) for a folder of frames or a folder of such folders."""
    own = _frames(path)
    below = [(sub.name, _frames(sub)) for sub in _visible(path) if sub.is_dir()]
    below = [(name, files) for name, files in below if files]
    if own and below:
        found = f"{len(own)} mesh files beside {len(below)} folders of mesh files"
        raise InputError(str(path), expected="frames, or one folder a clip", found=found, do="move one of them away")
    if not own and not below:
        found = ", ".join(sorted({f.suffix or f.name for f in _visible(path)})[:6]) or "an empty folder"
        raise InputError(str(path), expected="a folder of .obj or .ply files", found=found, do="check dataset.path")
    return below or [(path.resolve().name, own)]


def _frames(folder: Path) -> list[Path]:
    files = [f for f in _visible(folder) if f.is_file() and f.suffix.lower() in KINDS]
    kinds = {f.suffix.lower() for f in files}
    if len(kinds) > 1:
        raise InputError(str(folder), expected="one kind of mesh file", found="both .obj and .ply", do="keep one kind")
    return files


def _visible(folder: Path) -> list[Path]:
    files = [f for f in folder.iterdir() if not f.name.startswith(".")]
    return sorted(files, key=lambda f: [(int(t), t) if t.isdigit() else (-1, t) for t in re.split(r"(\d+)", f.name)])


def _read(file: Path) -> tuple[np.ndarray, bytes | np.ndarray]:
    """Vertices (V, 3) and something that tells the topology: OBJ face lines as bytes, PLY faces as an array."""
    data = validate.read_bytes(file, expected="a mesh")
    vertices, topology = _read_obj(file, data) if file.suffix.lower() == ".obj" else _read_ply(file, data)
    if len(vertices) == 0:
        raise InputError(str(file), expected="a mesh", found="no vertices", do="make or download it again")
    return vertices, topology


def _read_obj(file: Path, data: bytes) -> tuple[np.ndarray, bytes]:
    """Own reader: other readers split vertices that carry several texture coordinates, which changes their order."""
    lines = data.removeprefix(BOM_UTF8).splitlines()
    rows = [line[2:].split()[:3] for line in lines if line[:2] in (b"v ", b"v\t")]
    try:
        vertices = np.array(rows, dtype="S").astype(np.float64).reshape(len(rows), 3)
    except ValueError:
        bad = next((r for r in rows if not _three_numbers(r)), [])
        found = b"v " + b" ".join(bad)
        raise InputError(f"{file}: v", expected="three numbers", found=found.decode("utf-8", "replace")) from None
    return vertices, b"\n".join(line for line in lines if line[:2] in (b"f ", b"f\t"))


def _three_numbers(row: list[bytes]) -> bool:
    try:
        return len([float(x) for x in row]) == 3
    except ValueError:
        return False


def _read_ply(file: Path, data: bytes) -> tuple[np.ndarray, np.ndarray]:
    import trimesh  # 0.4 s to import, and only PLY needs it

    try:
        mesh = trimesh.load(io.BytesIO(data), file_type="ply", process=False)
    except Exception as error:  # whatever a parser of others trips over is bad input
        found = " ".join(str(error).split())[:120] or type(error).__name__
        raise InputError(str(file), expected="a PLY mesh", found=found, do="make or download it again") from None
    vertices = np.asarray(getattr(mesh, "vertices", np.zeros((0, 3))))  # trimesh makes a scene of an empty PLY
    return vertices, np.asarray(getattr(mesh, "faces", np.zeros((0, 3))), np.int64)


def _same_topology(file: Path, here: bytes | np.ndarray, first: Path, topology: bytes | np.ndarray) -> bool:
    """Compares OBJ text before triangles: only exporters that number normals anew in every frame need the latter."""
    if isinstance(here, bytes) and here == topology:
        return True
    return np.array_equal(_triangles(file, here), _triangles(first, topology))


def _triangles(file: Path, topology: bytes | np.ndarray) -> np.ndarray:
    """(T, 3) faces counted from 0; polygons of an OBJ are cut into fans."""
    if not isinstance(topology, bytes):
        return topology
    faces = []
    for line in topology.splitlines():
        try:
            corners = [int(corner.split(b"/")[0]) for corner in line.partition(b"#")[0].split()[1:]]
        except ValueError:
            corners = []
        if len(corners) < 3 or min(corners) < 1 or max(corners) >= 2**31:
            found = line.decode("utf-8", "replace")[:80]
            raise InputError(f"{file}: f", expected="three or more vertex numbers from 1", found=found)
        faces += [(corners[0] - 1, b - 1, c - 1) for b, c in pairwise(corners[1:])]
    return np.array(faces, np.int64).reshape(-1, 3)


def _changed(file: Path, first: Path, field: str, expected: object, found: object) -> None:
    raise InputError(
        f"{file}: {field}",
        expected=f"{expected} as in {first.name}, since the topology may not change",
        found=str(found),
        do="give frames of one mesh",
    )
