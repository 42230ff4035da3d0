"""A plain layout for captures by several cameras at once, which those of others can be brought into.

    FOLDER/cameras.json
        {"fps": 25.0, "unit": "m",
         "cameras": [{"name": "cam00", "split": "train", "intrinsics": 3 x 3, "world_to_camera": 4 x 4}, …],
         "clips": [{"name": "walk", "start": 0}, …]}
    FOLDER/frames/cam00/000000.png, …   RGB or RGBA, PNG or JPEG; one folder a camera, one file a frame
    FOLDER/masks/cam00/000000.png, …    only where the images have no alpha: white is the subject
    FOLDER/skeleton.npz                 only where there is one

`intrinsics` are in pixels, the first pixel's centre at 0.5, without lens distortion (undistort first);
`world_to_camera` has OpenCV's axes (x right, y down, z forward); the world is right-handed, its up is +Y. `split` says
whether a camera trains or tests, "train" where it is left out. `clips`, where given, name runs of frames. Frames are
ordered by the numbers in their names; every camera has every frame.

skeleton.npz: names (J,), parents (J,) int, -1 for the root, which is joint 0, every parent before its children;
joints (J, 3) at rest; rotations (F, J, 3) rotation vectors in radians, or (F, J, 3, 3), local to the parent and
relative to rest (SMPL's `global_orient` and `body_pose`); root (F, 3), the shift of the root joint in the world, or
instead translations (F, J, 3), those of all joints in their parents' frames, where the skeleton stretches.

DNA-Rendering: K, D and RT of each camera lie in the annotation file, masks and SMPL-X parameters beside them; RT is
camera to world, so invert it, and undistort by D. ActorsHQ: each row of calibration.csv holds a camera's rotation
vector and place, also camera to world, and focal lengths and centre as shares of the image's width and height; masks
are images of their own, named like the frames. Cameras left in the wrong direction are refused: they look away from
each other's subject.
"""

from __future__ import annotations

import io
import json
import re
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from tasks.captures import validate
from tasks.captures.files import png, read_json, read_mask, read_stack, write_files
from tasks.errors import InputError
from tasks.geometry.rotations import from_rotation_vector
from tasks.values import Capture, Rig

IMAGES = (".png", ".jpg", ".jpeg")
NOT_TURNED = 1e-3  # of a matrix's entries: rotations of float32 lie far below
UNREADABLE = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile)


def load(
    *, path: str, size: Annotated[int, "[1, inf)"] | None, background: Literal["none", "white", "black"]
) -> tuple[Capture, Capture]:
    """(train, test) captures of a folder in the layout above.

    size: of the longer side at most: larger images are brought down; null: none are; background: behind images without
    alpha and masks, which are refused when it is none; with alpha, none is white. Raises InputError for missing
    cameras, frames and masks, for unreadable files and for all that :mod:`validate` checks.
    """
    folder = Path(path).expanduser()
    if not (folder / "cameras.json").is_file():
        found = "no such folder" if not folder.is_dir() else "none"
        raise InputError(path, expected="a folder with cameras.json", found=found, do="check dataset.path")
    meta = read_json(folder / "cameras.json")
    cameras = _cameras(folder / "cameras.json", meta.get("cameras"))
    files = _frames(folder, cameras)
    frames = len(files[0])
    if frames < 2:
        raise InputError(str(folder / "frames"), expected="two frames or more", found=str(frames))
    start, names = _clips(folder, meta.get("clips"), frames)
    whole = replace(
        _read(folder, cameras, files, size, background),
        fps=_number(folder, meta, "fps"),
        unit=_unit(folder, meta),
        clip_start=start,
        clip_names=names,
        rig=_rig(folder / "skeleton.npz", frames) if (folder / "skeleton.npz").is_file() else None,
    )
    tests = np.array([c["split"] == "test" for c in cameras])[whole.camera]
    for name, chosen in (("train", ~tests), ("test", tests)):
        if not chosen.any():
            raise InputError(str(folder / "cameras.json"), expected=f"a camera whose split is {name}", found="none")
    return tuple(
        validate.check(f"{path}: {name}", whole.take(np.flatnonzero(chosen)), training=name == "train")
        for name, chosen in (("train", ~tests), ("test", tests))
    )


def _cameras(file: Path, cameras: object) -> list[dict]:
    if not isinstance(cameras, list) or not cameras:
        raise InputError(f"{file}: cameras", expected="a list of cameras", found=str(cameras)[:80])
    out = []
    for i, camera in enumerate(cameras):
        camera = camera if isinstance(camera, dict) else {}
        entry = {"name": str(camera.get("name", "")), "split": camera.get("split", "train")}
        where = f"{file}: cameras[{i}]"
        if not entry["name"] or entry["name"] in (c["name"] for c in out):
            raise InputError(f"{where}.name", expected="a name of its own", found=repr(entry["name"]))
        if entry["split"] not in ("train", "test"):
            raise InputError(f"{where}.split", expected="train or test", found=repr(entry["split"]))
        for key, shape in (("intrinsics", (3, 3)), ("world_to_camera", (4, 4))):
            try:
                entry[key] = np.array(camera.get(key), np.float64)
            except (TypeError, ValueError):
                entry[key] = np.zeros(0)
            if entry[key].shape != shape:
                found = str(camera.get(key))[:80]
                raise InputError(f"{where}.{key}", expected=f"{shape[0]} x {shape[1]} numbers", found=found)
        out.append(entry)
    return out


def _frames(folder: Path, cameras: list[dict]) -> list[list[Path]]:
    """The files of each camera, all of the same frames."""
    files = [_numbered(folder / "frames" / c["name"]) for c in cameras]
    every = sorted(set().union(*files))
    for camera, own in zip(cameras, files, strict=True):
        missing = [n for n in every if n not in own]
        if missing:
            raise InputError(
                str(folder / "frames" / camera["name"]),
                expected=f"the {len(every)} frames that the cameras have together",
                found=f"no frame {missing[0]} ({len(missing)} are missing)",
                do="add them, or leave these frames out for every camera",
            )
    return [[own[n] for n in every] for own in files]


def _numbered(folder: Path) -> dict[int, Path]:
    if not folder.is_dir():
        raise InputError(str(folder), expected="a camera's folder of frames", found="no such folder")
    files = [f for f in folder.iterdir() if f.suffix.lower() in IMAGES and not f.name.startswith(".")]
    numbers = {}
    for file in files:
        digits = re.findall(r"\d+", file.stem)
        if not digits or int(digits[-1]) in numbers:
            raise InputError(str(file), expected="one file for each number of a frame", found=file.name)
        numbers[int(digits[-1])] = file
    return numbers


def _read(folder: Path, cameras: list[dict], files: list[list[Path]], size, background) -> Capture:
    """All images, the cameras' one after another."""
    frames = len(files[0])
    images, alpha, (height, width) = read_stack([f for own in files for f in own], size, _mask_of(folder))
    scale = np.array([[images.shape[2] / width], [images.shape[1] / height], [1.0]])
    camera = np.repeat(np.arange(len(cameras), dtype=np.int32), frames)
    return Capture(
        name=folder.resolve().name,
        images=images,
        has_alpha=alpha,
        background=validate.background(str(folder), background, alpha),
        view=np.stack([c["world_to_camera"] for c in cameras]).astype(np.float32)[camera],
        intrinsics=np.stack([scale * c["intrinsics"] for c in cameras]).astype(np.float32)[camera],
        camera=camera,
        frame=np.tile(np.arange(frames, dtype=np.int32), len(cameras)),
        times=np.linspace(0, 1, frames).astype(np.float32),
        fps=1.0,
        clip_start=np.array([0, frames], np.int64),
        clip_names=(folder.resolve().name,),
    )


def _mask_of(folder: Path):
    """What finds the mask (H, W) of an image file, None where the folder has no masks."""
    masks = folder / "masks"
    if not masks.is_dir():
        return None
    numbers: dict[str, dict[int, Path]] = {}

    def mask(file: Path) -> np.ndarray:
        camera = file.parent.name
        if camera not in numbers:
            numbers[camera] = _numbered(masks / camera)
        number = int(re.findall(r"\d+", file.stem)[-1])
        if number not in numbers[camera]:
            raise InputError(str(masks / camera), expected=f"a mask of frame {number}", found="none", do="add it")
        return read_mask(numbers[camera][number])

    return mask


def _clips(folder: Path, clips: object, frames: int) -> tuple[np.ndarray, tuple[str, ...]]:
    if clips is None:
        return np.array([0, frames], np.int64), (folder.resolve().name,)
    try:
        start, names = [int(c["start"]) for c in clips] + [frames], tuple(str(c["name"]) for c in clips)
    except (TypeError, KeyError, ValueError):
        start, names = [], ()
    if len(start) < 2 or start[0] != 0 or (np.diff(start) <= 0).any():
        expected = f"names and rising starts from 0, below {frames}"
        raise InputError(f"{folder / 'cameras.json'}: clips", expected=expected, found=str(clips)[:80])
    return np.array(start, np.int64), names


def _number(folder: Path, meta: dict, key: str) -> float:
    value = meta.get(key)
    if not isinstance(value, int | float) or not value > 0:
        raise InputError(f"{folder / 'cameras.json'}: {key}", expected="a number above zero", found=repr(value))
    return float(value)


def _unit(folder: Path, meta: dict) -> str:
    unit = meta.get("unit", "unit")
    if unit not in ("m", "unit"):
        raise InputError(f"{folder / 'cameras.json'}: unit", expected="m or unit", found=repr(unit))
    return unit


def _rig(file: Path, frames: int) -> Rig:
    data = _arrays(file)
    joints = data["names"].size
    turns = (frames, joints, 3, 3) if data["rotations"].ndim == 4 else (frames, joints, 3)
    shapes = {"parents": (joints,), "joints": (joints, 3), "rotations": turns}
    shapes |= {"translations": (frames, joints, 3)} if "translations" in data else {"root": (frames, 3)}
    for key, shape in shapes.items():
        if data[key].shape != shape or data[key].dtype.kind not in "fiu" or not np.isfinite(data[key]).all():
            found = f"{data[key].dtype} {data[key].shape}"
            raise InputError(f"{file}: {key}", expected=f"finite numbers {shape}", found=found)
    if len(turns) == 3:
        data["rotations"] = from_rotation_vector(data["rotations"].astype(np.float64))
    off = np.abs(np.swapaxes(data["rotations"], -1, -2) @ data["rotations"] - np.eye(3)).max(initial=0.0)
    if off > NOT_TURNED or (np.linalg.det(data["rotations"]) < 0).any():
        raise InputError(f"{file}: rotations", expected="rotation matrices", found=f"|R^T R - I| up to {off:.3g}")
    parents = data["parents"]
    if joints == 0 or parents[0] != -1 or not all(0 <= p < j for j, p in enumerate(parents[1:], start=1)):
        expected = "one root at index 0 and every parent before its children"
        raise InputError(f"{file}: parents", expected=expected, found=str(parents.tolist()))
    shift = data.get("translations", np.zeros((frames, joints, 3))).astype(np.float32)
    if "root" in shapes:
        shift[:, 0] = data["root"]
    return Rig(
        names=tuple(str(n) for n in data["names"].ravel()),
        parents=parents.astype(np.int32),
        joints=data["joints"].astype(np.float32),
        weights=np.zeros((0, joints), np.float32),
        rotations=data["rotations"].astype(np.float32),
        translations=shift,
    )


def _arrays(file: Path) -> dict[str, np.ndarray]:
    """The arrays of a skeleton.npz. Raises InputError for a damaged file and where one is missing."""
    try:
        with np.load(file, allow_pickle=False) as archive:
            keys = ("names", "parents", "joints", "rotations", "translations" if "translations" in archive else "root")
            return {k: archive[k] for k in keys}
    except UNREADABLE as error:
        expected = "plain arrays names, parents, joints, rotations, root"
        raise InputError(str(file), expected=expected, found=" ".join(str(error).split())[:120]) from None


def write_multiview(train: Capture, test: Capture, folder: Path) -> None:
    """Writes :func:`multiview_files` below a folder."""
    write_files(multiview_files(train, test), folder)


def multiview_files(train: Capture, test: Capture) -> dict[str, bytes]:
    """Both captures in the layout above by paths, alpha in the images. Raises InputError where a camera moves or misses
    a frame."""
    files: dict[str, bytes] = {}
    cameras = []
    for split, capture in (("train", train), ("test", test)):
        for c in np.unique(capture.camera):
            shots = np.flatnonzero(capture.camera == c)
            shots = shots[np.argsort(capture.frame[shots], kind="stable")]
            _check_standing(capture, shots, len(train.times))
            name = f"{split}{c:02d}"
            files |= {f"frames/{name}/{f:06d}.png": png(capture.images[i]) for f, i in enumerate(shots)}
            k, view = capture.intrinsics[shots[0]].tolist(), capture.view[shots[0]].tolist()
            cameras.append({"name": name, "split": split, "intrinsics": k, "world_to_camera": view})
    starts = zip(train.clip_names, train.clip_start[:-1].tolist(), strict=True)
    clips = [{"name": name, "start": start} for name, start in starts]
    meta = {"fps": train.fps, "unit": train.unit, "cameras": cameras, "clips": clips}
    files["cameras.json"] = (json.dumps(meta, indent=1) + "\n").encode()
    if train.rig is not None:
        files["skeleton.npz"] = _rig_file(train.rig)
    return files


def _check_standing(capture: Capture, shots: np.ndarray, frames: int) -> None:
    if len(shots) != frames or (capture.frame[shots] != np.arange(frames)).any():
        found = f"{len(shots)} images of {frames} frames"
        raise InputError(capture.name, expected="cameras that see every frame", found=found, do="use write_dnerf")
    if np.ptp(capture.view[shots], axis=0).max() > 0 or np.ptp(capture.intrinsics[shots], axis=0).max() > 0:
        raise InputError(capture.name, expected="cameras that stand still", found="a moving one", do="use write_dnerf")


def _rig_file(rig: Rig) -> bytes:
    stream = io.BytesIO()
    arrays = {"parents": rig.parents, "joints": rig.joints, "rotations": rig.rotations}
    arrays |= {"translations": rig.translations}
    np.savez(stream, names=np.array(rig.names), **arrays)
    return stream.getvalue()
