"""Ctrl-C and SIGTERM end a run within seconds.

A stage is a plain function in a thread or in another process: nothing can ask it to stop, and Prefect waits for it, for
minutes if it is a fit. The store is safe from processes that die at any moment and long stages keep checkpoints, so the
run just ends, and takes with it the processes that it started.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import sys
import threading
import urllib.request
from collections.abc import Iterator

from flows.server import watched

STOPPED = "stopped; finished stages and checkpoints are kept: the same command goes on from there"
SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextlib.contextmanager
def stoppable(folder: str | None = None) -> Iterator[None]:
    """Within this block the signals end the process at once, with status 128 + their number and one line on stderr.
    folder: of temporary files, removed then. Only the main thread hears signals; elsewhere nothing is changed. A flow
    needs a block of its own, since Prefect puts its handlers over those that were there before."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(number: int, frame: object) -> None:
        for one in SIGNALS:
            signal.signal(one, signal.SIG_IGN)  # whoever is impatient does not disturb the rest
        if sys.stdout.isatty():
            sys.stdout.write("\x1b[?25h")  # the live line hides the cursor
        sys.stdout.flush()
        os.write(2, f"\n{STOPPED}\n".encode())
        with contextlib.suppress(Exception):  # a page that goes on saying "running" must not keep us here
            _tell_page()
        _end_children()
        if folder:
            shutil.rmtree(folder, ignore_errors=True)
        os._exit(128 + number)

    before = [signal.signal(one, stop) for one in SIGNALS]
    try:
        yield
    finally:
        for one, handler in zip(SIGNALS, before, strict=True):
            signal.signal(one, handler)


def _tell_page() -> None:
    """Tells a dashboard, if one watches, that the run in hand is over."""
    context = sys.modules.get("prefect.context")
    run = context and context.FlowRunContext.get()
    if run is None or not watched():
        return
    from prefect.settings import PREFECT_API_URL

    state = {"type": "CANCELLED", "name": "Cancelled", "message": STOPPED}
    url = f"{PREFECT_API_URL.value()}/flow_runs/{run.flow_run.id}/set_state"
    body = json.dumps({"state": state, "force": True}).encode()
    urllib.request.urlopen(urllib.request.Request(url, body, {"Content-Type": "application/json"}), timeout=2).close()


def _end_children() -> None:
    """Ends the workers and servers that this process has started."""
    import psutil

    for child in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error):
            child.kill()
