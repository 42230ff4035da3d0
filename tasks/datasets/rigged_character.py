"""Skinned, animated characters with their true skeleton: a decoded .npz or a binary glTF."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from tasks.datasets import gltf, validate
from tasks.datasets.rigging import Decoded, check_tree, to_motion
from tasks.errors import InputError
from tasks.geometry.measure import diagonal
from tasks.geometry.skinning import skin
from tasks.values import Motion

EXPECTED = "a decoded .npz or a .glb file"
ARRAYS = (
    "rest_vertices",
    "faces",
    "weight_index",
    "weight_value",
    "joint_names",
    "joint_parents",
    "bind_matrices",
    "clip_names",
    "clip_start",
    "skin_matrices",
)
REPRODUCED = 1e-4  # of the diagonal: a file whose own check vertices differ by more was decoded in another way


def load(
    *,
    path: str,
    fps: Annotated[float, "(0, 1000]"],
    hierarchy: Literal["attached", "authored"],
    unit: Literal["unit", "m"],
) -> Motion:
    """Reads a rigged character: points by linear blend skinning, rest shape, and the rig in ``Motion.rig``.

    path: an .npz with rest_vertices (V, 3), faces (T, 3), weight_index and weight_value (V, I), joint_names (J,),
    joint_parents (J,), bind_matrices (J, 4, 4), skin_matrices (F, J, 3, 4), clip_names (C,), clip_start (C+1,), and
    perhaps fps, check_frames (K,), check_vertices (K, V, 3), which the posed points are then held against; or a .glb
    with one skinned mesh or more and animations, sampled at `fps`. fps: for the .npz, the rate where it does not say.
    hierarchy: see :func:`tasks.datasets.rigging.single_tree`. Raises InputError for unusable files.
    """
    source = validate.existing_path(path, expected=EXPECTED)
    if source.suffix.lower() == ".glb":
        return to_motion(gltf.read_glb(source, fps=fps), hierarchy=hierarchy, unit=unit)
    if source.suffix.lower() == ".gltf":
        raise InputError(path, expected=EXPECTED, found="a .gltf in several files", do="pack it into one .glb")
    return to_motion(read_npz(source, fps=fps), hierarchy=hierarchy, unit=unit)


def read_npz(path: Path, *, fps: float) -> Decoded:
    """The .npz form as :class:`Decoded`, every array checked against the others."""
    data = validate.read_npz(path, required=ARRAYS, optional=("fps", "check_frames", "check_vertices"))
    names = validate.texts(f"{path}: joint_names", data["joint_names"])
    rest = validate.real(f"{path}: rest_vertices", data["rest_vertices"], shape="(points, 3)", last=3)
    if not np.isfinite(rest).all():
        raise InputError(f"{path}: rest_vertices", expected="finite numbers", found="NaN or infinity")
    matrices, bind, parents = data["skin_matrices"], data["bind_matrices"], data["joint_parents"]
    joints = len(names)
    _shape(path, "skin_matrices", matrices, "f", ("frames", joints, 3, 4))
    _shape(path, "bind_matrices", bind, "f", (joints, 4, 4))
    _shape(path, "joint_parents", parents, "i", (joints,))
    check_tree(f"{path}: joint_parents", parents)
    decoded = Decoded(
        where=str(path),
        name=path.stem,
        rest=rest.astype(np.float64),
        faces=validate.triangles(f"{path}: faces", data["faces"], len(rest)),
        weights=_dense(path, data["weight_index"], data["weight_value"], len(rest), joints),
        names=names,
        parents=parents,
        joints=bind[:, :3, 3].astype(np.float64),
        skin=matrices.astype(np.float64),
        clip_start=data["clip_start"],
        clip_names=validate.texts(f"{path}: clip_names", data["clip_names"]),
        fps=validate.number(f"{path}: fps", data["fps"]) if "fps" in data else fps,
    )
    if "check_frames" in data and "check_vertices" in data:
        _check_posed(decoded, data["check_frames"], data["check_vertices"])
    return decoded


def _dense(path: Path, index: np.ndarray, value: np.ndarray, points: int, joints: int) -> np.ndarray:
    _shape(path, "weight_index", index, "i", (points, "influences"))
    _shape(path, "weight_value", value, "f", index.shape)
    if ((index < 0) | (index >= joints)).any():
        found = f"{index.min()} to {index.max()}"
        raise InputError(f"{path}: weight_index", expected=f"joints 0 to {joints - 1}", found=found)
    weights = np.zeros((points, joints))
    np.add.at(weights, (np.arange(points)[:, None], index), value)
    return weights


def _check_posed(decoded: Decoded, frames: np.ndarray, expected: np.ndarray) -> None:
    """Holds the decoder against frames that the file carries for this."""
    path = Path(decoded.where)
    _shape(path, "check_frames", frames, "i", ("frames",))
    _shape(path, "check_vertices", expected, "f", (len(frames), *decoded.rest.shape))
    if ((frames < 0) | (frames >= len(decoded.skin))).any():
        raise InputError(f"{path}: check_frames", expected=f"0 to {len(decoded.skin) - 1}", found=str(frames.tolist()))
    error = np.abs(skin(decoded.rest, decoded.weights, decoded.skin[frames]) - expected).max() / diagonal(expected[0])
    if not error <= REPRODUCED:
        raise InputError(
            f"{path}: check_vertices",
            expected="the points that skinning gives",
            found=f"points up to {100 * error:.3g} % of the diagonal away",
            do="decode the character again",
        )


def _shape(path: Path, field: str, array: np.ndarray, kind: str, shape: tuple[int | str, ...]) -> None:
    """Raises InputError unless the array is of that kind ("f" real, "i" whole) and shape; text is any length."""
    fits = array.ndim == len(shape) and all(
        isinstance(n, str) or n == m for n, m in zip(shape, array.shape, strict=True)
    )
    if array.dtype.kind not in ("iu" if kind == "i" else "fiu") or not fits:
        wanted = ", ".join(str(n) for n in shape)
        what = "whole numbers" if kind == "i" else "real numbers"
        found = f"{array.dtype} of shape {array.shape}"
        raise InputError(f"{path}: {field}", expected=f"{what} of shape ({wanted})", found=found)
