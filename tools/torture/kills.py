"""Kill commands at any moment, with kill -9 or with signals that ask them to end.

What is on disk then is readable and lacks at most the last second; resuming, which may be killed
again, gives the same bytes. A command that is asked to end does so within 5 s, with its workers.
When a worker is killed, the command continues or ends with one clear line.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil

from recorder.mcap.reader import LogReader
from replay.runs.log import SIGNALS_TOPIC

from .cases import RIGHT, SKIPPED, Defect, Job
from .commands import LIMIT, UNCLEAR, Fork, Ran, judge, until
from .works import WORKS, Work, not_begun
from .works import prepare as prepare_works

BESIDE = 3
"""A case waits most of the time."""

SIGNALS = {
    (signal.SIGKILL,): 60,
    (signal.SIGTERM,): 8,
    (signal.SIGINT,): 8,
    (signal.SIGHUP,): 8,
    (signal.SIGINT, signal.SIGINT): 6,
    (signal.SIGINT, signal.SIGKILL): 5,
}
"""Signals in their order, with how often they are sent."""
PAUSED = 2.5
"""Seconds to which a quick command is slowed down."""
WORKER = 0.6
"""Share of cases with workers in which one of these is killed instead of the command."""
GOING_ON = 90.0
"""Seconds within which a command must end after it lost a worker: others may take its work."""
KEYFRAMES = 25
FLUSH = 1.0
"""Seconds within which what was written is on disk."""


def prepare(folder: Path) -> tuple[Path, dict[str, Any], dict[str, float]]:
    """Return the folder that works read, their results, and the seconds that they take."""
    return (folder, *prepare_works(folder, WORKS))


def case(job: Job) -> str:
    """Kill a command, perhaps again while it resumes, then let it finish."""
    rng, (shared, results, seconds) = job.rng, job.shared
    name = rng.choice(list(WORKS))
    work, place, kills = WORKS[name], job.folder / "out", 0
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        (how,) = rng.choices(list(SIGNALS), list(SIGNALS.values()))
        if _killed(job, work.again(place, shared), work, how, seconds[name]):
            break
        kills += 1
    work.finish(place, shared, results[name])
    return RIGHT if kills else SKIPPED


def _killed(job: Job, words: tuple[object, ...], work: Work, how: Any, takes: float) -> bool:
    """Start a command, kill it and check what it left; return whether it had ended before."""
    rng, place, witness = job.rng, job.folder / "out", job.folder / "witness"
    witness.unlink(missing_ok=True)
    pause = PAUSED / work.blocks if work.blocks else 0.0
    process = Fork(job.folder, *words, tweak=witnessing(witness, pause))
    until(lambda: not process.running, rng.uniform(0, (takes + pause * work.blocks) * 1.05))
    children: list[psutil.Process] = []
    if not (over := not process.running):
        children = psutil.Process(process.pid).children(recursive=True)
    workers = [child for child in children if _computes(child)]
    if workers and rng.random() < WORKER:
        rng.choice(workers).kill()
        judge(process.wait(GOING_ON, "whose worker was killed"), limit=None)
        return over
    process.send(how[0])
    killed = time.monotonic()
    for number in how[1:]:
        time.sleep(rng.choice((0, 0.001, 0.01, 0.1)))
        process.send(number)
    ran = process.wait(LIMIT, f"after {how}")
    _check_end(ran, how)
    _, left = psutil.wait_procs(children, timeout=LIMIT)
    if left := [child for child in left if child.is_running() and child.status() != "zombie"]:
        raise Defect(f"its processes {left} live on: {ran}")
    check_disk(place, due(witness, killed, work.log_fps), ran)
    return over


def _computes(child: psutil.Process) -> bool:
    """Return whether a child is a worker and not a process that only tidies up."""
    with contextlib.suppress(psutil.NoSuchProcess):
        return any("spawn_main" in w or "popen_loky" in w for w in child.cmdline())
    return False


def _check_end(ran: Ran, how: tuple[int, ...]) -> None:
    if UNCLEAR.search(ran.err) is None and ("over before" in ran.err or not_begun(ran)):
        return
    codes = {0, *(128 + number for number in how), *(-number for number in how)}
    if ran.code not in codes or UNCLEAR.search(ran.err):
        raise Defect(f"no clear end after {how}: {ran}")


def check_disk(place: Path, wanted: dict[str, int], ran: Ran) -> None:
    """Read everything that an interrupted command left, and count it."""
    there: Counter[str] = Counter()
    for path in sorted(place.rglob("*.mcap*")) if place.exists() else ():
        whole = path.suffix == ".mcap"
        if not whole and path.stat().st_size == 0:
            continue
        try:
            counts = _counted(path, whole)
        except Exception as error:
            raise Defect(f"{path.name} is not readable: {error}: {ran}") from None
        for what, n in counts.items():
            # The log of a resumed run lies beside the new one; views are in parts.
            there[what] = max(there[what], n) if what == "run" else there[what] + n
    for what, n in wanted.items():
        if there[what] < n:
            raise Defect(f"{what} has {there[what]}, had {n}: {ran}")


def _counted(path: Path, whole: bool) -> Counter[str]:
    counts: Counter[str] = Counter()
    with LogReader(path, skip_damaged=not whole) as reader:
        for message in reader.messages():
            topic = message.channel.topic
            if topic == SIGNALS_TOPIC:
                counts["run"] += 1
            elif topic.startswith("/view/"):
                counts[topic.removeprefix("/view/")] += 1
        if whole and (reader.problems or not reader.complete):
            raise ValueError(f"it has its name and is not whole: {reader.problems}")
    return counts


def witnessing(path: Path, pause: float) -> Callable[[], None]:
    """Return a function that has a process note every block that it writes, then pause."""

    def tweak() -> None:
        from cdmisfa.experiments import session
        from recorder.log.viewlog import ViewLog
        from replay.runs.writer import RunWriter

        # Unbuffered, so that the notes outlive the process.
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)

        def after(kind: Any, name: str, describe: Callable[..., tuple[str, int]]) -> None:
            method = getattr(kind, name)

            def noted(self: Any, *arguments: Any) -> None:
                method(self, *arguments)
                what, number = describe(self, *arguments)
                os.write(file, f"{what} {number} {time.monotonic()}\n".encode())
                time.sleep(pause)

            setattr(kind, name, noted)

        after(ViewLog, "write", lambda log, block: (log._view, log.t))
        after(RunWriter, "block", lambda log, block, signals, learner: ("run", learner.iteration))
        original = session.Keyframes
        session.Keyframes = lambda *args: original(*args[:-1], KEYFRAMES)  # type: ignore

    return tweak


def due(path: Path, killed: float, log_fps: float) -> dict[str, int]:
    """Return how much must be on disk: what was noted more than a second before the kill.

    Args:
        path: file of the notes.
        killed: when, by the monotonic clock.
        log_fps: frames of a second of log time, after which a recording flushes.

    Returns:
        The frames of each view, and the iterations of "run".
    """
    if not path.exists():
        return {}
    notes: dict[str, list[tuple[int, float]]] = defaultdict(list)
    for line in path.read_text().splitlines():
        what, number, at = line.split()
        notes[what].append((int(number), float(at)))
    wanted = {}
    for what, pairs in notes.items():
        steps = [b - a for (a, _), (b, _) in itertools.pairwise(pairs)]
        times = [b - a for (_, a), (_, b) in itertools.pairwise(pairs)]
        if what == "run":
            before = killed - FLUSH - max(times, default=0.0)
            wanted[what] = max((n for n, at in pairs if at <= before), default=0)
        else:
            block = max([*steps, pairs[0][0]])
            wanted[what] = max(0, pairs[-1][0] - round(FLUSH * log_fps) - block)
    return wanted
