"""The layout of D-NeRF (Pumarola et al. 2021) and DG-Mesh (Liu et al. 2025): images from one moving camera.

    FOLDER/transforms_train.json, transforms_test.json (transforms_val.json is not read)
        {"camera_angle_x": horizontal field of view in radians,
         "frames": [{"file_path": "./train/r_000", "time": 0..1, "transform_matrix": 4 x 4}, …]}
    FOLDER/train/r_000.png, …  RGBA

`transform_matrix` is camera to world with OpenGL's axes (x right, y up, z backward); the world's up is +Z, as Blender
has it. Without `time` an image's time is its index over their number. `file_path` goes without ".png". Instead of
`camera_angle_x` there may be `fl_x` and, where they differ, `fl_y`, `cx`, `cy` in pixels, and `fps` may say the rate.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from tasks.captures import validate
from tasks.captures.files import png, read_json, read_stack, write_files
from tasks.errors import InputError
from tasks.values import Capture

SPLITS = ("train", "test")
TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
# rows: our axes in a world whose up is +Z
UP = {"y": np.eye(4), "z": np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])}
SAME_TIME = 1e-6


def load(
    *,
    path: str,
    size: Annotated[int, "[1, inf)"] | None,
    background: Literal["none", "white", "black"],
    up: Literal["y", "z"],
    fps: Annotated[float, "(0, inf)"],
    unit: Literal["unit", "m"],
) -> tuple[Capture, Capture]:
    """(train, test) captures of a folder in the layout above, the world turned so that up is +Y.

    size: of the longer side at most: larger images are brought down; null: none are. background: behind images without
    alpha, which are refused when it is none; with alpha, none is white. up: the axis of the file's world that is up.
    fps: where the file does not say; the times of both halves are one list, so a frame is the same time in both.
    Raises InputError for missing or unreadable files and for all that :mod:`validate` checks.
    """
    folder = Path(path).expanduser()
    if not (folder / "transforms_train.json").is_file():
        found = "no such folder" if not folder.is_dir() else "none"
        raise InputError(path, expected="a folder with transforms_train.json", found=found, do="check dataset.path")
    halves = {s: _Half(folder, s, UP[up], size) for s in SPLITS}
    every = np.sort(np.concatenate([h.times for h in halves.values()]))
    times = every[np.diff(every, prepend=-1.0) > SAME_TIME]
    alpha = halves["train"].alpha
    if halves["test"].alpha != alpha:
        found = "only the training half with it" if alpha else "only the test half with it"
        raise InputError(path, expected="alpha in all images or in none", found=found)
    if len({h.images.shape[1:] for h in halves.values()}) > 1:
        shapes = " and ".join(f"{h.images.shape[2]} x {h.images.shape[1]}" for h in halves.values())
        raise InputError(path, expected="images of one size", found=shapes, do="set dataset.size")
    poses = np.concatenate([h.view for h in halves.values()]).reshape(-1, 16).round(6)
    numbers = np.unique(poses, axis=0, return_inverse=True)[1].astype(np.int32).reshape(-1)
    cut = len(halves["train"].times)
    out = []
    for (name, half), camera in zip(halves.items(), (numbers[:cut], numbers[cut:]), strict=True):
        capture = Capture(
            name=folder.resolve().name,
            images=half.images,
            has_alpha=alpha,
            background=validate.background(path, background, alpha),
            view=half.view.astype(np.float32),
            intrinsics=half.intrinsics.astype(np.float32),
            camera=camera,
            frame=np.searchsorted(times, half.times - 2 * SAME_TIME).astype(np.int32),
            times=times.astype(np.float32),
            fps=float(fps if half.fps is None else half.fps),
            clip_start=np.array([0, len(times)], np.int64),
            clip_names=(folder.resolve().name,),
            unit=unit,
        )
        out.append(validate.check(f"{path}: {name}", capture, training=name == "train"))
    return tuple(out)


class _Half:
    """What one transforms_*.json says. view: (I, 4, 4); intrinsics: (I, 3, 3); images: (I, H, W, 4); times: (I,)."""

    def __init__(self, folder: Path, split: str, world: np.ndarray, size: int | None) -> None:
        self.file = folder / f"transforms_{split}.json"
        self.meta = read_json(self.file)
        frames = self.meta.get("frames")
        if not isinstance(frames, list) or not frames or not all(isinstance(f, dict) for f in frames):
            raise InputError(f"{self.file}: frames", expected="a list of images", found=str(frames)[:80])
        given = [f.get("time", i / len(frames)) for i, f in enumerate(frames)]
        if not all(isinstance(t, int | float) for t in given):
            raise InputError(f"{self.file}: time", expected="numbers", found=str(given)[:80])
        self.times = validate.times_in_range(str(self.file), np.array(given, np.float64))
        self.view = np.stack([world_to_camera(self._matrix(i, f), world) for i, f in enumerate(frames)])
        self.fps = self.meta.get("fps")
        if not isinstance(self.fps, int | float | None):
            raise InputError(f"{self.file}: fps", expected="a number", found=repr(self.fps)[:80])
        self._read(folder, frames, size)

    def _matrix(self, i: int, frame: dict) -> np.ndarray:
        where = f"{self.file}: frames[{i}].transform_matrix"
        try:
            matrix = np.array(frame.get("transform_matrix"), np.float64)
        except (TypeError, ValueError):
            matrix = np.zeros(0)
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or abs(np.linalg.det(matrix)) < 1e-9:
            raise InputError(where, expected="4 x 4 numbers", found=str(frame.get("transform_matrix"))[:80])
        return matrix

    def _read(self, folder: Path, frames: list[dict], size: int | None) -> None:
        files = [folder / (f"{p}.png" if not Path(p).suffix else p) for p in (str(f.get("file_path")) for f in frames)]
        missing = [f for f in files if not os.path.isfile(f)]  # a path's own is_file raises for names too long
        if missing:
            first = str(missing[0]).removeprefix(f"{folder}{os.sep}")[:200]
            found = f"no {first} ({len(missing)} of {len(files)} files are missing)"
            raise InputError(str(self.file), expected="the images that it names", found=found, do="add them")
        self.images, self.alpha, (height, width) = read_stack(files, size)
        k = self._intrinsics(height, width)
        k[:2] *= np.array([[self.images.shape[2] / width], [self.images.shape[1] / height]])
        self.intrinsics = np.tile(k, (len(files), 1, 1))

    def _intrinsics(self, height: int, width: int) -> np.ndarray:
        meta = {n: self.meta[n] for n in ("camera_angle_x", "fl_x", "fl_y", "cx", "cy") if n in self.meta}
        most = {"camera_angle_x": np.pi}  # more are degrees
        bad = [n for n, v in meta.items() if not isinstance(v, int | float) or not 0 < v < most.get(n, 1e6)]
        if bad or not {"camera_angle_x", "fl_x"} & set(meta):
            found = f"{bad[0]} = {meta[bad[0]]}" if bad else "neither camera_angle_x nor fl_x"
            expected = f"{bad[0]} in pixels" if bad and bad[0] != "camera_angle_x" else "camera_angle_x in radians"
            raise InputError(str(self.file), expected=expected, found=found)
        fx = meta.get("fl_x") or width / 2 / np.tan(meta["camera_angle_x"] / 2)
        fy, cx, cy = meta.get("fl_y", fx), meta.get("cx", width / 2), meta.get("cy", height / 2)
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def write_dnerf(train: Capture, test: Capture, folder: Path) -> None:
    """Writes :func:`dnerf_files` below a folder."""
    write_files(dnerf_files(train, test), folder)


def dnerf_files(train: Capture, test: Capture) -> dict[str, bytes]:
    """Both captures in the layout above, +Z up, by paths; the validation half repeats the test half.

    Clips, rig and unit have no place in it. Raises InputError for cameras whose intrinsics differ or whose pixels are
    not square, for which it has none either.
    """
    files: dict[str, bytes] = {}
    for split, capture in (("train", train), ("test", test)):
        frames = []
        for i, image in enumerate(capture.images):
            files[f"{split}/r_{i:03d}.png"] = png(image)
            matrix = UP["z"].T @ np.linalg.inv(capture.view[i].astype(np.float64)) @ TO_OPENCV
            time = round(float(capture.times[capture.frame[i]]), 9)
            frames.append({"file_path": f"./{split}/r_{i:03d}", "time": time, "transform_matrix": matrix.tolist()})
        about = {"camera_angle_x": _angle(capture), "fps": capture.fps, "frames": frames}
        for name in (split, "val") if split == "test" else (split,):
            files[f"transforms_{name}.json"] = (json.dumps(about, indent=1) + "\n").encode()
    return files


def _angle(capture: Capture) -> float:
    """The field of view that all images share, in radians."""
    k, (height, width) = capture.intrinsics.astype(np.float64), capture.size
    centred = np.allclose(k[:, :2, 2], [width / 2, height / 2], atol=1e-3)
    if not (centred and np.allclose(k[:, 0, 0], k[:, 1, 1], rtol=1e-6) and np.ptp(k[:, 0, 0]) < 1e-6 * k[0, 0, 0]):
        do = "write it with write_multiview"
        raise InputError(capture.name, expected="one centred camera", found="several intrinsics", do=do)
    return float(2 * np.arctan(width / 2 / k[0, 0, 0]))


def world_to_camera(camera_to_world: np.ndarray, world: np.ndarray) -> np.ndarray:
    """OpenGL's camera-to-world as OpenCV's world-to-camera. world: (4, 4), our axes in the file's world."""
    return np.linalg.inv(world @ camera_to_world @ TO_OPENCV)
