"""Commands on a log of a server that lies: the right bits in time, or one clear line."""

from __future__ import annotations

import contextlib
import io
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from camera_files import write_cameras
from lying_server import lying

from cdmisfa.cli import run
from replay.recordings.source import RecordedSource

from .server_lies import LIES

TIMES = ("--timeout", "1.5", "--read-timeout", "0.5")
LIMIT = 6.5
"""Seconds in which every command must have ended: 5 more than its own limit."""

LEARN = ("--set", "learner.tau=10", "--max-iterations", "6")
CAMERAS = ("--topic", "/left", "--topic", "/right", "--size", "16x12")


@dataclass(frozen=True, slots=True)
class Case:
    """A lie, about a log, to a command."""

    lie: str
    log: str
    command: str


CASES = tuple(
    Case(lie, log, command)
    for lie in LIES
    for log in ("cameras", "recording")
    for command in ("info", "verify", "learn", "convert")
    if (log, command) != ("recording", "convert")
)


@dataclass(frozen=True, slots=True)
class Given:
    """The logs, another one of each kind, and what commands say of them as files."""

    logs: dict[str, tuple[bytes, bytes]]
    right: dict[tuple[str, str], list[Any]]


class WrongError(AssertionError):
    """What must not be; `kind` is one of the torture suite's words for defects."""

    def __init__(self, kind: str, detail: str) -> None:
        super().__init__(detail)
        self.kind = kind


def prepare(folder: Path) -> Given:
    """Make the logs and ask the commands about them."""
    for name, topics in (("one", ("/left", "/right")), ("two", ("/right", "/left"))):
        write_cameras(folder / f"{name}.mcap", dict.fromkeys(topics, (600, 20)))
        words = ("record", "oscillatory", "-o", folder / name, "--frames", 1500)
        made, _, err = call(*words, *(("--set", "scene.streams=x1,x2") if name == "two" else ()))
        assert made == 0, err
    files = {
        "cameras": (folder / "one.mcap", folder / "two.mcap"),
        "recording": (folder / "one" / "x1.mcap", folder / "two" / "x2.mcap"),
    }
    right = {
        (case.log, case.command): [
            told(case, str(file), folder / f"{case.log}-{file.parent.name}-{file.stem}")
            for file in files[case.log]
        ]
        for case in CASES[:7]
    }
    logs = {name: (one.read_bytes(), two.read_bytes()) for name, (one, two) in files.items()}
    return Given(logs, right)


def call(*words: object) -> tuple[int, str, str]:
    """Run a command: its exit code, and what it wrote to stdout and stderr."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = run([str(word) for word in words])
    return code, out.getvalue(), err.getvalue()


def told(case: Case, place: str, out: Path, times: tuple[str, ...] = ()) -> Any:
    """What a command comes to; of one that fails its exit code and its line."""
    words = {
        "info": ("info", place, "--json"),
        "verify": ("verify", place, "--json"),
        "learn": ("learn", place, *LEARN, *(CAMERAS if case.log == "cameras" else ()), "--json"),
        "convert": ("convert", place, *CAMERAS, "-o", str(out), "--json"),
    }[case.command]
    code, written, err = call(*words, *times)
    if code and not (case.command in ("info", "verify") and written):
        return code, err
    if case.command == "convert":
        with RecordedSource(out) as source:
            frames = [source.take(0, source.frames).frames]
            source.seek(0)
            frames.append(source.take(1, source.frames).frames)
        return np.concatenate(frames).tobytes()
    said = json.loads(written)
    if case.command == "verify":
        return "whole" if not code else "damaged"
    if case.command == "info":
        named = [{**channel, "file": ""} for channel in said["channels"]]
        return named if said["complete"] and not code else "cut"
    return said["signals_sha256"]


def check(case: Case, given: Given, out: Path, seed: int = 0) -> str:
    """Run one case.

    Returns:
        "right", or the line of a clear error.

    Raises:
        WrongError: what must not be.
    """
    one, two = given.logs[case.log]
    with lying(one, LIES[case.lie], two, seed) as server:
        began = time.monotonic()
        found = told(case, server.address, out, TIMES)
        took = time.monotonic() - began
    if took > LIMIT:
        raise WrongError("hang", f"{case}: {took:.1f} s")
    if isinstance(found, tuple):
        code, err = found
        *notes, last = err.splitlines() or [""]
        clear = last.startswith("cdmisfa: ") and last.isprintable() and len(last) < 500
        plain = not any("cdmisfa: " in note for note in notes) and "unexpected" not in err
        if code not in (1, 2, 3) or not clear or not plain:
            raise WrongError("traceback", f"{case}: exit code {code}, {err!r}")
        return str(last)
    if found not in (*given.right[case.log, case.command], "damaged", "cut"):
        raise WrongError("mixed", f"{case}: not what any of the files gives")
    return "right"
