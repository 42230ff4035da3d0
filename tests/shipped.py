"""The settings that the product ships, for tests that are about them."""

from __future__ import annotations

from flows import config


def shipped(node: str, *overrides: str) -> dict:
    """One node of the composed config, as ``skeleton.surface``."""
    values = config.expand(["sweep.datasets=null", "sweep.methods=null", *overrides])[0].config
    for part in node.split("."):
        values = values[part]
    return values
