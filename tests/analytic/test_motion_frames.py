"""Kernels on bones as frames, against the small matrix products that they stand for."""

from __future__ import annotations

import numpy as np
import pytest

from tasks.geometry import rigid
from tasks.geometry.rotations import from_rotation_vector
from tasks.motion.frames import placed, seen_from


def some(*shape: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rigid.make(from_rotation_vector(rng.normal(size=(*shape, 3))), rng.normal(size=(*shape, 3)))


def test_a_frame_stands_where_its_bone_s_centroid_is():
    transforms, centres = some(5, 4, seed=1), np.random.default_rng(2).normal(size=(4, 3))
    out = np.empty_like(transforms)
    placed(transforms, centres, out)
    np.testing.assert_allclose(out, rigid.make(transforms[..., :3], rigid.apply(transforms, centres)), atol=1e-14)


@pytest.mark.parametrize("bones", [1, 4])
def test_frames_seen_from_others(bones):
    base, frames = some(5, bones, seed=3), some(5, 4, seed=4)
    want = rigid.compose(rigid.inverse(base), frames)
    seen_from(base, frames, frames)  # in place
    np.testing.assert_allclose(frames, want, atol=1e-14)
