"""Garments cut from the body: a level set of the distance to the body, opened at neck, sleeves and hem, remeshed.

All is done on the body with its arms lifted, so that sleeves, side seams and hem are cut by planes. The shape as cut is
the cloth's stress-free shape.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from tasks.garments.body import largest_component
from tasks.garments.retarget import to_poses, zero_pose
from tasks.geometry import kinematics
from tasks.geometry.skinning import skin
from tasks.values import Canonical, Motion, Poses

ARMS_LIFTED = 65.0  # degrees off the body: clear of it, yet no more cloth in the armpit than hanging arms can fold
GRID = 0.01  # metres
BLUR = 1.2  # grid cells: cloth spans hollows of the skin
SECTORS = 72  # directions in which the skirt's width is measured


def cutting_pose(body: Motion) -> Poses:
    """The pose, one frame, in which garments are cut: standing, arms lifted."""
    world = zero_pose(body, spread=ARMS_LIFTED)[None]
    return to_poses(body.rig.parents, world, np.zeros((1, 3)))


def cut(
    body: Motion,
    *,
    garment: Literal["tshirt", "dress"],
    edge: Annotated[float, "(0, inf)"],
    ease_top: float,
    ease_hem: float,
    sleeve: Annotated[float, "[0, inf)"],
    flare: Annotated[float, "[0, inf)"],
    length: Annotated[float, "(0, inf)"],
) -> Canonical:
    """The garment on the body in the cutting pose, an open triangle mesh.

    edge: wanted edge length; ease_top, ease_hem: distance from the skin at the shoulders and at the hem; sleeve: share
    of the upper arm that it covers (T-shirt); flare: degrees by which the skirt widens from the hips (dress); length:
    height of the hem above the ground; lengths in metres. -> points (N, 3), faces, source says what it is.
    """
    joints = _joints(body)
    vertices = _posed(body)
    axes = _axes(joints, length)
    distance = _distance(vertices, body.faces, axes)
    x, y, z = np.meshgrid(*axes, indexing="ij")
    top, hips = joints["LeftArm"][1], joints["Hips"][1]
    down = np.clip((top - y) / (top - hips), 0, 1)
    field = distance - (ease_top + (ease_hem - ease_top) * down)
    if garment == "dress":
        width = skirt_width(vertices, joints, y, np.arctan2(z - joints["Hips"][2], x), flare=np.radians(flare))
        field = np.minimum(field, np.hypot(x, z - joints["Hips"][2]) - width - ease_hem)
    else:
        field = np.minimum(field, _seat(vertices, joints, x, y, z) - ease_hem)
    points, faces = _level_set(gaussian_filter(field, BLUR), axes)
    for keep in _openings(points, joints, garment=garment, sleeve=sleeve, length=length):
        points, faces = clip(points, faces, keep(points))
    points, faces = _largest(points, faces)
    points, faces = remesh(points, faces, edge)
    return Canonical(points.astype(np.float32), faces.astype(np.int32), -1, f"{garment} cut from {body.name}")


def skirt_width(
    vertices: np.ndarray, joints: dict[str, np.ndarray], y: np.ndarray, angle: np.ndarray, *, flare: float
) -> np.ndarray:
    """How far the skirt stands from the axis through the hips, at heights y and azimuths `angle`: the widest that hips
    and thighs are at or above that height, and the flare. Zero above the waist, where there is no skirt."""
    hips, waist, knee = joints["Hips"], joints["Spine1"][1], joints["LeftLeg"][1]
    levels = np.arange(waist, knee - 0.4, -0.02)
    directions = np.linspace(-np.pi, np.pi, SECTORS, endpoint=False)
    unit = np.stack([np.cos(directions), np.sin(directions)], axis=1)
    width = np.zeros((len(levels), SECTORS))
    for row, level in enumerate(levels):
        if level > joints["LeftLeg"][1] + 0.2:  # below that the thighs have given all they have
            near = vertices[(np.abs(vertices[:, 1] - level) < 0.015) & (np.abs(vertices[:, 0]) < 0.25)]
            reach = (near[:, [0, 2]] - hips[[0, 2]]) @ unit.T
            width[row] = radius_of_hull(reach.max(0), unit)
        width[row] = np.maximum(width[row], width[row - 1] if row else 0)
    width += np.maximum(hips[1] - levels, 0)[:, None] * np.tan(flare)
    row = np.clip((waist - y) / 0.02, 0, len(levels) - 1)
    sector = (angle + np.pi) / (2 * np.pi) * SECTORS % SECTORS
    r0, s0 = np.minimum(row.astype(int), len(levels) - 2), sector.astype(int) % SECTORS
    fr, fs, s1 = row - r0, sector - np.floor(sector), (s0 + 1) % SECTORS
    upper = width[r0, s0] * (1 - fs) + width[r0, s1] * fs
    lower = width[r0 + 1, s0] * (1 - fs) + width[r0 + 1, s1] * fs
    return np.where(y > waist, 0.0, upper * (1 - fr) + lower * fr)


def radius_of_hull(support: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """Support function -> radius of the convex shape along each direction: min over tangents of h / cos. (S,) (S, 2)"""
    cosine = unit @ unit.T
    return np.where(cosine > 0.05, support / np.maximum(cosine, 0.05), np.inf).min(1)


def clip(points: np.ndarray, faces: np.ndarray, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The part of a triangle mesh where `value` (N,) at the points is positive, cut through the triangles."""
    inside = value[faces] > 0
    out = [faces[inside.all(1)]]
    new, index = [], {}

    def crossing(a: int, b: int) -> int:
        key = (min(a, b), max(a, b))
        if key not in index:
            t = value[a] / (value[a] - value[b])
            index[key] = len(points) + len(new)
            new.append(points[a] + t * (points[b] - points[a]))
        return index[key]

    cut_faces = []
    for face, kept in zip(faces[inside.any(1) & ~inside.all(1)], inside[inside.any(1) & ~inside.all(1)], strict=True):
        first = int(np.flatnonzero(kept)[0]) if kept.sum() == 1 else (int(np.flatnonzero(~kept)[0]) + 1) % 3
        a, b, c = np.roll(face, -first)
        if kept.sum() == 1:
            cut_faces.append((a, crossing(a, b), crossing(a, c)))
        else:  # a and b are kept
            bc, ca = crossing(b, c), crossing(a, c)
            cut_faces += [(a, b, bc), (a, bc, ca)]
    if cut_faces:
        out.append(np.array(cut_faces))
    faces = np.concatenate(out)
    points = np.concatenate([points, np.array(new).reshape(-1, 3)])
    return compact(points, faces)


def remesh(points: np.ndarray, faces: np.ndarray, edge: float) -> tuple[np.ndarray, np.ndarray]:
    """Even triangles of that edge length, boundaries kept."""
    import pymeshlab

    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(points, faces))
    meshes.meshing_merge_close_vertices(threshold=pymeshlab.PureValue(0.1 * edge))
    meshes.meshing_isotropic_explicit_remeshing(
        targetlen=pymeshlab.PureValue(edge), iterations=12, featuredeg=180.0, checksurfdist=False
    )
    mesh = meshes.current_mesh()
    return collapse_short(mesh.vertex_matrix(), mesh.face_matrix(), 0.45 * edge)


def collapse_short(points: np.ndarray, faces: np.ndarray, shortest: float) -> tuple[np.ndarray, np.ndarray]:
    """Merges the ends of edges shorter than that, shortest first, wherever the surface stays a manifold."""
    points, faces = points.copy(), faces.copy()
    while True:
        edges, uses = np.unique(
            np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1),
            axis=0,
            return_counts=True,
        )
        rim = np.zeros(len(points), bool)
        rim[edges[uses == 1]] = True
        length = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
        for e in np.argsort(length, kind="stable"):
            a, b = edges[e]
            if length[e] >= shortest:
                return compact(points, faces)
            around = [set(faces[(faces == v).any(1)].ravel()) for v in (a, b)]
            on_rim = uses[e] == 1
            if len((around[0] & around[1]) - {a, b}) == (1 if on_rim else 2) and (on_rim or not (rim[a] and rim[b])):
                break
        else:
            return compact(points, faces)
        points[a] = points[[v for v in (a, b) if rim[v] or rim[a] == rim[b]]].mean(0)  # the rim stays where it is
        faces[faces == b] = a
        faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]


def compact(points: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Without points that no face uses."""
    used = np.unique(faces)
    number = np.full(len(points), -1)
    number[used] = np.arange(len(used))
    return points[used], number[faces]


def _joints(body: Motion) -> dict[str, np.ndarray]:
    rig, pose = body.rig, cutting_pose(body)
    transforms = kinematics.forward(rig.parents, rig.joints, pose.rotations, pose.translations)
    places = kinematics.joint_positions(transforms, rig.joints)[0]
    return dict(zip(rig.names, places.astype(np.float64), strict=True))


def _posed(body: Motion) -> np.ndarray:
    rig, pose = body.rig, cutting_pose(body)
    transforms = kinematics.forward(rig.parents, rig.joints, pose.rotations, pose.translations)
    return skin(body.rest, rig.weights, transforms)[0].astype(np.float64)


def _axes(joints: dict[str, np.ndarray], length: float) -> list[np.ndarray]:
    low = np.array([-0.55, length - 0.06, -0.5])
    high = np.array([0.55, joints["Head"][1], 0.5])
    return [np.arange(a, b, GRID) for a, b in zip(low, high, strict=True)]


def _distance(vertices: np.ndarray, faces: np.ndarray, axes: list[np.ndarray]) -> np.ndarray:
    """Signed distance to the body on the grid, exact near it; far from it only a lower bound, which is all we need."""
    import igl

    shape = tuple(len(a) for a in axes)
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    far, _ = cKDTree(vertices).query(grid, distance_upper_bound=0.09)
    out = np.full(len(grid), 0.08)
    near = np.isfinite(far)
    out[near] = igl.signed_distance(grid[near], vertices, faces.astype(np.int64))[0]
    inside = igl.fast_winding_number(vertices, faces.astype(np.int64), grid[~near]) > 0.5
    out[np.flatnonzero(~near)[inside]] = -0.08
    return out.reshape(shape)


def _seat(vertices: np.ndarray, joints: dict[str, np.ndarray], x: np.ndarray, y: np.ndarray, z: np.ndarray):
    """A tube round the hips, so that a hem below the crotch stays one loop."""
    width = skirt_width(vertices, joints, y, np.arctan2(z - joints["Hips"][2], x), flare=0.0)
    tube = np.hypot(x, z - joints["Hips"][2]) - width
    return np.where(y < joints["Hips"][1], tube, 1.0)


def _level_set(field: np.ndarray, axes: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    import igl

    shape = field.shape
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    # igl counts x fastest
    flat, corners = field.transpose(2, 1, 0).ravel(), grid.transpose(2, 1, 0, 3).reshape(-1, 3)
    points, faces, *_ = igl.marching_cubes(flat, corners, *shape, 0.0)
    a, b, c = (points[faces[:, i]] for i in range(3))
    outward = np.einsum("ij,ij->", np.cross(b - a, c - a), (a + b + c) / 3 - points.mean(0)) > 0
    return points, faces if outward else faces[:, ::-1]


def _openings(points: np.ndarray, joints: dict[str, np.ndarray], *, garment: str, sleeve: float, length: float):
    """Functions of points, positive where cloth stays: hem, neck, sleeves or arm holes."""
    neck, arm, elbow = joints["Neck"], joints["LeftArm"], joints["LeftForeArm"]
    front = np.array([0.0, 0.015 if garment == "tshirt" else 0.0, 0.02 if garment == "tshirt" else 0.045])
    radius = 0.085 if garment == "tshirt" else 0.105

    def hem(p):
        return p[:, 1] - length

    def hole(p):
        away = (p - (neck + front)) / np.array([1.0, 1.0 if garment == "tshirt" else 1.15, 1.0])
        return np.minimum(np.linalg.norm(away, axis=1) - radius, neck[1] + 0.05 - p[:, 1])

    def sleeves(p):
        along = (np.abs(p[:, 0]) - arm[0]) / (elbow[0] - arm[0])
        return sleeve - along

    def arm_holes(p):
        slant = np.maximum(arm[1] - 0.11 - p[:, 1], 0)
        return arm[0] - 0.035 + 2.0 * slant - np.abs(p[:, 0])

    return [hem, hole, sleeves if garment == "tshirt" else arm_holes]


def _largest(points: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    kept, faces = largest_component(faces, len(points))
    return points[kept], faces
