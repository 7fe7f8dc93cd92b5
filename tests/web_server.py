"""A web server on this machine that sends parts of files, counts bytes, and can misbehave."""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Literal
from urllib.parse import unquote, urlsplit

Fault = Literal[
    "", "no ranges", "short", "other part", "403", "500 once", "endless", "packed", "no length"
]


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, request: object, client_address: object) -> None:
        """Keep quiet about clients that went away."""


class WebServer:
    """Objects by their path.

    Attributes:
        files: path, with its slash, to content; may be changed at any time.
        sent: bytes of content that were sent.
        requests: (path, first byte asked for) of every request.
        fault: how it misbehaves from now on.
    """

    def __init__(self) -> None:
        self.files: dict[str, bytes] = {}
        self.sent = 0
        self.requests: list[tuple[str, int]] = []
        self.fault: Fault = ""
        self.server = _Server(("127.0.0.1", 0), _handler_of(self))

    def url(self, path: str) -> str:
        """The URL of an object."""
        return f"http://127.0.0.1:{self.server.server_port}{path}"

    def reset(self) -> None:
        """Begin to count anew."""
        self.sent, self.requests = 0, []


@contextmanager
def serving() -> Iterator[WebServer]:
    """A server for as long as it is wanted."""
    web = WebServer()
    thread = threading.Thread(target=web.server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    try:
        yield web
    finally:
        web.server.shutdown()
        thread.join()
        web.server.server_close()


def _handler_of(web: WebServer) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"
        disable_nagle_algorithm = True

        def log_message(self, *args: object) -> None:
            pass

        def do_GET(self) -> None:
            path = unquote(urlsplit(self.path).path)
            found = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
            start, stop = (int(found[1]), int(found[2]) + 1) if found else (0, 2**63)
            web.requests.append((path, start))
            body = web.files.get(path)
            if web.fault == "500 once":
                web.fault = ""
                return self.answer(500)
            if body is None or web.fault == "403":
                return self.answer(404 if body is None else 403)
            if start >= len(body):
                return self.answer(416, **{"Content-Range": f"bytes */{len(body)}"})
            if found is None or web.fault == "no ranges":
                return self.answer(200, body)
            part = body[start:stop]
            first = start + 1 if web.fault == "other part" else start
            said = f"bytes {first}-{start + len(part) - 1}/{len(body)}"
            tag = f'"{hash(body)}"'
            headers = {"Content-Range": said, "ETag": tag}
            if web.fault == "packed":
                headers["Content-Encoding"] = "gzip"
            length = len(part)
            if web.fault == "short":
                part = part[: len(part) // 2]
            if web.fault == "endless":
                part, length = bytes(50_000_000), 50_000_000
            return self.answer(206, part, length, **headers)

        def answer(
            self, status: int, body: bytes = b"", length: int | None = None, **headers: str
        ) -> None:
            self.send_response(status)
            for name, value in headers.items():
                self.send_header(name, value)
            self.send_header("Content-Length", str(len(body) if length is None else length))
            self.end_headers()
            try:
                for at in range(0, len(body), 1 << 16):
                    self.wfile.write(body[at : at + (1 << 16)])
                    web.sent += len(body[at : at + (1 << 16)])
            except ConnectionError:
                pass
            if length not in (None, len(body)):
                self.close_connection = True

    return Handler
