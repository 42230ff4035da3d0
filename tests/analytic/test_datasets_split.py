"""Splits that share nothing, and the canonical frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tasks.datasets.canonical import canonical
from tasks.datasets.split import choose_clips, liveliness, split
from tasks.errors import InputError
from tasks.values import Motion, Rig


def random_motion(lengths: list[int], sizes: list[float] | None = None, seed: int = 0) -> Motion:
    """Clips of random frames round one shape; clip c moves by sizes[c]."""
    rng = np.random.default_rng(seed)
    shape = rng.normal(size=(1, 12, 3))
    sizes = sizes or [1.0] * len(lengths)
    points = np.concatenate([shape + s * rng.normal(size=(n, 12, 3)) for n, s in zip(lengths, sizes, strict=True)])
    names = tuple(f"clip{c}" for c in range(len(lengths)))
    start = np.concatenate([[0], np.cumsum(lengths)])
    return Motion("noise", points.astype(np.float32), None, start, names, 24.0)


def test_named_clips():
    motion = random_motion([5, 6, 7])
    train, test = split(motion, by="clips", test=["clip1"], fraction=0.5, observed=1.0, frames=None)
    assert (train.clip_names, test.clip_names) == (("clip0", "clip2"), ("clip1",))
    np.testing.assert_array_equal(test.points, motion.points[5:11])
    np.testing.assert_array_equal(train.points, np.delete(motion.points, np.r_[5:11], axis=0))
    assert train.clip_start.tolist() == [0, 5, 12]


def test_last_frames_of_every_clip():
    motion = random_motion([10, 5])
    train, test = split(motion, by="frames", test=[], fraction=0.2, observed=1.0, frames=None)
    assert (train.clip_start.tolist(), test.clip_start.tolist()) == ([0, 8, 12], [0, 2, 3])
    np.testing.assert_array_equal(test.points, motion.points[[8, 9, 14]])


@settings(max_examples=60, deadline=None)
@given(
    lengths=st.lists(st.integers(1, 9), min_size=1, max_size=6),
    by=st.sampled_from(["clips", "frames"]),
    fraction=st.floats(0.01, 0.99),
)
def test_no_frame_is_on_both_sides_and_none_is_lost(lengths, by, fraction):
    motion = random_motion(lengths)
    motion.points[:, 0, 0] = np.arange(motion.frames)  # tells the frames apart
    try:
        train, test = split(motion, by=by, test=[], fraction=fraction, observed=1.0, frames=None)
    except InputError:
        return
    sides = [side.points[:, 0, 0].astype(int) for side in (train, test)]
    assert sorted(np.concatenate(sides)) == list(range(motion.frames))
    for side, frames in zip((train, test), sides, strict=True):
        for clip in side.clips():  # no window crosses a cut: every clip is a run of one original clip
            assert np.all(np.diff(frames[clip]) == 1)
            assert len(set(np.searchsorted(motion.clip_start, frames[clip], side="right"))) == 1


def test_the_rig_is_split_along():
    motion = random_motion([4, 4])
    rotations = np.tile(np.eye(3, dtype=np.float32), (8, 2, 1, 1))
    shifts = np.arange(8 * 6, dtype=np.float32).reshape(8, 2, 3)
    rig = Rig(("a", "b"), np.array([-1, 0], np.int32), np.zeros((2, 3)), np.ones((12, 2)) / 2, rotations, shifts)
    train, test = split(replace(motion, rig=rig), by="clips", test=["clip0"], fraction=0.5, observed=1.0, frames=None)
    np.testing.assert_array_equal(train.rig.translations, shifts[4:])
    np.testing.assert_array_equal(test.rig.translations, shifts[:4])


def test_a_sequence_that_repeats_itself_is_refused():
    once = random_motion([24]).points
    motion = Motion("gallop", np.concatenate([once, once]), None, np.array([0, 48]), ("gallop",), 24.0)
    for fraction in (0.2, 0.5, 0.6):
        with pytest.raises(InputError, match="repeat training frames"):
            split(motion, by="frames", test=[], fraction=fraction, observed=1.0, frames=None)


def test_single_repeats_are_left_out_of_the_test():
    motion = random_motion([6, 7])
    motion.points[6] = motion.points[0]  # both clips start from one pose
    motion.points[9] = motion.points[3] + 1e-7
    _, test = split(motion, by="clips", test=["clip1"], fraction=0.5, observed=1.0, frames=None)
    assert test.clip_names == ("clip1", "clip1 (2)")
    np.testing.assert_array_equal(test.points, motion.points[[7, 8, 10, 11, 12]])
    assert test.clip_start.tolist() == [0, 2, 5]


def test_a_copied_clip_is_refused_as_a_test_and_never_chosen():
    motion = random_motion([6, 6, 6, 6])
    motion.points[6:12] = motion.points[5::-1]  # clip1 is clip0 backwards
    with pytest.raises(InputError, match=r"clip1, frame 0.*clip0, frame 5"):
        split(motion, by="clips", test=["clip1"], fraction=0.5, observed=1.0, frames=None)
    assert choose_clips(motion, 4) == [2, 3]
    split(
        motion, by="clips", test=["clip0", "clip1"], fraction=0.5, observed=1.0, frames=None
    )  # together they are unseen


def test_clips_that_barely_move_are_not_chosen():
    motion = random_motion([8] * 6, [0.01, 1.0, 1.2, 0.9, 0.01, 1.1])
    order = np.argsort(liveliness(motion))
    assert set(order[:2]) == {0, 4}
    assert choose_clips(motion, 2) == sorted([order[3], order[5]])
    assert choose_clips(motion, 2) == choose_clips(motion, 2)


def test_liveliness_by_hand():
    """Two frames that differ by a shift do not move; two points swinging by +-1 move by one."""
    swing = np.zeros((2, 4, 3), np.float32)
    swing[0, :, 0], swing[1, :, 0] = (1, 1, -1, -1), (-1, -1, 1, 1)
    shift = np.zeros((2, 4, 3), np.float32)
    shift[1] = 5.0
    motion = Motion("m", np.concatenate([shift, swing]), None, np.array([0, 2, 4]), ("shift", "swing"), 24.0)
    np.testing.assert_allclose(liveliness(motion), [0.0, 1.0])


@pytest.mark.parametrize(
    ("lengths", "by", "test", "fraction", "says"),
    [
        ([5, 5], "clips", ["clip7"], 0.5, "names among clip0, clip1, found clip7"),
        ([5, 5], "clips", ["Clip0"], 0.5, "found Clip0"),
        ([5, 5], "clips", ["clip0", "clip1"], 0.5, "left to train on"),
        ([5], "clips", [], 0.5, "set split.by=frames"),
        ([5, 5], "frames", [], 0.01, "expected test frames, found zero"),
        ([5, 5], "frames", [], 0.99, "expected training frames, found zero"),
    ],
)
def test_impossible_splits(lengths, by, test, fraction, says):
    with pytest.raises(InputError) as caught:
        split(random_motion(lengths), by=by, test=test, fraction=fraction, observed=1.0, frames=None)
    assert says in str(caught.value)


def test_canonical_frames():
    motion = replace(random_motion([5]), rest=np.ones((12, 3), np.float32))
    assert canonical(motion, choice="first").frame == 0
    assert canonical(motion, choice="middle").frame == 2
    np.testing.assert_array_equal(canonical(motion, choice="middle").points, motion.points[2])
    rest = canonical(motion, choice="rest")
    assert rest.frame == -1
    np.testing.assert_array_equal(rest.points, motion.rest)
    with pytest.raises(InputError, match="rest shape"):
        canonical(replace(motion, rest=None), choice="rest")


@pytest.mark.parametrize("faces", [None, np.array([[0, 1, 2], [0, 2, 3], [3, 4, 5], [5, 6, 7]], np.int32)])
def test_least_deformed_is_the_frame_in_the_middle_of_a_stretch(faces):
    """Scales 1, 1.1, 1.25, 1.8, 2: the summed squared change is least for the scale nearest the mean, 1.43."""
    shape = np.random.default_rng(3).normal(size=(12, 3))
    points = (np.array([2.0, 1.25, 1.0, 1.8, 1.1])[:, None, None] * shape).astype(np.float32)
    motion = Motion("stretch", points, faces, np.array([0, 5]), ("stretch",), 24.0)
    assert canonical(motion, choice="least_deformed").frame == 1


def test_auto_takes_clips_where_there_are_several():
    several, one = random_motion([5, 6, 7]), random_motion([10])
    assert split(several, by="auto", test=[], fraction=0.3, observed=1.0, frames=None)[1].clip_names in [
        ("clip0",),
        ("clip1",),
        ("clip2",),
    ]
    assert split(one, by="auto", test=[], fraction=0.2, observed=1.0, frames=None)[1].frames == 2


def test_observed_keeps_the_first_training_frames_and_the_whole_test():
    motion = random_motion([6, 5, 7])
    train, test = split(motion, by="clips", test=["clip1"], fraction=0.5, observed=0.6, frames=None)
    assert train.clip_start.tolist() == [0, 6, 8]
    assert train.clip_names == ("clip0", "clip2")
    np.testing.assert_array_equal(train.points, motion.points[[*range(6), 11, 12]])
    assert test.frames == 5


@pytest.mark.parametrize("frames", [2, 24, 60, 61, 99, 130])
def test_fewer_frames_come_in_stretches_from_clips_far_apart(frames):
    motion = random_motion([30, 50, 20, 40, 20])
    train, test = split(motion, by="clips", test=["clip4"], fraction=0.5, observed=1.0, frames=frames)
    assert train.frames == frames
    assert test.frames == 20
    assert min(np.diff(train.clip_start)) >= min(frames, 20)
    for name, clip in zip(train.clip_names, train.clips(), strict=True):
        source = motion.clips()[motion.clip_names.index(name)]
        np.testing.assert_array_equal(train.points[clip], motion.points[source][: clip.stop - clip.start])
    with pytest.raises(InputError, match=r"split\.frames.*at most the 140"):
        split(motion, by="clips", test=["clip4"], fraction=0.5, observed=1.0, frames=141)
