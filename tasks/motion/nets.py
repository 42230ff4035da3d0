"""Small networks from poses to bones, trained on one thread from a seed, stopped by a clip they do not see."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from tasks.geometry.rotations import to_rotation_vector
from tasks.geometry.skinning import skin
from tasks.motion.mirror import mirrored
from tasks.motion.posed import Posed
from tasks.motion.query import check_poses
from tasks.motion.regression import bone_radii, from_numbers, to_numbers
from tasks.values import Animation, Poses, Training

if TYPE_CHECKING:
    import torch

CHECK = 5  # steps between two looks at the validation clip
FLOOR = 0.1  # least unit of a number, in units of the root mean square spread
WARM_UP = 8  # frames that a recurrent net sees before its error counts


@dataclass(frozen=True)
class Recipe:
    """How to train. hidden: width; steps: most optimiser steps; patience: steps without gain before stopping;
    rate: Adam's; represent, dynamics, mirror: as for the other methods; seed: of the net and of the validation clip."""

    hidden: int
    steps: int
    patience: int
    rate: float
    represent: str
    dynamics: bool
    mirror: bool
    seed: int


def animate_with(
    make: Callable[[int, int, int], torch.nn.Module], training: Training, query: Poses, recipe: Recipe
) -> Animation:
    """Trains make(inputs, hidden, outputs) on the database and poses the query with it.

    Inputs and outputs are standardised over the training frames. Training stops when one clip, drawn by the seed and
    held back with its mirror image (the last fifth of the only clip where there is one), stops getting better; the
    net is then trained anew on all frames for as many steps. Raises InputError for bad poses.
    """
    check_poses(query, training.skeleton, "query")
    known, asked = Posed(training, training.database.poses), Posed(training, query)
    image = mirrored(training) if recipe.mirror else None
    learnt = [(known, training.database.bones)]
    learnt += [] if image is None else [(Posed(training, image[0], known), image[1])]
    radius = bone_radii(training.skinning.rest, training.skinning.weights)
    length = np.repeat([radius, np.ones_like(radius)], 3, axis=0).T  # (B, 6): turns as the way that points go
    x = np.concatenate([_inputs(posed, recipe.dynamics) for posed, _ in learnt])
    y = np.concatenate([to_numbers(posed.encode(bones, recipe.represent)) * length for posed, bones in learnt])
    y = y.reshape(len(y), -1)
    z = _inputs(asked, recipe.dynamics)
    x_mean, x_unit, y_mean, y_unit = x.mean(0), _unit(x), y.mean(0), _unit(y)
    x, y = (x - x_mean) / x_unit, (y - y_mean) / y_unit
    starts = np.arange(len(learnt)) * len(known.world)  # a clip's image follows as many frames later
    clips = [[slice(int(s + a), int(s + b)) for s in starts] for a, b in pairwise(known.poses.clip_start)]
    data = [[(x[c], y[c]) for c in both] for both in clips]
    asked_clips = [(z[a:b] - x_mean) / x_unit for a, b in pairwise(query.clip_start)]
    made = np.concatenate(_train_and_ask(make, data, asked_clips, recipe)) * y_unit + y_mean
    bones = asked.decode(from_numbers(made.reshape(len(made), -1, 6) / length), recipe.represent).astype(np.float32)
    return Animation(points=skin(training.skinning.rest, training.skinning.weights, bones), bones=bones)


def _inputs(posed: Posed, dynamics: bool) -> np.ndarray:
    """(F, D): rotation vectors of the joints below the model's root, and of the root the direction of gravity; with
    dynamics also its velocity, acceleration and angular velocity. Heading and place say nothing about the shape."""
    inner = posed.inner.copy()
    inner[posed.root] = False
    turns = to_rotation_vector(posed.poses.rotations[:, inner].astype(np.float64)).reshape(len(posed.world), -1)
    root = posed.dynamics if dynamics else posed.dynamics[:, :1]
    return np.concatenate([turns, root.reshape(len(root), -1)], axis=1)


def _unit(x: np.ndarray) -> np.ndarray:
    """Standard deviations, but at least a tenth of the usual one: what hardly moves in training is mostly noise, and
    an unseen clip that moves it must not throw the net far outside all it has seen."""
    spread = x.std(0)
    return np.maximum(spread, max(FLOOR * np.sqrt((spread**2).mean()), 1e-12))


def _train_and_ask(make, data: list, asked: list[np.ndarray], recipe: Recipe) -> list[np.ndarray]:
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # sums then come out the same whatever the machine has
    try:
        train, held = _hold_back(data, np.random.default_rng(recipe.seed))
        best, _ = _descend(make, train, held, recipe.steps, recipe)
        _, net = _descend(make, [clip for both in data for clip in both], [], best, recipe)
        with torch.no_grad():
            return [net(torch.from_numpy(q[None].astype(np.float32)))[0].double().numpy() for q in asked]
    finally:
        torch.set_num_threads(threads)


def _hold_back(data: list, rng: np.random.Generator) -> tuple[list, list]:
    """Clips to train on, images included, and the clip to look at; data: of each clip itself and its image, if any."""
    if len(data) > 1:
        held = int(rng.integers(len(data)))
        return [clip for i, both in enumerate(data) if i != held for clip in both], [data[held][0]]
    (x, y), cut = data[0][0], max(1, len(data[0][0][0]) * 4 // 5)
    train = [(x[:cut], y[:cut]) for x, y in data[0]]
    return train, [(x[cut:], y[cut:])] if cut < len(x) else []


def _descend(make, data: list, held: list, steps: int, recipe: Recipe) -> tuple[int, torch.nn.Module]:
    """Adam on all clips at once. Returns the step of the lowest validation error (the last one without validation)."""
    import torch

    net = make(data[0][0].shape[1], recipe.hidden, data[0][1].shape[1])
    _initialise(net, np.random.default_rng(recipe.seed))
    optimiser = torch.optim.Adam(net.parameters(), lr=recipe.rate)
    batch, check = _batch(data), _batch(held) if held else None
    best, best_step = np.inf, steps
    for step in range(1, steps + 1):
        optimiser.zero_grad()
        _loss(net, batch).backward()
        optimiser.step()
        if check is not None and step % CHECK == 0:
            with torch.no_grad():
                error = float(_loss(net, check))
            if error < best:
                best, best_step = error, step
            elif step - best_step >= recipe.patience:
                break
    return best_step, net


def _batch(clips: list) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Clips padded to one length: inputs (C, F, D), targets (C, F, Y), which frames count (C, F, 1)."""
    import torch

    longest = max(len(x) for x, _ in clips)
    padded = [[np.pad(a, ((0, longest - len(a)), (0, 0))) for a in clip] for clip in clips]
    frame = np.arange(longest)[:, None]
    counts = [(frame < len(x)) & (frame >= min(WARM_UP, len(x) - 1)) for x, _ in clips]
    stack = [np.stack(a).astype(np.float32) for a in (*zip(*padded, strict=True), counts)]
    return tuple(torch.from_numpy(a) for a in stack)


def _loss(net, batch) -> torch.Tensor:
    x, y, counts = batch
    return (((net(x) - y) ** 2) * counts).sum() / (counts.sum() * y.shape[2])


def _initialise(net: torch.nn.Module, rng: np.random.Generator) -> None:
    """torch's own rule, uniform in +-1 / sqrt(fan in), but from our generator: torch's is shared by all threads."""
    import torch

    with torch.no_grad():
        for module in net.modules():
            own = list(module.parameters(recurse=False))
            fan = module.hidden_size if isinstance(module, torch.nn.GRU) else own[0].shape[1] if own else 1
            for p in own:
                p.copy_(torch.from_numpy(rng.uniform(-1, 1, tuple(p.shape)).astype(np.float32) / np.sqrt(fan)))
