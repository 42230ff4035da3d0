"""Binding on a real animated animal and on the embedded creature with soft parts."""

from __future__ import annotations

from functools import partial
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from flows import schema
from tasks.bones.clustering import cluster
from tasks.bones.ssdr import ssdr
from tasks.datasets import creature, rigged_character
from tasks.datasets.canonical import canonical
from tasks.geometry.kinematics import forward
from tasks.geometry.measure import diagonal, vertex_rmse
from tasks.motion.database import build_database
from tasks.motion.parts import find_parts
from tasks.skeleton.given import given_poses, given_skeleton
from tasks.values import Motion, Skinning, Training

CONF = Path(__file__).resolve().parents[2] / "conf"


def as_shipped(method: str):
    """The method with the settings of its own file: query and training in, animation out; and its parts' settings."""
    with initialize_config_dir(str(CONF), version_base=None):
        config = OmegaConf.to_container(compose(overrides=[f"+method={method}"]))
    function = config["animate"]["function"]
    settings = schema.arguments(schema.animate_function(function), config["animate"], seed=0)
    return partial(import_module(f"tasks.methods.{function}").animate, **settings), config["parts"]


def halves(motion: Motion, test: list[str]) -> tuple[Motion, Motion]:
    held = [motion.clip_names.index(name) for name in test]
    return motion.take_clips([c for c in range(len(motion.clip_names)) if c not in held]), motion.take_clips(held)


def bind(train: Motion, parts: dict, skinning: Skinning | None = None) -> Training:
    """The data's own skeleton; its joints as bones where no other bones are given."""
    shape = canonical(train, choice="rest")
    skeleton = given_skeleton(train, shape)
    poses = given_poses(train, train, shape, skeleton)
    if skinning is None:
        world = forward(skeleton.parents, skeleton.joints, poses.rotations, poses.translations)
        skinning = Skinning(shape.points, skeleton.weights, world, np.zeros((0, 2)))
    found = find_parts(skeleton, skinning, **parts)
    return Training(train, shape, skinning, skeleton, build_database(train, skinning, poses), found)


def error(method: str, train: Motion, test: Motion, skinning: Skinning | None = None) -> float:
    """Vertex RMSE as a part of the diagonal."""
    animate, parts = as_shipped(method)
    training = bind(train, parts, skinning)
    made = animate(training, given_poses(test, train, training.canonical, training.skeleton))
    return vertex_rmse(made.points, test.points) / diagonal(training.canonical.points)


@pytest.fixture(scope="module")
def horse(shared_data) -> tuple[Motion, Motion]:
    path = shared_data / "rigged_quaternius" / "decoded" / "horse.npz"
    motion = rigged_character.load(path=str(path), fps=24.0, hierarchy="attached", unit="unit")
    return halves(motion, ["Gallop", "Attack_Kick", "Death"])


def test_a_horse_has_four_legs(horse):
    legs = ("FrontShoulder.L", "FrontShoulder.R", "BackShoulder.L", "BackShoulder.R")
    assert bind(horse[0], as_shipped("partmm")[1]).parts.names == ("torso", *legs)


@pytest.mark.parametrize("method", ["partmm", "fullmm", "partmm_plus"])
def test_training_clips_of_a_horse_come_back(horse, method):
    assert error(method, horse[0], horse[0]) < 1e-3


def test_parts_beat_the_whole_and_the_nearest_frame_on_unseen_clips_of_a_horse(horse):
    by_part = error("partmm", *horse)
    assert by_part < 0.8 * error("fullmm", *horse)
    assert by_part < error("nearest", *horse)


TUNED = [pytest.param(name, marks=pytest.mark.slow) for name in ("part_kernel", "bone_response")]


@pytest.mark.parametrize("method", ["lbs_fitted", "lbs_residual", "partmm_plus", *TUNED])
def test_skinning_is_exact_on_a_horse_and_nothing_spoils_it(horse, method):
    """These files are linear blend skinning: residuals are nearly zero, and nobody may make them worse."""
    assert error("lbs", *horse) < 1e-5
    assert error(method, *horse) < 5e-3


def test_sources_are_training_frames_and_unseen_poses_are_farther(horse):
    train, test = horse
    animate, parts = as_shipped("partmm")
    training = bind(train, parts)
    far = animate(training, given_poses(test, train, training.canonical, training.skeleton))
    near = animate(training, training.database.poses)
    assert far.sources.min() >= 0
    assert far.sources.max() < train.frames
    assert near.distance.max() < 1e-4 < far.distance.min()


@pytest.mark.slow
def test_on_a_figure_in_a_skirt_ours_beat_skinning_on_unseen_clips():
    """The creature's soft parts lag and swing, which no skinning can show."""
    motion = creature.load(subject="figure", frames_per_clip=50, vertices=6000, softness=1.0, seed=0)
    train, test = halves(motion, ["kick", "spin"])
    shape = canonical(train, choice="rest")
    node = OmegaConf.to_container(OmegaConf.load(CONF / "bones" / "ssdr.yaml"))
    clusters = cluster(train, shape, **schema.arguments(schema.CLUSTER, node, seed=0))
    bones = ssdr(train, shape, clusters, **schema.arguments(schema.SSDR, node, seed=0))
    made = {m: error(m, train, test, bones) for m in ("lbs", "fullmm", "partmm", "partmm_plus", "part_kernel")}
    made["bone_response"] = error("bone_response", train, test, bones)
    assert made["partmm_plus"] < made["partmm"] < made["fullmm"]
    assert made["part_kernel"] < made["lbs"]  # its settings are chosen on garments, which swing less
    assert made["bone_response"] < 0.95 * made["lbs"]
