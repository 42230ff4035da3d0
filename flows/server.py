"""The Prefect server that a run talks to: the user's, a running dashboard, or a small one of the run's own.

Prefect starts one by itself, but that one outlives a run that is killed, and several of them share one SQLite file and
lock each other out. Ours keeps its database in memory and ends when the pipe to its parent closes.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

STARTUP_SECONDS = 180  # a slow machine needs more than the usual 20


def quiet_prefect() -> None:
    """Settings that Prefect reads when it is imported; what the user has set stays."""
    defaults = {
        "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
        "DO_NOT_TRACK": "1",
        "PREFECT_LOGGING_HANDLERS_CONSOLE_LEVEL": "CRITICAL",  # our own display says what happens
        "PREFECT_LOGGING_INTERNAL_LEVEL": "CRITICAL",  # nor pages about events that a stopped server did not take
    }
    for name, value in defaults.items():
        os.environ.setdefault(name, value)


@contextlib.contextmanager
def server() -> Iterator[Callable[[], str]]:
    """A function that gives the API's address once it answers: the user's server if one is configured, else the
    dashboard if one runs, else a server that lives as long as this block and starts while the caller does something
    else."""
    quiet_prefect()
    from prefect.settings import PREFECT_API_URL

    configured = PREFECT_API_URL.value()  # from the environment or the user's profile
    if configured:
        yield lambda: configured
        return
    with contextlib.ExitStack() as settings:
        dashboard = dashboard_address()
        if dashboard:
            _point_at(dashboard, settings)
            yield lambda: dashboard
            return
        port = free_port()
        url = f"http://127.0.0.1:{port}/api"
        child = _start(port)
        log: list[bytes] = []
        threading.Thread(target=lambda: log.extend(child.stderr), daemon=True).start()
        try:
            yield lambda: _use(url, child, log, settings)
        finally:
            child.stdin.close()
            try:
                child.wait(10)
            except subprocess.TimeoutExpired:
                child.kill()


def watched() -> bool:
    """Whether the server in use has pages that somebody may look at: ours, which ends with the run, is sent no logs."""
    from prefect.settings import PREFECT_LOGGING_TO_API_ENABLED

    return PREFECT_LOGGING_TO_API_ENABLED.value()


lost = threading.Event()  # set when the server stopped answering in the middle of a run
ASKED_AGAIN = 0.2  # seconds after which an answer is no longer trusted
_answered: dict[str, float] = {}  # by address, when
_hasty = contextlib.ExitStack()  # settings from then on


def alive() -> bool:
    """Whether the server in use still answers. When it does not, Prefect's client is told to give up at once and to
    keep quiet, from here on: it would try again for minutes after every stage."""
    from prefect.settings import PREFECT_API_URL, PREFECT_CLIENT_MAX_RETRIES, temporary_settings

    if lost.is_set():
        return False
    url = PREFECT_API_URL.value()
    if time.monotonic() - _answered.get(url, -ASKED_AGAIN) < ASKED_AGAIN:
        return True
    for _ in range(3):  # a busy server may be late once
        if _answers(url):
            _answered[url] = time.monotonic()
            return True
    lost.set()
    logging.disable(logging.CRITICAL)
    _hasty.enter_context(temporary_settings({PREFECT_CLIENT_MAX_RETRIES: 0}))
    return False


def _answers(url: str) -> bool:
    with contextlib.suppress(OSError, ValueError), urllib.request.urlopen(f"{url}/health", timeout=10) as answer:
        return answer.read() == b"true"
    return False


def dashboard_note() -> Path:
    """The file in Prefect's folder in which a running dashboard says where it listens."""
    return Path(os.environ.get("PREFECT_HOME", "~/.prefect")).expanduser() / "skelebones" / "dashboard.json"


def dashboard_address() -> str | None:
    """The API of the dashboard that runs now; None if there is none, or if it was killed and only its note is left."""
    try:
        url = json.loads(dashboard_note().read_text("utf-8"))["api"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return url if _answers(url) else None


def _start(port: int) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-m", "flows.server", str(port)],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        cwd=os.path.dirname(os.path.dirname(os.path.abspath(__file__))),
    )


def _use(url: str, child: subprocess.Popen, log: list[bytes], settings: contextlib.ExitStack) -> str:
    """Waits for a server of our own. Nobody will read the logs of one that ends with the run, so they are not sent."""
    _wait(url, child, log)
    _point_at(url, settings, PREFECT_LOGGING_TO_API_ENABLED="false")
    return url


def _point_at(url: str, settings: contextlib.ExitStack, **more: str) -> None:
    """Points Prefect at a server, here and in worker processes, until the settings are closed."""
    from prefect import settings as known
    from prefect.settings import temporary_settings

    changed = {"PREFECT_API_URL": url, **more}
    os.environ.update(changed)
    settings.callback(lambda: [os.environ.pop(name, None) for name in changed])
    settings.enter_context(temporary_settings({getattr(known, name): value for name, value in changed.items()}))


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
        if _answers(url):
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
