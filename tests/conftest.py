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
def prefect_server(tmp_path_factory):
    """One Prefect server for the whole test run, with a database of its own."""
    from flows.sweep import quiet_prefect

    quiet_prefect()
    os.environ["PREFECT_HOME"] = str(tmp_path_factory.mktemp("prefect"))
    from prefect.testing.utilities import prefect_test_harness

    with prefect_test_harness(server_startup_timeout=180):
        yield
