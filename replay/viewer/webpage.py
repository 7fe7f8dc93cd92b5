"""The viewer's web page and the run that it shows, for a browser that asks nobody else.

Rerun's page asks other hosts for fonts, a newer version and examples, and reports to its
makers. A content security policy makes the browser refuse all of that.
"""

from __future__ import annotations

import http.client
import shutil
import threading
import time
from http.server import BaseHTTPRequestHandler
from typing import BinaryIO
from urllib.parse import quote, urlsplit

from replay.viewer.guarded import HOST, Answer

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


def page_for(data: str, viewer_port: int) -> Answer:
    """The files of the page, which may ask for data elsewhere on this machine, too.

    Args:
        data: where, as http://host:port.
        viewer_port: as for `page_of`.
    """
    policy = POLICY.replace("connect-src 'self'", f"connect-src 'self' {data}")
    return lambda request, path: _pass_on(request, path, viewer_port, policy)


def page_of(view: BinaryIO, viewer_port: int) -> Answer:
    """What is served: a run, and the files of the page, with the policy.

    Args:
        view: of the run, an .rrd file; it may have no name any more.
        viewer_port: where the viewer's own server has the page, on this machine.
    """
    reading = threading.Lock()

    def piece(at: int) -> bytes:
        with reading:
            view.seek(at)
            return view.read(PIECE)

    def answer(request: BaseHTTPRequestHandler, path: str) -> None:
        if urlsplit(path).path != DATA:
            _pass_on(request, path, viewer_port)
            return
        request.send_response(200)
        request.send_header("Content-Type", "application/octet-stream")
        request.send_header("Cache-Control", "no-store")
        request.end_headers()
        at = 0
        while data := piece(at):
            request.wfile.write(data)
            at += len(data)

    return answer


def _pass_on(
    request: BaseHTTPRequestHandler, path: str, viewer_port: int, policy: str = POLICY
) -> None:
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
