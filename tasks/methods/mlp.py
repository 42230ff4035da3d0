"""A perceptron from a pose to the bones: the baseline of Holden et al. 2019's kind, frame by frame."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Literal

from tasks.motion.nets import Recipe, animate_with
from tasks.values import Animation, Poses, Training

LAYERS = 3


def animate(
    training: Training,
    query: Poses,
    *,
    hidden: Annotated[int, "[1, inf)"],
    steps: Annotated[int, "[1, inf)"],
    patience: Annotated[int, "[1, inf)"],
    rate: Annotated[float, "(0, inf)"],
    represent: Literal["root", "residual"],
    dynamics: bool,
    mirror: bool,
    seed: int,
) -> Animation:
    """Poses -> points: three hidden layers give six numbers a bone, then skinning by W (GaussiAnimate 4.1).

    hidden: units of a layer; steps, patience, rate: of Adam, stopped by a held-back training clip;
    represent: bones relative to the model's ``root`` or their ``residual`` on the skeleton's skinning;
    dynamics: also show it the root's velocity, acceleration and angular velocity; mirror: train on the clips' mirror
    images as well, where the character is symmetric. Raises InputError for bad poses.
    """

    def make(inputs: int, width: int, outputs: int):
        from torch import nn

        sizes = [inputs] + [width] * LAYERS
        layers = [layer for a, b in pairwise(sizes) for layer in (nn.Linear(a, b), nn.ReLU())]
        return nn.Sequential(*layers, nn.Linear(width, outputs))

    recipe = Recipe(hidden, steps, patience, rate, represent, dynamics, mirror, seed)
    return animate_with(make, training, query, recipe)
