"""The compiled kernels of the decomposition against slow and plain computations of the same things."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from scipy.optimize import nnls

from tasks.bones import transforms, weights
from tasks.bones.rest import refine
from tasks.bones.trajectories import Trajectories, compress
from tasks.geometry import rigid, rotations


@pytest.fixture(scope="module")
def case() -> tuple[Trajectories, np.ndarray, np.ndarray]:
    """Trajectories of 40 points over 6 frames, five bones (B, 4, 3, F), and the same paths u as (N, 3F)."""
    rng = np.random.default_rng(0)
    canonical = rng.standard_normal((40, 3))
    points = canonical + 0.3 * rng.standard_normal((6, 40, 3))
    paths = compress(points.astype(np.float32), canonical, tolerance=0.0, sample=np.arange(40))
    turn = rotations.from_rotation_vector(0.3 * rng.standard_normal((6, 5, 3))) - np.eye(3)
    local = rigid.make(turn, 0.3 * rng.standard_normal((6, 5, 3)))  # beside the identity, as offsets are
    return paths, np.ascontiguousarray(local.transpose(1, 3, 2, 0)), paths.path.astype(np.float64) @ paths.basis.T


def moved(paths: Trajectories, offsets: np.ndarray) -> np.ndarray:
    """D_b h_n, (N, B, 3F)."""
    return np.einsum("bidf,ni->nbdf", offsets, paths.rest).reshape(len(paths.rest), len(offsets), -1)


def best_weights(a: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, float]:
    """min |w a - x|^2, w >= 0, sum w = 1, by nonnegative least squares with a heavy row for the sum. a: (S, 3F)."""
    heavy = 1e4
    w, _ = nnls(np.vstack([a.T, heavy * np.ones(len(a))]), np.append(x, heavy))
    return w / w.sum(), float(np.sum((w / w.sum() @ a - x) ** 2))


def test_offsets_in_the_world_move_points_as_their_paths_say(case: tuple[Trajectories, np.ndarray, np.ndarray]) -> None:
    """x = R_f (scale h + centre + scale D h) + t_f, point by point."""
    paths, offsets, _ = case
    along, rest = paths.alignment, paths.rest[:, :3]
    world = along.to_world(offsets)
    canonical = along.scale * rest + along.centre
    for f, b in ((0, 0), (3, 1), (5, 4)):
        local = along.scale * (rest + paths.rest @ offsets[b, :, :, f]) + along.centre
        expected = local @ along.motion[f, :, :3].T + along.motion[f, :, 3]
        np.testing.assert_allclose(canonical @ world[f, b, :, :3].T + world[f, b, :, 3], expected, atol=1e-12)


def test_weights_on_a_given_support(case: tuple[Trajectories, np.ndarray, np.ndarray]) -> None:
    paths, offsets, u = case
    a, support = moved(paths, offsets), np.array([0, 2, 4])
    index = np.tile(np.append(support, -1).astype(np.int32), (40, 1))
    value = np.tile([1 / 3, 1 / 3, 1 / 3, 0.0], (40, 1))
    error = search(paths, offsets, index, value, rounds=0)
    for n in range(40):
        w, least = best_weights(a[n, support], u[n])
        found = np.zeros(5)
        found[index[n][index[n] >= 0]] = value[n][index[n] >= 0]
        np.testing.assert_allclose(found[support], w, atol=1e-4)
        assert error[n] * paths.frames == pytest.approx(least, rel=1e-5)


def test_exchange_against_trying_all_supports(case: tuple[Trajectories, np.ndarray, np.ndarray]) -> None:
    paths, offsets, u = case
    a = moved(paths, offsets)
    label, _ = weights.nearest_bone(paths, offsets)
    np.testing.assert_array_equal(label, np.sum((a - u[:, None]) ** 2, axis=2).argmin(1))
    index = np.full((40, 2), -1, np.int32)
    index[:, 0] = label
    value = np.tile([1.0, 0.0], (40, 1))
    error = search(paths, offsets, index, value, rounds=4) * paths.frames
    pairs = list(combinations(range(5), 2))
    best = np.array([min(best_weights(a[n, list(p)], u[n])[1] for p in pairs) for n in range(40)])
    assert (error >= best * (1 - 1e-5)).all()
    assert np.mean(error <= best * (1 + 1e-5)) > 0.85  # greedy, so not always
    assert np.mean(error) < 1.02 * np.mean(best)


def search(paths: Trajectories, offsets: np.ndarray, index: np.ndarray, value: np.ndarray, rounds: int) -> np.ndarray:
    forms, centres = weights.forms(paths, offsets), np.zeros((len(offsets), 3))
    settings = {"smoothness": 0.0, "graph": None, "locality": 0.0, "centres": centres}
    return weights.exchange(paths, forms, index, value, rounds=rounds, **settings)


def test_sums_and_error(case: tuple[Trajectories, np.ndarray, np.ndarray]) -> None:
    paths, offsets, u = case
    w = np.random.default_rng(1).dirichlet(np.ones(5), 40)
    index = np.tile(np.arange(5, dtype=np.int32), (40, 1))
    k, y = transforms.sums(paths, index, w, 5)
    np.testing.assert_allclose(k, np.einsum("nb,nc,ni,nj->bcij", w, w, paths.rest, paths.rest), atol=1e-9)
    np.testing.assert_allclose(y.reshape(5, 4, -1), np.einsum("nb,ni,nx->bix", w, paths.rest, u), atol=1e-6)
    plain = np.sum((np.einsum("nb,nbx->nx", w, moved(paths, offsets)) - u) ** 2)
    assert paths.squared + transforms.sweep(k, y, offsets.copy(), 0) == pytest.approx(plain, rel=1e-6)


@pytest.mark.parametrize("firmness", [0.0, 3.0])
def test_rest_points_against_least_squares(case: tuple[Trajectories, np.ndarray, np.ndarray], firmness: float) -> None:
    """The canonical point counts for `firmness` frames beside those of the path; what moves stays where it was."""
    paths, offsets, u = case
    w = np.random.default_rng(3).dirichlet(np.ones(5), 40)
    index = np.tile(np.arange(5, dtype=np.int32), (40, 1))
    home = paths.rest + np.append(0.1 * np.random.default_rng(4).standard_normal(3), 0.0)
    found = refine(paths, offsets, index, w, home, firmness)
    local = np.einsum("nb,bidf->nfdi", w, offsets) + np.eye(3, 4)  # the blended transform of each point and frame
    target = paths.rest[:, None, :3] + u.reshape(40, 3, 6).transpose(0, 2, 1)
    for n in range(40):
        a = np.concatenate([*local[n, :, :, :3], np.sqrt(firmness) * np.eye(3)])
        x = np.append((target[n] - local[n, :, :, 3]).ravel(), np.sqrt(firmness) * home[n, :3])
        np.testing.assert_allclose(found.rest[n, :3], np.linalg.lstsq(a, x, rcond=None)[0], atol=1e-5)
    after = (found.path.astype(np.float64) @ paths.basis.T).reshape(40, 3, 6).transpose(0, 2, 1)
    np.testing.assert_allclose(found.rest[:, None, :3] + after, target, atol=1e-5)


def test_a_sweep_never_raises_the_error_and_ends_where_bones_agree(
    case: tuple[Trajectories, np.ndarray, np.ndarray],
) -> None:
    paths, offsets, _ = case
    w = np.random.default_rng(2).dirichlet(np.ones(5), 40)
    k, y = transforms.sums(paths, np.tile(np.arange(5, dtype=np.int32), (40, 1)), w, 5)
    now = offsets.copy()
    errors = [transforms.sweep(k, y, now, 0)] + [transforms.sweep(k, y, now, 1) for _ in range(20)]
    assert (np.diff(errors) <= 1e-9).all()


def test_one_group_is_plain_procrustes(case: tuple[Trajectories, np.ndarray, np.ndarray]) -> None:
    paths, _, u = case
    k, y = transforms.sums(paths, np.zeros((40, 1), np.int32), np.ones((40, 1)), 1)
    offsets, _ = transforms.rigid_fit(k[0], y)
    target = paths.rest[:, :3] + np.moveaxis(u.reshape(40, 3, 6), 2, 0)
    truth = rigid.procrustes(paths.rest[:, :3], target)
    found = np.moveaxis(offsets[0], (2, 1, 0), (0, 1, 2)) + np.eye(3, 4)
    np.testing.assert_allclose(found, truth, atol=1e-6)
