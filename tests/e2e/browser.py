"""A real headless Chromium, driven over its own DevTools protocol: nothing to install but the browser."""

from __future__ import annotations

import base64
import itertools
import json
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from websockets.sync.client import ClientConnection, connect

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
START_SECONDS = 60
QUIET = (
    *("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--hide-scrollbars"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync", "--no-first-run"),
)


def executable() -> str | None:
    """Where the browser lies, if there is one."""
    return next(filter(None, map(shutil.which, NAMES)), None)


@contextmanager
def browser(profile: Path, width: int = 1400, height: int = 1000) -> Iterator[Page]:
    """A page of a new browser with a profile of its own."""
    command = [executable(), *QUIET, f"--user-data-dir={profile}", f"--window-size={width},{height}"]
    child = subprocess.Popen(
        [*command, "--remote-debugging-port=0", "about:blank"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        with connect(_page_address(profile, child), max_size=None) as connection:
            yield Page(connection)
    finally:
        child.terminate()
        child.wait(20)


def _page_address(profile: Path, child: subprocess.Popen) -> str:
    """The browser writes its port and the path of its own connection into the profile; pages are opened over that."""
    note = profile / "DevToolsActivePort"
    end = time.monotonic() + START_SECONDS
    while not (note.exists() and len(note.read_text().split()) == 2):
        if child.poll() is not None or time.monotonic() > end:
            raise RuntimeError(f"the browser did not start (exit status {child.poll()})")
        time.sleep(0.1)
    port, path = note.read_text().split()
    with connect(f"ws://127.0.0.1:{port}{path}", max_size=None) as connection:
        target = Page(connection).call("Target.createTarget", url="about:blank")["targetId"]
    return f"ws://127.0.0.1:{port}/devtools/page/{target}"


class Page:
    """One page of the browser. sent: the requests that it made, if Network.enable was called; blocked: those that the
    browser held back."""

    def __init__(self, connection: ClientConnection) -> None:
        self._connection = connection
        self._numbers = itertools.count(1)
        self.sent: dict[str, str] = {}
        self.blocked: set[str] = set()

    def call(self, method: str, **parameters: object) -> dict:
        """One command of the protocol and its result."""
        number = next(self._numbers)
        self._connection.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._connection.recv(timeout=60))
            about = answer.get("params", {})
            if answer.get("method") == "Network.requestWillBeSent":
                self.sent[about["requestId"]] = about["request"]["url"]
            elif answer.get("method") == "Network.loadingFailed" and about.get("blockedReason"):
                self.blocked.add(about["requestId"])
            if answer.get("id") == number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return answer["result"]

    def open(self, address: str) -> None:
        self.call("Page.navigate", url=address)

    def evaluate(self, script: str) -> object:
        """The value of a JavaScript expression."""
        answer = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in answer:
            raise RuntimeError(f"{script}: {answer['exceptionDetails']}")
        return answer["result"].get("value")

    def text(self) -> str:
        """What a reader sees."""
        return str(self.evaluate("document.body ? document.body.innerText : ''"))

    def wait(self, script: str, seconds: float = 30) -> object:
        """Waits until an expression is true and returns its value; fails with what the page shows instead."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            value = self.evaluate(script)
            if value:
                return value
            time.sleep(0.2)
        raise AssertionError(f"never true: {script}\nthe page shows:\n{self.text()[:3000]}")

    def wait_for_text(self, *texts: str) -> None:
        """Waits until the page shows all of them."""
        for text in texts:
            self.wait(f"document.body && document.body.innerText.includes({json.dumps(text)})")

    def screenshot(self, path: Path) -> None:
        """What the window shows, as a PNG."""
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))
