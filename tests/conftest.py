"""What all tests share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

# torch and numba on shared cores: spinning OpenMP threads make both crawl, so this comes before any import of torch
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real data that lies beside a development checkout; tests that need it skip without it."""
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"no real data beside the checkout (looked for ../{folder.relative_to(ROOT.parent)})")
    return folder


@pytest.fixture(scope="session")
def prefect_home(tmp_path_factory) -> Path:
    """Prefect's folder for the whole test run: never the user's, nor a dashboard that runs beside the tests."""
    folder = tmp_path_factory.mktemp("prefect")
    os.environ["PREFECT_HOME"] = str(folder)
    os.environ.pop("PREFECT_API_URL", None)
    return folder


@pytest.fixture(scope="session")
def prefect_server(prefect_home):
    """One Prefect server for the whole test run."""
    from flows.server import server

    with server() as ready:
        yield ready()
