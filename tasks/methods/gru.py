"""A gated recurrent unit from a motion to the bones: the baseline of Santesteban et al. 2019's kind."""

from __future__ import annotations

from typing import Annotated, Literal

from tasks.motion.nets import Recipe, animate_with
from tasks.values import Animation, Poses, Training


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
    """Poses -> points: one recurrent layer and a linear head give six numbers a bone, then skinning by W
    (GaussiAnimate 4.1, after the VTO garments' baseline). Settings as in :func:`tasks.methods.mlp.animate`."""

    def make(inputs: int, width: int, outputs: int):
        from torch import nn

        class Recurrent(nn.Module):
            def __init__(self) -> None:
                super().__init__()
                self.memory, self.head = nn.GRU(inputs, width, batch_first=True), nn.Linear(width, outputs)

            def forward(self, x):
                return self.head(self.memory(x)[0])

        return Recurrent()

    recipe = Recipe(hidden, steps, patience, rate, represent, dynamics, mirror, seed)
    return animate_with(make, training, query, recipe)
