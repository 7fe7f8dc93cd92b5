"""A web server on this machine that sends parts of files, and counts bytes."""

from __future__ import annotations

import contextlib
import re
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote, urlsplit


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, request: object, client_address: object) -> None:
        """Keep quiet about clients that went away."""


class WebServer:
    """Objects by their path.

    Attributes:
        files: path, with its slash, to content; may be changed at any time.
        sent: bytes of content that were sent.
        asked: bytes of each part that was asked for.
    """

    def __init__(self) -> None:
        self.files: dict[str, bytes] = {}
        self.sent = 0
        self.asked: list[int] = []
        self.server = _Server(("127.0.0.1", 0), _handler_of(self))

    def url(self, path: str) -> str:
        """The URL of an object."""
        return f"http://127.0.0.1:{self.server.server_port}{path}"

    def reset(self) -> None:
        """Begin to count anew."""
        self.sent = 0
        self.asked = []


@contextlib.contextmanager
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
            body = web.files.get(unquote(urlsplit(self.path).path))
            found = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
            if body is None or found is None:
                return self.answer(404 if body is None else 200, body or b"")
            start, stop = int(found[1]), int(found[2]) + 1
            web.asked.append(stop - start)
            if start >= len(body):
                return self.answer(416, **{"Content-Range": f"bytes */{len(body)}"})
            part = body[start:stop]
            said = f"bytes {start}-{start + len(part) - 1}/{len(body)}"
            return self.answer(206, part, **{"Content-Range": said, "ETag": f'"{hash(body)}"'})

        def answer(self, status: int, body: bytes = b"", **headers: str) -> None:
            self.send_response(status)
            for name, value in {**headers, "Content-Length": str(len(body))}.items():
                self.send_header(name, value)
            self.end_headers()
            with contextlib.suppress(ConnectionError):
                self.wfile.write(body)
                web.sent += len(body)

    return Handler
