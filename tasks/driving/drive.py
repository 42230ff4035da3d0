"""Poses for a character out of a file of somebody else's motion: joints matched by name, limbs brought into line."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from tasks.driving.bvh import Driver, read_bvh
from tasks.errors import InputError
from tasks.geometry import kinematics
from tasks.geometry.rotations import from_rotation_vector, geodesic, project_so3, to_rotation_vector
from tasks.values import About, Motion, Poses, Skeleton

WORD = re.compile(r"[^\W_]+")  # of any script
CAMEL = re.compile(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])")  # where a word begins within LHipJoint
SIDES = {"l": "left", "left": "left", "r": "right", "right": "right"}
ARRAYS = ("joint_names", "joint_parents", "joints", "joint_rotations", "joint_translations", "fps")
EXPECTED = "a .bvh or .npz file of poses"
ROUNDED = 1e-2  # of a frame: files give the frame time in few digits
SLOWEST = 0.1  # frames a second of a file: below it is no motion, and filling in between would take all memory
TILTED = np.radians(45)  # between the hips of two skeletons at rest: beyond it one of them does not stand
LYING = 0.7  # of a length: a body that leans so far towards a side in the median lies there
LEAST = 0.5  # of the joints that move skin: with fewer matched it is another creature


def driving_poses(
    skeleton: Skeleton,
    train: Motion,
    *,
    path: str | None,
    rename: list[str],
    up: Literal["y", "z"],
    first: Annotated[int, "[0, inf)"],
    frames: Annotated[int, "[1, inf)"] | None,
) -> tuple[Motion, Poses, About]:
    """The motion of a file on this skeleton: its joints' path (F, J, 3) as a motion, the poses, and what was left out.

    path: a .bvh, or an .npz as the export writes it (joint_names, joint_parents, joints, joint_rotations,
    joint_translations, fps). Joints are matched by name, whatever their order; capitals, separators, a prefix before
    ":" and how left and right are written do not count. rename: "theirs=ours" where names differ. Joints without a
    counterpart keep their rest pose. Each matched joint takes the driver's rotation in the world, after its own bones
    at rest have been turned onto the driver's; the root takes its counterpart's path, and the lowest joint keeps the
    driver's height above the ground, both scaled. up: the file's axis that points up. Sampled at the training data's
    rate. first, frames: where to begin, captures often have a T pose in front, and how many at most.
    Raises InputError where the file cannot be read or too few names match.
    """
    source = existing(path)
    driver = read_bvh(source) if source.suffix.lower() == ".bvh" else _read_npz(source)
    driver = _sampled(_upright(driver) if up == "z" else driver, train.fps, first, frames)
    match = match_names(skeleton, driver.names, rename, where=str(source))
    poses = retarget(skeleton, driver, match)
    turned = kinematics.forward(skeleton.parents, skeleton.joints, poses.rotations, poses.translations)
    at = kinematics.joint_positions(turned, skeleton.joints)
    name = re.sub(r"\s+", "_", source.stem)
    left = [skeleton.names[j] for j in np.flatnonzero((match < 0) & (skeleton.weights.sum(0) > 0))]
    notes = [f"driven by {name}, {len(at)} frames"]
    notes += [f"joints left at rest: {', '.join(left)}"] if left else []
    notes += ["lies on its back or belly in most frames: where the file's Z is up, say drive.up=z"] * _lies(turned)
    motion = Motion(name, at.astype(np.float32), None, poses.clip_start, (name,), train.fps, train.unit)
    return motion, poses, About(train.name, tuple(notes))


def existing(path: str | None) -> Path:
    """The file of poses. Raises InputError where none is named or there."""
    if not path:
        raise InputError("drive.path", expected=EXPECTED, found="nothing", do="add drive.path=FILE to the command")
    source = Path(path).expanduser()
    if not source.is_file():
        raise InputError(path, expected=EXPECTED, found="no such file", do="check drive.path")
    return source


def match_names(skeleton: Skeleton, theirs: tuple[str, ...], rename: list[str], *, where: str) -> np.ndarray:
    """(J,) which of their joints each joint of the skeleton follows, -1 for none.

    Raises InputError for a renaming of unknown joints, for a root without a counterpart and for too few matches.
    """
    index = {_plain(name): j for j, name in reversed(list(enumerate(theirs)))}
    match = np.array([index.get(_plain(name), -1) for name in skeleton.names])
    for entry in rename:
        their, _, our = entry.partition("=")
        for name, valid in ((their, theirs), (our, skeleton.names)):
            if name not in valid:
                raise InputError("drive.rename", expected=f"theirs=ours, among {', '.join(valid)}", found=repr(entry))
        match[skeleton.names.index(our)] = theirs.index(their)
    moves = skeleton.weights.sum(0) > 0
    if match[0] < 0 or (match[moves] >= 0).mean() < LEAST:
        raise InputError(
            f"{where}: joints",
            expected=f"the names of the skeleton's joints ({', '.join(skeleton.names)})",
            found=f"{int((match >= 0).sum())} of {len(match)} among {', '.join(theirs)}",
            do="set drive.rename=[THEIRS=OURS,...], the root first",
        )
    return match


def retarget(skeleton: Skeleton, driver: Driver, match: np.ndarray) -> Poses:
    """The driver's world rotations W on the skeleton: joint j turns as W_match(j) A_j, with A_j the rotation that
    brings its bones at rest onto the driver's; see :func:`driving_poses`."""
    parents, rest = np.asarray(skeleton.parents), skeleton.joints.astype(np.float64)
    world = np.empty_like(driver.rotations)
    for j, p in enumerate(driver.parents):
        world[:, j] = driver.rotations[:, j] if p < 0 else world[:, p] @ driver.rotations[:, j]
    frames = len(world)
    into_line, scale = _into_line(parents, rest, driver, match)
    ours = np.empty((frames, len(parents), 3, 3))
    local = np.tile(np.eye(3), (frames, len(parents), 1, 1))
    for j, p in enumerate(parents):
        above = ours[:, p] if p >= 0 else np.tile(np.eye(3), (frames, 1, 1))
        ours[:, j] = world[:, match[j]] @ into_line[j] if match[j] >= 0 else above
        local[:, j] = np.swapaxes(above, -1, -2) @ ours[:, j]
    shift = np.zeros((frames, len(parents), 3))
    places = _places(driver.parents, driver.joints, driver.rotations, driver.translations)
    shift[:, 0] = scale * (places[:, match[0]] - places[:1, match[0]])
    shift[:, 0, 1] = 0
    low = _places(parents, rest, local, shift)[..., 1].min(1)
    body = np.setdiff1d(np.arange(len(driver.parents)), _above(driver.parents, match[0]))
    height = places[:, body, 1].min(1)
    shift[:, 0, 1] = rest[:, 1].min() + scale * (height - height.min()) - low
    clip = np.array([0, frames], np.int64)
    return Poses(project_so3(local).astype(np.float32), shift.astype(np.float32), clip)


def _into_line(parents: np.ndarray, rest: np.ndarray, driver: Driver, match: np.ndarray) -> tuple[np.ndarray, float]:
    """(J, 3, 3) rotations of the rest pose onto the driver's, joint by joint, and the driver's size in ours."""
    out = np.tile(np.eye(3), (len(parents), 1, 1))
    own, theirs = 0.0, 0.0
    for j, p in enumerate(parents):
        ends = _matched_below(parents, match, j)
        if match[j] < 0 or not ends or _placed_on_parent(driver, match[j]):
            out[j] = out[p] if p >= 0 else np.eye(3)
            continue
        a = rest[ends] - rest[j]
        b = driver.joints[match[ends]] - driver.joints[match[j]]
        own, theirs = own + np.linalg.norm(a, axis=1).sum(), theirs + np.linalg.norm(b, axis=1).sum()
        a, b = (v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-9) for v in (a, b))
        spread = np.linalg.svd(a)[1]
        if len(ends) > 1 and spread[1] > 0.3:  # two directions and more decide a rotation
            out[j] = project_so3(b.T @ a) if p >= 0 else _standing(project_so3(b.T @ a))
        else:
            before = out[p] if p >= 0 else np.eye(3)  # about their own axis, limbs turn as what they hang on
            out[j] = _onto(before @ a.mean(0), b.mean(0)) @ before
    return out, float(own / max(theirs, 1e-9))


def _standing(turn: np.ndarray) -> np.ndarray:
    """The root's own: a small tilt between two characters that stand is where their hips' joints lie, not a pose, so
    that only the turn about the vertical counts."""
    upright = from_rotation_vector(np.array([0.0, np.arctan2(turn[0, 2] - turn[2, 0], turn[0, 0] + turn[2, 2]), 0.0]))
    return upright if geodesic(turn, upright) < TILTED else turn


def _placed_on_parent(driver: Driver, joint: int) -> bool:
    """Collar bones of some captures begin at the neck: where their bones point says nothing about a pose."""
    above = driver.parents[joint]
    size = np.ptp(driver.joints, axis=0).max()
    return above >= 0 and np.linalg.norm(driver.joints[joint] - driver.joints[above]) < 1e-3 * size


def _matched_below(parents: np.ndarray, match: np.ndarray, joint: int) -> list[int]:
    """The nearest matched joints below a joint, on every branch."""
    found, pending = [], list(np.flatnonzero(parents == joint))
    while pending:
        j = int(pending.pop(0))
        if match[j] >= 0:
            found.append(j)
        else:
            pending += list(np.flatnonzero(parents == j))
    return found


def _onto(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The smallest rotation that brings direction a onto direction b."""
    a, b = (v / max(np.linalg.norm(v), 1e-12) for v in (a, b))
    axis = np.cross(a, b)
    sine, cosine = np.linalg.norm(axis), a @ b
    if sine < 1e-9:  # opposite: half a turn about anything across
        axis, sine = np.cross(a, np.eye(3)[np.argmin(np.abs(a))]), 1e-9
        cosine = np.sign(cosine)
    return from_rotation_vector(axis / max(np.linalg.norm(axis), 1e-12) * np.arctan2(sine, cosine))


def _places(parents: np.ndarray, rest: np.ndarray, rotations: np.ndarray, translations: np.ndarray) -> np.ndarray:
    """Where the joints are in each frame. (F, J, 3)"""
    return kinematics.joint_positions(kinematics.forward(parents, rest, rotations, translations), rest)


def _above(parents: np.ndarray, joint: int) -> list[int]:
    """What a joint hangs on: nodes that stand still under a moving body, as some programs write them."""
    found = []
    while (joint := int(parents[joint])) >= 0:
        found.append(joint)
    return found


def _lies(turned: np.ndarray) -> bool:
    """Whether the root, upright at rest, has its own up along Z in most frames. turned: (F, J, 3, 4)"""
    return bool(np.abs(np.median(turned[:, 0, 2, 1])) > LYING)


def _upright(driver: Driver) -> Driver:
    """A motion whose Z is up, with Y up: x y z -> x z -y."""
    turn = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    joints, moved = driver.joints @ turn.T, driver.translations @ turn.T
    return replace(driver, joints=joints, rotations=turn @ driver.rotations @ turn.T, translations=moved)


def _sampled(driver: Driver, fps: float, first: int, frames: int | None) -> Driver:
    """The same motion at another rate, from a frame on, cut to so many frames."""
    if not driver.fps >= SLOWEST:
        raise InputError("drive.path: frame time", expected=f"at most {1 / SLOWEST:g} s", found=f"{1 / driver.fps:g} s")
    last = len(driver.rotations) - 1
    count = int(np.floor(last * fps / driver.fps + ROUNDED)) + 1
    if first >= count:
        raise InputError("drive.first", expected=f"at most {count - 1}", found=str(first))
    at = np.minimum(np.arange(count)[first:][:frames] * (driver.fps / fps), last)
    a = np.minimum(at.astype(int), max(last - 1, 0))
    b, t = np.minimum(a + 1, last), (at - a)[:, None, None]
    step = to_rotation_vector(np.swapaxes(driver.rotations[a], -1, -2) @ driver.rotations[b])
    rotations = driver.rotations[a] @ from_rotation_vector(t * step)
    moved = (1 - t) * driver.translations[a] + t * driver.translations[b]
    return replace(driver, rotations=rotations, translations=moved, fps=fps)


def _read_npz(path: Path) -> Driver:
    try:
        with np.load(path, allow_pickle=False) as archive:
            missing = [name for name in ARRAYS if name not in archive.files]
            if missing:
                found = ", ".join(sorted(archive.files))
                raise InputError(str(path), expected=", ".join(ARRAYS), found=found, do=f"add {', '.join(missing)}")
            names, parents, joints, rotations, moved, fps = (archive[name] for name in ARRAYS)
    except (ValueError, OSError, EOFError) as error:
        raise InputError(str(path), expected="a .bvh or a plain .npz", found=str(error)[:120]) from None
    count = len(names)
    fits = parents.shape == (count,) and joints.shape == (count, 3) and rotations.shape[1:] == (count, 3, 3)
    if not fits or moved.shape != rotations.shape[:3]:
        shapes = ", ".join(str(a.shape) for a in (parents, joints, rotations, moved))
        raise InputError(str(path), expected=f"arrays of {count} joints", found=shapes)
    if parents[0] != -1 or not all(0 <= p < j for j, p in enumerate(parents[1:], start=1)):
        expected = "one root at index 0 and every parent before its children"
        raise InputError(f"{path}: joint_parents", expected=expected, found=str(parents.tolist()))
    for name, array in (("joints", joints), ("joint_translations", moved), ("fps", fps)):
        if array.dtype.kind not in "fiu" or not np.isfinite(array).all():
            raise InputError(f"{path}: {name}", expected="finite numbers", found="others")
    if fps.size != 1 or not fps > 0:
        raise InputError(f"{path}: fps", expected="one number above zero", found=str(fps.tolist()))
    off = np.abs(np.swapaxes(rotations, -1, -2) @ rotations - np.eye(3)).max((-1, -2))
    if not (off <= 1e-3).all() or (np.linalg.det(rotations) < 0).any():
        f, j = np.unravel_index(int(np.nanargmax(np.where(np.isfinite(off), off, np.inf))), off.shape)
        found = f"frame {f}, joint {names[j]}"
        raise InputError(f"{path}: joint_rotations", expected="rotation matrices", found=found)
    joints, rotations, moved = (array.astype(np.float64) for array in (joints, rotations, moved))
    return Driver(tuple(map(str, names)), parents, joints, rotations, moved, float(fps.item()))


def _plain(name: str) -> str:
    """A joint's name without prefix, separators and capitals, its side in front: mixamorig:LeftArm, arm.L and l_arm
    are one."""
    words = [w.lower() for w in WORD.findall(CAMEL.sub(" ", name.rpartition(":")[2]))]
    words = words[1:] if words[:1] == ["mixamorig"] else words
    if len(words) > 1:
        at = next((at for at in (0, -1) if words[at] in SIDES), None)
        words = words if at is None else [SIDES[words.pop(at)], *words]
    return "".join(words) or name
