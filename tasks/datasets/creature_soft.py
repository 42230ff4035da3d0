"""Which parts of a creature are soft, how soft, and where their masses sit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from tasks.datasets import creature_shape as shape
from tasks.datasets.creature_dynamics import GRAVITY, Masses
from tasks.datasets.creature_motion import TAU

Vec = tuple[float, float, float]


@dataclass(frozen=True)
class Lobe:
    """A soft lobe, stiff at its root and soft at its tip: an ear, a tail, a pony tail.

    parts: indices of the parts it consists of; axis: points from root to tip; count: masses along it; slow, fast:
    swing in Hz of tip and root; bend: Hz of its springs against bending; limit: metres at which ties stiffen; heavy:
    it hangs by its springs; avoid: joints whose parts it may not enter.
    """

    parts: tuple[int, ...]
    axis: tuple[Vec, ...]
    count: int
    slow: float
    fast: float
    bend: float
    damping: float
    limit: float
    heavy: bool = False
    avoid: tuple[str, ...] = ()

    def chain(self) -> np.ndarray:
        """(count, 3) points evenly along the axis."""
        knots = np.asarray(self.axis)
        arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(knots, axis=0), axis=1))])
        at = np.linspace(0.0, arc[-1], self.count)
        return np.stack([np.interp(at, arc, knots[:, i]) for i in range(3)], axis=1)

    def along(self, points: np.ndarray) -> np.ndarray:
        """0 before the root to 1 at the tip, by the nearest place on the chain. points: (N, 3) -> (N,)."""
        chain = self.chain()
        step = np.diff(chain, axis=0)
        t = ((points[:, None] - chain[:-1]) * step).sum(2) / (step**2).sum(1)
        t = np.clip(t, 0.0, 1.0)
        gap = np.linalg.norm(points[:, None] - chain[:-1] - t[..., None] * step, axis=2)
        nearest = gap.argmin(1)
        return (nearest + t[np.arange(len(t)), nearest]) / len(step)


@dataclass(frozen=True)
class Pad:
    """Soft flesh within an ellipsoid, firm at its border: a belly, a chest. radii: half axes of the ellipsoid;

    spacing: metres between masses; the rest as in :class:`Lobe`.
    """

    parts: tuple[int, ...]
    centre: Vec
    radii: Vec
    slow: float
    fast: float
    damping: float
    limit: float
    spacing: float

    def mask(self, points: np.ndarray) -> np.ndarray:
        """1 at the centre, 0 from the border on. points: (N, 3) -> (N,)."""
        q2 = (((points - self.centre) / np.asarray(self.radii)) ** 2).sum(1)
        return np.clip(1.0 - q2, 0.0, 1.0) ** 2


@dataclass(frozen=True)
class Cloth:
    """A skirt: the bell of a part as a grid of masses with stretch, shear and bend springs, its top row held."""

    part: int
    columns: int
    rows: int
    slow: float
    fast: float
    damping: float
    limit: float
    avoid: tuple[str, ...]


def masses_of(
    soft: Lobe | Pad | Cloth, parts: list, nearest: np.ndarray, vertices: np.ndarray, weights: np.ndarray
) -> Masses:
    """The masses of a soft region; nearest: (N,) each vertex's nearest part; weights: (N, J) of the skin."""
    if isinstance(soft, Cloth):
        return cloth_masses(soft, parts[soft.part], nearest, vertices, weights)
    build = lobe_masses if isinstance(soft, Lobe) else pad_masses
    return build(soft, nearest, vertices, weights)


def lobe_masses(soft: Lobe, nearest: np.ndarray, vertices: np.ndarray, weights: np.ndarray) -> Masses:
    """A chain of masses on the axis of a lobe, the first two held."""
    rest = soft.chain()
    n = np.arange(soft.count)
    springs = np.concatenate([np.stack([n[:-1], n[1:]], 1), np.stack([n[:-2], n[2:]], 1)])
    stretch = TAU * np.repeat([20.0, soft.bend], [soft.count - 1, soft.count - 2])
    length = np.linalg.norm(rest[springs[:, 0]] - rest[springs[:, 1]], axis=1)
    if soft.heavy:
        carried = np.concatenate([soft.count - n[1:], np.zeros(soft.count - 2)])
        length = length - carried * -GRAVITY[1] / stretch**2
    tie = TAU * soft.slow * (soft.fast / soft.slow) ** (1.0 - n / n[-1])
    tie[:2] = np.inf
    along = soft.along(vertices) * np.isin(nearest, soft.parts)
    # a skin point follows the chain where it stands beside it; near the root it stays with the bones
    spread = np.maximum(1.0 - np.abs(along[:, None] * n[-1] - n) / 1.5, 0.0) ** 2
    spread *= (smooth(along * n[-1] / 2.0) / spread.sum(1))[:, None]
    return Masses(
        rest=rest,
        hold=hold_of_skin(rest, vertices, weights),
        spread=csr_matrix(spread),
        tie=tie,
        damping=soft.damping,
        limit=soft.limit,
        springs=springs,
        length=length,
        stretch=stretch,
        drag=0.3,
        avoid=soft.avoid,
        margin=0.045,
    )


def pad_masses(soft: Pad, nearest: np.ndarray, vertices: np.ndarray, weights: np.ndarray) -> Masses:
    """Masses spread over the skin of a pad."""
    mask = soft.mask(vertices) * np.isin(nearest, soft.parts)
    inside = np.flatnonzero(mask > 0.02)
    rest = vertices[inside][farthest_points(vertices[inside], int(mask[inside].argmax()), soft.spacing)]
    springs = near_pairs(rest, 1.8 * soft.spacing)
    spread = np.zeros((len(vertices), len(rest)))
    spread[inside] = spread_over(vertices[inside], rest, 2.0 * soft.spacing, smooth(mask[inside] / 0.4))
    return Masses(
        rest=rest,
        hold=hold_of_skin(rest, vertices, weights),
        spread=csr_matrix(spread),
        tie=TAU * soft.slow * (soft.fast / soft.slow) ** (1.0 - soft.mask(rest)),
        damping=soft.damping,
        limit=soft.limit,
        springs=springs,
        length=np.linalg.norm(rest[springs[:, 0]] - rest[springs[:, 1]], axis=1),
        stretch=np.full(len(springs), TAU * 3.0),
        drag=0.0,
        avoid=(),
        margin=0.0,
    )


def farthest_points(points: np.ndarray, first: int, spacing: float) -> np.ndarray:
    """Indices of points about ``spacing`` apart, each the farthest from those before it."""
    chosen = [first]
    gap = np.linalg.norm(points - points[first], axis=1)
    while gap.max() > spacing:
        chosen.append(int(gap.argmax()))
        gap = np.minimum(gap, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(chosen)


def near_pairs(points: np.ndarray, reach: float) -> np.ndarray:
    """(S, 2) pairs of points nearer to each other than ``reach``, each once."""
    d = np.linalg.norm(points[:, None] - points[None], axis=2)
    return np.argwhere(np.triu(d < reach, 1)).reshape(-1, 2)


def spread_over(points: np.ndarray, masses: np.ndarray, reach: float, mask: np.ndarray) -> np.ndarray:
    """(N, M) smooth interpolation from masses to skin points, rows sum to the mask (normalised Wendland C2)."""
    d = np.linalg.norm(points[:, None] - masses[None], axis=2)
    reach = np.maximum(reach, 1.5 * d.min(1, keepdims=True))
    q = np.minimum(d / reach, 1.0)
    kernel = (1 - q) ** 4 * (4 * q + 1)
    return kernel / kernel.sum(1, keepdims=True) * mask[:, None]


def smooth(s: np.ndarray) -> np.ndarray:
    """0 below 0, 1 above 1, smooth in between."""
    s = np.clip(s, 0.0, 1.0)
    return s * s * (3.0 - 2.0 * s)


def hold_of_skin(masses: np.ndarray, vertices: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Joint weights of masses from the eight skin points nearest to each, (M, J), rows sum to one."""
    d, near = cKDTree(vertices).query(masses, k=8)
    share = np.exp(-((d / d[:, -1:]) ** 2) * 2.0)
    hold = np.einsum("mk,mkj->mj", share, weights[near])
    return hold / hold.sum(1, keepdims=True)


def cloth_masses(
    soft: Cloth, bell: shape.Bell, nearest: np.ndarray, vertices: np.ndarray, weights: np.ndarray
) -> Masses:
    """Masses on the middle surface of a bell, row by row from the waist."""
    knots = np.asarray(bell.profile)
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(knots, axis=0), axis=1))])
    down = np.linspace(0.0, arc[-1], soft.rows)
    radius, height = np.interp(down, arc, knots[:, 0]), np.interp(down, arc, knots[:, 1])
    angle = 2.0 * np.pi * np.arange(soft.columns) / soft.columns
    x, z = radius[:, None] * np.cos(angle), bell.depth * radius[:, None] * np.sin(angle)
    rest = np.stack([x, np.broadcast_to(height[:, None], x.shape), z], axis=-1).reshape(-1, 3)
    springs, length, stretch = cloth_springs(rest, soft.rows, soft.columns)
    level = np.repeat(np.linspace(0.0, 1.0, soft.rows), soft.columns)
    tie = TAU * soft.slow * (soft.fast / soft.slow) ** (1.0 - level)
    tie[level < 1.5 / (soft.rows - 1)] = np.inf
    mask = np.clip((bell.along(vertices) - 0.1) / 0.25, 0.0, 1.0) * (nearest == soft.part)
    inside = np.flatnonzero(mask > 0)
    spread = np.zeros((len(vertices), len(rest)))
    spread[inside] = spread_over(vertices[inside], rest, 2.2 * arc[-1] / (soft.rows - 1), smooth(mask[inside]))
    return Masses(
        rest=rest,
        hold=hold_of_skin(rest, vertices, weights),
        spread=csr_matrix(spread),
        tie=tie,
        damping=soft.damping,
        limit=soft.limit,
        springs=springs,
        length=length,
        stretch=stretch,
        drag=0.8,
        avoid=soft.avoid,
        margin=bell.half + 0.028,
    )


def cloth_springs(rest: np.ndarray, rows: int, columns: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Springs of a ring of rows x columns masses, the lengths at which they pull nothing, their angular frequencies.

    Along the ring, down the cloth, across, and against bending. Those down the cloth are short by what makes them
    carry the weight below them, so that cloth that was thrown up falls back.
    """
    grid = np.arange(rows * columns).reshape(rows, columns)
    links = [
        (grid, np.roll(grid, -1, 1), 9.0),
        (grid[:-1], np.roll(grid[1:], -1, 1), 4.0),
        (grid[:-1], np.roll(grid[1:], 1, 1), 4.0),
        (grid, np.roll(grid, -2, 1), 2.0),
        (grid[:-2], grid[2:], 2.0),
        (grid[:-1], grid[1:], 11.0),
    ]
    springs = np.concatenate([np.stack([a.ravel(), b.ravel()], axis=1) for a, b, _ in links])
    stretch = TAU * np.concatenate([np.full(a.size, hertz) for a, _, hertz in links])
    line = rest[springs[:, 1]] - rest[springs[:, 0]]
    length = np.linalg.norm(line, axis=1)
    hung = slice(-(rows - 1) * columns, None)
    below = np.repeat(np.arange(rows - 1, 0, -1), columns)
    steep = np.abs(line[hung, 1]) / length[hung]
    length[hung] -= below * -GRAVITY[1] / steep / stretch[hung] ** 2
    return springs, length, stretch
