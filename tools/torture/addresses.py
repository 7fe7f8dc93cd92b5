"""Ports that are taken, addresses that are none, hosts that are not there, servers that lie.

Commands serve where they can, and end with one clear line where they cannot, in time and without
telling a password. Each case has a network of its own, in which there is nothing but itself.
"""

from __future__ import annotations

import ctypes
import fcntl
import itertools
import os
import signal
import socket
import struct
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random

from recorder.cameras import words as cameras

from . import materials
from .commands import LIMIT, Fork, Process, judge, must, until
from .outcomes import RIGHT, SKIPPED, WRONG, Defect, Job, Limits, Outcome

LIMITS = Limits(seconds=60, beside=3, share=3)

CLONE_NEWNET = 0x40000000
SIOCSIFFLAGS, IFF_UP = 0x8914, 1
PR_CAPBSET_DROP, CAP_NET_BIND_SERVICE = 24, 10

PORT, PRIVILEGED = 8765, 80
PASSWORD = "hush-hush"
TIMEOUT = 1.0
"""Seconds that commands are given for what waits for an answer."""


@dataclass(frozen=True, slots=True)
class Case:
    """A command, and what there is on its network.

    Attributes:
        words: of the command.
        group: which row of the page's data it belongs to.
        served: whether it is to succeed.
        begin: makes what there is.
    """

    words: tuple[object, ...]
    group: str
    served: bool = False
    begin: Callable[[], object] = int


def _listening(host: str) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    return socket.create_server((host, PORT), family=family)


def _unprivileged() -> None:
    """Take the right to low ports from what is begun; as a user has it from the start."""
    ctypes.CDLL(None).prctl(PR_CAPBSET_DROP, CAP_NET_BIND_SERVICE)


PORTS: dict[str, tuple[int, bool, Callable[[], object]]] = {
    "free": (PORT, True, int),
    "taken": (PORT, False, lambda: _listening("127.0.0.1")),
    "taken on all interfaces": (PORT, False, lambda: _listening("0.0.0.0")),
    "taken by IPv6": (PORT, True, lambda: _listening("::1")),
    "privileged": (PRIVILEGED, False, _unprivileged),
}

HOSTS = (
    *("127.0.0.1:9", "[::1]:9", "localhost:9", "0.0.0.0:9", "[::]:9", "127.0.0.1:0", "192.0.2.1:9"),
    *("nowhere.invalid", "nowhere.invalid:9", "256.1.1.1", "1.2.3:9", "a..b:9", "x" * 300 + ":9"),
    *(
        "bücher.invalid:9",
        "\N{SNOWMAN}:9",
        "a b:9",
        "-:9",
        "%00:9",
        "",
        ":9",
        "[::1",
        "::1",
        "[]:9",
    ),
    *("[fe80::1%25lo]:9", "[x]:9", "127.0.0.1:65536", "127.0.0.1:-1", "127.0.0.1:x"),
    *(f"127.0.0.1:{'9' * 400}", f"user:{PASSWORD}@127.0.0.1:9", f"user:{PASSWORD}@[::1"),
)


def _nonsense(connection: socket.socket) -> None:
    connection.sendall(os.urandom(1 << 12))


def _no_end(connection: socket.socket) -> None:
    while True:
        connection.sendall(b"HTTP/1.1 200 OK\r\n" + b"x: " + b"y" * (1 << 16))


LIARS: dict[str, Callable[[socket.socket], object]] = {
    "nothing": lambda connection: time.sleep(60),
    "an end": lambda connection: None,
    "nonsense": _nonsense,
    "no end": _no_end,
    "yes to HTTP": lambda connection: connection.sendall(
        b"HTTP/1.1 200 OK\r\n\r\n" + b"\xff" * 999
    ),
    "yes, at length": lambda connection: connection.sendall(
        b"HTTP/1.1 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=b\r\n\r\n--b\r\n"
        b"Content-Type: image/jpeg\r\nContent-Length: 99999999999\r\n\r\n\xff\xd8"
    ),
    "other protocols": lambda connection: connection.sendall(
        b"HTTP/1.1 101 Go\r\n\r\n\x82\x7f" + b"\xff" * 99
    ),
    "RTSP": lambda connection: connection.sendall(
        b"RTSP/1.0 200 OK\r\nCSeq: 1\r\nPublic: X\r\n\r\n"
    ),
}


def _lying(host: str, lie: Callable[[socket.socket], object]) -> None:
    listener = _listening(host)

    def answer(connection: socket.socket) -> None:
        with connection:
            try:
                connection.recv(1 << 12)
                lie(connection)
            except OSError:
                return

    def accept() -> None:
        while True:
            connection, _ = listener.accept()
            threading.Thread(target=answer, args=(connection,), daemon=True).start()

    threading.Thread(target=accept, daemon=True).start()


def _reading(host: str) -> list[tuple[str, tuple[object, ...]]]:
    """List commands that read from a host."""
    return [
        (kind, ("record", address, "--frames", 2, "--size", "16x12", "-o", "out"))
        for kind, address in {
            "foxglove": f"foxglove://{host}/cam",
            "rtsp": f"rtsp://{host}/cam",
            "mjpg": f"http://{host}/cam.mjpg",
            "tcp": f"tcp://{host}",
        }.items()
    ]


def prepare(folder: Path) -> list[Case]:
    """Every case there is."""
    for name in ("recording", "run"):
        materials.MAKERS[name](folder / name)
    rows = ("sweep", "oscillatory", "--seeds", "0:2", "--max-iterations", 3, "--keep-logs")
    must(folder, *rows, "-o", folder / "sweep")
    serving = {
        "view --web": ("view", folder / "run", "--web"),
        "view a sweep": ("view", folder / "sweep"),
    }
    ports = [
        Case(
            (*words, "--port", port),
            f"port {state}: {name}",
            served or (state, name) == ("taken", "view a sweep"),  # which has another address
            begin,
        )
        for (name, words), (state, (port, served, begin)) in itertools.product(
            serving.items(), PORTS.items()
        )
    ]
    addresses = [
        Case(words, f"address: {kind}") for host in HOSTS for kind, words in _reading(host)
    ]
    liars = [
        Case(words, f"{said}: {kind}", begin=lambda h=host, lie=lie: _lying(h, lie))
        for host in ("127.0.0.1", "::1")
        for said, lie in LIARS.items()
        for kind, words in _reading(f"[{host}]:{PORT}" if ":" in host else f"{host}:{PORT}")
    ]
    cameras._TIMEOUT = TIMEOUT  # type: ignore[misc]
    found = [*ports, *addresses, *liars]
    Random(0).shuffle(found)
    return found


def case(job: Job) -> Outcome:
    """The case of a seed; see `Job`."""
    case: Case = job.given[job.seed % len(job.given)]
    if ctypes.CDLL(None).unshare(CLONE_NEWNET) != 0:
        return Outcome(SKIPPED, case.group, "no right to a network of its own")
    with socket.socket() as any_socket:
        fcntl.ioctl(any_socket, SIOCSIFFLAGS, struct.pack("16sh14x", b"lo", IFF_UP))
    kept = case.begin()
    process = (Process if case.begin is _unprivileged else Fork)(job.folder, *case.words)
    # what serves says where, and goes on
    until(lambda: not process.running or "://" in process.ran().out, LIMIT + TIMEOUT)
    said_where = process.running and "://" in process.ran().out
    process.send(signal.SIGINT if case.served else signal.SIGCONT)
    ran = process.wait(LIMIT, case.group, f"within {TIMEOUT:g} s and 5 more")
    del kept
    outcome = judge(ran, case.group, limit=None)
    if PASSWORD in ran.out + ran.err:
        raise Defect(WRONG, case.group, f"{ran.line}: it tells the password: {ran.told()}")
    if case.served != (said_where or outcome.kind == RIGHT):
        raise Defect(WRONG, case.group, f"{ran.line}: exit {ran.code}: {ran.out} {ran.told()}")
    return outcome
