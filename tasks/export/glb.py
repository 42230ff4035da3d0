"""Binary glTF 2.0 with numpy alone: a skinned mesh, its joints and one animation a clip.

Specification: https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass

import numpy as np

from tasks.geometry.rotations import project_so3, to_quaternion

INFLUENCES = 8  # two sets of four: what readers take
_KINDS = {"float32": 5126, "uint8": 5121, "uint16": 5123, "uint32": 5125}
_WIDTHS = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
_VERTICES, _INDICES = 34962, 34963  # targets of buffer views
_POINTS, _TRIANGLES = 0, 4


@dataclass(frozen=True)
class Character:
    """What a .glb holds. rest: (N, 3); faces: (T, 3) or None for bare points; weights: (N, J); names: J;
    parents: (J,), -1 for every root; joints: (J, 3) rest positions, unturned; rotations: (F, J, 3, 3) local to the
    parent; places: (F, J, 3) positions in the parent's frame; clips: name -> its frames; fps: frames a second."""

    name: str
    rest: np.ndarray
    faces: np.ndarray | None
    weights: np.ndarray
    names: tuple[str, ...]
    parents: np.ndarray
    joints: np.ndarray
    rotations: np.ndarray
    places: np.ndarray
    clips: dict[str, slice]
    fps: float


def write_glb(character: Character) -> bytes:
    """The character as the bytes of a .glb file: mesh and skin at node 0, then the joints in their order."""
    packer = _Packer()
    joints = len(character.names)
    up = np.asarray(character.parents)
    offsets = character.joints - np.where(up[:, None] < 0, 0, character.joints[up])
    nodes = [{"name": character.name, "mesh": 0, "skin": 0}]
    for j, name in enumerate(character.names):
        node: dict = {"name": name, "translation": offsets[j].astype(float).tolist()}
        children = (1 + np.flatnonzero(up == j)).tolist()
        nodes.append(node | ({"children": children} if children else {}))
    roots = (1 + np.flatnonzero(up < 0)).tolist()
    if len(roots) > 1:  # joints of a skin must have a node above them all
        nodes.append({"name": "bones", "children": roots})
        roots = [len(nodes) - 1]
    bind = np.tile(np.eye(4, dtype=np.float32), (joints, 1, 1))
    bind[:, :3, 3] = -character.joints
    skin = {"joints": list(range(1, joints + 1)), "name": character.name}
    skin["inverseBindMatrices"] = packer.add(np.swapaxes(bind, 1, 2).reshape(joints, 16))  # column by column
    tree = {
        "asset": {"version": "2.0", "generator": "skelebones"},
        "scene": 0,
        "scenes": [{"nodes": [0, *roots]}],
        "nodes": nodes,
        "meshes": [{"name": character.name, "primitives": [_primitive(packer, character)]}],
        "skins": [skin],
        "animations": [_animation(packer, character, name, frames) for name, frames in character.clips.items()],
    }
    return packer.file(tree)


def influences(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The largest weights of each point, in sets of four. (N, J) -> joints (N, 4 s) uint16, shares (N, 4 s) float32.

    One set where no point has more than four, else two; shares sum to one, and one of no weight names joint 0.
    """
    most = int((weights > 0).sum(1).max())
    width = 4 if most <= 4 else INFLUENCES
    padded = np.pad(np.asarray(weights, np.float64), ((0, 0), (0, max(0, width - weights.shape[1]))))
    index = np.argsort(-padded, axis=1, kind="stable")[:, :width]
    share = np.take_along_axis(padded, index, axis=1)
    share = (share / share.sum(1, keepdims=True)).astype(np.float32)
    share[:, 0] += 1 - share.sum(1, dtype=np.float64).astype(np.float32)  # the largest takes what rounding lost
    return np.where(share > 0, index, 0).astype(np.uint16), share


def normals_of(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals at vertices, weighted by area; +Y where a vertex has no area. (N, 3) float32"""
    a, b, c = (points[faces[:, k]].astype(np.float64) for k in range(3))
    area = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    total = np.stack([np.bincount(faces.ravel(), area[:, k], len(points)) for k in range(3)], axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 1e-30, total / np.maximum(length, 1e-30), [0.0, 1.0, 0.0]).astype(np.float32)


def _primitive(packer: _Packer, character: Character) -> dict:
    joints, share = influences(character.weights)
    attributes = {"POSITION": packer.add(character.rest, target=_VERTICES, bounds=True)}
    if character.faces is not None:
        attributes["NORMAL"] = packer.add(normals_of(character.rest, character.faces), target=_VERTICES)
    for s in range(joints.shape[1] // 4):
        some = slice(4 * s, 4 * s + 4)
        attributes[f"JOINTS_{s}"] = packer.add(joints[:, some], "uint16", target=_VERTICES)
        attributes[f"WEIGHTS_{s}"] = packer.add(share[:, some], target=_VERTICES)
    if character.faces is None:
        return {"attributes": attributes, "mode": _POINTS}
    indices = packer.add(character.faces.reshape(-1, 1), "uint32", target=_INDICES)
    return {"attributes": attributes, "indices": indices, "mode": _TRIANGLES}


def _animation(packer: _Packer, character: Character, name: str, frames: slice) -> dict:
    count = frames.stop - frames.start
    times = packer.add((np.arange(count) / character.fps)[:, None], bounds=True)
    turns = quaternions(character.rotations[frames])
    samplers, channels = [], []
    for j in range(len(character.names)):
        for path, values in (("rotation", turns[:, j]), ("translation", character.places[frames][:, j])):
            channels.append({"sampler": len(samplers), "target": {"node": 1 + j, "path": path}})
            samplers.append({"input": times, "output": packer.add(values), "interpolation": "LINEAR"})
    return {"name": name, "samplers": samplers, "channels": channels}


def quaternions(rotations: np.ndarray) -> np.ndarray:
    """Rotations along time (F, J, 3, 3) -> unit quaternions x y z w (F, J, 4) that never jump to their negative."""
    q = to_quaternion(project_so3(rotations.astype(np.float64)))[..., [1, 2, 3, 0]]
    flips = np.where((q[1:] * q[:-1]).sum(-1) < 0, -1.0, 1.0)
    q[1:] *= np.cumprod(flips, axis=0)[..., None]
    return q


class _Packer:
    """Arrays one after another in the one binary chunk."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict] = []
        self.accessors: list[dict] = []

    def add(self, values: np.ndarray, kind: str = "float32", *, target: int = 0, bounds: bool = False) -> int:
        """An accessor for values (count, width)."""
        array = np.ascontiguousarray(values, kind)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes}
        self.views.append(view | ({"target": target} if target else {}))
        self.data += array.tobytes()
        self.data += b"\0" * (-len(self.data) % 4)
        accessor = {"bufferView": len(self.views) - 1, "componentType": _KINDS[kind], "count": len(array)}
        accessor["type"] = _WIDTHS[array.shape[1]]
        if bounds:
            accessor |= {"min": array.min(0).tolist(), "max": array.max(0).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def file(self, tree: dict) -> bytes:
        """The .glb of a tree that uses these accessors."""
        tree |= {"accessors": self.accessors, "bufferViews": self.views, "buffers": [{"byteLength": len(self.data)}]}
        text = json.dumps(tree, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text
        chunks += struct.pack("<I4s", len(self.data), b"BIN\0") + bytes(self.data)
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
