"""A Prefect server of our own for runs that have none to talk to.

Prefect starts one by itself, but that one outlives a run that is killed, and several of them share one SQLite file and
lock each other out. This one keeps its database in memory and ends when the pipe to its parent closes.
"""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator

STARTUP_SECONDS = 180  # a slow machine needs more than the usual 20


def quiet_prefect() -> None:
    """Settings that Prefect reads when it is imported; what the user has set stays."""
    defaults = {
        "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
        "DO_NOT_TRACK": "1",
        "PREFECT_LOGGING_HANDLERS_CONSOLE_LEVEL": "CRITICAL",  # our own display says what happens
    }
    for name, value in defaults.items():
        os.environ.setdefault(name, value)


@contextlib.contextmanager
def server() -> Iterator[Callable[[], str]]:
    """A function that gives the API's address once it answers: the user's server if one is configured, else one that
    lives as long as this block and starts while the caller does something else."""
    quiet_prefect()
    from prefect.settings import PREFECT_API_URL

    configured = PREFECT_API_URL.value()  # from the environment or the user's profile
    if configured:
        yield lambda: configured
        return
    port = free_port()
    url = f"http://127.0.0.1:{port}/api"
    child = _start(port)
    log: list[bytes] = []
    threading.Thread(target=lambda: log.extend(child.stderr), daemon=True).start()
    with contextlib.ExitStack() as settings:
        try:
            yield lambda: _use(url, child, log, settings)
        finally:
            for name in ("PREFECT_API_URL", "PREFECT_LOGGING_TO_API_ENABLED"):
                os.environ.pop(name, None)
            child.stdin.close()
            try:
                child.wait(10)
            except subprocess.TimeoutExpired:
                child.kill()


def _start(port: int) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-m", "flows.server", str(port)],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        cwd=os.path.dirname(os.path.dirname(os.path.abspath(__file__))),
    )


def _use(url: str, child: subprocess.Popen, log: list[bytes], settings: contextlib.ExitStack) -> str:
    """Points Prefect at the server, here and in worker processes. Nobody will read the logs of a server that ends with
    the run, so they are not sent."""
    from prefect.settings import PREFECT_API_URL, PREFECT_LOGGING_TO_API_ENABLED, temporary_settings

    _wait(url, child, log)
    os.environ |= {"PREFECT_API_URL": url, "PREFECT_LOGGING_TO_API_ENABLED": "false"}
    settings.enter_context(temporary_settings({PREFECT_API_URL: url, PREFECT_LOGGING_TO_API_ENABLED: False}))
    return url


def free_port() -> int:
    """A port of the loopback that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def _wait(url: str, child: subprocess.Popen, log: list[bytes]) -> None:
    end = time.monotonic() + STARTUP_SECONDS
    while time.monotonic() < end:
        if child.poll() is not None:
            raise RuntimeError(f"Prefect's server did not start:\n{b''.join(log).decode(errors='replace')[-2000:]}")
        with contextlib.suppress(OSError), urllib.request.urlopen(f"{url}/health", timeout=5) as answer:
            if answer.status == 200:
                return
        time.sleep(0.1)
    raise TimeoutError(f"Prefect's server did not answer within {STARTUP_SECONDS} s")


def _end_with_parent() -> None:
    sys.stdin.buffer.read()  # returns when the parent closes the pipe or dies
    os._exit(0)


def serve(port: int) -> None:
    """The server itself, in its own process."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    os.environ["PREFECT_API_DATABASE_CONNECTION_URL"] = "sqlite+aiosqlite:///:memory:"
    os.environ["PREFECT_UI_ENABLED"] = "0"
    os.environ["PREFECT__SERVER_EPHEMERAL"] = "1"
    import uvicorn
    from prefect.server.api.server import create_app

    uvicorn.run(create_app(ephemeral=True, final=True), host="127.0.0.1", port=port, log_level="error", lifespan="on")


if __name__ == "__main__":
    serve(int(sys.argv[1]))
