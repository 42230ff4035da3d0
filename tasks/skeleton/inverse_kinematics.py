"""Gauss-Newton on all local rotations and the root, over sums of the skeleton's size: no point is touched.

Turning joint j by the small world vector a moves a point by a x u with u = sum over the subtree of w_k (T_k h - p_j).
All that the normal equations need are second moments of these u, which follow from :class:`Moments` by transforming
blocks of 4 x 4 and adding them up the tree, for all frames at once.
"""

from __future__ import annotations

import numpy as np

from tasks.geometry import kinematics, rigid
from tasks.geometry.moments import Moments, skin_error
from tasks.geometry.parallel import for_chunks
from tasks.geometry.rotations import from_rotation_vector, project_so3, skew

FRAMES = 32  # frames solved together: keeps the (frames, J, J, 4, 4) blocks in a few megabytes
_HALVINGS = 4


def take_frames(moments: Moments, a: int, b: int) -> Moments:
    """The moments of frames a:b."""
    return Moments(moments.K, moments.Y[a:b], moments.xx[a:b], moments.mass, moments.count)


def warm_start(parents: np.ndarray, joints: np.ndarray, moments: Moments, stiffness: float) -> tuple:
    """World rotations by weighted Procrustes per segment (Kabsch), top down; ``stiffness`` pulls a segment whose points
    do not determine its turn (a thin or small one) towards its parent. -> rotations (F, J, 3, 3), root shift (F, 3).
    """
    frames = len(moments.Y)
    world = np.empty((frames, len(parents), 3, 3))
    mass = np.maximum(moments.mass[:, 3], 1e-12)
    centre = moments.mass[:, :3] / mass[:, None]
    cross = moments.Y[:, :, :3] - centre[:, :, None] * moments.Y[:, :, 3:]  # (F, J, 3, 3) = sum w (v - c) x^T
    spread = np.linalg.norm(cross, axis=(-2, -1)).mean(0)
    typical = spread.mean()
    for j, p in enumerate(parents):
        h = np.swapaxes(cross[:, j], -1, -2)
        if p >= 0:
            h = h + stiffness * (spread[j] + 0.01 * typical) * world[:, p]
        world[:, j] = project_so3(h)
    root = moments.Y[:, 0, 3] / mass[0] - (world[:, 0] @ (centre[0] - joints[0])[..., None])[..., 0]
    if moments.mass[0, 3] < 1e-3 * moments.count:  # a root that owns no points: the whole shape's centre instead
        whole = moments.mass[:, :3].sum(0) / moments.count
        root = moments.Y[:, :, 3].sum(1) / moments.count - (world[:, 0] @ (whole - joints[0])[..., None])[..., 0]
    return world, root - joints[0]


def transforms_of(parents: np.ndarray, joints: np.ndarray, world: np.ndarray, root: np.ndarray) -> np.ndarray:
    """Transforms (F, J, 3, 4) on canonical points of world rotations (F, J, 3, 3) and the root's shift (F, 3)."""
    position = np.empty((*world.shape[:2], 3))
    for j, p in enumerate(parents):
        if p < 0:
            position[:, j] = joints[j] + root
        else:
            position[:, j] = position[:, p] + world[:, p] @ (joints[j] - joints[p])
    return rigid.make(world, position - (world @ joints[..., None])[..., 0])


def solve_poses(
    parents: np.ndarray,
    joints: np.ndarray,
    moments: Moments,
    world: np.ndarray,
    root: np.ndarray,
    *,
    steps: int,
    damping: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Lowers the skinning error from the given start. world: (F, J, 3, 3) world rotations; root: (F, 3) shift of the
    root -> the same, improved. ``damping``, a share of each joint's own second moment, holds what no point fixes."""

    def part(a: int, b: int) -> tuple[np.ndarray, np.ndarray]:
        few, w, r = take_frames(moments, a, b), world[a:b], root[a:b]
        error = skin_error(few, transforms_of(parents, joints, w, r))
        for _ in range(steps):
            step = _gauss_newton_step(parents, joints, few, w, r, damping)
            w, r, error = _advance(parents, joints, few, w, r, error, step)
        return w, r

    parts = for_chunks(part, len(world), FRAMES)
    return np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])


def _advance(parents, joints, moments, world, root, error, step) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Takes the step, halved where it would raise a frame's error; frames that cannot improve stay where they are."""
    todo = np.ones(len(world), bool)
    world, root, error = world.copy(), root.copy(), error.copy()
    scale = 1.0
    for _ in range(_HALVINGS):
        index = np.flatnonzero(todo)
        if len(index) == 0:
            break
        turn, shift = _split(parents, scale * step[index])
        new_world, new_root = project_so3(turn @ world[index]), root[index] + shift
        few = Moments(moments.K, moments.Y[index], moments.xx[index], moments.mass, moments.count)
        new_error = skin_error(few, transforms_of(parents, joints, new_world, new_root))
        better = new_error < error[index]
        done = index[better]
        world[done], root[done], error[done] = new_world[better], new_root[better], new_error[better]
        todo[done] = False
        scale *= 0.5
    return world, root, error


def _split(parents: np.ndarray, step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(F, 3J + 3) -> accumulated world turns (F, J, 3, 3) and root shift (F, 3)."""
    count = len(parents)
    turn = from_rotation_vector(step[:, : 3 * count].reshape(-1, count, 3))
    for j, p in enumerate(parents):
        if p >= 0:
            turn[:, j] = turn[:, p] @ turn[:, j]
    return turn, step[:, 3 * count :]


def subtree_sums(parents: np.ndarray, values: np.ndarray, axis: int) -> np.ndarray:
    """Adds every joint's entry along ``axis`` to all its ancestors'."""
    out = np.moveaxis(values.copy(), axis, 0)
    for j in range(len(parents) - 1, 0, -1):
        out[parents[j]] += out[j]
    return np.moveaxis(out, 0, axis)


def world_moments(parents: np.ndarray, moments: Moments, transforms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A: (F, J, J, 4, 4) = sum_n s_nj s_nk^T and C: (F, J, 4, 3) = sum_n s_nj r_n^T, where s_nj = sum over the subtree
    of j of w_k [T_k h; 1] and r is the residual."""
    frames, count = transforms.shape[:2]
    t = np.zeros((frames, count, 4, 4))
    t[..., :3, :] = transforms
    t[..., 3, 3] = 1.0
    k = moments.K.transpose(0, 2, 1, 3).reshape(count, 4, 4 * count)
    left = (t @ k).reshape(frames, count, 4, count, 4).transpose(0, 3, 1, 2, 4)  # (F, Jk, Jj, 4, 4)
    m = left.reshape(frames, count, 4 * count, 4) @ np.swapaxes(t, -1, -2)
    m = m.reshape(frames, count, count, 4, 4).transpose(0, 2, 1, 3, 4)
    a = subtree_sums(parents, subtree_sums(parents, m, 1), 2)
    c = a[:, :, 0, :, :3] - subtree_sums(parents, t @ moments.Y, 1)
    return a, c


def _gauss_newton_step(parents, joints, moments, world, root, damping) -> np.ndarray:
    """(F, 3J + 3): small world turn of every joint's subtree about the joint, then the shift of all."""
    transforms = transforms_of(parents, joints, world, root)
    frames, count = world.shape[:2]
    a, c = world_moments(parents, moments, transforms)
    d = np.zeros((frames, count, 3, 4))
    d[..., :3] = np.eye(3)
    d[..., 3] = -kinematics.joint_positions(transforms, joints)
    s = d[:, :, None] @ a @ np.swapaxes(d, -1, -2)[:, None]  # (F, J, J, 3, 3) = sum_n u_j u_i^T
    trace = np.trace(s, axis1=-2, axis2=-1)
    block = trace[..., None, None] * np.eye(3) - np.swapaxes(s, -1, -2)
    size = 3 * count + 3
    h = np.zeros((frames, size, size))
    h[:, :-3, :-3] = block.transpose(0, 1, 3, 2, 4).reshape(frames, size - 3, size - 3)
    cross = skew((d @ a[:, :, 0, :, 3:])[..., 0])  # (F, J, 3, 3)
    h[:, :-3, -3:] = cross.reshape(frames, size - 3, 3)
    h[:, -3:, :-3] = np.swapaxes(h[:, :-3, -3:], -1, -2)
    h[:, -3:, -3:] = moments.count * np.eye(3)
    own = np.trace(block, axis1=-2, axis2=-1)[:, np.arange(count), np.arange(count)]
    hold = damping * own + 1e-9 * own.max(1, keepdims=True) + 1e-12
    index = np.arange(3 * count)
    h[:, index, index] += np.repeat(hold, 3, axis=1)
    g = d @ c  # (F, J, 3, 3) = sum_n u_j r^T
    turn = np.stack([g[..., 1, 2] - g[..., 2, 1], g[..., 2, 0] - g[..., 0, 2], g[..., 0, 1] - g[..., 1, 0]], axis=-1)
    gradient = np.concatenate([turn.reshape(frames, -1), c[:, 0, 3]], axis=1)
    return -np.linalg.solve(h, gradient[..., None])[..., 0]
