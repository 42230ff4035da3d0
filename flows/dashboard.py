"""``python -m flows.dashboard``: Prefect's server with its pages, until it is stopped.

It listens on the loopback only, sends nothing anywhere and opens no browser. Runs of the same user find it by a note
that it leaves in Prefect's folder, so nothing has to be exported. What it has shown stays in a database beside it.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
from collections.abc import Callable

from flows.server import dashboard_address, dashboard_note, free_port, quiet_prefect

HINT = """\
dashboard   {pages}
runs        python -m flows.run …     in another terminal; it finds this dashboard by itself
others      export PREFECT_API_URL={api}     for runs of another user on this machine
stop        Ctrl-C
"""


def main(arguments: list[str] | None = None) -> int:
    """The command line. Returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m flows.dashboard", description=__doc__.splitlines()[0])
    parser.add_argument("--port", type=int, help="where to listen (else a free port)")
    port = parser.parse_args(arguments).port or free_port()
    quiet_prefect()
    earlier = dashboard_address()
    if earlier:
        print(f"a dashboard runs already: {_pages(earlier)}")
        return 0
    serve(port)
    return 0


def serve(port: int) -> None:
    """Serves until Ctrl-C or SIGTERM; the address is printed and noted once the server answers."""
    api = f"http://127.0.0.1:{port}/api"
    note = dashboard_note()
    note.parent.mkdir(parents=True, exist_ok=True)
    os.environ |= {  # read when Prefect is imported
        "PREFECT_API_URL": api,  # what the pages call
        "PREFECT_API_DATABASE_CONNECTION_URL": f"sqlite+aiosqlite:///{note.with_name('dashboard.db')}",
        "PREFECT_UI_STATIC_DIRECTORY": str(note.with_name("pages")),  # the default lies in the package's own folder
        "PREFECT_SERVER_UI_SHOW_PROMOTIONAL_CONTENT": "false",
    }
    import uvicorn
    from prefect.server.api.server import create_app

    class Announced(uvicorn.Server):
        """Says where it listens once it does."""

        async def startup(self, sockets: list | None = None) -> None:
            await super().startup(sockets)
            if self.started:
                note.write_text(json.dumps({"api": api}), "utf-8")
                print(HINT.format(pages=_pages(api), api=api), flush=True)

    app = closed(create_app(final=True), port)
    settings = uvicorn.Config(app, host="127.0.0.1", port=port, log_level="error", timeout_graceful_shutdown=2)
    try:
        with contextlib.suppress(KeyboardInterrupt):
            Announced(settings).run()
    finally:
        note.unlink(missing_ok=True)


def closed(app: Callable, port: int) -> Callable:
    """The ASGI app with a rule for browsers: its pages may talk to this server and to nobody else.

    Prefect's pages load a usage tracker whatever its settings say.
    """
    here = " ".join(f"{scheme}://{host}:{port}" for scheme in ("http", "ws") for host in ("127.0.0.1", "localhost"))
    rule = f"default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob: {here}".encode()

    async def answer(scope: dict, receive: Callable, send: Callable) -> None:
        async def send_closed(message: dict) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message["headers"], (b"content-security-policy", rule)]
            await send(message)

        await app(scope, receive, send_closed if scope["type"] == "http" else send)

    return answer


def _pages(api: str) -> str:
    return api.removesuffix("/api")


if __name__ == "__main__":
    sys.exit(main())
