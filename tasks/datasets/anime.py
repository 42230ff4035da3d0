"""DeformingThings4D (Li et al. 2021): .anime files, a first frame and offsets from it.

Little endian: int32 frames F, vertices V, triangles T; float32 (V, 3) the first frame; int32 (T, 3) faces; float32
(F - 1, V, 3) what each later frame adds to the first.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from tasks.datasets import validate
from tasks.datasets.vto import TO_Y_UP
from tasks.errors import InputError
from tasks.values import Motion

EXPECTED = "an .anime file, or a folder of them for one animal"
HEADER = 12  # bytes


def load(*, path: str, files: str, fps: Annotated[float, "(0, inf)"], up: Literal["y", "z"]) -> Motion:
    """Reads an animation, or all of one subject as clips.

    path: FILE.anime, or a folder in which every .anime file at any depth whose name fits `files`, as `bear3EP_*`, is a
    clip of the one subject; fps: frames a second, the files do not say; up: the data's upward axis.
    Raises InputError for damaged files and for files of several meshes.
    """
    found = validate.existing_path(path, expected=EXPECTED)
    sources = sorted(found.rglob(f"{files}.anime")) if found.is_dir() else [found]
    if not sources:
        raise InputError(path, expected=EXPECTED, found=f"no {files}.anime", do="check dataset.path and dataset.files")
    clips = [read(source) for source in sources]
    faces = clips[0][1]
    for source, (points, own) in zip(sources, clips, strict=True):
        if points.shape[1] != clips[0][0].shape[1] or not np.array_equal(own, faces):
            found_here = f"{points.shape[1]} vertices, {len(own)} faces"
            expected = f"the mesh of {sources[0].name} ({clips[0][0].shape[1]} vertices, {len(faces)} faces)"
            do = "name one subject, as dataset.files='bear3EP_*'"
            raise InputError(str(source), expected=expected, found=found_here, do=do)
    return validate.motion(
        str(found),
        name=found.stem.split("_")[0] if found.is_file() else sources[0].stem.split("_")[0],
        points=np.concatenate([points for points, _ in clips]) @ TO_Y_UP[up].astype(np.float32).T,
        faces=faces,
        fps=fps,
        unit="unit",
        clip_start=np.concatenate([[0], np.cumsum([len(points) for points, _ in clips])]),
        clip_names=[source.stem for source in sources],
    )


def read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """A file's points (F, V, 3) and faces (T, 3). Raises InputError unless its size is what its header says."""
    data = validate.read_bytes(path, expected=EXPECTED)
    frames, vertices, triangles = np.frombuffer(data[:HEADER].ljust(HEADER, b"\0"), "<i4").tolist()
    size = HEADER + 12 * vertices + 12 * triangles + 12 * (frames - 1) * vertices
    if min(frames, vertices, triangles) < 1 or len(data) != size:
        says = f"{size} bytes for {frames} frames of {vertices} vertices and {triangles} faces, as its header says"
        raise InputError(str(path), expected=says, found=f"{len(data)} bytes", do="download it again")
    first, faces, offsets = np.split(
        np.frombuffer(data, "<f4", offset=HEADER), [3 * vertices, 3 * (vertices + triangles)]
    )
    points = np.empty((frames, vertices, 3), np.float32)
    points[:] = first.reshape(vertices, 3)
    points[1:] += offsets.reshape(frames - 1, vertices, 3)
    return points, validate.triangles(f"{path}: faces", faces.view("<i4").reshape(triangles, 3), vertices)
