"""Skeletons of real rigs and captures with the shipped settings, held against the truth where there is one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import igl
import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from tasks.bones.clustering import cluster
from tasks.bones.ssdr import ssdr
from tasks.datasets import mesh_sequence, rigged_character
from tasks.datasets.canonical import canonical
from tasks.evaluation.joints import counting_joints, joint_scores
from tasks.geometry import kinematics
from tasks.geometry.measure import diagonal, vertex_rmse
from tasks.geometry.rotations import geodesic
from tasks.geometry.skinning import skin
from tasks.skeleton.curve import curve_skeleton
from tasks.skeleton.given import given_poses, given_skeleton
from tasks.skeleton.joints_gradient import joints_by_gradient
from tasks.skeleton.joints_motion import joints_by_motion
from tasks.skeleton.poses import fit_poses
from tasks.skeleton.surface import closed_surface
from tasks.skeleton.symmetry import find_mirror
from tasks.values import Canonical, Curve, Motion, Skeleton, Skinning, Surface
from tests.shipped import shipped

STEP = 3  # every third frame: 8 a second


@dataclass(frozen=True)
class Found:
    motion: Motion
    canonical: Canonical
    skinning: Skinning
    surface: Surface
    curve: Curve

    def joints(self, way, name: str) -> Skeleton:
        inputs = (self.motion, self.canonical, self.skinning, self.surface, self.curve)
        return way(*inputs, **shipped(f"skeleton.{name}"))

    def lbs_percent(self, skeleton: Skeleton) -> float:
        poses = fit_poses(self.motion, self.canonical, skeleton, **shipped("skeleton.poses"))
        transforms = kinematics.forward(skeleton.parents, skeleton.joints, poses.rotations, poses.translations)
        posed = skin(self.canonical.points, skeleton.weights, transforms)
        return 100.0 * vertex_rmse(posed, self.motion.points) / diagonal(self.canonical.points)


def settings(node: str, function) -> dict:
    values = shipped(node) | {"seed": 0}
    names = function.__kwdefaults__ or {}
    wanted = function.__code__.co_varnames[
        function.__code__.co_argcount : function.__code__.co_argcount + function.__code__.co_kwonlyargcount
    ]
    return {n: values[n] for n in wanted if n not in names}


def prepare(motion: Motion, choice: str) -> Found:
    shape = canonical(motion, choice=choice)
    clusters = cluster(motion, shape, **settings("bones", cluster))
    skinning = ssdr(motion, shape, clusters, **settings("bones", ssdr))
    surface = closed_surface(shape, **shipped("skeleton.surface"))
    return Found(motion, shape, skinning, surface, curve_skeleton(surface, **shipped("skeleton.curve")))


def thinned(motion: Motion) -> Motion:
    """Every third frame of every clip, as one clip a clip."""
    index = [np.arange(clip.start, clip.stop, STEP) for clip in motion.clips()]
    pieces = [slice(int(f), int(f) + 1) for clip in index for f in clip]
    return motion.take_frames(pieces, [str(i) for i in range(len(pieces))])


@pytest.fixture(scope="module", autouse=True)
def _one_thread_in_products():
    """As stages run in the workflow: spinning BLAS threads make small products crawl."""
    with threadpool_limits(1, user_api="blas"):
        yield


@pytest.fixture(scope="module")
def fox(shared_data) -> Found:
    path = shared_data / "rigged_quaternius" / "decoded" / "fox.npz"
    motion = rigged_character.load(path=str(path), fps=24.0, hierarchy="attached", unit="unit")
    return prepare(thinned(motion), "rest")


@pytest.fixture(scope="module")
def skeleton(fox) -> Skeleton:
    return fox.joints(joints_by_motion, "motion")


@pytest.mark.slow
def test_joints_of_a_fox_lie_where_its_rig_has_them(fox, skeleton):
    truth = counting_joints(fox.motion.rig, 5.0)
    size = diagonal(fox.canonical.points)
    ours = joint_scores(skeleton.joints, skeleton.parents, *truth, size)
    by_gradient = fox.joints(joints_by_gradient, "gradient")
    papers = joint_scores(by_gradient.joints, by_gradient.parents, *truth, size)
    assert ours["f1"] > 0.75
    assert ours["j2j"] < 1.8
    assert ours["link_f1"] > 0.75
    assert ours["f1"] > papers["f1"]
    assert ours["j2j"] < papers["j2j"]
    assert len(skeleton.joints) <= shipped("skeleton.motion")["max_joints"]


@pytest.mark.slow
def test_a_posed_fox_lies_on_its_points_and_its_joints_inside(fox, skeleton):
    assert skeleton.parents[0] == -1
    assert (skeleton.parents[1:] < np.arange(1, len(skeleton.parents))).all()
    assert (skeleton.parents[1:] >= 0).all()  # one root
    assert fox.lbs_percent(skeleton) < 0.15
    vertices, faces = fox.surface.vertices.astype(np.float64), fox.surface.faces.astype(np.int64)
    assert igl.fast_winding_number(vertices, faces, skeleton.joints.astype(np.float64)).min() > 0.5
    assert (skeleton.weights.sum(axis=0) > 0).all()


@pytest.mark.slow
def test_left_and_right_of_the_fox_have_as_many_joints(fox, skeleton):
    mirror = find_mirror(fox.surface)
    partners = mirror.partners(skeleton.joints)
    sides = (partners >= 0) & (partners != np.arange(len(partners)))
    across = (skeleton.joints - mirror.centre) @ mirror.normal
    assert np.sum(across[sides] > 0) == np.sum(across[sides] < 0) >= 8  # two or more joints a leg
    assert np.abs(across[~sides]).max() < 0.02 * mirror.size  # what has no partner lies in the middle


@pytest.mark.slow
def test_fewer_frames_give_the_fox_the_same_tree(fox, skeleton):
    some = fox.motion.take_frames([slice(0, int(0.8 * fox.motion.frames))], ["some"])
    clusters = cluster(some, fox.canonical, **settings("bones", cluster))
    skinning = ssdr(some, fox.canonical, clusters, **settings("bones", ssdr))
    found = replace(fox, motion=some, skinning=skinning).joints(joints_by_motion, "motion")
    assert abs(len(found.joints) - len(skeleton.joints)) <= 3
    truth = (skeleton.joints, skeleton.parents)
    scores = joint_scores(found.joints, found.parents, *truth, diagonal(fox.canonical.points))
    assert scores["f1"] > 0.85
    assert scores["link_f1"] > 0.85


@pytest.mark.slow
def test_poses_of_a_walking_fox_never_flip(shared_data, fox, skeleton):
    path = shared_data / "rigged_quaternius" / "decoded" / "fox.npz"
    motion = rigged_character.load(path=str(path), fps=24.0, hierarchy="attached", unit="unit")
    walk = next(c for c, name in zip(motion.clips(), motion.clip_names, strict=True) if "Walk" in name)
    poses = fit_poses(motion.take_frames([walk], ["walk"]), fox.canonical, skeleton, **shipped("skeleton.poses"))
    steps = np.degrees(geodesic(poses.rotations[1:], poses.rotations[:-1]))
    owned = np.bincount(skeleton.weights.argmax(axis=1), minlength=len(skeleton.joints)) > 0
    assert np.sum(~owned) <= 1  # a bone that was cut may leave a joint without points of its own, whose turn is open
    assert steps[:, owned].max() < 45.0
    transforms = kinematics.forward(skeleton.parents, skeleton.joints, poses.rotations, poses.translations)
    posed = skin(fox.canonical.points, skeleton.weights, transforms)
    true = np.linalg.norm(np.diff(motion.take_frames([walk], ["walk"]).points, axis=0), axis=2).max()
    assert np.linalg.norm(np.diff(posed, axis=0), axis=2).max() < 1.2 * true  # nor does any point jump


@pytest.mark.slow
def test_the_foxs_own_poses_come_back_from_its_points_alone(fox):
    """The rig's feet stretch away from their legs, which rotations cannot follow: hence the median."""
    skeleton = given_skeleton(fox.motion, fox.canonical)
    true = given_poses(fox.motion, fox.motion, fox.canonical, skeleton)
    transforms = kinematics.forward(skeleton.parents, skeleton.joints, true.rotations, true.translations)
    posed = skin(fox.canonical.points, skeleton.weights, transforms)
    assert vertex_rmse(posed, fox.motion.points) < 1e-5 * diagonal(fox.canonical.points)
    found = fit_poses(fox.motion, fox.canonical, skeleton, **shipped("skeleton.poses"))
    used = skeleton.weights.max(axis=0) > 0.5
    off = np.degrees(geodesic(found.rotations, true.rotations))[:, used]
    assert np.median(off) < 1.0
    assert np.percentile(off, 90) < 5.0


@pytest.mark.slow
def test_a_dancer_in_a_skirt_is_posed_by_the_tree_that_follows_her(shared_data):
    path = shared_data / "mesh_sequences" / "human_samba.npz"
    motion = mesh_sequence.load(path=str(path), fps=24.0, faces=True, unit="unit")
    samba = prepare(thinned(motion), "first")
    skeleton = samba.joints(joints_by_motion, "motion")
    assert 12 <= len(skeleton.joints) <= 32
    assert samba.lbs_percent(skeleton) < 0.5
    above = np.linalg.norm(skeleton.joints[1:] - skeleton.joints[skeleton.parents[1:]], axis=1)
    assert above.max() < 0.35 * diagonal(samba.canonical.points)  # no link across the body
