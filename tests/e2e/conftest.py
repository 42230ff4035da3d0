"""A small moving mesh in a file, and the command as a user types it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from flows.source import ROOT


def worm(frames: int = 40, around: int = 16, along: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """A closed tube that bends at two places and swings a little: (F, N, 3) and (T, 3)."""
    u = np.linspace(0, 2 * np.pi, around, endpoint=False)
    z = np.linspace(-1, 1, along)
    ring = np.stack([0.15 * np.cos(u), 0.15 * np.sin(u)], 1)
    body = np.concatenate([np.concatenate([ring, np.full((around, 1), h)], 1) for h in z])
    rest = np.concatenate([body, [[0, 0, -1.05], [0, 0, 1.05]]])
    faces = []
    for i in range(along - 1):
        for j in range(around):
            a, b = i * around + j, i * around + (j + 1) % around
            faces += [[a, b, b + around], [a, b + around, a + around]]
    low, high = len(body), len(body) + 1
    faces += [[low, (j + 1) % around, j] for j in range(around)]
    top = (along - 1) * around
    faces += [[high, top + j, top + (j + 1) % around] for j in range(around)]
    points = np.stack([_bend(rest, t) for t in np.linspace(0, 4 * np.pi, frames)])
    return points.astype(np.float32), np.array(faces, np.int32)


def _bend(rest: np.ndarray, t: float) -> np.ndarray:
    out = rest.copy()
    for pivot, angle in ((-0.35, 0.6 * np.sin(t)), (0.35, 0.8 * np.sin(1.7 * t + 1))):
        amount = np.clip((rest[:, 2] - pivot) / 0.1 + 0.5, 0, 1) * angle
        y, z = out[:, 1], out[:, 2] - pivot
        out[:, 1], out[:, 2] = y * np.cos(amount) - z * np.sin(amount), y * np.sin(amount) + z * np.cos(amount) + pivot
    return out + np.array([0.1 * np.sin(t), 0.0, 0.02 * t])


@pytest.fixture(scope="session")
def worm_file(tmp_path_factory) -> Path:
    """The moving mesh as an .npz."""
    points, faces = worm()
    path = tmp_path_factory.mktemp("data") / "worm.npz"
    np.savez(path, vertices=points, faces=faces)
    return path


@pytest.fixture(scope="session")
def small_file(tmp_path_factory) -> Path:
    """The same, as small as the stages take it, for tests that run it often."""
    points, faces = worm(frames=30, around=8, along=24)
    path = tmp_path_factory.mktemp("data") / "small.npz"
    np.savez(path, vertices=points, faces=faces)
    return path


class Run:
    """Runs the command in a folder of its own, with its own store and reports."""

    def __init__(self, folder: Path, url: str | None) -> None:
        self.folder = folder
        self.environment = os.environ | ({"PREFECT_API_URL": url} if url else {})
        self.environment |= {"COLUMNS": "160", "PYTHONPATH": str(ROOT)}

    def arguments(self, *overrides: str) -> list[str]:
        return [sys.executable, "-m", "flows.run", *overrides]

    def __call__(self, *overrides: str, status: int = 0) -> subprocess.CompletedProcess:
        done = subprocess.run(
            self.arguments(*overrides),
            cwd=self.folder,
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=600,
            check=False,
        )
        assert done.returncode == status, done.stdout[-3000:] + done.stderr[-3000:]
        return done

    def start(self, *overrides: str) -> subprocess.Popen:
        return subprocess.Popen(
            self.arguments(*overrides),
            cwd=self.folder,
            env=self.environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    def leftovers(self) -> list[str]:
        """What a crash could have left in the store."""
        return [str(p) for p in (self.folder / "store").rglob("*.tmp")]


@pytest.fixture
def user(tmp_path, prefect_server) -> Run:
    """A user in an empty folder, with a Prefect server running."""
    return Run(tmp_path, prefect_server)
