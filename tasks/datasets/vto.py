"""The VTO dataset (Santesteban et al. 2019, 2021): simulated garments over SMPL bodies, one file a sequence.

A file holds `pose` (F, 72) and `translation` (F, 3), or `poses` (F, 75) with both, `shape` or `shapes` (F, 10),
`vertices` (F, N, 3) and `faces` (T, 3). It is a .pkl, or an .npz of the same names.
"""

from __future__ import annotations

from fnmatch import fnmatch
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from tasks.datasets import body_model, validate
from tasks.datasets.mesh_sequence import read_mesh
from tasks.datasets.unpickle import CONVERT, read_pickle
from tasks.errors import InputError
from tasks.geometry.rebase import rebased
from tasks.geometry.weight_transfer import robust_weights
from tasks.values import Motion, Rig

EXPECTED = "the folder of a garment's simulations, as tshirt/simulations"
MODEL = "smpl.npz"  # the body model, which has a licence of its own: the user puts it into the folder
TO_Y_UP = {"y": np.eye(3), "z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])}
_PC2 = b"POINTCACHE2\0"


def load(*, path: str, files: str, fps: Annotated[float, "(0, inf)"], up: Literal["y", "z"]) -> Motion:
    """Reads one garment on one body: every sequence is a clip, called after what its file's name adds to the others'.

    path: the folder, or one file; files: which of the folder's, as `*_shape00_*`; fps: of the simulation; up: the
    data's upward axis. Vertices that a file lacks are read from FILE.pc2 beside it, faces from the folder's one .obj.

    With SMPL's model as `smpl.npz` in the folder, the motion has SMPL's skeleton and poses and, transferred from the
    body (Abdrashitov et al. 2023), skin weights, at rest in its first frame; without it, none (skeleton=curve).
    Raises InputError for files that hold anything but numbers, lack a field or differ in their faces.
    """
    found = validate.existing_path(path, expected=EXPECTED)
    folder = found if found.is_dir() else found.parent
    sources = _sources(found, files)
    sequences = [_read(source) for source in sources]
    faces = sequences[0]["faces"]
    for source, sequence in zip(sources, sequences, strict=True):
        if not np.array_equal(sequence["faces"], faces):
            do = "load one garment at a time"
            raise InputError(f"{source}: faces", expected=f"those of {sources[0].name}", found="others", do=do)
    turn = TO_Y_UP[up].astype(np.float32)
    points = np.concatenate([sequence["vertices"] for sequence in sequences]) @ turn.T
    names = [source.stem for source in sources]
    start = np.concatenate([[0], np.cumsum([len(s["vertices"]) for s in sequences])])
    rig = _rig(folder / MODEL, sources, sequences, points[0], faces, turn) if (folder / MODEL).is_file() else None
    return validate.motion(
        str(found),
        name=names[0].split("_")[0],
        points=points,
        faces=faces,
        fps=fps,
        unit="m",
        clip_start=start,
        clip_names=_without_common(names),
        rest=points[0] if rig else None,
        rig=rig,
    )


def _sources(found: Path, files: str) -> list[Path]:
    if found.is_file():
        return [found]
    kinds = sorted(f for f in found.iterdir() if f.suffix in (".pkl", ".npz") and f.name != MODEL)
    chosen = [f for f in kinds if fnmatch(f.stem, files)]
    if not chosen:
        some = ", ".join(f.stem for f in kinds[:4]) or "no .pkl and no .npz"
        do = "set dataset.files, or dataset.path to the folder with the sequences"
        raise InputError(str(found), expected=f"sequences called {files}", found=some, do=do)
    return chosen


def _without_common(names: list[str]) -> list[str]:
    """`tshirt_shape00_01_01` among others of tshirt_shape00 is the clip 01_01."""
    parts = [name.split("_") for name in names]
    common = 0
    if len(names) > 1:
        while len({tuple(p[: common + 1]) for p in parts}) == 1:
            common += 1
    return ["_".join(p[common:]) for p in parts]


def _read(source: Path) -> dict[str, np.ndarray]:
    """A sequence with the fields vertices, faces and, where it has them, turns (F, 3 J), shift (F, 3), shape (S,)."""
    data = _content(source)
    vertices = data["vertices"] if "vertices" in data else _point_cache(source)
    vertices = validate.real(f"{source}: vertices", vertices, shape="(frames, points, 3)", last=3)
    if "faces" in data:
        faces = validate.triangles(f"{source}: faces", data["faces"], vertices.shape[1])
    else:
        faces = _faces_beside(source, vertices.shape[1])
    out = {"vertices": vertices, "faces": faces}
    frames = len(vertices)
    if "poses" in data:  # both in one, the translation last
        turns, shift = data["poses"][..., :-3], data["poses"][..., -3:]
    elif "pose" in data:
        turns, shift = data["pose"], data.get("translation", np.zeros((frames, 3)))
    else:
        return out
    if turns.shape != (frames, turns.shape[-1]) or shift.shape != (frames, 3):
        expected = f"pose (F, 72) and translation (F, 3), or poses (F, 75), for {frames} frames"
        raise InputError(f"{source}: pose", expected=expected, found=f"{turns.shape} and {shift.shape}")
    shape = np.atleast_2d(data.get("shape", data.get("shapes", np.zeros(10))))[0]
    return out | {"turns": turns, "shift": shift, "shape": shape}


def _content(source: Path) -> dict[str, np.ndarray]:
    if source.suffix == ".npz":
        names = ("pose", "poses", "translation", "shape", "shapes", "vertices", "faces")
        return validate.read_npz(source, required=(), optional=names)
    content = read_pickle(source)
    if not isinstance(content, dict):
        raise InputError(str(source), expected="a dict of arrays", found=type(content).__name__, do=CONVERT)
    return {str(name): np.asarray(value) for name, value in content.items() if not isinstance(value, dict)}


def _point_cache(source: Path) -> np.ndarray:
    """The PC2 file beside a sequence: version, points, first frame, rate, samples; float32 (samples, points, 3)."""
    path = source.with_suffix(".pc2")
    if not path.is_file():
        do = f"add vertices to the file, or put {path.name} beside it"
        raise InputError(f"{source}: vertices", expected="vertices", found="none, and no point cache", do=do)
    data = validate.read_bytes(path, expected="a point cache (.pc2)")
    if not data.startswith(_PC2) or len(data) < 32:
        raise InputError(str(path), expected="a point cache (.pc2)", found="something else")
    points, samples = (int(np.frombuffer(data, "<i4", 1, at)[0]) for at in (16, 28))
    if points < 1 or samples < 1 or len(data) != 32 + 12 * points * samples:
        found = f"{len(data)} bytes"
        raise InputError(str(path), expected=f"{32 + 12 * points * samples} bytes as its header says", found=found)
    return np.frombuffer(data, "<f4", offset=32).reshape(samples, points, 3)


def _faces_beside(source: Path, points: int) -> np.ndarray:
    meshes = sorted(source.parent.glob("*.obj"))
    if len(meshes) != 1:
        found = f"none in the file, and {len(meshes)} .obj files beside it"
        raise InputError(f"{source}: faces", expected="faces, or one .obj in the folder", found=found)
    vertices, faces = read_mesh(meshes[0])
    if len(vertices) != points:
        raise InputError(str(meshes[0]), expected=f"{points} vertices as in {source.name}", found=str(len(vertices)))
    return validate.triangles(f"{meshes[0]}: f", faces, points)


def _rig(
    model: Path, sources: list[Path], sequences: list[dict], rest: np.ndarray, faces: np.ndarray, turn: np.ndarray
) -> Rig:
    """SMPL's skeleton in the pose of the first frame, the garment's weights from the body there."""
    for source, sequence in zip(sources, sequences, strict=True):
        if "turns" not in sequence:
            raise InputError(f"{source}: pose", expected="SMPL poses", found="none", do=f"take {MODEL} away")
        if not np.allclose(sequence["shape"], sequences[0]["shape"]):
            do = "load one body at a time, as dataset.files='*_shape00_*'"
            raise InputError(f"{source}: shape", expected=f"the body of {sources[0].name}", found="another", do=do)
    body = body_model.read_body(model, np.asarray(sequences[0]["shape"], np.float64))
    joints = len(body.names)
    for source, sequence in zip(sources, sequences, strict=True):
        if sequence["turns"].shape[1] != 3 * joints:
            found = f"{sequence['turns'].shape[1]} numbers a frame"
            expected = f"3 for each of the {joints} joints of {MODEL}"
            raise InputError(f"{source}: pose", expected=expected, found=found)
    turns, shift = (np.concatenate([s[n] for s in sequences]) for n in ("turns", "shift"))
    rotations, translations = body_model.poses_of(turns, shift)
    skin = body.posed(rotations[:1], translations[:1])[0] @ turn.T
    weights = robust_weights(skin, body.faces, body.weights, rest, faces).astype(np.float32)
    # the world is turned upright about the origin: the root's rotation and place turn with it
    translations[:, 0] = (translations[:, 0] + body.joints[0]) @ turn.T - body.joints[0]
    rotations[:, 0] = turn @ rotations[:, 0]
    rig = Rig(body.names, body.parents, body.joints, weights, rotations, translations)
    return rebased(rig, rig, 0)
