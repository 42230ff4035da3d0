"""Files of Gaussians read again, by the two formats' descriptions alone."""

from __future__ import annotations

import numpy as np

from tasks.export.splat_files import C0
from tasks.values import Gaussians


def read_ply(data: bytes) -> Gaussians:
    """A binary .ply of floats, one row a Gaussian, columns by their names in the header."""
    head, _, body = data.partition(b"end_header\n")
    lines = head.decode("ascii").split("\n")
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    names = [line.split()[2] for line in lines if line.startswith("property float ")]
    column = dict(zip(names, np.frombuffer(body, "<f4").reshape(-1, len(names)).T, strict=True))
    assert f"element vertex {len(column['x'])}" in lines

    def of(*chosen: str) -> np.ndarray:
        return np.stack([column[n] for n in chosen], axis=1)

    higher = [n for n in names if n.startswith("f_rest_")]
    sh = of("f_dc_0", "f_dc_1", "f_dc_2")[:, None]
    if higher:  # all of red, then green, then blue
        sh = np.concatenate([sh, of(*higher).reshape(len(sh), 3, -1).transpose(0, 2, 1)], axis=1)
    scales, turns = np.exp(of("scale_0", "scale_1", "scale_2")), of("rot_0", "rot_1", "rot_2", "rot_3")
    return Gaussians(of("x", "y", "z"), scales, turns, 1 / (1 + np.exp(-column["opacity"])), sh)


def read_splat(data: bytes) -> Gaussians:
    """32 bytes a Gaussian: place and scales as float32, colour and opacity, quaternion w x y z with 128 for 0."""
    rows = np.frombuffer(data, np.uint8).reshape(-1, 32)
    numbers = rows[:, :24].copy().view("<f4")
    rgba, turns = rows[:, 24:28] / np.float32(255), (rows[:, 28:].astype(np.float32) - 128) / 128
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    return Gaussians(numbers[:, :3], numbers[:, 3:], turns, rgba[:, 3], ((rgba[:, :3] - 0.5) / C0)[:, None])
