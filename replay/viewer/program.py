"""Rerun's viewer as a program: started with its telemetry off, and what it needs to be shown."""

from __future__ import annotations

import contextlib
import ctypes
import os
import re
import secrets
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

from cdmisfa.core.errors import CdmisfaError, UsageError
from cdmisfa.core.untrusted import printable
from replay.view.bindings import viewer_client, viewer_program

SIZE = re.compile(r"[1-9]\d{2,3}x[1-9]\d{2,3}")
"""Width and height of a window, in points."""

LIMIT = re.compile(r"\d+(%|B|[kMGT]B|[KMGT]iB)")
"""What Rerun takes for a limit of memory; another makes it panic."""

INSTALL = "apt-get install mesa-vulkan-drivers libvulkan1"
"""What gives a machine without a graphics card a driver."""

REFUSALS = (OSError, RuntimeError, ValueError)
"""What Rerun's clients raise when the viewer or its server refuses, or is not there."""

TOLD_SECONDS = 30.0
"""Longest wait for a viewer that is starting to take an address."""


def environment() -> dict[str, str]:
    """Environment for the viewer: CI=1 switches its telemetry off."""
    return {**os.environ, "CI": "1"}


def tell(line: str) -> None:
    """A line on stderr, at once."""
    print(printable(line), file=sys.stderr, flush=True)


def check_limit(limit: str) -> str:
    """A limit of memory that the viewer takes.

    Raises:
        UsageError: it is none.
    """
    if not LIMIT.fullmatch(limit):
        raise UsageError(f"--memory-limit {limit} is no amount of memory: say 4GB or 75%")
    return limit


def check_window(size: str) -> str:
    """A size of a window that the viewer takes.

    Raises:
        UsageError: it is none.
    """
    if not SIZE.fullmatch(size):
        raise UsageError(f"--size {size} is no size of a window: say 1600x1000")
    return size


class Program(subprocess.Popen[bytes]):
    """The viewer, or its server, as it runs.

    Args:
        arguments: of the program.
        words: a file for its output; it hangs when nobody empties a pipe.
        given: its standard input.
        apart: an interrupt of the group of processes that we are in is not for it.
    """

    def __init__(
        self,
        arguments: Sequence[str],
        words: BinaryIO,
        given: BinaryIO | None = None,
        *,
        apart: bool = False,
    ) -> None:
        self._words = words
        super().__init__(
            [str(viewer_program()), *arguments],
            env={**environment(), "RUST_LOG": "warn"},
            stdin=given,
            stdout=words,
            stderr=words,
            preexec_fn=ends_with_parent(),
            start_new_session=apart,
        )

    def last_words(self) -> str:
        """What it said about its end, in one line."""
        self._words.seek(0)
        text = self._words.read().decode("utf-8", "replace")
        lines = [line for line in text.splitlines() if line.strip()]
        last = lines[-1].strip() if lines else "it does not say why"
        return next((line for line in lines if "panicked" in line), last)

    def end(self) -> None:
        """End it, if need be by force."""
        with contextlib.suppress(ProcessLookupError):
            self.terminate()
        try:
            self.wait(timeout=5)
        except subprocess.TimeoutExpired:
            self.kill()
            self.wait()


@contextlib.contextmanager
def running(
    arguments: Sequence[str], given: BinaryIO | None = None, *, apart: bool = False
) -> Iterator[Program]:
    """The viewer, or its server, while the body runs; ended on the way out.

    Args:
        arguments: of the program.
        given: its standard input.
        apart: see `Program`.

    Raises:
        CdmisfaError: it has ended with an error, whose last words are given.
    """
    with tempfile.TemporaryFile() as words:
        process = Program(arguments, words, given, apart=apart)
        try:
            yield process
            code = process.poll()
        finally:
            process.end()
        if code:
            raise CdmisfaError(f"the viewer ended with code {code}: {process.last_words()}")


def run_program(
    arguments: Sequence[str],
    given: BinaryIO | None = None,
    begun: Callable[[Program], None] = lambda process: None,
) -> None:
    """Run the viewer, or its server, until it ends; an interrupt ends it and is passed on.

    Args:
        arguments: of the program.
        given: its standard input.
        begun: called with it once it runs.

    Raises:
        CdmisfaError: it ended with an error, whose last words are given.
    """
    with running(arguments, given) as process:
        begun(process)
        process.wait()


def ends_with_parent() -> Callable[[], None] | None:
    """What a child does first so that it ends with us, even when we are killed; Linux only."""
    if not sys.platform.startswith("linux"):
        return None
    # The library is opened here: between fork and exec as little as possible may happen.
    prctl, set_death_signal = ctypes.CDLL(None).prctl, 1

    def ask() -> None:
        prctl(set_death_signal, signal.SIGTERM)

    return ask


def open_privately(address: str) -> None:
    """Open a viewer on what a server of Rerun's has; it stays open when we have ended.

    It is told the address once it runs: others can see a program's arguments.
    """
    host = private_host()
    port = str(free_port(host))
    viewer = _window(host, port, subprocess.DEVNULL)

    def open_it() -> bool:
        viewer_client().connect(f"rerun+http://{host}:{port}/proxy").open(address)
        return True

    def tell() -> None:
        with contextlib.suppress(CdmisfaError):
            wait_until(open_it, TOLD_SECONDS, "the viewer did not start", viewer)
        viewer.wait()

    threading.Thread(target=tell, daemon=True).start()


def open_growing(pieces: Iterable[bytes]) -> None:
    """Open a viewer on a recording that grows; it stays open when we have ended.

    One of its threads does nothing but wait for its standard input: with the default, two fewer
    than the machine has processors, there might be no other.
    """
    host, threads = private_host(), 1 + (os.cpu_count() or 1)
    how = ("--threads", str(threads), "-")
    viewer = _window(host, str(free_port(host)), subprocess.PIPE, *how)
    given = viewer.stdin
    assert given is not None

    def feed() -> None:
        with contextlib.suppress(OSError), given:  # the window may have been closed
            for piece in pieces:
                given.write(piece)
                given.flush()
        viewer.wait()

    threading.Thread(target=feed, daemon=True).start()


def _window(host: str, port: str, given: int, *arguments: str) -> subprocess.Popen[bytes]:
    """A viewer in a window, which outlives us."""
    place = ["--bind", host, "--port", port, "--expect-data-soon", "--memory-limit", "2GB"]
    return subprocess.Popen(
        [str(viewer_program()), *place, *arguments],
        env=environment(),
        stdin=given,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )


def wait_until(
    question: Callable[[], Any], seconds: float, what: str, process: subprocess.Popen[bytes]
) -> Any:
    """Repeat a question to a program until it is answered: while it starts, it raises or has none.

    Args:
        question: gives the answer.
        seconds: longest wait.
        what: did not happen, where there is none in time.
        process: that is asked.

    Returns:
        The answer; None where the process has ended.

    Raises:
        CdmisfaError: there was none in time.
    """
    end, refusal = time.monotonic() + seconds, ""
    while time.monotonic() < end:
        if process.poll() is not None:
            return None
        try:
            if answer := question():
                return answer
        except REFUSALS as error:
            refusal = f": {error}".splitlines()[0]
        time.sleep(0.02)
    raise CdmisfaError(f"{what} within {seconds:.0f} s{refusal}")


def private_host() -> str:
    """A loopback address that cannot be guessed, for a server without authentication.

    On Linux all of 127.0.0.0/8 is this machine; by chance one is taken that no page of somebody
    else's can guess and have its name lead to.
    """
    if not sys.platform.startswith("linux"):
        return "127.0.0.1"
    return ".".join(str(part) for part in (127, *(1 + secrets.randbelow(254) for _ in range(3))))


def free_port(host: str = "127.0.0.1", port: int = 0) -> int:
    """A port of this machine that nothing listens at.

    Args:
        host: on which of its addresses.
        port: the one that is wanted; 0 for any.

    Raises:
        CdmisfaError: somebody listens there, or this user may not.
    """
    with socket.socket() as probe:
        try:
            probe.bind((host, port))
        except OSError as error:
            raise CdmisfaError(f"--port {port}: {error.strerror}, choose another one") from error
        return int(probe.getsockname()[1])


def has_display() -> bool:
    """Whether a window can be opened."""
    return not sys.platform.startswith("linux") or any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")
    )


def vulkan_drivers() -> Iterator[Path]:
    """Manifests of the Vulkan drivers that a loader would find."""
    chosen = os.environ.get("VK_DRIVER_FILES") or os.environ.get("VK_ICD_FILENAMES")
    if chosen:
        yield from (p for p in map(Path, chosen.split(os.pathsep)) if p.exists())
        return
    shared = os.environ.get("XDG_DATA_DIRS") or "/usr/local/share:/usr/share"
    for folder in ("/etc", *shared.split(os.pathsep)):
        yield from Path(folder, "vulkan", "icd.d").glob("*.json")


def missing_driver() -> str:
    """Why no picture can be drawn without a screen here, or "" where it can."""
    if sys.platform.startswith("linux") and not any(vulkan_drivers()):
        return f"no Vulkan driver is installed: {INSTALL}"
    return ""
