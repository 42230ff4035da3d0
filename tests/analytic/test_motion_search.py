"""The search against a plain double loop, and what windows may not do."""

from __future__ import annotations

import numpy as np
import pytest

from tasks.geometry.rotations import from_quaternion, geodesic
from tasks.motion import search
from tasks.motion.search import Keys, frame_distances, nearest_windows


def random_keys(rng: np.random.Generator, clips: list[int], joints: int = 5, extra: int = 2) -> Keys:
    q = rng.normal(size=(sum(clips), joints, 4)).astype(np.float32)
    q /= np.linalg.norm(q, axis=-1, keepdims=True)
    start = np.concatenate([[0], np.cumsum(clips)])
    return Keys(q, rng.normal(size=(sum(clips), extra, 3)).astype(np.float32), start)


def brute_force(query: Keys, database: Keys, patch: int, stride: int) -> np.ndarray:
    """Distance of every query window to every start frame, inf where the window would leave its clip."""
    a, b = from_quaternion(query.rotations.astype(float)), from_quaternion(database.rotations.astype(float))
    frames = geodesic(a[:, None], b[None]).sum(-1)
    apart = np.linalg.norm(query.extra[:, None].astype(float) - database.extra[None], axis=-1).sum(-1)
    frames += query.scale * apart
    reach = (patch - 1) * stride
    out = np.full((len(a) - reach, len(b)), np.inf)
    for first, last in zip(database.clip_start[:-1], database.clip_start[1:], strict=True):
        for u in range(first, last - reach):
            for t in range(len(out)):
                out[t, u] = sum(frames[t + i * stride, u + i * stride] for i in range(patch))
    return out / (patch * query.scale)


def test_frame_distances_are_geodesic_to_float_precision():
    rng = np.random.default_rng(0)
    a, b = random_keys(rng, [9], extra=0), random_keys(rng, [11], extra=0)
    got = frame_distances(a.rotations, a.extra, b, 2, 10)
    left, right = from_quaternion(a.rotations.astype(float)), from_quaternion(b.rotations.astype(float))
    np.testing.assert_allclose(got, geodesic(left[:, None], right[None, 2:10]).sum(-1), atol=2e-5)


def test_angle_of_equal_rotations_is_zero_and_sign_of_quaternion_does_not_matter():
    a = random_keys(np.random.default_rng(1), [6], extra=0)
    turned = Keys(-a.rotations, a.extra, a.clip_start)
    assert np.all(np.diagonal(frame_distances(a.rotations, a.extra, turned, 0, 6)) == 0)


@pytest.mark.parametrize("blocks", [(256, 2048), (7, 9)])
def test_recall_against_brute_force_is_one(monkeypatch, blocks):
    monkeypatch.setattr(search, "QUERY_BLOCK", blocks[0])
    monkeypatch.setattr(search, "DATABASE_BLOCK", blocks[1])
    rng = np.random.default_rng(2)
    query, database = random_keys(rng, [30]), random_keys(rng, [25, 40, 8])
    strides = [4, 2, 1]
    found = nearest_windows(query, database, k=7, patch=5, strides=strides)
    for level, stride in enumerate(strides):
        truth = brute_force(query, database, 5, stride)
        assert found.count[level] == len(truth)
        best = np.sort(truth, axis=1)[:, :7]
        np.testing.assert_allclose(found.distance[level, : len(truth)], best, rtol=1e-5)
        claimed = np.take_along_axis(truth, found.start[level, : len(truth)].astype(int), 1)
        np.testing.assert_allclose(claimed, best, rtol=1e-5)


def test_no_window_crosses_a_clip():
    rng = np.random.default_rng(3)
    clips, patch = [9, 12, 10], 7
    database = random_keys(rng, clips)
    # a query that equals the frames on both sides of a cut: its best place would be right across it
    across = slice(5, 15)
    query = Keys(database.rotations[across], database.extra[across], np.array([0, 10]))
    found = nearest_windows(query, database, k=12, patch=patch, strides=[1])
    starts = found.start[found.start >= 0]
    clip = np.searchsorted(database.clip_start, starts, side="right") - 1
    assert np.all(starts + patch <= database.clip_start[clip + 1])
    assert found.distance[0, 0, 0] > 0.1


def test_fewer_windows_than_k_are_marked():
    rng = np.random.default_rng(4)
    found = nearest_windows(random_keys(rng, [8]), random_keys(rng, [8]), k=5, patch=7, strides=[1])
    assert np.all(found.start[..., 2:] == -1)
    assert np.all(np.isinf(found.distance[..., 2:]))
    assert np.all(np.isfinite(found.distance[..., :2]))


def test_threads_do_not_change_a_bit(monkeypatch):
    rng = np.random.default_rng(5)
    query, database = random_keys(rng, [600]), random_keys(rng, [300])
    results = []
    for threads in ("1", "3"):
        monkeypatch.setenv("SKELEBONES_THREADS", threads)
        results.append(nearest_windows(query, database, k=3, patch=7, strides=[2, 1]))
    assert results[0].distance.tobytes() == results[1].distance.tobytes()
    assert results[0].start.tobytes() == results[1].start.tobytes()
