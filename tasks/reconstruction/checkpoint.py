"""The state of a fit in one file, replaced as a whole: tensors and, as JSON, everything else."""

from __future__ import annotations

import json
import os
from pathlib import Path

import torch

FILE = "fit.safetensors"


def save(folder: Path, tensors: dict[str, torch.Tensor], rest: dict) -> None:
    """Writes beside the last state, then takes its place: a kill leaves one or the other."""
    from safetensors.torch import save_file

    folder.mkdir(parents=True, exist_ok=True)
    partial = folder / f"{FILE}.partial"
    save_file({n: t.detach().cpu().contiguous() for n, t in tensors.items()}, partial, {"rest": json.dumps(rest)})
    with open(partial, "rb") as file:
        os.fsync(file.fileno())
    os.replace(partial, folder / FILE)


def load(folder: Path) -> tuple[dict[str, torch.Tensor], dict] | None:
    """The state last saved, or None where there is none that can be read whole."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(folder / FILE, "pt") as file:
            return {n: file.get_tensor(n) for n in file.keys()}, json.loads(file.metadata()["rest"])  # noqa: SIM118
    except (FileNotFoundError, SafetensorError):
        return None
