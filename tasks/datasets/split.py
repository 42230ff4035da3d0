"""Training and test frames that share nothing."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from scipy.spatial import cKDTree

from tasks.errors import InputError
from tasks.geometry.measure import diagonal
from tasks.values import Motion

SAME = 1e-5  # of the diagonal: two frames whose points all lie this close are the same frame
MOSTLY = 0.5  # a test clip of which more than this share repeats training frames tests nothing
LIVELY = 0.5  # of the median clip's movement: below this a clip is not chosen as a test by itself
STRETCH = 25  # frames of a clip, about a second, below which fewer clips give longer ones
LANDMARKS = 16  # points compared first when looking for equal frames


def split(
    motion: Motion,
    *,
    by: Literal["auto", "clips", "frames"],
    test: Annotated[list[str], "not test or by != 'frames': [] where by=frames holds out the end of every clip"],
    fraction: Annotated[float, "(0, 1)"],
    observed: Annotated[float, "(0, 1]"],
    frames: Annotated[int, "[2, inf)"] | None,
) -> tuple[Motion, Motion]:
    """(train, test), each contiguous run of frames a clip of its own, so that no window crosses a cut.

    by="clips": the clips named in `test`; when it is empty, :func:`choose_clips` picks about `fraction` of them.
    by="frames": the last `fraction` of every clip; `test` must be empty.
    by="auto": clips where there are several or some are named, else frames.
    observed: share of the training frames that is kept, from the first on (the paper's fig. 9); the test stays.
    frames: so many of them are kept in the end, in stretches from the beginnings of clips that lie evenly among all;
    None keeps all.

    Frames at which the test repeats a training frame (clips often start from one neutral pose) are left out of the
    test. Raises InputError when that takes more than half of a test clip (by="frames": of all test frames), when either
    side has no frames, and for unknown names.
    """
    if by == "auto":
        by = "clips" if test or len(motion.clip_names) > 1 else "frames"
    if by == "clips":
        train, held = _by_clips(motion, test, fraction)
    else:
        train, held = _by_frames(motion, fraction)
    test_motion = _without_repeats(train, held, each_clip=by == "clips")
    return _fewer(_prefix(train, observed), frames), test_motion


def _fewer(train: Motion, frames: int | None) -> Motion:
    """So many training frames, from as many clips as leave each a stretch of at least ``STRETCH``."""
    if frames is None:
        return train
    if frames > train.frames:
        expected = f"null, or at most the {train.frames} training frames"
        raise InputError("split.frames", expected=expected, found=str(frames))
    clips, lengths = train.clips(), np.diff(train.clip_start)
    for count in range(min(len(clips), max(1, frames // STRETCH)), len(clips) + 1):
        chosen = np.arange(count) * len(clips) // count
        if lengths[chosen].sum() >= frames:
            break
    longest = next(n for n in range(1, frames + 1) if np.minimum(lengths[chosen], n).sum() >= frames)
    kept = np.minimum(lengths[chosen], longest)
    surplus = int(kept.sum()) - frames  # of those that are cut, the last give a frame each
    kept[np.flatnonzero(kept == longest)[-surplus:] if surplus else []] -= 1
    pieces = [(slice(clips[c].start, clips[c].start + int(n)), c) for c, n in zip(chosen, kept, strict=True) if n]
    return train.take_frames([p for p, _ in pieces], [train.clip_names[c] for _, c in pieces])


def _prefix(train: Motion, share: float) -> Motion:
    """The first frames of the training motion, at least two."""
    stop = max(2, round(share * train.frames))
    if stop >= train.frames:
        return train
    runs = [slice(c.start, min(c.stop, stop)) for c in train.clips() if c.start < stop]
    return train.take_frames(runs, list(train.clip_names[: len(runs)]))


def choose_clips(motion: Motion, count: int) -> list[int]:
    """Picks test clips by rule, never by result: the same data always give the same clips.

    A clip qualifies when it moves at least half as much as the median clip (see :func:`liveliness`: idle clips, which
    barely move, test nothing) and when at most half of its frames occur in another clip. The qualified are put in order
    of movement, cut into `count` equal stretches, and the middle one of each is taken: calm and lively, no extremes.
    """
    moves = liveliness(motion)
    qualified = [
        c
        for c, frames in enumerate(motion.clips())
        if moves[c] >= LIVELY * np.median(moves)
        and np.mean(_repeats(_others(motion, c), motion.points[frames]) >= 0) <= MOSTLY
    ]
    if not qualified:
        raise InputError(
            "split.test",
            expected="a clip that moves and does not repeat another",
            found="none",
            do="name the test clips, or set split.by=frames",
        )
    count = min(count, len(qualified))
    ordered = sorted(qualified, key=lambda c: (moves[c], c))
    return sorted(ordered[int((i + 0.5) * len(ordered) / count)] for i in range(count))


def liveliness(motion: Motion) -> np.ndarray:
    """How much each clip moves: RMS distance of the points from the clip's mean shape once every frame is shifted to
    one centroid, in the data's unit. (C,)"""
    out = []
    for frames in motion.clips():
        shape = motion.points[frames].astype(np.float64)
        shape -= shape.mean(1, keepdims=True)
        out.append(np.sqrt(((shape - shape.mean(0)) ** 2).sum(-1).mean()))
    return np.array(out)


def _by_clips(motion: Motion, test: list[str], fraction: float) -> tuple[Motion, Motion]:
    names = motion.clip_names
    if len(names) < 2:
        raise InputError(
            "split.by", expected="at least two clips", found=f"one clip in {motion.name}", do="set split.by=frames"
        )
    unknown = [name for name in test if name not in names]
    if unknown:
        raise InputError("split.test", expected=f"names among {_list(names)}", found=_list(unknown))
    if test:
        chosen = [c for c, name in enumerate(names) if name in test]
    else:
        chosen = choose_clips(motion, min(max(1, round(fraction * len(names))), len(names) - 1))
    kept = [c for c in range(len(names)) if c not in chosen]
    if not kept:
        raise InputError("split.test", expected="a clip left to train on", found="every clip named as a test")
    return motion.take_clips(kept), motion.take_clips(chosen)


def _by_frames(motion: Motion, fraction: float) -> tuple[Motion, Motion]:
    cuts = [(c.start, c.stop - round(fraction * (c.stop - c.start)), c.stop) for c in motion.clips()]
    train = [(slice(a, cut), name) for (a, cut, _), name in zip(cuts, motion.clip_names, strict=True) if cut > a]
    test = [(slice(cut, b), name) for (_, cut, b), name in zip(cuts, motion.clip_names, strict=True) if b > cut]
    for side, runs in (("training", train), ("test", test)):
        if not runs:
            longest = int(np.diff(motion.clip_start).max())
            found = f"zero frames with split.fraction={fraction} of clips of {longest} frames at most"
            raise InputError("split.fraction", expected=f"{side} frames", found=found, do="change split.fraction")
    return tuple(motion.take_frames([p for p, _ in runs], [n for _, n in runs]) for runs in (train, test))


def _without_repeats(train: Motion, test: Motion, *, each_clip: bool) -> Motion:
    """The test without frames that training has; InputError where that takes the most of it (or of each clip)."""
    source = _repeats(train.points, test.points)
    if (source < 0).all():
        return test
    for run in test.clips() if each_clip else [slice(0, test.frames)]:
        if np.mean(source[run] >= 0) > MOSTLY:
            _mostly_repeated(train, test, run, source)
    runs, names = [], []
    for name, clip in zip(test.clip_names, test.clips(), strict=True):
        edges = clip.start + np.flatnonzero(np.diff(np.concatenate([[True], source[clip] >= 0, [True]])))
        for k, (a, b) in enumerate(zip(edges[::2], edges[1::2], strict=True)):
            runs.append(slice(int(a), int(b)))
            names.append(name if k == 0 else f"{name} ({k + 1})")
    return test.take_frames(runs, names)


def _mostly_repeated(train: Motion, test: Motion, run: slice, source: np.ndarray) -> None:
    repeated = run.start + np.flatnonzero(source[run] >= 0)
    here, there = int(repeated[0]), int(source[repeated[0]])
    raise InputError(
        f"{test.name}: test clip {_place(test, here)}",
        expected="frames that training does not have",
        found=f"{len(repeated)} of {run.stop - run.start} that repeat training frames exactly, the first one that of "
        f"clip {_place(train, there)}",
        do="remove repeated frames from the data, or choose other test clips (split.test) or another split.fraction",
    )


def _repeats(known: np.ndarray, asked: np.ndarray) -> np.ndarray:
    """For each frame asked, the first known frame with the same points, or -1. known: (F, N, 3); asked: (G, N, 3)."""
    step = max(1, known.shape[1] // LANDMARKS)
    near = SAME * diagonal(known[0])
    marks = cKDTree(known[:, ::step].reshape(len(known), -1))
    out = np.full(len(asked), -1, np.int64)
    # a frame within `near` in every coordinate lies within `near` in the maximum norm of the landmarks
    for g, close in enumerate(marks.query_ball_point(asked[:, ::step].reshape(len(asked), -1), near, p=np.inf)):
        equal = [f for f in close if np.abs(known[f] - asked[g]).max() <= near]
        out[g] = min(equal, default=-1)
    return out


def _others(motion: Motion, clip: int) -> np.ndarray:
    frames = motion.clips()[clip]
    return np.delete(motion.points, np.r_[frames], axis=0)


def _place(motion: Motion, frame: int) -> str:
    clip = int(np.searchsorted(motion.clip_start, frame, side="right")) - 1
    return f"{motion.clip_names[clip]}, frame {frame - motion.clip_start[clip]}"


def _list(names: list[str] | tuple[str, ...]) -> str:
    return ", ".join(names)
