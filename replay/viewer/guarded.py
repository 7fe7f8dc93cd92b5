"""Serving on this machine to those alone who were given the address.

A page of somebody else's that has its name lead to this machine (DNS rebinding) is refused by
that name, which the browser says in the Host header; a program of another user by the token in
the path, which it cannot know.
"""

from __future__ import annotations

import contextlib
import secrets
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from cdmisfa.core.errors import CdmisfaError

HOST = "127.0.0.1"

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
        OSError: the port is taken.
    """
    token = secrets.token_urlsafe(TOKEN_BYTES)
    server = _Server((HOST, port or 0), _guard(answer, token))
    threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
    try:
        yield f"http://{HOST}:{server.server_port}/{token}/"
    finally:
        server.shutdown()
        server.server_close()


@contextlib.contextmanager
def served_at(answer: Answer, port: int | None) -> Iterator[str]:
    """The same, at a port that a user has chosen.

    Raises:
        CdmisfaError: it is taken.
    """
    with contextlib.ExitStack() as opened:
        try:
            address = opened.enter_context(served(answer, port))
        except OSError as error:
            raise CdmisfaError(f"--port {port}: {error.strerror}, choose another one") from error
        yield address


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
