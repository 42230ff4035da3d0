"""Reading Biovision hierarchies: a skeleton and its motion."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tasks.errors import InputError
from tasks.geometry.rotations import from_rotation_vector

MOTION = re.compile(r"^\s*MOTION\b", re.MULTILINE)  # on a line of its own: joints may be called LOCOMOTION
CHANNEL = re.compile("[XYZ](rotation|position)", re.IGNORECASE)


@dataclass(frozen=True)
class Driver:
    """A motion on a skeleton of its own. names: J; parents: (J,), -1 for the root, which comes first; joints: (J, 3)
    rest positions; rotations: (F, J, 3, 3) local, identity at rest; translations: (F, J, 3) shift of the joint from its
    rest offset, in the parent's frame; fps: frames a second."""

    names: tuple[str, ...]
    parents: np.ndarray
    joints: np.ndarray
    rotations: np.ndarray
    translations: np.ndarray
    fps: float


@dataclass
class _Joint:
    name: str
    parent: int
    offset: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    channels: list[str] = field(default_factory=list)


def read_bvh(path: Path) -> Driver:
    """A .bvh file. Rotations are taken in the order of the channels; positions, which any joint may have, are from the
    parent and stand in place of the OFFSET, as programs read them.

    Raises InputError for what is no BVH, for a motion of another size than the header says and for numbers that are not
    finite.
    """
    try:
        text = path.read_text("utf-8-sig", "replace")
    except OSError as error:
        found = f"a file that cannot be read ({error.strerror})"
        raise InputError(str(path), expected="a BVH file", found=found, do="check its permissions") from None
    head, *rest = MOTION.split(text, 1)
    if not head.lstrip().startswith("HIERARCHY") or not rest:
        raise InputError(str(path), expected="a BVH file (HIERARCHY … MOTION …)", found=repr(head[:40]))
    try:
        joints = _hierarchy(head.split()[1:])
        lines = rest[0].split("\n")
        header = [line.strip() for line in lines if ":" in line]
        count, seconds = (float(line.rpartition(":")[2]) for line in header[:2])
        numbers = np.array(" ".join(line for line in lines if ":" not in line).split(), np.float64)
    except (ValueError, IndexError) as error:
        raise InputError(str(path), expected="a BVH file", found=f"damaged text ({error})") from None
    columns = sum(len(joint.channels) for joint in joints)
    if count < 1 or columns < 1 or not 0 < seconds < np.inf or len(numbers) != count * columns:
        expected = f"{max(count, 1):.0f} frames of {columns} numbers, and a frame time"
        raise InputError(f"{path}: MOTION", expected=expected, found=f"{len(numbers)} numbers, {seconds:g} s")
    rows = numbers.reshape(int(count), columns)
    bad = np.flatnonzero(~np.isfinite(rows).all(1))
    if len(bad):
        found = f"others in frame {bad[0]} ({len(bad)} such frames)"
        raise InputError(f"{path}: MOTION", expected="finite numbers", found=found, do="repair these frames")
    return _driver(joints, rows, 1 / seconds)


def _hierarchy(words: list[str]) -> list[_Joint]:
    joints: list[_Joint] = []
    stack: list[int] = []
    at = 0
    while at < len(words):
        word = words[at]
        if word in ("ROOT", "JOINT"):
            name_end = words.index("{", at)
            joints.append(_Joint("_".join(words[at + 1 : name_end]), stack[-1] if stack else -1))
            stack.append(len(joints) - 1)
            at = name_end + 1
        elif word == "End":  # End Site { OFFSET x y z }
            at = words.index("}", at) + 1
        elif word == "OFFSET":
            joints[stack[-1]].offset = [float(v) for v in words[at + 1 : at + 4]]
            if not np.isfinite(joints[stack[-1]].offset).all():
                raise ValueError("an OFFSET that is not finite")
            at += 4
        elif word == "CHANNELS":
            count = int(words[at + 1])
            joints[stack[-1]].channels = words[at + 2 : at + 2 + count]
            unknown = [c for c in joints[stack[-1]].channels if not CHANNEL.fullmatch(c)]
            if unknown:
                raise ValueError(f"unknown channel {unknown[0][:20]!r}")
            if len(joints[stack[-1]].channels) != count:
                raise ValueError(f"{count} channels")
            at += 2 + count
        elif word == "}":
            stack.pop()
            at += 1
        else:
            raise ValueError(f"unknown word {word[:20]!r}")
    if stack:
        raise ValueError(f"no end of joint {joints[stack[-1]].name[:20]!r}")
    if not joints or sum(joint.parent < 0 for joint in joints) != 1:
        raise ValueError("not one ROOT")
    return joints


def _driver(joints: list[_Joint], rows: np.ndarray, fps: float) -> Driver:
    parents = np.array([joint.parent for joint in joints])
    rest = np.zeros((len(joints), 3))
    rotations = np.tile(np.eye(3), (len(rows), len(joints), 1, 1))
    moved = np.zeros((len(rows), len(joints), 3))
    column = 0
    for j, joint in enumerate(joints):
        rest[j] = joint.offset if joint.parent < 0 else rest[joint.parent] + joint.offset
        for channel in joint.channels:
            axis = "XYZ".index(channel[:1].upper())
            if channel.lower().endswith("rotation"):
                turn = from_rotation_vector(np.radians(rows[:, column])[:, None] * np.eye(3)[axis])
                rotations[:, j] = rotations[:, j] @ turn
            else:
                moved[:, j, axis] = rows[:, column] - joint.offset[axis]
            column += 1
    return Driver(tuple(joint.name for joint in joints), parents, rest, rotations, moved, fps)
