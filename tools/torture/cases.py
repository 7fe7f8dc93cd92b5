"""Run cases, each in a forked process, and collect their results."""

from __future__ import annotations

import contextlib
import os
import select
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

import psutil

RIGHT, REFUSED, SKIPPED, DEFECT = "right", "refused in one line", "skipped", "DEFECTS"
SECONDS = 150.0
"""Limit for one case; a campaign's slowest case takes a third of it on two loaded cores."""
RESULT = "result.txt"


@dataclass(frozen=True, slots=True)
class Job:
    """One case.

    Attributes:
        seed: number of the case; the same seed is the same case.
        rng: source of everything random.
        folder: empty folder of the case.
        shared: value that the campaign's `prepare` returned.
    """

    seed: int
    rng: Random
    folder: Path
    shared: Any


class Defect(Exception):  # noqa: N818 - it names what was found
    """Behaviour that must not happen; the message has the command and the observation."""


@dataclass(frozen=True, slots=True)
class Running:
    """A case that runs."""

    seed: int
    pid: int
    pidfd: int
    folder: Path
    began: float


def run(module: Any, seeds: Iterator[int], shared: Any, deadline: float, jobs: int) -> Counter[str]:
    """Run cases until the deadline, at least two of each job; count their results."""
    counts: Counter[str] = Counter()
    running: list[Running] = []
    started, beside = 0, jobs * getattr(module, "BESIDE", 1)
    while running or started < 2 * beside or time.monotonic() < deadline:
        while len(running) < beside and (started < 2 * beside or time.monotonic() < deadline):
            running.append(begin(module, next(seeds), shared))
            started += 1
        for case in wait(running, 0.5):
            running.remove(case)
            counts[end(module, case)] += 1
    return counts


def begin(module: Any, seed: int, shared: Any) -> Running:
    """Start a case in a process of its own."""
    folder = Path(tempfile.mkdtemp(prefix="torture-case-"))
    sys.stdout.flush()
    sys.stderr.flush()
    if (pid := os.fork()) == 0:
        _in_child(module, seed, folder, shared)
    return Running(seed, pid, os.pidfd_open(pid), folder, time.monotonic())


def _in_child(module: Any, seed: int, folder: Path, shared: Any) -> None:
    try:
        os.setsid()
        os.chdir(folder)
        (folder / "case").mkdir()
        job = Job(seed, Random(f"{module.__name__} {seed}"), folder / "case", shared)
        try:
            result = str(module.case(job))
        except Defect as defect:
            result = f"{DEFECT} {defect}"
        except BaseException as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            where = f"{Path(last.filename).name}:{last.lineno}"
            result = f"{DEFECT} the case itself: {type(error).__name__} at {where}: {error}"
        (folder / RESULT).write_text(result)
    finally:
        os._exit(0)


def wait(running: Sequence[Running], seconds: float) -> list[Running]:
    """Wait until one of the cases ends; kill those that take too long."""
    ready = select.select([case.pidfd for case in running], [], [], seconds)[0]
    for case in running:
        if time.monotonic() - case.began > SECONDS:
            os.kill(case.pid, signal.SIGKILL)
    return [case for case in running if case.pidfd in ready]


def end(module: Any, case: Running, *, keep: bool = False) -> str:
    """Return the kind of result of a case that ended; print a defect; remove what it left."""
    # Its zombie still holds the session's number, so no other process can have it.
    left = [p for p in psutil.process_iter() if p.pid != case.pid and _session(p) == case.pid]
    _, _, usage = os.wait4(case.pid, 0)
    os.close(case.pidfd)
    for process in left:
        with contextlib.suppress(psutil.NoSuchProcess):
            process.kill()
    try:
        result = (case.folder / RESULT).read_text()
    except OSError:
        result = f"{DEFECT} the case itself ended after {time.monotonic() - case.began:.0f} s"
    megabytes, limit = usage.ru_maxrss / 1024, getattr(module, "MEGABYTES", None)
    if limit is not None and megabytes > limit:
        result = f"{DEFECT} {megabytes:.0f} MB: {result}"
    if not keep:
        shutil.rmtree(case.folder, ignore_errors=True)
    kind = DEFECT if result.startswith(DEFECT) else result
    if kind == DEFECT:
        name = module.__name__.rpartition(".")[2]
        print(f"{name} --case {case.seed}: {result.removeprefix(DEFECT)}", flush=True)
    return kind


def _session(process: psutil.Process) -> int | None:
    with contextlib.suppress(OSError):
        return os.getsid(process.pid)
    return None
