"""Dem Bones (Le & Deng 2012 and 2014; Electronic Arts, BSD) over py-dem-bones: the peer of our bones.

An extra that only benchmarks need, so it is imported where it is used.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tasks.errors import InputError
from tasks.values import Canonical, Motion, Skinning


def prepare(
    motion: Motion, canonical: Canonical, *, bones: int, influences: int, smooth: float | None, affine: float | None
) -> Callable[[], object]:
    """The peer with its data handed over, ready to run: a function that computes and returns the solver, once.

    bones, influences: as ours have them; smooth, affine: its
    settings weightsSmooth and transAffine, None leaves them as they come. All else stays as it comes. It may find
    fewer bones than asked for. Raises InputError where the extra is missing or the motion has no faces, which it
    needs.
    """
    if motion.faces is None:
        raise InputError("Motion.faces", expected="triangles, which the peer needs", found="bare points")
    native = _library()()
    if smooth is not None:
        native.weightsSmooth = smooth
    if affine is not None:
        native.transAffine = affine
    frames, points = motion.points.shape[:2]
    native.nV, native.nF, native.nS, native.nB, native.nnz = points, frames, 1, bones, min(influences, bones)
    native.fStart = np.array([0, frames], np.int32)
    native.subjectID = np.zeros(frames, np.int32)
    native.u = np.ascontiguousarray(canonical.points.T, np.float64)
    native.v = np.ascontiguousarray(motion.points.transpose(0, 2, 1).reshape(3 * frames, points), np.float64)
    native.fv = motion.faces.tolist()

    def compute() -> object:
        native.compute()
        return native

    return compute


def _library() -> Callable[[], object]:
    try:
        from py_dem_bones import DemBones
    except ImportError:
        do = 'pip install -e ".[bench]"'
        raise InputError("benchmark", expected="the package py-dem-bones", found="none", do=do) from None
    return DemBones


def skinning(native: object, canonical: Canonical) -> Skinning:
    """What a solver has found, in our terms."""
    weights = np.asarray(native.get_weights(), np.float64).T  # (N, B)
    blocks = np.asarray(native.m, np.float64).reshape(native.nF, 4, native.nB, 4)
    transforms = blocks.transpose(0, 2, 1, 3)[:, :, :3]
    rest = canonical.points.astype(np.float32)
    return Skinning(rest, weights.astype(np.float32), transforms.astype(np.float32), np.zeros(0))
