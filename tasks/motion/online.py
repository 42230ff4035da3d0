"""Matching as poses come in: one at a time, without looking ahead."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.sparse import csr_matrix

from tasks.motion.affine import REACH, Space, describe, nearest_moments, space
from tasks.motion.blending import Sources, window_weights
from tasks.motion.matching import Prepared, believed, merged
from tasks.motion.posed import Posed
from tasks.motion.search import Keys, frame_distances
from tasks.values import Poses

DELAY = 2  # frames until the root's acceleration is known: dynamics are compared as they were then


class WindowSearch:
    """The windows nearest to the latest frames of a stream, exactly.

    The distances of a frame to all frames of the database are computed when it comes and kept while it lies in the
    window; a window's distance is their sum along a diagonal, so a new frame costs one row instead of ``patch``.
    """

    def __init__(self, database: Keys, *, k: int, patch: int) -> None:
        self.database, self.patch = database, patch
        frames = len(database.rotations)
        last = database.clip_start[1:, None] - np.arange(1, patch)  # windows that would cross a clip's end
        whole = np.ones(frames, bool)
        whole[last[last >= np.repeat(database.clip_start[:-1, None], patch - 1, 1)]] = False
        self._starts = np.flatnonzero(whole)
        self.k = min(k, len(self._starts))
        self._rows: list[np.ndarray] = []

    def restart(self) -> None:
        """Forgets the frames that came before."""
        self._rows = []

    def push(self, rotations: np.ndarray, extra: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A new frame, (J, 4) quaternions and (E, 3) vectors -> (k,) mean angles in radians and (k,) last frames of the
        nearest windows, the nearest first. The first frame of a motion also stands for those before it."""
        database, patch = self.database, self.patch
        row = frame_distances(rotations[None], extra[None], database, 0, len(database.rotations))[0]
        self._rows = [*self._rows[1 - patch :], row] if patch > 1 and self._rows else [row] * patch
        total = self._rows[0][: len(row) - patch + 1].copy()
        for i in range(1, patch):
            total += self._rows[i][i : i + len(total)]
        total = total[self._starts]
        near = np.argpartition(total, self.k - 1)[: self.k]
        near = near[np.lexsort((near, total[near]))]
        return total[near] / (patch * database.scale), self._starts[near] + patch - 1


class Online:
    """Poses in, points out, one frame at a time: as :func:`tasks.motion.matching.match` with the one level of windows
    that end at the latest frame, of which the last frames are blended. Raises nothing: poses are not checked."""

    def __init__(self, ready: Prepared) -> None:
        self._ready = ready
        known, way = ready.known, ready.way
        self._searches = [
            WindowSearch(_delayed(known.keys(part, way.dynamics)), k=way.k, patch=way.patch)
            for part in range(len(ready.parts))
        ]
        self._spaces = [
            space(search.database, store.heavy, way.every) if way.sources else None
            for search, store in zip(self._searches, ready.parts, strict=True)
        ]
        skinning = known.training.skinning
        weights = csr_matrix(skinning.weights.astype(np.float64))
        ones = np.ones((len(skinning.rest), 1))
        self._weights, self._rest = weights, np.concatenate([skinning.rest, ones], axis=1)
        self._past: list[tuple[np.ndarray, np.ndarray]] = []
        self._keys: list[tuple[np.ndarray, np.ndarray]] = []

    def restart(self) -> None:
        """Begins a new motion."""
        self._past, self._keys = [], []
        for search in self._searches:
            search.restart()

    def pose(self, rotations: np.ndarray, translations: np.ndarray) -> np.ndarray:
        """One pose, (J, 3, 3) and (J, 3) as in :class:`Poses` -> (N, 3) points."""
        ready, training = self._ready, self._ready.known.training
        self._past = [*self._past[-2 * DELAY :], (rotations, translations)]
        now = Poses(rotations[None], translations[None], np.array([0, 1]))
        asked = Posed(training, now, ready.known)
        moving = self._moving()
        self._keys = [*self._keys[-REACH:], (asked.quaternions[0], moving)]
        rows = []
        for part, search in enumerate(self._searches):
            if ready.way.sources:
                rows.append(self._moments(part, self._spaces[part]))
                continue
            turns = asked.quaternions[0, ready.known.key_joints(part)]
            distance, frame = search.push(turns, moving)
            share = window_weights(distance[None], ready.way.temperature)
            rows.append(Sources(frame[None].astype(np.int32), share, np.array([len(frame)])))
        bones = asked.decode(believed(ready, merged(asked, ready, rows)), ready.way.represent)[0]
        blended = (self._weights @ bones.reshape(len(bones), 12)).reshape(-1, 3, 4)
        return np.einsum("nij,nj->ni", blended, self._rest).astype(np.float32)

    def _moments(self, part: int, known: Space) -> Sources:
        """The moments nearest to the latest pose and its past."""
        joints = self._ready.known.key_joints(part)
        turns, moving = (np.stack(x) for x in zip(*self._keys, strict=True))
        told = describe(Keys(turns[:, joints], moving, np.array([0, len(turns)])), known)[-1:]
        return nearest_moments(told, known, self._ready.way.sources)

    def _moving(self) -> np.ndarray:
        """The root's dynamics some frames ago, (E, 3), as the delayed keys of the database hold them."""
        if self._ready.way.dynamics == 0:
            return np.zeros((0, 3), np.float32)
        rotations, translations = (np.stack(x) for x in zip(*self._past, strict=True))
        poses = Poses(rotations, translations, np.array([0, len(rotations)]))
        past = Posed(self._ready.known.training, poses, self._ready.known)
        return (self._ready.way.dynamics * past.dynamics[max(len(rotations) - 1 - DELAY, 0)]).astype(np.float32)


def _delayed(keys: Keys) -> Keys:
    """Keys whose dynamics are those of some frames earlier in the clip."""
    if keys.extra.shape[1] == 0:
        return keys
    index = np.concatenate([np.maximum(np.arange(a, b) - DELAY, a) for a, b in pairwise(keys.clip_start)])
    return Keys(keys.rotations, keys.extra[index], keys.clip_start)
