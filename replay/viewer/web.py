"""Runs and the viewer's web page, served on this machine to those who have the address.

A page of somebody else's that has its name lead to this machine (DNS rebinding) is refused by
that name, which the browser says in the Host header; a program of another user by the token in
the path, which it cannot know. Rerun's page asks other hosts for fonts, a newer version and
examples, and reports to its makers: a content security policy makes the browser refuse all of that.
"""

from __future__ import annotations

import contextlib
import http.client
import os
import secrets
import shutil
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import BinaryIO
from urllib.parse import quote, urlsplit

from cdmisfa.core.errors import CdmisfaError

HOST = "127.0.0.1"

DATA = "run.rrd"
"""Where the run is, beside the page."""

PIECE = 1 << 20

SECONDS = 60.0
"""Longest wait for an answer of the viewer's own server."""

START_SECONDS = 20.0
"""Longest wait until it listens: a browser may be quicker than it starts."""

KEPT = ("Content-Type", "Content-Length", "Cache-Control", "ETag")
"""What is passed on of what the viewer's server says about a file."""

POLICY = "; ".join(
    (
        "default-src 'self'",
        "script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob:",
        "style-src 'self' 'unsafe-inline'",
        "img-src 'self' data: blob:",
        "worker-src 'self' blob:",
        "connect-src 'self' data: blob:",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
    )
)
"""The content security policy: this page, and what is beside it."""

FRAMED = "frame-ancestors http: https: vscode-webview:"
"""What it says of a page that is for notebooks, whose own address nobody knows before."""

TOKEN_BYTES = 24

Answer = Callable[[BaseHTTPRequestHandler, str], None]
"""Answers a GET for what stands behind the token, without a slash before it."""


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, request: object, client_address: object) -> None:
        """Say nothing of clients that went away."""


@contextlib.contextmanager
def served(answer: Answer, port: int | None = None) -> Iterator[str]:
    """Serve while the body runs.

    Args:
        answer: what is served.
        port: where to listen, on this machine; by default at a free one.

    Yields:
        The address, which ends in a slash: http://127.0.0.1:PORT/TOKEN/

    Raises:
        CdmisfaError: the port is taken.
    """
    token = secrets.token_urlsafe(TOKEN_BYTES)
    try:
        server = _Server((HOST, port or 0), _guard(answer, token))
    except OSError as error:
        raise CdmisfaError(f"--port {port}: {error.strerror}, choose another one") from error
    threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
    try:
        yield f"http://{HOST}:{server.server_port}/{token}/"
    finally:
        server.shutdown()
        server.server_close()


def _guard(answer: Answer, token: str) -> type[BaseHTTPRequestHandler]:
    class Guard(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            place = f"{HOST}:{self.server.server_port}"  # type: ignore[attr-defined]
            _, _, rest = self.path.partition("/")
            given, slash, path = rest.partition("/")
            known = secrets.compare_digest(given.encode("utf-8", "replace"), token.encode())
            if self.headers.get_all("Host") != [place] or not (known and slash):
                self.send_error(403, "this is not the address that was printed")
                return
            with contextlib.suppress(ConnectionError):  # the viewer has gone
                answer(self, path)

        def log_message(self, format: str, *args: object) -> None:
            """Say nothing: stderr is for the user."""

    return Guard


def shown_at(address: str) -> str:
    """The address of the page that shows the run beside it."""
    return f"{address}?url={quote(address + DATA, safe='')}"


def page_server(viewer_port: int) -> list[str]:
    """Arguments with which the viewer's own server has the page, and nothing else, at a port.

    With an address to show it serves no data at a port of its own. This one is without the
    token, as others can see the arguments.
    """
    place = f"http://{HOST}:{viewer_port}/"
    return ["--serve-web", "--bind", HOST, "--web-viewer-port", str(viewer_port), place]


def pieces_of(view: BinaryIO) -> Iterator[bytes]:
    """An .rrd file piece by piece; it may have no name any more, and others may read it, too."""
    at = 0
    while piece := os.pread(view.fileno(), PIECE, at):
        yield piece
        at += len(piece)


def page_of(
    viewer_port: int,
    run: Callable[[], Iterable[bytes]] | None = None,
    data: str = "",
    *,
    framed: bool = False,
) -> Answer:
    """What is served: the files of the viewer's page, with the policy, and a run beside it.

    Args:
        viewer_port: where the viewer's own server has the page, on this machine.
        run: gives the run piece by piece, to each who asks for it.
        data: where else on this machine the page may ask for data, as http://host:port.
        framed: another page may show it in a frame.
    """
    policy = POLICY.replace("connect-src 'self'", f"connect-src 'self' {data}".rstrip())
    if framed:
        policy = policy.replace("frame-ancestors 'none'", FRAMED)

    def answer(request: BaseHTTPRequestHandler, path: str) -> None:
        if run is None or urlsplit(path).path != DATA:
            _pass_on(request, path, viewer_port, policy)
            return
        request.send_response(200)
        request.send_header("Content-Type", "application/octet-stream")
        request.send_header("Cache-Control", "no-store")
        request.end_headers()
        for piece in run():
            request.wfile.write(piece)

    return answer


def _pass_on(request: BaseHTTPRequestHandler, path: str, viewer_port: int, policy: str) -> None:
    """Answer with what the viewer's own server has, which is the same for every run."""
    source = http.client.HTTPConnection(HOST, viewer_port, timeout=SECONDS)
    try:
        _connect(source)
        source.request("GET", f"/{urlsplit(path).path}")
        answer = source.getresponse()
        request.send_response(answer.status)
        for name in KEPT:
            if value := answer.headers.get(name):
                request.send_header(name, value)
        request.send_header("Content-Security-Policy", policy)
        request.send_header("Referrer-Policy", "no-referrer")
        request.end_headers()
        shutil.copyfileobj(answer, request.wfile)
    except (OSError, http.client.HTTPException):
        request.send_error(502, "the viewer does not answer yet: load the page again")
    finally:
        source.close()


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
