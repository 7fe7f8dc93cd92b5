"""The viewer's web page, served so that a browser asks nobody but this machine for anything.

Rerun's page asks other hosts for fonts, a newer version and examples, and reports to its
makers. A content security policy makes the browser refuse all of that.
"""

from __future__ import annotations

import contextlib
import http.client
import shutil
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

HOST = "127.0.0.1"
SECONDS = 60.0
"""Longest wait for an answer of the viewer's own server."""

START_SECONDS = 20.0
"""Longest wait until it listens: a browser may be quicker than it starts."""

KEPT = ("Content-Type", "Content-Length", "Cache-Control", "ETag")
"""What is passed on of what the viewer's server says about a file."""


def policy(data_port: int) -> str:
    """The content security policy: this page, and the run's data at `data_port`."""
    rules = {
        "default-src": "'self'",
        "script-src": "'self' 'unsafe-inline' 'wasm-unsafe-eval' blob:",
        "style-src": "'self' 'unsafe-inline'",
        "img-src": "'self' data: blob:",
        "worker-src": "'self' blob:",
        "connect-src": f"'self' data: blob: http://{HOST}:{data_port}",
        "base-uri": "'none'",
        "form-action": "'none'",
    }
    return "; ".join(f"{name} {value}" for name, value in rules.items())


@contextlib.contextmanager
def serve_page(viewer_port: int, data_port: int, port: int) -> Iterator[None]:
    """Serve the page of a viewer's own server, with the policy.

    Args:
        viewer_port: where that server listens, on this machine.
        data_port: where the run's data are served.
        port: where to listen, on this machine.

    Raises:
        OSError: the port is taken.
    """
    server = ThreadingHTTPServer((HOST, port), _handler(viewer_port, policy(data_port)))
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield
    finally:
        server.shutdown()
        server.server_close()


def _connect(source: http.client.HTTPConnection) -> None:
    """Connect to a server that may still be starting."""
    end = time.monotonic() + START_SECONDS
    while True:
        try:
            source.connect()
            return
        except ConnectionRefusedError:
            if time.monotonic() > end:
                raise
            time.sleep(0.05)


def _handler(viewer_port: int, rules: str) -> type[BaseHTTPRequestHandler]:
    class Page(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            names = {f"{name}:{self.server.server_port}" for name in (HOST, "localhost")}  # type: ignore[attr-defined]
            if self.headers.get("Host") not in names:  # a name of somebody else's that leads here
                self.send_error(403)
                return
            source = http.client.HTTPConnection(HOST, viewer_port, timeout=SECONDS)
            try:
                _connect(source)
                source.request("GET", self.path)
                answer = source.getresponse()
                self.send_response(answer.status)
                for name in KEPT:
                    if value := answer.headers.get(name):
                        self.send_header(name, value)
                self.send_header("Content-Security-Policy", rules)
                self.end_headers()
                with contextlib.suppress(ConnectionError):  # the browser has gone
                    shutil.copyfileobj(answer, self.wfile)
            except (OSError, http.client.HTTPException):
                self.send_error(502, "the viewer does not answer yet: load the page again")
            finally:
                source.close()

        def log_message(self, format: str, *args: object) -> None:
            """Say nothing: stderr is for the user."""

    return Page
