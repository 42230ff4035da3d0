"""Bones on motions whose decomposition is known."""

from __future__ import annotations

import numpy as np
import pytest

from tasks.bones import weights
from tasks.bones.clustering import choose_count, cluster
from tasks.bones.refit import refit_bones
from tasks.bones.rigid import rigid_skinning
from tasks.bones.rotation import nearest_rotation
from tasks.bones.ssdr import ssdr
from tasks.geometry import rigid, rotations
from tasks.geometry.measure import diagonal, vertex_rmse
from tasks.geometry.skinning import skin
from tasks.values import Canonical, Clusters, Motion, same

CLUSTERING = {"max_bones": 12, "count": "auto", "slack": 0.02, "exact": 1e-4, "rounds": 4, "seed": 0}
SSDR = {
    "influences": 4,
    "surplus": 40,
    "iterations": 14,
    "polish": 6,
    "points_per_bone": 80,
    "smoothness": 0.0,
    "locality": 0.0,
    "firmness": 1.0,
    "compression": 0.01,
    "prune": 0.0,
    "seed": 0,
}


def motion_of(points: np.ndarray) -> Motion:
    return Motion("made", points.astype(np.float32), None, np.array([0, len(points)]), ("all",), 30.0)


def canonical_of(points: np.ndarray) -> Canonical:
    return Canonical(points.astype(np.float32), None, -1, "rest")


def random_transforms(rng: np.random.Generator, frames: int, bones: int) -> np.ndarray:
    """Smooth rigid motions, (F, B, 3, 4)."""
    time = np.linspace(0, 2 * np.pi, frames)[:, None, None]
    turn = np.sin(time + rng.uniform(0, 6, (bones, 3))) * rng.uniform(-1, 1, (bones, 3))
    shift = 0.3 * np.sin(time + rng.uniform(0, 6, (bones, 3)))
    return rigid.make(rotations.from_rotation_vector(turn), shift)


def boxes(rng: np.random.Generator, parts: int, each: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """Clouds in a row that do not touch: points (N, 3), labels (N,)."""
    labels = np.repeat(np.arange(parts), each)
    return rng.uniform(-0.4, 0.4, (parts * each, 3)) + labels[:, None] * [1.0, 0.0, 0.0], labels


def test_one_rigid_motion_is_one_bone_without_error() -> None:
    rng = np.random.default_rng(1)
    points = rng.standard_normal((300, 3))
    motion = motion_of(rigid.apply(random_transforms(rng, 30, 1), points[None]))
    clusters = cluster(motion, canonical_of(points), **CLUSTERING)
    skinning = ssdr(motion, canonical_of(points), clusters, **SSDR)
    assert clusters.transforms.shape[1] == 1
    assert skinning.weights.shape[1] == 1
    assert skinning.history[-1] < 1e-6 * diagonal(points)


@pytest.mark.parametrize("parts", [2, 5, 9])
@pytest.mark.parametrize("noise", [0.0, 0.002])
def test_planted_rigid_parts_are_found_and_counted(parts: int, noise: float) -> None:
    rng = np.random.default_rng(parts)
    points, labels = boxes(rng, parts)
    moved = rigid.apply(random_transforms(rng, 40, parts)[:, labels], points)
    moved += noise * diagonal(points) / np.sqrt(3) * rng.standard_normal(moved.shape)
    clusters = cluster(motion_of(moved), canonical_of(points), **CLUSTERING)
    assert clusters.transforms.shape[1] == parts
    pairs = np.unique(np.stack([labels, clusters.labels]), axis=1)
    assert pairs.shape[1] == parts  # one cluster for one part
    skinning = rigid_skinning(motion_of(moved), canonical_of(points), clusters, spread=0)
    assert skinning.history[-1] < (1.01 * noise + 1e-6) * diagonal(points)


def test_planted_weights_and_bones_are_recovered() -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(0, 1, (900, 3)) * [4.0, 0.5, 0.5]
    centres = np.array([0.5, 1.5, 2.5, 3.5])
    weights = np.maximum(0.0, 1.0 - np.abs(points[:, :1] - centres) / 1.0) ** 2
    weights /= weights.sum(1, keepdims=True)
    moved = skin(points, weights, random_transforms(rng, 50, 4))
    clusters = cluster(motion_of(moved), canonical_of(points), **{**CLUSTERING, "max_bones": 4, "count": "fixed"})
    skinning = ssdr(motion_of(moved), canonical_of(points), clusters, **{**SSDR, "iterations": 80})
    assert skinning.history[-1] < 1e-3 * diagonal(points)
    likeness = weights.T @ skinning.weights
    order = likeness.argmax(1)
    assert sorted(order) == [0, 1, 2, 3]
    assert np.abs(skinning.weights[:, order] - weights).mean() < 0.02


def test_a_canonical_frame_that_bones_cannot_show_does_not_spoil_the_others() -> None:
    rng = np.random.default_rng(11)
    points, labels = boxes(rng, 4)
    moved = rigid.apply(random_transforms(rng, 40, 4)[:, labels], points)
    dented = canonical_of(points + 0.02 * np.sin(9 * points[:, ::-1]))
    clusters = cluster(motion_of(moved), dented, **{**CLUSTERING, "max_bones": 4, "count": "fixed"})
    held = ssdr(motion_of(moved), dented, clusters, **SSDR | {"firmness": 1e9})
    free = ssdr(motion_of(moved), dented, clusters, **SSDR)
    np.testing.assert_allclose(held.rest, dented.points, atol=1e-6)
    assert free.history[-1] < 0.1 * held.history[-1]
    shape = rigid.procrustes(free.rest[labels == 0].astype(np.float64), points[None, labels == 0])
    np.testing.assert_allclose(rigid.apply(shape, free.rest[labels == 0]), points[labels == 0], atol=4e-3)


def test_transforms_are_rigid_and_weights_are_a_partition() -> None:
    rng = np.random.default_rng(4)
    points, labels = boxes(rng, 4)
    moved = rigid.apply(random_transforms(rng, 20, 4)[:, labels], points) + 0.05 * np.sin(9 * points)
    clusters = cluster(motion_of(moved), canonical_of(points), **CLUSTERING)
    skinning = ssdr(motion_of(moved), canonical_of(points), clusters, **{**SSDR, "influences": 3, "prune": 0.02})
    turn = skinning.transforms[..., :3].astype(np.float64)
    np.testing.assert_allclose(turn @ np.swapaxes(turn, -1, -2), np.broadcast_to(np.eye(3), turn.shape), atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(turn), 1.0, atol=1e-5)
    np.testing.assert_allclose(skinning.weights.sum(1), 1.0, atol=1e-6)
    assert skinning.weights.min() >= 0
    assert (skinning.weights > 0).sum(1).max() <= 3
    assert skinning.weights[skinning.weights > 0].min() >= 0.02
    assert skinning.history[-1] == pytest.approx(
        vertex_rmse(skin(skinning.rest, skinning.weights, skinning.transforms), moved)
    )


@pytest.mark.parametrize("noise", [0.01, 0.03])
def test_the_pull_to_near_bones_is_the_clusters_own_squared_error_over_the_frames(noise: float, monkeypatch) -> None:
    """Three times the noise is nine times the pull: it is held against squared errors."""
    rng = np.random.default_rng(4)
    points, labels = boxes(rng, 3)
    moved = rigid.apply(random_transforms(rng, 20, 3)[:, labels], points)
    motion = motion_of(moved + noise * rng.standard_normal(moved.shape))
    clusters = cluster(motion, canonical_of(points), **CLUSTERING)
    pulls, exchange = set(), weights.exchange
    monkeypatch.setattr(weights, "exchange", lambda *a, **how: pulls.add(how["locality"]) or exchange(*a, **how))
    ssdr(motion, canonical_of(points), clusters, **SSDR | {"iterations": 2, "locality": 0.5})
    own = np.eye(clusters.transforms.shape[1], dtype=np.float32)[clusters.labels]
    error = vertex_rmse(skin(canonical_of(points).points, own, clusters.transforms), motion.points)
    radius = np.sqrt(((points - points.mean(0)) ** 2).sum(1).mean())
    assert len(pulls) == 1
    assert pulls.pop() == pytest.approx(0.5 * (error / radius) ** 2 / 20, rel=0.01)


def test_refit_on_unseen_frames_finds_their_transforms() -> None:
    rng = np.random.default_rng(5)
    points = rng.uniform(0, 1, (500, 3)) * [3.0, 0.5, 0.5]
    weights = np.maximum(0.0, 1.0 - np.abs(points[:, :1] - [0.5, 1.5, 2.5])) ** 2
    weights /= weights.sum(1, keepdims=True)
    truth = random_transforms(rng, 60, 3)
    moved = skin(points, weights, truth)
    clusters = cluster(motion_of(moved[:40]), canonical_of(points), **{**CLUSTERING, "max_bones": 3, "count": "fixed"})
    skinning = ssdr(motion_of(moved[:40]), canonical_of(points), clusters, **{**SSDR, "iterations": 80})
    unseen = refit_bones(motion_of(moved[40:]), skinning)
    assert vertex_rmse(skin(skinning.rest, skinning.weights, unseen), moved[40:]) < 2e-3 * diagonal(points)


def test_stillness_and_duplicates_do_not_crash() -> None:
    points = np.repeat(np.random.default_rng(6).standard_normal((20, 3)), 5, axis=0)
    motion = motion_of(np.repeat(points[None], 8, axis=0))
    clusters = cluster(motion, canonical_of(points), **{**CLUSTERING, "count": "fixed"})
    skinning = ssdr(motion, canonical_of(points), clusters, **SSDR)
    assert clusters.transforms.shape[1] == 1
    assert np.isfinite(skinning.transforms).all()
    assert skinning.history[-1] < 1e-6


def test_the_same_bits_for_any_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(7)
    points, labels = boxes(rng, 6, each=500)
    moved = rigid.apply(random_transforms(rng, 40, 6)[:, labels], points) + 0.05 * np.sin(9 * points)
    found = []
    for threads in ("1", "3"):
        monkeypatch.setenv("SKELEBONES_THREADS", threads)
        clusters = cluster(motion_of(moved), canonical_of(points), **CLUSTERING)
        found.append(ssdr(motion_of(moved), canonical_of(points), clusters, **{**SSDR, "smoothness": 1e-5}))
    assert same(found[0], found[1])


def test_count_rule() -> None:
    counts, flat = np.arange(1, 6), np.array([1.0, 0.5, 0.21, 0.205, 0.2])
    assert counts[choose_count(counts, flat, 10_000, 0.06, 0.0)] == 3
    assert counts[choose_count(counts, flat, 10_000, 0.0, 0.0)] == 5
    assert counts[choose_count(counts, flat, 10_000, 0.0, 0.6)] == 2


@pytest.mark.parametrize("kind", ["any", "flat", "mirrored", "line"])
def test_nearest_rotation_against_singular_values(kind: str) -> None:
    rng = np.random.default_rng(8)
    for _ in range(200):
        m = rng.standard_normal((3, 3))
        if kind == "flat":
            m = m @ np.diag([1.0, 1e-5, 0.0])
        if kind == "mirrored":
            m = -rotations.project_so3(m) + 1e-9 * m
        if kind == "line":
            m = np.outer(m[0], m[1])
        r = np.empty((3, 3))
        nearest_rotation(m, r)
        best = np.sum(rotations.project_so3(m) * m)
        assert np.sum(r * m) >= best - 1e-9 * np.linalg.norm(m)
        np.testing.assert_allclose(r @ r.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(r) > 0.999


def test_spread_shares_points_with_their_neighbours() -> None:
    """Two rods end to end: far from the seam nothing changes, at the seam both bones have a share."""
    rng = np.random.default_rng(10)
    points = np.stack([np.linspace(-1, 1, 200), *rng.uniform(-0.01, 0.01, (2, 200))], 1)
    labels = (points[:, 0] > 0).astype(np.int32)
    transforms = random_transforms(rng, 4, 2).astype(np.float32)
    motion = motion_of(rigid.apply(transforms[:, labels], points))
    clusters = Clusters(labels, transforms, np.ones(len(labels), bool), np.array([2]), np.array([0.0]))
    hard = rigid_skinning(motion, canonical_of(points), clusters, spread=0)
    soft = rigid_skinning(motion, canonical_of(points), clusters, spread=5)
    assert hard.history[-1] < 1e-6 < soft.history[-1]
    np.testing.assert_allclose(soft.weights.sum(1), 1, atol=1e-6)
    far = np.abs(points[:, 0]) > 0.5
    np.testing.assert_array_equal(soft.weights[far], hard.weights[far])
    assert 0.2 < soft.weights[100, 0] < 0.8
