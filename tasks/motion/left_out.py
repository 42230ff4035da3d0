"""A training set without one of its clips: what a number owes to single clips, and what settings are chosen by."""

from __future__ import annotations

import numpy as np

from tasks.errors import InputError
from tasks.motion.database import build_database
from tasks.values import Database, Motion, Poses, Skinning


def leave_out(
    train: Motion, test: Motion, skinning: Skinning, poses: Poses, query: Poses, *, run: int, runs: int
) -> tuple[Motion, Skinning, Database, Poses, Motion]:
    """Training motion, bones and database without one clip, and what is then asked: the test clips, and after them the
    one left out. (motion, skinning, database, asked, truth)

    run: which, of ``runs`` clips that lie evenly among those of training; all in turn where there are ``runs`` of
    them. A motion of one clip gives up one of ``runs`` stretches of equal length. Bones keep their weights, which all
    training clips made: the same for every method. Raises InputError where fewer clips than ``runs`` are there.
    """
    count = len(train.clip_names)
    if count == 1:
        if not 2 <= runs <= train.frames:
            expected = f"2 to {train.frames} stretches of the one training clip"
            raise InputError("evaluate.left_out", expected=expected, found=str(runs))
        edges = np.linspace(0, train.frames, runs + 1).round().astype(int)
        held = slice(int(edges[run]), int(edges[run + 1]))
        kept = [p for p in (slice(0, held.start), slice(held.stop, train.frames)) if p.stop > p.start]
        names, name = [f"{train.clip_names[0]} ({i + 1})" for i in range(len(kept))], train.clip_names[0]
    else:
        if runs > count:
            raise InputError("evaluate.left_out", expected=f"at most the {count} training clips", found=str(runs))
        chosen = run * count // runs
        held, name = train.clips()[chosen], train.clip_names[chosen]
        kept = [clip for clip in train.clips() if clip != held]
        names = [n for c, n in enumerate(train.clip_names) if c != chosen]
    motion = train.take_frames(kept, names)
    index = np.concatenate([np.arange(p.start, p.stop) for p in kept])
    bones = Skinning(skinning.rest, skinning.weights, skinning.transforms[index], skinning.history)
    known = Poses(poses.rotations[index], poses.translations[index], motion.clip_start)
    start = np.append(query.clip_start, len(query.rotations) + held.stop - held.start)
    asked = Poses(
        np.concatenate([query.rotations, poses.rotations[held]]),
        np.concatenate([query.translations, poses.translations[held]]),
        start.astype(np.int64),
    )
    truth = Motion(
        test.name,
        np.concatenate([test.points, train.points[held]]),
        test.faces,
        asked.clip_start,
        (*test.clip_names, f"{name} (left out)"),
        test.fps,
        test.unit,
    )
    return motion, bones, build_database(motion, bones, known), asked, truth
