"""A capture on DeepMimic's skeleton becomes poses of the body, begun from a standing pose."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import numpy as np

from tasks.errors import InputError
from tasks.garments.capture import LINKS, Capture, heading_of, read
from tasks.geometry import kinematics
from tasks.geometry.rotations import from_rotation_vector, to_rotation_vector
from tasks.values import Motion, Poses

LINK = {name: index for index, (name, *_) in enumerate(LINKS)}
# joint of the body: links whose world rotations it takes, and the share of the second
FOLLOWS = {
    "Hips": ("root", "root", 0.0),
    "Spine": ("root", "chest", 0.33),
    "Spine1": ("root", "chest", 0.67),
    "Spine2": ("root", "chest", 1.0),
    "Neck": ("chest", "neck", 0.5),
    "Head": ("chest", "neck", 1.0),
}
for _side in ("left", "right"):
    _Side = _side.capitalize()
    FOLLOWS |= {
        f"{_Side}Shoulder": ("chest", f"{_side}_shoulder", 0.12),  # the collar bone gives way a little
        f"{_Side}Arm": ("chest", f"{_side}_shoulder", 1.0),
        f"{_Side}ForeArm": ("chest", f"{_side}_elbow", 1.0),
        f"{_Side}Hand": ("chest", f"{_side}_elbow", 1.0),
        f"{_Side}UpLeg": ("root", f"{_side}_hip", 1.0),
        f"{_Side}Leg": ("root", f"{_side}_knee", 1.0),
        f"{_Side}Foot": ("root", f"{_side}_ankle", 1.0),
        f"{_Side}ToeBase": ("root", f"{_side}_ankle", 1.0),
    }
ARMS = ("Arm", "ForeArm", "Hand")
ROOT_HEIGHT = 0.89  # of DeepMimic's root when it stands, in metres
LEAD = 0.12  # seconds in which the lead-in takes up the clip's first velocity


def motion_clip(
    body: Motion,
    *,
    clip: str,
    cycles: Annotated[float, "(0, inf)"],
    turn: float,
    slow: Annotated[float, "(0, inf)"],
    fps: Annotated[float, "(0, inf)"],
    spread: float,
    stand: float,
    speed: Annotated[float, "(0, inf)"],
    frames: Annotated[int, "[2, inf)"] | None,
) -> Poses:
    """A motion of the body from pybullet's wheel, lead-in and clip: :func:`tasks.garments.capture.read`, then
    :func:`retarget`, then :func:`lead_in` from standing with arms `stand` degrees off the body. frames: of the clip,
    at most, from its first on, or None for all."""
    capture = read(clip=clip, cycles=cycles, fps=fps, turn=turn, slow=slow)
    if frames is not None:
        capture = replace(capture, local=capture.local[:frames], root=capture.root[:frames])
    return lead_in(body, retarget(body, capture, spread=spread), spread=stand, fps=fps, speed=speed)


def retarget(body: Motion, capture: Capture, *, spread: float) -> Poses:
    """Poses of the body by the capture's world rotations. spread: degrees by which hanging arms stand off the body,
    which is broader than DeepMimic's stick figure."""
    rig = _checked(body)
    world = capture.world()
    rotations = np.empty((len(world), len(rig.names), 3, 3))
    zero = zero_pose(body, spread=spread)
    for joint, name in enumerate(rig.names):
        first, second, share = FOLLOWS[name]
        rotations[:, joint] = _between(world[:, LINK[first]], world[:, LINK[second]], share) @ zero[joint]
    place = capture.root * (float(rig.joints[0, 1]) / ROOT_HEIGHT)
    return to_poses(rig.parents, rotations, place - rig.joints[0])


def zero_pose(body: Motion, *, spread: float) -> np.ndarray:
    """World rotations (J, 3, 3) from the body's rest pose to the one where DeepMimic's angles are zero: arms hang."""
    rig = body.rig
    at = dict(zip(rig.names, rig.joints.astype(np.float64), strict=True))
    out = np.tile(np.eye(3), (len(rig.names), 1, 1))
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        down = np.array([sign * np.sin(np.radians(spread)), -np.cos(np.radians(spread)), 0.0])
        upper = _onto(at[f"{side}ForeArm"] - at[f"{side}Arm"], down)
        lower = _onto(upper @ (at[f"{side}Hand"] - at[f"{side}ForeArm"]), down) @ upper
        for part, turn in zip(ARMS, (upper, lower, lower), strict=True):
            out[rig.names.index(side + part)] = turn
    return out


def to_poses(parents: np.ndarray, world: np.ndarray, shift: np.ndarray) -> Poses:
    """World rotations (F, J, 3, 3) and the root's shift (F, 3) as local poses of one clip."""
    up = np.where(parents < 0, 0, parents)
    local = np.swapaxes(world[:, up], -1, -2) @ world
    local[:, 0] = world[:, 0]
    moved = np.zeros(world.shape[:3])
    moved[:, 0] = shift
    return Poses(local.astype(np.float32), moved.astype(np.float32), np.array([0, len(world)]))


def lead_in(body: Motion, poses: Poses, *, spread: float, fps: float, speed: float) -> Poses:
    """The poses with a lead-in from standing before them, which ends with their own velocity. It is two clips:
    the lead-in, in which the cloth finds its way and which is no data, and the poses.

    spread: degrees that the arms stand off when standing; speed: metres a second that no joint should much exceed,
    which sets the lead-in's length.
    """
    rig = _checked(body)
    stand = _local_of(rig.parents, zero_pose(body, spread=spread))
    facing = heading_of(poses.rotations[0, 0].astype(np.float64))
    stand[0] = facing @ stand[0]
    velocity = (poses.translations[1, 0] - poses.translations[0, 0]).astype(np.float64) * fps
    spin = to_rotation_vector(poses.rotations[1] @ np.swapaxes(poses.rotations[0], -1, -2)).astype(np.float64) * fps
    count = _lead_frames(rig, poses, stand, velocity, fps=fps, speed=speed)
    t = np.arange(-count, 0) / fps
    ease = 1 + t * fps / count
    ease = ease**2 * (3 - 2 * ease)
    go = -LEAD * (1 - np.exp(t / LEAD))  # runs up to t = 0 at full speed from nearly none
    target = from_rotation_vector(go[:, None, None] * spin) @ poses.rotations[0]
    turn = to_rotation_vector(target @ np.swapaxes(stand, -1, -2))
    rotations = from_rotation_vector(ease[:, None, None] * turn) @ stand
    far = 4 * LEAD
    ahead = -far * (1 - np.exp(t / far))
    place = poses.translations[0, 0] + ahead[:, None] * velocity
    place[:, 1] *= ease
    shift = np.zeros((count, *poses.translations.shape[1:]))
    shift[:, 0] = place
    return Poses(
        np.concatenate([rotations, poses.rotations]).astype(np.float32),
        np.concatenate([shift, poses.translations]).astype(np.float32),
        np.array([0, count, count + len(poses.rotations)]),
    )


def dressing(
    body: Motion, start: Poses, *, spread: float, frames: Annotated[int, "[1, inf)"], hold: Annotated[int, "[0, inf)"]
) -> Poses:
    """From the pose `start` (its first frame) to standing in `frames` frames, then `hold` frames of standing still:
    where a garment settles before any clip."""
    rig = _checked(body)
    stand = _local_of(rig.parents, zero_pose(body, spread=spread))
    ease = np.concatenate([np.linspace(0, 1, frames), np.ones(hold)])
    ease = ease**2 * (3 - 2 * ease)
    turn = to_rotation_vector(stand @ np.swapaxes(start.rotations[0].astype(np.float64), -1, -2))
    rotations = from_rotation_vector(ease[:, None, None] * turn) @ start.rotations[0]
    shift = np.zeros((len(ease), len(rig.names), 3), np.float32)
    return Poses(rotations.astype(np.float32), shift, np.array([0, len(ease)]))


def _lead_frames(rig, poses: Poses, stand: np.ndarray, velocity: np.ndarray, *, fps: float, speed: float) -> int:
    """Frames that the farthest joint needs at that speed on average, at least half a second."""
    start = np.zeros((1, len(rig.names), 3))
    start[0, 0, [0, 2]] = poses.translations[0, 0, [0, 2]]
    first = kinematics.forward(rig.parents, rig.joints, poses.rotations[:1], poses.translations[:1])
    still = kinematics.forward(rig.parents, rig.joints, stand[None], start)
    a, b = (kinematics.joint_positions(x, rig.joints)[0] for x in (first, still))
    return int(np.ceil(fps * max(0.5, np.linalg.norm(a - b, axis=1).max() / speed)))


def _between(first: np.ndarray, second: np.ndarray, share: float) -> np.ndarray:
    if share in (0.0, 1.0):
        return second if share else first
    return from_rotation_vector(share * to_rotation_vector(second @ np.swapaxes(first, -1, -2))) @ first


def _onto(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The smallest rotation that brings direction a onto direction b."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    axis = np.cross(a, b)
    sine = np.linalg.norm(axis)
    return from_rotation_vector(axis / max(sine, 1e-12) * np.arctan2(sine, a @ b))


def _local_of(parents: np.ndarray, world: np.ndarray) -> np.ndarray:
    up = np.where(parents < 0, 0, parents)
    local = np.swapaxes(world[up], -1, -2) @ world
    local[0] = world[0]
    return local


def _checked(body: Motion):
    missing = [name for name in body.rig.names if name not in FOLLOWS]
    if missing:
        raise InputError(
            "body.rig", expected=f"joints among {', '.join(FOLLOWS)}", found=", ".join(missing), do="use the mixamo rig"
        )
    return body.rig
