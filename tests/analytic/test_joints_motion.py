"""Joints from relative motion, and the kernels under it, against planted joints."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from tasks.geometry import kinematics, rigid
from tasks.geometry.measure import diagonal, vertex_rmse
from tasks.geometry.rotations import from_rotation_vector, geodesic
from tasks.geometry.skinning import skin
from tasks.geometry.sparse_weights import fit_weights
from tasks.skeleton.articulation import centres, off_hinges
from tasks.skeleton.body import Body
from tasks.skeleton.curve_weights import onto_surface
from tasks.skeleton.division import divide, peak_angles
from tasks.skeleton.inner_bones import Bones, prune
from tasks.skeleton.joints_gradient import joints_by_gradient
from tasks.skeleton.joints_motion import joints_by_motion
from tasks.skeleton.linking import Articulation, root_of
from tasks.skeleton.poses import fit_poses
from tasks.skeleton.symmetry import find_mirror
from tasks.skeleton.tree_fit import keep_inside
from tasks.values import Curve, Skinning
from tests.analytic.jointed_shapes import RADIUS, Bending, ball_joint
from tests.shipped import shipped

SETTINGS = shipped("skeleton.motion")
POSES = shipped("skeleton.poses")


@pytest.fixture(scope="module", autouse=True)
def _one_thread_in_products():
    """As stages run in the workflow: spinning BLAS threads make small products crawl."""
    with threadpool_limits(1, user_api="blas"):
        yield


def find(shape: Bending, skinning: Skinning | None = None, **changed):
    inputs = (shape.motion, shape.canonical, skinning or shape.skinning, shape.surface, shape.curve)
    return joints_by_motion(*inputs, **(SETTINGS | changed))


def lbs_error(shape: Bending, skeleton) -> float:
    poses = fit_poses(shape.motion, shape.canonical, skeleton, **POSES)
    transforms = kinematics.forward(skeleton.parents, skeleton.joints, poses.rotations, poses.translations)
    return vertex_rmse(skin(shape.canonical.points, skeleton.weights, transforms), shape.motion.points)


@pytest.mark.parametrize("topology", ["auto", "motion", "curve"])
def test_a_ball_joint_is_found(topology):
    shape = ball_joint()
    skeleton = find(shape, topology=topology)
    assert len(skeleton.joints) == 2
    np.testing.assert_allclose(skeleton.joints[1], [1.0, 0.0, 0.0], atol=0.02)
    assert lbs_error(shape, skeleton) < 2e-3


def placed(shape: Bending, scale: float, offset: np.ndarray):
    """The inputs of ``joints_by_motion`` under x -> scale x + offset."""

    def place(points: np.ndarray) -> np.ndarray:
        return (scale * points.astype(np.float64) + offset).astype(np.float32)

    transforms = shape.skinning.transforms.astype(np.float64)
    transforms[..., 3] = scale * transforms[..., 3] + offset - transforms[..., :3] @ offset
    return (
        replace(shape.motion, points=place(shape.motion.points)),
        replace(shape.canonical, points=place(shape.canonical.points)),
        replace(shape.skinning, rest=place(shape.skinning.rest), transforms=transforms.astype(np.float32)),
        replace(shape.surface, vertices=place(shape.surface.vertices)),
        replace(shape.curve, nodes=place(shape.curve.nodes)),
    )


@pytest.mark.parametrize(
    ("diagonals", "scale", "near"),
    [(1, 1.0, 1e-4), (10, 1.0, 1e-4), (1000, 1.0, 1e-3), (0, 1e-3, 1e-4), (0, 1e3, 1e-4)],
)
def test_neither_place_nor_unit_matters(diagonals, scale, near):
    """But for what float32 coordinates of a thousand lengths round off."""
    shape = ball_joint()
    offset = diagonals * diagonal(shape.canonical.points) * np.array([0.6, -0.48, 0.64])
    here, there = find(shape), joints_by_motion(*placed(shape, scale, offset), **SETTINGS)
    np.testing.assert_array_equal(there.parents, here.parents)
    np.testing.assert_allclose(
        (there.joints - offset) / scale, here.joints, atol=near * diagonal(shape.canonical.points)
    )


def test_bones_improve_alike_wherever_the_origin_is():
    """Extrapolated as a turn about the origin and a shift, bones a thousand lengths away from it overshot."""
    rng = np.random.default_rng(0)
    rest, paths = rng.normal(size=(60, 3)), []
    for turn in rng.uniform(-0.3, 0.3, (20, 2, 3)):
        a, b = from_rotation_vector(turn)
        paths.append(np.where(rest[:, :1] < 0.0, rest @ a.T, rest @ b.T))
    paths, weights = np.array(paths) + 0.05 * rng.normal(size=(20, 60, 3)), rng.dirichlet(np.ones(3), 60)
    start = rigid.make(from_rotation_vector(rng.uniform(-0.3, 0.3, (20, 3, 3))), np.zeros((20, 3, 3)))
    far = np.array([2000.0, -800.0, 1500.0])
    moved = rigid.make(start[..., :3], far - start[..., :3] @ far)
    here = Bones(rest, paths, weights, start, 3).improve(8)
    there = Bones(rest + far, paths + far, weights, moved, 3).improve(8)
    np.testing.assert_allclose(there.weights, here.weights, atol=1e-4)
    np.testing.assert_allclose(there.transforms[..., :3], here.transforms[..., :3], atol=1e-4)


def test_a_hinge_is_found_though_it_is_free_along_its_axis():
    turns = np.zeros((40, 2, 3))
    turns[:, 1, 2] = np.linspace(-1.0, 1.0, 40)
    shape = Bending(2.0, [0.0, 1.0], turns, np.zeros((40, 3)), 0.05)
    skeleton = find(shape)
    assert len(skeleton.joints) == 2
    np.testing.assert_allclose(skeleton.joints[1], [1.0, 0.0, 0.0], atol=0.02)


def test_a_hinge_lies_where_its_skins_meet_and_a_ball_joint_where_it_turns():
    parents, joints = np.array([-1, 0, 0, 0]), np.array([[0.0, 0, 0], [1, 0, 0.4], [1, 0, 0], [1, 0, 0]])
    meet = np.array([[9.0, 9, 9], [1.1, 0.1, 0.0], [1.1, 0.1, 0.1], [7, 7, 7]])
    rng = np.random.default_rng(0)
    turns = np.zeros((50, 4, 3))
    turns[:, 1, 2] = rng.uniform(-1, 1, 50)  # free along z
    turns[:, 2] = rng.uniform(-1, 1, (50, 3))
    turns[:, 3, 2] = rng.uniform(-1, 1, 50)
    found = off_hinges(parents, joints, from_rotation_vector(turns), meet, share=0.1, far=0.5, gap=0.01)
    np.testing.assert_allclose(found[1], [1.0, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(found[[0, 2, 3]], joints[[0, 2, 3]])  # the last one's skins meet too far away


@pytest.mark.parametrize("seed", range(3))
def test_left_and_right_of_a_symmetric_shape_have_as_many_joints_at_mirrored_places(seed):
    rng = np.random.default_rng(seed)
    turns = rng.uniform(-0.5, 0.5, (50, 3, 3))
    shape = Bending(4.0, [0.0, 1.0, 3.0], turns, rng.normal(size=(50, 3)), 0.1)
    skeleton = find(shape)
    x = np.sort(skeleton.joints[1:, 0] - 2.0)
    assert len(x) == 2
    np.testing.assert_allclose(x, -x[::-1], atol=1e-3)
    np.testing.assert_allclose(x, [-1.0, 1.0], atol=0.03)
    assert np.abs(skeleton.joints[1:, 1:]).max() < RADIUS


def test_a_mirror_is_found_and_only_where_there_is_one():
    shape = ball_joint()
    mirror = find_mirror(shape.surface)
    points = shape.surface.vertices.astype(float)
    np.testing.assert_allclose(mirror.image(mirror.image(points)), points, atol=1e-9)
    some = np.array([[0.5, 0.0, 0.0], [0.52, 0.01, 0.01], [1.5, 0.0, 0.02]])
    assert (mirror.partners(some) >= -1).all()
    evened = mirror.even(some)
    for a, b in enumerate(mirror.partners(some)):
        if b >= 0:
            np.testing.assert_allclose(evened[a], mirror.image(evened)[b], atol=1e-9)
    bent = shape.motion.points[0].astype(np.float32)
    rng = np.random.default_rng(0)
    uneven = bent * rng.uniform(0.7, 1.3, (len(bent), 1)).astype(np.float32)
    assert find_mirror(replace(shape.surface, vertices=uneven)) is None


def test_the_tree_is_stable_between_neighbouring_prefixes():
    """A skeleton from more of the same motion has the same tree, its joints where they were."""
    rng = np.random.default_rng(3)
    turns = np.cumsum(rng.normal(0.0, 0.12, (60, 3, 3)), axis=0).clip(-0.7, 0.7)
    shape = Bending(3.0, [0.0, 1.0, 2.0], turns, rng.normal(size=(60, 3)), 0.1)
    found = []
    for frames in (36, 45, 60):
        first = replace(shape.motion, points=shape.motion.points[:frames], clip_start=np.array([0, frames]))
        seen = replace(shape.skinning, transforms=shape.skinning.transforms[:frames])
        inputs = (first, shape.canonical, seen, shape.surface, shape.curve)
        found.append(joints_by_motion(*inputs, **SETTINGS))
    for skeleton in found:
        assert len(skeleton.parents) == 3
        np.testing.assert_allclose(np.sort(skeleton.joints[1:, 0]), np.sort(found[-1].joints[1:, 0]), atol=0.02)


def test_poses_of_a_found_skeleton_carry_the_root_and_never_flip():
    """The whole turns right round while it walks far off; what the joints turn between two frames stays small."""
    angle = np.linspace(0.0, 2.0 * np.pi, 60)
    turns = np.zeros((60, 3, 3))
    turns[:, 0, 1] = angle
    turns[:, 1:, 2] = 0.5 * np.sin(np.array([2.0, 3.0]) * angle[:, None])
    turns[:, 1:, 1] = 0.4 * np.cos(np.array([3.0, 2.0]) * angle[:, None])
    walk = np.stack([10.0 * np.cos(angle), np.zeros(60), 10.0 * np.sin(angle)], axis=1)
    shape = Bending(3.0, [0.0, 1.0, 2.0], turns, walk, 0.1)
    skeleton = find(shape)
    poses = fit_poses(shape.motion, shape.canonical, skeleton, **POSES)
    assert skeleton.parents.tolist().count(-1) == 1
    step = np.degrees(geodesic(poses.rotations[1:], poses.rotations[:-1]))
    assert step.max() < 20.0
    transforms = kinematics.forward(skeleton.parents, skeleton.joints, poses.rotations, poses.translations)
    centre = skin(shape.canonical.points, skeleton.weights, transforms).mean(axis=1)
    np.testing.assert_allclose(centre, shape.motion.points.mean(axis=1), atol=0.01)


def test_a_chain_of_three_is_a_chain():
    rng = np.random.default_rng(3)
    turns = rng.uniform(-0.5, 0.5, (50, 3, 3))
    shape = Bending(3.0, [0.0, 1.0, 2.0], turns, rng.normal(size=(50, 3)), 0.1)
    skeleton = find(shape)
    assert len(skeleton.joints) == 3
    inner = np.sort(skeleton.joints[1:, 0])
    root = skeleton.joints[0, 0]
    expected = {0: [1.0, 2.0], 1: [1.0, 2.0], 2: [1.0, 2.0]}[int(root)]
    np.testing.assert_allclose(inner, expected, atol=0.03)
    assert lbs_error(shape, skeleton) < 5e-3


def test_ghost_bones_are_seen_through():
    """Blends of the true bones, given to some of the points, are no bones of their own."""
    shape = ball_joint()
    true = shape.transforms
    half = true.mean(axis=1, keepdims=True)
    third = (0.3 * true[:, :1] + 0.7 * true[:, 1:]).copy()
    transforms = np.concatenate([true, half, third], axis=1).astype(np.float32)
    weights = np.concatenate([shape.weights, np.zeros((len(shape.weights), 2))], axis=1).astype(np.float32)
    mixed = shape.weights.min(axis=1) > 0.2
    weights[mixed] = [0.0, 0.0, 0.6, 0.4]
    ghosts = Skinning(shape.skinning.rest, weights, transforms, np.zeros(1))
    skeleton = find(shape, ghosts)
    assert len(skeleton.joints) == 2
    np.testing.assert_allclose(skeleton.joints[1], [1.0, 0.0, 0.0], atol=0.02)


def test_a_body_that_moves_as_one_has_one_joint():
    rng = np.random.default_rng(4)
    turns = np.zeros((20, 2, 3))
    turns[:, 0] = rng.uniform(-1.0, 1.0, (20, 3))
    shape = Bending(2.0, [0.0, 1.0], turns, rng.normal(size=(20, 3)), 0.05)
    skeleton = find(shape)
    assert len(skeleton.joints) == 1
    assert skeleton.parents.tolist() == [-1]
    assert lbs_error(shape, skeleton) < 1e-3


@pytest.mark.parametrize("way", [joints_by_motion, joints_by_gradient])
def test_a_curve_of_one_point_gives_one_joint(way):
    """A ball shrinks to a point: there is no branch to walk along."""
    shape = ball_joint()
    of = np.zeros(len(shape.canonical.points), np.int32)
    point = Curve(np.array([[1.0, 0.0, 0.0]], np.float32), np.zeros((0, 2), np.int32), of, of)
    settings = SETTINGS if way is joints_by_motion else shipped("skeleton.gradient")
    skeleton = way(shape.motion, shape.canonical, shape.skinning, shape.surface, point, **settings)
    assert len(skeleton.joints) == 1
    np.testing.assert_allclose(skeleton.joints[0], [1.0, 0.0, 0.0])
    np.testing.assert_allclose(skeleton.weights, 1.0)


def test_weights_are_sparse_convex_and_the_ceiling_holds():
    rng = np.random.default_rng(5)
    shape = Bending(4.0, [0.0, 1.0, 2.0, 3.0], rng.uniform(-0.5, 0.5, (40, 4, 3)), np.zeros((40, 3)), 0.2)
    for ceiling in (4, 2):
        skeleton = find(shape, max_joints=ceiling, influences=2)
        assert len(skeleton.joints) <= ceiling
        np.testing.assert_allclose(skeleton.weights.sum(axis=1), 1.0, atol=1e-5)
        assert skeleton.weights.min() >= 0.0
        assert (skeleton.weights > 0).sum(axis=1).max() <= 2
        assert (skeleton.weights.argmax(axis=1)[:, None] == np.arange(len(skeleton.joints))).any(axis=0).all()


def test_the_same_input_gives_the_same_bits():
    first, second = find(ball_joint()), find(ball_joint())
    assert first.joints.tobytes() == second.joints.tobytes()
    assert first.weights.tobytes() == second.weights.tobytes()


def test_joints_outside_are_taken_inside():
    shape = ball_joint()
    moved = keep_inside(np.array([[1.0, 0.5, 0.0], [0.5, 0.01, 0.0]]), shape.surface, shape.curve)
    assert np.linalg.norm(moved[0, 1:]) < 0.15
    assert moved[1].tolist() == [0.5, 0.01, 0.0]


def test_centres_of_planted_pairs_with_noise_in_the_guess():
    rng = np.random.default_rng(6)
    place = rng.normal(size=3)
    r = from_rotation_vector(rng.uniform(-1, 1, (100, 2, 3)))
    meet = rng.normal(size=(100, 3))  # both bones carry the place here
    t = meet[:, None] - (r @ place[:, None])[..., 0]
    transforms = np.concatenate([r, t[..., None]], axis=-1)
    guess = (place + np.array([0.05, -0.05, 0.02]))[None]
    points, residuals = centres(transforms, np.array([[0, 1]]), guess, np.array([1e-3]), 0.2)
    np.testing.assert_allclose(points[0], place, atol=1e-3)
    assert residuals[0] < 1e-3
    clipped, _ = centres(transforms, np.array([[0, 1]]), guess + np.array([0.95, 0.05, -0.02]), np.array([1e-3]), 0.2)
    assert np.linalg.norm(clipped[0] - place - [1.0, 0, 0]) == pytest.approx(0.2)


def test_sparse_weights_match_a_search_over_all_supports():
    rng = np.random.default_rng(7)
    rest = rng.normal(size=(12, 3))
    r = from_rotation_vector(rng.uniform(-0.7, 0.7, (6, 6, 3)))
    transforms = np.concatenate([r, rng.normal(size=(6, 6, 3, 1))], axis=-1)
    true = rng.dirichlet(np.ones(6), 12)
    points = skin(rest, true, transforms)
    found = fit_weights(rest, points, transforms, influences=2, exchanges=6)
    each = np.einsum("fbij,nj->nfbi", transforms, np.concatenate([rest, np.ones((12, 1))], 1))  # (N, F, B, 3)
    for n in range(12):
        best = np.inf
        for a, b in combinations(range(6), 2):
            d = (each[n, :, a] - each[n, :, b]).ravel()
            w = np.clip(d @ (points[:, n] - each[n, :, b]).ravel() / (d @ d), 0.0, 1.0)
            mixed = w * each[n, :, a] + (1 - w) * each[n, :, b]
            best = min(best, np.sum((mixed - points[:, n]) ** 2))
        reached = np.sum((np.einsum("fbi,b->fi", each[n], found[n]) - points[:, n]) ** 2)
        assert reached <= 1.3 * best + 1e-9  # an exchange search, not an exhaustive one


def test_sparse_weights_are_exact_where_they_can_be():
    shape = ball_joint()
    found = fit_weights(shape.canonical.points, shape.motion.points, shape.transforms, influences=2, exchanges=2)
    np.testing.assert_allclose(found, shape.weights, atol=1e-3)


def test_pruning_keeps_small_bones_that_turn_and_drops_large_ones_that_do_not():
    rng = np.random.default_rng(8)
    turns = np.zeros((40, 4, 3))
    turns[:, 1] = rng.uniform(-0.5, 0.5, (40, 3))
    turns[:, 3] = rng.uniform(-0.5, 0.5, (40, 3))  # the last 5 % of the length; joint 2 in the middle never turns
    shape = Bending(4.0, [0.0, 1.0, 2.0, 3.8], turns, np.zeros((40, 3)), 0.05)
    bones = Bones(shape.canonical.points.astype(float), shape.motion.points, shape.weights, shape.transforms, 4)
    kept = prune(bones, 4.0, knee=1.7, angle=6.0, at_most=10)
    assert kept.count == 3
    assert kept.error() < 1e-3


def test_of_bones_that_own_no_curve_those_at_a_limbs_end_stay_if_they_turn():
    """Three quarters of the skin of two stretches, amid the body and at its tip, hide the bone of the fourth."""
    shape = Bending(4.0, [0.0], np.zeros((40, 1, 3)), np.zeros((40, 3)), 0.05)
    rest, upper = shape.canonical.points, shape.canonical.points[:, 1] > 0.5 * RADIUS
    owner = np.zeros(len(rest), int)
    for bone, low in ((1, 1.8), (3, 3.8)):
        stretch = (rest[:, 0] > low) & (rest[:, 0] < low + 0.4)
        owner[stretch], owner[stretch & upper] = bone, bone + 1
    weights = np.eye(5, dtype=np.float32)[owner]
    body = Body(shape.surface, shape.curve, onto_surface(shape.canonical, shape.surface), 4.0, None)

    def kept(twist: float) -> int:
        turns = np.zeros((40, 5, 3))
        turns[:, [1, 3], 2] = 0.5 * np.sin(np.linspace(0.0, 6.0, 40))[:, None]
        turns[:, [2, 4]] = turns[:, [1, 3]]
        turns[:, [2, 4], 0] = np.cos(np.linspace(0.0, 9.0, 40))[:, None] * [twist, -twist]
        transforms = rigid.make(from_rotation_vector(turns), np.zeros((40, 5, 3)))
        bones = Bones(rest.astype(float), skin(rest, weights, transforms), weights, transforms, 4)
        return body.limbs(bones, SETTINGS["missed"]).count

    assert kept(0.6) == 4
    assert kept(0.03) == 3  # hardly away from the bone that hides it


def test_the_root_is_the_calm_bone_of_the_trunk_not_the_largest_nor_a_calm_leaf():
    """Bones 0 and 1, two limbs on each, and a large head 6 on the one that turns."""
    links = np.array([[0, 1], [0, 2], [0, 3], [1, 4], [1, 5], [1, 6]])
    turn = np.array([0.1, 0.3, 0.5, 0.5, 0.5, 0.0, 0.2])  # amplitudes; limb 5 is the calmest of all
    swing = turn[None] * np.sin(np.linspace(0.0, 6.0, 50))[:, None]
    transforms = rigid.make(from_rotation_vector(swing[..., None] * [0.0, 0.0, 1.0]), np.zeros((50, 7, 3)))
    bones = Bones(np.zeros((1, 3)), np.zeros((50, 1, 3), np.float32), np.ones((1, 7)), transforms, 4)
    areas = np.array([2.0, 2.5, 1.0, 1.0, 1.0, 1.0, 6.0])
    found = Articulation(bones, links, np.zeros((6, 3)), np.zeros(6), np.ones(6), np.zeros((7, 3)), areas)
    assert root_of(found) == 0


@pytest.mark.parametrize(("folds", "found"), [(4, 3), (0, 2)])
def test_a_bone_of_two_segments_is_cut_though_it_folds_in_few_frames_only(folds, found):
    rng = np.random.default_rng(0)
    turns = np.zeros((60, 3, 3))
    turns[:, 1] = rng.uniform(-0.5, 0.5, (60, 3))
    turns[:folds, 2] = rng.uniform(0.2, 0.4, (folds, 3))
    shape = Bending(4.0, [0.0, 1.5, 2.7], turns, np.zeros((60, 3)), 0.1)
    weights = np.stack([shape.weights[:, 0], shape.weights[:, 1:].sum(axis=1)], axis=1)
    rest = shape.canonical.points.astype(float)
    bones = Bones(rest, shape.motion.points, weights, shape.transforms[:, :2], 4).improve(8)
    assert prune(bones, 4.0, knee=1.7, angle=6.0, at_most=10).count == 2
    cut = divide(bones, 4.0, angle=5.0, at_most=10, rounds=8)
    assert cut.count == found
    if folds:
        assert len(np.unique(cut.weights.argmax(axis=1))) == 3
        assert cut.error() < 0.3 * bones.error()
        owner = cut.weights[rest[:, 0] > 2.9].argmax(axis=1)
        assert (owner == owner[0]).all()
    assert divide(bones, 4.0, angle=5.0, at_most=2, rounds=8).count == 2


def test_skin_that_swells_is_not_cut():
    """The halves of a tube that grows thick and thin move apart, but lie beside each other and leave the error."""
    shape = Bending(1.0, [0.0], np.zeros((40, 1, 3)), np.zeros((40, 3)), 0.05)
    thick = 1.0 + 0.3 * np.sin(np.linspace(0.0, 9.0, 40))[:, None, None]
    paths = (shape.canonical.points * np.concatenate([np.ones_like(thick), thick, thick], axis=2)).astype(np.float32)
    bones = Bones(shape.canonical.points.astype(float), paths, shape.weights, shape.transforms, 4)
    assert peak_angles(bones, 1.0)[0] > np.radians(1.0)
    assert divide(bones, 1.0, angle=5.0, at_most=10, rounds=8).count == 1
