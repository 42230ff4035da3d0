"""Skinned, animated characters from binary glTF 2.0 (.glb), with numpy alone.

Read are node hierarchy, skins, triangles and animations (LINEAR, STEP, CUBICSPLINE). Not read: materials, cameras,
meshes without a skin. Refused, since ignoring them would give wrong points: compressed meshes, external buffers and
animated morph targets. Specification: https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html
"""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np

from tasks.datasets import validate
from tasks.datasets.rigging import Decoded, check_tree
from tasks.errors import InputError
from tasks.geometry.rotations import from_quaternion

COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
REFUSED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression")
TRIANGLES = 4
JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942
REST = {"translation": (0.0, 0.0, 0.0), "rotation": (0.0, 0.0, 0.0, 1.0), "scale": (1.0, 1.0, 1.0)}
AGREE = 1e-3  # of the model's size: how far two skins may differ about one joint's bind pose


class Glb:
    """The two chunks of a .glb and the arrays in them."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.tree, self.binary = _chunks(path)
        needed = [e for e in self.tree.get("extensionsRequired", []) if e in REFUSED]
        if needed:
            self.fail("extensionsRequired", "plain buffers", ", ".join(needed), "export without compression")

    def __getitem__(self, key: str) -> list[dict]:
        return self.tree.get(key, [])

    def fail(self, field: str, expected: str, found: object, do: str = "export the file again") -> None:
        raise InputError(f"{self.path}: {field}", expected=expected, found=str(found), do=do)

    def array(self, index: int) -> np.ndarray:
        """Accessor `index` as (count, width); normalised integers become numbers from -1 or 0 to 1."""
        accessor = self["accessors"][index]
        kind, width = np.dtype(COMPONENTS[accessor["componentType"]]), WIDTHS[accessor["type"]]
        count = accessor["count"]
        if "bufferView" in accessor:
            out = self._view(accessor["bufferView"], accessor.get("byteOffset", 0), kind, count, width)
        else:
            out = np.zeros((count, width), kind)
        if "sparse" in accessor:
            out = self._with_sparse(out, accessor["sparse"])
        if accessor.get("normalized"):
            out = np.maximum(out / np.iinfo(kind).max, -1.0)
        return out

    def _view(self, view: int, offset: int, kind: np.dtype, count: int, width: int) -> np.ndarray:
        layout = self["bufferViews"][view]
        if layout["buffer"] != 0 or "uri" in self["buffers"][0]:
            self.fail("buffers", "one buffer inside the file", "external buffers", "pack everything into one .glb")
        row = kind.itemsize * width
        stride = layout.get("byteStride", row)
        start = layout.get("byteOffset", 0) + offset
        end = start + stride * (count - 1) + row
        limit = min(layout.get("byteOffset", 0) + layout["byteLength"], len(self.binary))
        if count < 1 or start < 0 or stride < row or end > limit:
            self.fail(f"bufferView {view}", f"{end} bytes or more", f"{limit}", "the file is truncated or damaged")
        rows = np.ndarray((count, row), np.uint8, self.binary, start, (stride, 1))
        return np.ascontiguousarray(rows).view(kind)

    def _with_sparse(self, out: np.ndarray, sparse: dict) -> np.ndarray:
        at, new = sparse["indices"], sparse["values"]
        index_kind = np.dtype(COMPONENTS[at["componentType"]])
        index = self._view(at["bufferView"], at.get("byteOffset", 0), index_kind, sparse["count"], 1)
        values = self._view(new["bufferView"], new.get("byteOffset", 0), out.dtype, sparse["count"], out.shape[1])
        out = out.copy()
        out[index[:, 0]] = values
        return out


def read_glb(path: Path, *, fps: float) -> Decoded:
    """Every skinned mesh of a .glb as one character, every animation as a clip sampled at `fps`.

    Vertices at one place with the same weights are welded. Clips are called as in the file, without the armature's name
    before "|". Raises InputError for damaged files and for what is not supported.
    """
    glb = Glb(path)
    try:
        return _decode(glb, fps)
    except (KeyError, IndexError, TypeError, AttributeError, ValueError, MemoryError) as error:
        # JSON that is not shaped as the standard says fails in any of these ways
        found = f"{type(error).__name__}: {error}"
        raise InputError(str(path), expected="glTF 2.0", found=found, do="export the file again") from error


def _decode(glb: Glb, fps: float) -> Decoded:
    skinned = [node for node in glb["nodes"] if "mesh" in node and "skin" in node]
    if not skinned:
        glb.fail(
            "skins", "a mesh with a skin", f"{len(glb['meshes'])} meshes, none skinned", "export mesh and armature"
        )
    if not glb["animations"]:
        glb.fail("animations", "at least one animation", "none", "export the armature's actions")
    nodes = list(dict.fromkeys(j for node in skinned for j in glb["skins"][node["skin"]]["joints"]))
    above = _node_parents(glb)
    inverse_bind = _inverse_bind(glb, skinned, nodes)
    rest, faces, weights = _weld(*_mesh(glb, skinned, nodes, inverse_bind))
    worlds, names = [], []
    for number, animation in enumerate(glb["animations"]):
        worlds.append(_joint_worlds(glb, animation, above, nodes, fps))
        names.append(str(animation.get("name", f"clip{number:03d}")).rsplit("|", 1)[-1])
    skin = np.concatenate(worlds) @ inverse_bind
    return Decoded(
        where=str(glb.path),
        name=glb.path.stem,
        rest=rest,
        faces=faces,
        weights=weights,
        names=_different([str(glb["nodes"][n].get("name", f"node{n}")) for n in nodes]),
        parents=_joint_parents(above, nodes),
        joints=np.linalg.inv(inverse_bind)[:, :3, 3],
        skin=skin[..., :3, :],
        clip_start=np.concatenate([[0], np.cumsum([len(w) for w in worlds])]),
        clip_names=_different(names),
        fps=fps,
    )


def _chunks(path: Path) -> tuple[dict, bytes]:
    data = validate.read_bytes(path, expected="a binary glTF file")
    if len(data) < 20 or data[:4] != b"glTF":
        found = f"{len(data)} bytes that start with {data[:4]!r}"
        raise InputError(str(path), expected="a binary glTF file", found=found, do="export as .glb")
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise InputError(f"{path}: version", expected="2", found=str(version), do="export as glTF 2.0")
    if length > len(data):
        found = f"{len(data)}: the file is truncated"
        raise InputError(f"{path}: length", expected=f"{length} bytes", found=found, do="make or download it again")
    chunks, at = {}, 12
    while at + 8 <= length:
        size, kind = struct.unpack_from("<II", data, at)
        chunks.setdefault(kind, data[at + 8 : at + 8 + size])
        at += 8 + size
    try:
        tree = json.loads(chunks.get(JSON_CHUNK, b""))
    except (ValueError, RecursionError) as error:  # ValueError also covers bytes that are not UTF-8
        raise InputError(f"{path}: JSON", expected="JSON", found=str(error), do="make or download it again") from None
    if not isinstance(tree, dict):
        raise InputError(f"{path}: JSON", expected="an object", found=type(tree).__name__, do="export as glTF 2.0")
    return tree, chunks.get(BINARY_CHUNK, b"")


def _node_parents(glb: Glb) -> np.ndarray:
    above = np.full(len(glb["nodes"]), -1)
    for n, node in enumerate(glb["nodes"]):
        above[node.get("children", [])] = n
    check_tree(f"{glb.path}: nodes", above)
    return above


def _joint_parents(above: np.ndarray, nodes: list[int]) -> np.ndarray:
    """(J,) the nearest node above each joint that is a joint too, or -1."""
    place = {n: j for j, n in enumerate(nodes)}
    parents = []
    for n in nodes:
        up = int(above[n])
        while up >= 0 and up not in place:
            up = int(above[up])
        parents.append(place.get(up, -1))
    return np.array(parents)


def _skin_inverse_bind(glb: Glb, skin: dict) -> np.ndarray:
    """(joints of the skin, 4, 4); glTF stores columns first."""
    if "inverseBindMatrices" not in skin:
        return np.tile(np.eye(4), (len(skin["joints"]), 1, 1))
    matrices = glb.array(skin["inverseBindMatrices"]).astype(np.float64).reshape(-1, 4, 4).swapaxes(1, 2)
    if len(matrices) < len(skin["joints"]) or not np.isfinite(matrices).all():
        glb.fail("inverseBindMatrices", f"{len(skin['joints'])} finite matrices", f"{len(matrices)}")
    if (np.abs(np.linalg.det(matrices)) == 0).any():
        glb.fail("inverseBindMatrices", "matrices that can be inverted", "a singular one")
    return matrices[: len(skin["joints"])]


def _inverse_bind(glb: Glb, skinned: list[dict], nodes: list[int]) -> np.ndarray:
    """(J, 4, 4), each joint's from the first skin that has it."""
    out = np.zeros((len(nodes), 4, 4))
    for node in reversed(skinned):
        skin = glb["skins"][node["skin"]]
        out[[nodes.index(j) for j in skin["joints"]]] = _skin_inverse_bind(glb, skin)
    return out


def _mesh(
    glb: Glb, skinned: list[dict], nodes: list[int], inverse_bind: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All primitives of all skinned meshes in one mesh space: rest (V, 3), faces (T, 3), weights (V, J)."""
    rest, faces, weights, count = [], [], [], 0
    for node in skinned:
        skin = glb["skins"][node["skin"]]
        columns = np.array([nodes.index(j) for j in skin["joints"]])
        to_common = _to_common(glb, np.linalg.inv(inverse_bind[columns]) @ _skin_inverse_bind(glb, skin))
        for primitive in glb["meshes"][node["mesh"]]["primitives"]:
            _refuse_unsupported(glb, primitive)
            attributes = primitive["attributes"]
            at = glb.array(attributes["POSITION"]).astype(np.float64)
            corners = glb.array(primitive["indices"])[:, 0] if "indices" in primitive else np.arange(len(at))
            rest.append(at @ to_common[:3, :3].T + to_common[:3, 3])
            faces.append(corners[: len(corners) // 3 * 3].reshape(-1, 3).astype(np.int64))
            if len(faces[-1]) and faces[-1].max() >= len(at):
                glb.fail("indices", f"0 to {len(at) - 1}", faces[-1].max(), "the mesh is damaged")
            faces[-1] += count
            weights.append(_primitive_weights(glb, attributes, len(at), columns, len(nodes)))
            count += len(at)
    return np.concatenate(rest), np.concatenate(faces), np.concatenate(weights)


def _to_common(glb: Glb, candidates: np.ndarray) -> np.ndarray:
    """The matrix that brings a skin's mesh space into that of the first; its joints must agree about it."""
    size = np.abs(candidates[0]).max()
    if np.abs(candidates - candidates[0]).max() > AGREE * size:
        glb.fail("skins", "skins that agree about the bind pose", "different ones", "apply all transforms and export")
    return candidates[0]


def _refuse_unsupported(glb: Glb, primitive: dict) -> None:
    if any(e in primitive.get("extensions", {}) for e in REFUSED):
        glb.fail("meshes", "plain vertex data", "a compressed mesh", "export without compression")
    if primitive.get("mode", TRIANGLES) != TRIANGLES:
        glb.fail("meshes", "triangles (mode 4)", f"mode {primitive['mode']}", "triangulate the mesh")
    moved = any(c["target"]["path"] == "weights" for a in glb["animations"] for c in a["channels"])
    if primitive.get("targets") and moved:
        glb.fail("meshes", "skinning alone", "animated morph targets", "export without shape keys")
    if not {"POSITION", "JOINTS_0", "WEIGHTS_0"} <= primitive["attributes"].keys():
        found = ", ".join(sorted(primitive["attributes"]))
        glb.fail("meshes", "POSITION, JOINTS_0 and WEIGHTS_0", found, "bind every mesh to the armature")


def _primitive_weights(glb: Glb, attributes: dict, points: int, columns: np.ndarray, joints: int) -> np.ndarray:
    weights = np.zeros((points, joints))
    for k in range(len(attributes)):
        if f"JOINTS_{k}" not in attributes:
            break
        index, value = glb.array(attributes[f"JOINTS_{k}"]), glb.array(attributes[f"WEIGHTS_{k}"])
        if index.shape != (points, 4) or value.shape != (points, 4):
            glb.fail(f"JOINTS_{k}", f"four joints for each of {points} vertices", f"{index.shape}, {value.shape}")
        if index.max() >= len(columns):
            glb.fail(f"JOINTS_{k}", f"0 to {len(columns) - 1}", index.max(), "the skin is damaged")
        np.add.at(weights, (np.arange(points)[:, None], columns[index]), value)
    return weights


def _weld(rest: np.ndarray, faces: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Joins vertices that agree in place and weights (exporters double them at seams); order of first appearance."""
    rows = np.concatenate([rest, weights], axis=1).astype(np.float32) + 0.0  # -0.0 and 0.0 are one place
    _, first, label = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    keep = first[order]
    faces = rank[label.reshape(-1)][faces]
    collapsed = (faces == np.roll(faces, 1, axis=1)).any(1)
    return rest[keep], faces[~collapsed], weights[keep]


def _joint_worlds(glb: Glb, animation: dict, above: np.ndarray, nodes: list[int], fps: float) -> np.ndarray:
    """World transforms of the joints, (frames of the clip, J, 4, 4)."""
    channels = [c for c in animation["channels"] if "node" in c["target"] and c["target"]["path"] in REST]
    samplers = animation["samplers"]
    spans = [glb.array(samplers[c["sampler"]]["input"])[:, 0].astype(np.float64) for c in channels]
    if not spans:
        glb.fail(f"animation {animation.get('name', '')}", "channels that move nodes", "none", "leave it out")
    start, stop = min(s[0] for s in spans), max(s[-1] for s in spans)
    times = start + np.arange(int(np.floor((stop - start) * fps + 1e-3)) + 1) / fps
    moved = {}
    for channel, keys in zip(channels, spans, strict=True):
        target, sampler = channel["target"], samplers[channel["sampler"]]
        how = sampler.get("interpolation", "LINEAR")
        values = glb.array(sampler["output"]).astype(np.float64)
        _check_keys(glb, f"animation {animation.get('name', '')}", keys, values, how, target["path"])
        moved[target["node"], target["path"]] = interpolate(
            keys, values, times, how, turns=target["path"] == "rotation"
        )
    worlds: dict[int, np.ndarray] = {}
    return np.stack([_world(glb, n, above, moved, len(times), worlds) for n in nodes], axis=1)


def _check_keys(glb: Glb, field: str, keys: np.ndarray, values: np.ndarray, how: str, path: str) -> None:
    if how not in ("LINEAR", "STEP", "CUBICSPLINE"):
        glb.fail(field, "LINEAR, STEP or CUBICSPLINE", how)
    if not (np.all(np.diff(keys) > 0) and np.isfinite(keys).all()):
        glb.fail(field, "key times that rise", "times that do not")
    per_key = 3 if how == "CUBICSPLINE" else 1
    wanted = (per_key * len(keys), len(REST[path]))
    if values.shape != wanted:
        glb.fail(field, f"{path} values of shape {wanted}", values.shape)
    if not np.isfinite(values).all() or (path == "rotation" and not values[per_key // 2 :: per_key].any(1).all()):
        glb.fail(field, f"finite {path} values", "NaN, infinity or a quaternion of zeros")


def interpolate(keys: np.ndarray, values: np.ndarray, times: np.ndarray, how: str, *, turns: bool) -> np.ndarray:
    """Values at `times`, held before the first key and after the last (glTF 2.0, appendix C).

    keys: (K,) seconds; values: (K, c), for CUBICSPLINE (3 K, c) as in-tangent, value, out-tangent; turns: quaternions
    as x y z w, taken along the shorter arc -> (len(times), c).
    """
    times = np.clip(times, keys[0], keys[-1])
    a = np.clip(np.searchsorted(keys, times + 1e-6, side="right") - 1, 0, len(keys) - 1)
    if how == "STEP":
        return values[a]
    b = np.minimum(a + 1, len(keys) - 1)
    span = np.where(b > a, keys[b] - keys[a], 1.0)[:, None]
    u = np.clip((times - keys[a])[:, None] / span, 0.0, 1.0)
    if how == "CUBICSPLINE":
        into, value, out = values.reshape(len(keys), 3, -1).swapaxes(0, 1)
        result = (
            (2 * u**3 - 3 * u**2 + 1) * value[a]
            + span * (u**3 - 2 * u**2 + u) * out[a]
            + (3 * u**2 - 2 * u**3) * value[b]
            + span * (u**3 - u**2) * into[b]
        )
        return result / np.linalg.norm(result, axis=1, keepdims=True) if turns else result
    return _slerp(values[a], values[b], u) if turns else (1 - u) * values[a] + u * values[b]


def _slerp(p: np.ndarray, q: np.ndarray, u: np.ndarray) -> np.ndarray:
    p, q = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (p, q))
    cosine = (p * q).sum(1, keepdims=True)
    q = np.where(cosine < 0, -q, q)
    angle = np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))
    near = angle < 1e-6  # the arc is a line, and sin(angle) too small to divide by
    sine = np.where(near, 1.0, np.sin(angle))
    return np.where(near, (1 - u) * p + u * q, (np.sin((1 - u) * angle) * p + np.sin(u * angle) * q) / sine)


def _world(glb: Glb, n: int, above: np.ndarray, moved: dict, frames: int, worlds: dict[int, np.ndarray]) -> np.ndarray:
    """(frames, 4, 4) of node n; `worlds` keeps what is known."""
    if n not in worlds:
        local = _local(glb["nodes"][n], n, moved, frames)
        up = int(above[n])
        worlds[n] = local if up < 0 else _world(glb, up, above, moved, frames, worlds) @ local
    return worlds[n]


def _local(node: dict, n: int, moved: dict, frames: int) -> np.ndarray:
    if "matrix" in node:
        return np.tile(np.array(node["matrix"], np.float64).reshape(4, 4).T, (frames, 1, 1))
    part = {path: moved.get((n, path), np.array([node.get(path, rest)], np.float64)) for path, rest in REST.items()}
    out = np.tile(np.eye(4), (frames, 1, 1))
    out[:, :3, :3] = from_quaternion(part["rotation"][:, [3, 0, 1, 2]]) * part["scale"][:, None, :]
    out[:, :3, 3] = part["translation"]
    return out


def _different(names: list[str]) -> list[str]:
    """The names, with a number behind those that stood before."""
    out: list[str] = []
    for name in names:
        new, k = name, 2
        while new in out:
            new, k = f"{name}_{k}", k + 1
        out.append(new)
    return out
