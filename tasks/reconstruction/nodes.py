"""Deformation by control nodes on four levels, each node's turn and shift a cubic B-spline over time.

Gaussians follow their four nearest fine nodes by linear blend skinning, as in SC-GS (Huang et al. 2024). A fine node
follows the nodes of the coarser levels in turn (256 after 64 after 16 after one for all), so that a limb can swing by
one parameter and a stiff rigidity term still converges.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import torch
from scipy.spatial import cKDTree

from tasks.reconstruction.deformed import Deformed
from tasks.reconstruction.skin import Skin
from tasks.reconstruction.splines import Spline

BOUND = 4  # nodes that a Gaussian follows
COARSER = 4  # every level has a quarter of the nodes of the one below
FEWEST = 8  # a level of fewer nodes is left to the one node for all


class Nodes:
    """centres: (S, 3) nodes of all levels, the finest first; level: (S,) int64; table: (knots, S, 7) float32, what is
    added to the unit quaternion (w x y z) and the shift, the parameter."""

    def __init__(self, spline: Spline, centres: np.ndarray, level: np.ndarray, table: np.ndarray) -> None:
        self.spline, self.centres, self.level = spline, centres, level
        self.table = torch.from_numpy(table).requires_grad_()
        fine = centres[level == 0]
        self.count = len(fine)
        self.rest = torch.from_numpy(fine)
        self._all = torch.from_numpy(centres)
        self._unit = torch.tensor([1.0, 0, 0, 0, 0, 0, 0])
        self._follow = [torch.from_numpy(_follow(fine, centres[level == k])) for k in range(1, int(level.max()) + 1)]
        self._sizes = np.bincount(level).tolist()
        self._last = torch.tensor([0.0, 0, 0, 1]).expand(self.count, 1, 4)
        self._tree = cKDTree(fine)
        self._radius = float(np.median(self._tree.query(fine, k=2)[0][:, 1])) if len(fine) > 1 else 1.0
        self._inner = torch.from_numpy(np.concatenate([np.arange(a, b - 2) for a, b in pairwise(spline.clip_knots)]))
        self.index = self.weights = None

    @classmethod
    def placed(cls, spline: Spline, points: np.ndarray, count: int) -> Nodes:
        """Nodes spread over the points, at rest."""
        chosen, level = [], []
        while count >= FEWEST or not chosen:
            spread = points[farthest(points, min(count, len(points)))]
            chosen.append(spread)
            level += [len(chosen) - 1] * len(spread)
            count //= COARSER
        chosen.append(points.mean(0, keepdims=True))
        centres = np.concatenate(chosen).astype(np.float32)
        level = np.array([*level, len(chosen) - 1])
        return cls(spline, centres, level, np.zeros((spline.knots, len(centres), 7), np.float32))

    def bind(self, means: np.ndarray) -> None:
        """Chooses the nodes that each Gaussian follows, and how much. means: (N, 3) at rest."""
        far, index = self._tree.query(means, k=min(BOUND, self.count))
        far, index = far.reshape(len(means), -1), index.reshape(len(means), -1)
        # at the distance of its nearest node a Gaussian far from all still follows somebody
        weights = np.exp(-(far**2 - far[:, :1] ** 2) / (2 * self._radius**2))
        weights /= weights.sum(1, keepdims=True)
        self.index = torch.from_numpy(np.ascontiguousarray(index, np.int32))
        self.weights = torch.from_numpy(np.ascontiguousarray(weights, np.float32))

    def transforms(self, frame: int) -> torch.Tensor:
        """(B, 3, 4) of the fine nodes in a frame, acting on canonical points."""
        first = int(self.spline.first[frame])
        blend = torch.from_numpy(self.spline.weights[frame])
        value = (blend @ self.table[first : first + 4].reshape(4, -1)).view(-1, 7) + self._unit
        own = _rigid(value, self._all)
        fine, *coarse = own.split(self._sizes)
        for follow, level in zip(self._follow, coarse, strict=True):
            outer = (follow @ level.reshape(len(level), 12)).view(-1, 3, 4)
            fine = outer @ torch.cat([fine, self._last], dim=1)
        return fine

    def at(self, frame: int, means: torch.Tensor) -> Deformed:
        """Where the Gaussians are in a frame. means: (N, 3) at rest."""
        transforms = self.transforms(frame)
        turns = transforms[..., :3]
        carriers = (turns @ self.rest[..., None])[..., 0] + transforms[..., 3]
        return Deformed(Skin.apply(means, transforms, self.index, self.weights), carriers, turns)

    def roughness(self) -> torch.Tensor:
        """Squared second differences of the knots, of each clip for itself: summed over nodes, mean over time."""
        bend = self.table[self._inner] - 2 * self.table[self._inner + 1] + self.table[self._inner + 2]
        return bend.square().sum() / len(self._inner)

    def copy_outwards(self, first: int, last: int, clip: int) -> None:
        """Frames outside first..last of a clip take the pose at that end: what has not been seen yet starts there."""
        knots = slice(int(self.spline.clip_knots[clip]), int(self.spline.clip_knots[clip + 1]))
        low, high = int(self.spline.first[first]) + 1, int(self.spline.first[last]) + 2
        with torch.no_grad():
            self.table[knots.start : low] = self.table[low].clone()
            self.table[high + 1 : knots.stop] = self.table[high].clone()


def farthest(points: np.ndarray, count: int) -> np.ndarray:
    """Farthest-point sampling from the point nearest to the mean. points: (M, 3) -> (count,) indices."""
    away = ((points - points.mean(0)) ** 2).sum(1)
    chosen = [int(away.argmin())]
    away = np.full(len(points), np.inf)
    for _ in range(count - 1):
        away = np.minimum(away, ((points - points[chosen[-1]]) ** 2).sum(1))
        chosen.append(int(away.argmax()))
    return np.array(chosen)


def _follow(fine: np.ndarray, coarse: np.ndarray) -> np.ndarray:
    """How much each fine node follows each coarse one: a soft choice among them, rows sum to one. (B, C) float32."""
    far = ((fine[:, None].astype(np.float64) - coarse) ** 2).sum(-1)
    if len(coarse) == 1:
        return np.ones((len(fine), 1), np.float32)
    between = ((coarse[:, None].astype(np.float64) - coarse) ** 2).sum(-1)
    np.fill_diagonal(between, np.inf)
    width = np.median(between.min(1)) / 4.0
    weights = np.exp(-(far - far.min(1, keepdims=True)) / (2 * width))
    return (weights / weights.sum(1, keepdims=True)).astype(np.float32)


def _rigid(value: torch.Tensor, centres: torch.Tensor) -> torch.Tensor:
    """value: (S, 7) quaternion of any length and shift, about the centres (S, 3) -> (S, 3, 4)."""
    q = torch.nn.functional.normalize(value[:, :4], dim=1)
    outer = 2.0 * q[:, :, None] * q[:, None, :]
    ww, xx, yy, zz = outer[:, 0, 0], outer[:, 1, 1], outer[:, 2, 2], outer[:, 3, 3]
    wx, wy, wz = outer[:, 0, 1], outer[:, 0, 2], outer[:, 0, 3]
    xy, xz, yz = outer[:, 1, 2], outer[:, 1, 3], outer[:, 2, 3]
    rows = [ww + xx - 1, xy - wz, xz + wy, xy + wz, ww + yy - 1, yz - wx, xz - wy, yz + wx, ww + zz - 1]
    turn = torch.stack(rows, dim=1).view(-1, 3, 3)
    shift = centres + value[:, 4:] - (turn @ centres[..., None])[..., 0]
    return torch.cat([turn, shift[..., None]], dim=2)
