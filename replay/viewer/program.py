"""Rerun's viewer as a program of its own: it is started with its telemetry switched off."""

from __future__ import annotations

import contextlib
import ctypes
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

import rerun_cli

from cdmisfa.core.errors import CdmisfaError, UsageError

LIMIT = re.compile(r"\d+(%|B|[kMGT]B|[KMGT]iB)")
"""What Rerun takes for a limit of memory; another makes it panic."""


def program() -> Path:
    """The viewer itself; the `rerun` on the path is a wrapper that leaves it behind when ended."""
    return Path(rerun_cli.__file__).with_name("rerun.exe" if os.name == "nt" else "rerun")


def environment() -> dict[str, str]:
    """Environment for the viewer: CI=1 switches its telemetry off."""
    return {**os.environ, "CI": "1"}


def check_limit(limit: str) -> str:
    """A limit of memory that the viewer takes.

    Raises:
        UsageError: it is none.
    """
    if not LIMIT.fullmatch(limit):
        raise UsageError(f"--memory-limit {limit} is no amount of memory: say 4GB or 75%")
    return limit


def has_display() -> bool:
    """Whether a window can be opened."""
    return not sys.platform.startswith("linux") or any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")
    )


def last_words(words: BinaryIO) -> str:
    """What a viewer said about its end, in one line."""
    words.seek(0)
    lines = [line for line in words.read().decode("utf-8", "replace").splitlines() if line.strip()]
    last = lines[-1].strip() if lines else "it does not say why"
    return next((line for line in lines if "panicked" in line), last)


@contextlib.contextmanager
def running(
    arguments: Sequence[str], given: BinaryIO | None = None
) -> Iterator[subprocess.Popen[bytes]]:
    """The viewer, or its server, while the body runs; ended on the way out.

    Args:
        arguments: of the program.
        given: its standard input.

    Raises:
        CdmisfaError: it has ended with an error, whose last words are given.
    """
    command = [str(program()), *arguments]
    variables = {**environment(), "RUST_LOG": "warn"}
    with tempfile.TemporaryFile() as words:
        process = subprocess.Popen(
            command,
            env=variables,
            stdin=given,
            stdout=words,
            stderr=words,
            preexec_fn=ends_with_parent(),
        )
        try:
            yield process
            code = process.poll()
        finally:
            stop(process)
        if code:
            raise CdmisfaError(f"the viewer ended with code {code}: {last_words(words)}")


def run_program(arguments: Sequence[str], given: BinaryIO | None = None) -> None:
    """Run the viewer, or its server, until it ends; an interrupt ends it and is passed on.

    Args:
        arguments: of the program.
        given: its standard input.

    Raises:
        CdmisfaError: it ended with an error, whose last words are given.
    """
    with running(arguments, given) as process:
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


def stop(process: subprocess.Popen[bytes]) -> None:
    with contextlib.suppress(ProcessLookupError):
        process.send_signal(signal.SIGTERM)
    try:
        process.wait(timeout=5)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def free_port() -> int:
    """A port of this machine that nothing listens at."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
