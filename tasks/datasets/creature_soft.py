"""Which parts of a creature are soft, how soft, and where their masses sit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from tasks.datasets import creature_shape as shape
from tasks.datasets.creature_dynamics import Masses, farthest_points, near_pairs, spread_over

Vec = tuple[float, float, float]


@dataclass(frozen=True)
class Lobe:
    """A soft lobe, stiff at its root and soft at its tip: an ear, a tail, a pony tail.

    parts: indices of the parts it consists of; root, tip: ends of its axis; slow, fast: swing in Hz of tip and root.
    """

    parts: tuple[int, ...]
    root: Vec
    tip: Vec
    slow: float
    fast: float
    damping: float
    limit: float
    spacing: float
    avoid: tuple[str, ...] = ()

    def mask(self, points: np.ndarray) -> np.ndarray:
        """0 at the root to 1 at the tip. points: (N, 3) -> (N,)."""
        axis = np.asarray(self.tip) - self.root
        return np.clip((points - self.root) @ axis / (axis @ axis), 0.0, 1.0)


@dataclass(frozen=True)
class Pad:
    """Soft flesh within an ellipsoid, firm at its border: a belly, a chest. radii: half axes of the ellipsoid."""

    parts: tuple[int, ...]
    centre: Vec
    radii: Vec
    slow: float
    fast: float
    damping: float
    limit: float
    spacing: float
    avoid: tuple[str, ...] = ()

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


def lobe_masses(soft: Lobe | Pad, nearest: np.ndarray, vertices: np.ndarray, weights: np.ndarray) -> Masses:
    """Masses spread over the skin of a lobe or pad; nearest: (N,) each vertex's nearest part."""
    mask = soft.mask(vertices) * np.isin(nearest, soft.parts)
    # the skin takes the displacement over within the first fifth of the mask, the ties do the rest
    share = mask / 0.2
    share = np.where(share < 1.0, share * share * (3.0 - 2.0 * share), 1.0)
    inside = np.flatnonzero(mask > 0.02)
    chosen = inside[farthest_points(vertices[inside], int(mask[inside].argmax()), soft.spacing)]
    rest = vertices[chosen]
    springs = near_pairs(rest, 1.8 * soft.spacing)
    hertz = soft.slow * (soft.fast / soft.slow) ** (1.0 - mask[chosen])
    spread = np.zeros((len(vertices), len(rest)))
    spread[inside] = spread_over(vertices[inside], rest, 1.6 * soft.spacing, share[inside])
    return Masses(
        rest=rest,
        tie=2.0 * np.pi * hertz,
        damping=soft.damping,
        limit=soft.limit,
        springs=springs,
        stretch=np.full(len(springs), 2.0 * np.pi * 8.0),
        drag=0.2,
        spread=spread,
        hold=hold_of_skin(rest, vertices, weights),
        avoid=soft.avoid,
        margin=0.02,
    )


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
    springs, stretch = cloth_springs(soft.rows, soft.columns)
    level = np.repeat(np.linspace(0.0, 1.0, soft.rows), soft.columns)
    tie = 2.0 * np.pi * soft.slow * (soft.fast / soft.slow) ** (1.0 - level)
    tie[level < 1.5 / (soft.rows - 1)] = np.inf
    mask = np.clip((bell.along(vertices) - 0.1) / 0.25, 0.0, 1.0) * (nearest == soft.part)
    inside = np.flatnonzero(mask > 0)
    spread = np.zeros((len(vertices), len(rest)))
    share = mask[inside] ** 2 * (3.0 - 2.0 * mask[inside])
    spread[inside] = spread_over(vertices[inside], rest, 2.2 * arc[-1] / (soft.rows - 1), share)
    return Masses(
        rest=rest,
        tie=tie,
        damping=soft.damping,
        limit=soft.limit,
        springs=springs,
        stretch=stretch,
        drag=0.8,
        spread=spread,
        hold=hold_of_skin(rest, vertices, weights),
        avoid=soft.avoid,
        margin=bell.half + 0.015,
    )


def cloth_springs(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Springs of a ring of rows x columns masses and their angular frequencies: stretch, shear, bend."""
    grid = np.arange(rows * columns).reshape(rows, columns)
    pairs, strength = [], []

    def link(a: np.ndarray, b: np.ndarray, hertz: float) -> None:
        pairs.append(np.stack([a.ravel(), b.ravel()], axis=1))
        strength.append(np.full(a.size, 2.0 * np.pi * hertz))

    link(grid, np.roll(grid, -1, 1), 9.0)
    link(grid[:-1], grid[1:], 11.0)
    link(grid[:-1], np.roll(grid[1:], -1, 1), 4.0)
    link(grid[:-1], np.roll(grid[1:], 1, 1), 4.0)
    link(grid, np.roll(grid, -2, 1), 2.0)
    link(grid[:-2], grid[2:], 2.0)
    return np.concatenate(pairs), np.concatenate(strength)
