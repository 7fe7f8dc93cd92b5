"""Commands killed at any moment, with kill -9 or with signals that ask them to end.

What is on disk then is readable and holds all but the last second; going on, which may be killed
again, gives the bytes of recordings, the signals and modules of runs, and the results of sweeps
that were never stopped. What is asked to end does so within 5 s, and at the second signal, too.
"""

from __future__ import annotations

import signal
import time
from collections import Counter
from pathlib import Path
from typing import Any

from recorder.mcap.reader import LogReader
from replay.runs.log import SIGNALS_TOPIC

from .commands import ERRORS, LIMIT, UNCLEAR, Fork, Process, Ran, here, until
from .outcomes import (
    HANG,
    LOST,
    MIXED,
    RIGHT,
    SKIPPED,
    TRACEBACK,
    WRONG,
    Defect,
    Job,
    Limits,
    Outcome,
)
from .processes import descendants, wait_gone
from .witness import due, witnessing
from .works import WORKS, Work, prepared

LIMITS = Limits(seconds=150, share=9, enough=1_100, beside=3)

SIGNALS = {
    "kill -9": (signal.SIGKILL,),
    "TERM": (signal.SIGTERM,),
    "INT": (signal.SIGINT,),
    "HUP": (signal.SIGHUP,),
    "INT, INT": (signal.SIGINT, signal.SIGINT),
    "TERM, HUP": (signal.SIGTERM, signal.SIGHUP),
    "INT, kill -9": (signal.SIGINT, signal.SIGKILL),
}
WEIGHTS = (60, 8, 8, 8, 6, 5, 5)
RESUMED = ("", ", resumed", ", resumed twice")
SECONDS = 2.5
"""For which a command is made to run that would be over sooner."""
REAL = 0.1
"""Share of commands that are begun as a user would, importing everything."""


def prepare(folder: Path) -> dict[str, Any]:
    """Results of commands that nobody stops, and how long each takes."""
    return prepared(folder, WORKS)


def case(job: Job) -> Outcome:
    """Kill a command, perhaps also when it goes on, and let it finish."""
    rng = job.rng
    (name,) = rng.choices(list(WORKS), [work.share for work in WORKS.values()])
    work, shared = WORKS[name], job.given["folder"]
    place, kills = job.folder / "out", Counter[str]()
    words: tuple[object, ...] = work.words(place, shared)
    for attempt in range(rng.choice((1, 1, 1, 2, 3))):
        (how,) = rng.choices(list(SIGNALS), WEIGHTS)
        group = f"{name}{RESUMED[attempt]}: {how}"
        line = going_on(place, words, work) if begun(place) else words
        if _killed(job, line, work, SIGNALS[how], group, job.given["seconds"][name]):
            break
        kills[group] += 1
    finish(place, words, work, group)
    if (found := work.result(place)) != job.given["results"][name]:
        raise Defect(MIXED, group, f"{name}, {dict(kills)}: gone on with, it gives {found}")
    if not kills:
        return Outcome(SKIPPED, group, "it had ended before")
    return Outcome(RIGHT, group, count=kills.total())


def _killed(
    job: Job, words: tuple[object, ...], work: Work, how: tuple[int, ...], group: str, takes: float
) -> bool:
    """Begin a command, kill it, and look at what is there; whether it was over before."""
    rng, place = job.rng, job.folder / "out"
    witness = job.folder / "witness"
    witness.unlink(missing_ok=True)
    if rng.random() < REAL:
        process, takes = Process(job.folder, *words), takes + 1
    else:
        pause = SECONDS / work.blocks if work.blocks else 0.0
        takes += pause * work.blocks
        process = Fork(job.folder, *words, tweak=witnessing(witness, pause))
    until(lambda: not process.running, rng.uniform(0, takes * 1.05))
    over, children = not process.running, descendants(process.pid)
    process.send(how[0])
    killed = time.monotonic()
    for number in how[1:]:
        time.sleep(rng.choice((0, 0.001, 0.01, 0.1)))
        process.send(number)
    ran = process.wait(LIMIT, group, f"after {group}")
    _check_end(ran, how, group)
    if left := wait_gone(children, LIMIT):
        raise Defect(HANG, group, f"{ran.line}: after it its processes {left} live on")
    check_disk(place, due(witness, killed, work.log_fps), group, ran)
    return over


def _check_end(ran: Ran, how: tuple[int, ...], group: str) -> None:
    codes = {0, *(128 + number for number in how), *(-number for number in how)}
    refused = ran.code in ERRORS and not UNCLEAR.search(ran.err)
    if refused and ("over before" in ran.err or nothing_yet(ran)):
        return
    early = "cdmisfa:" not in ran.err and "KeyboardInterrupt" in ran.err and ran.seconds < 2
    if early:  # before anything of ours was imported
        return
    if ran.code not in codes or UNCLEAR.search(ran.err):
        raise Defect(TRACEBACK, group, f"{ran.line}: exit {ran.code}: {ran.told()}")


def begun(place: Path) -> bool:
    """Whether there is something to go on with."""
    return place.exists() and any(place.iterdir())


def going_on(place: Path, words: tuple[object, ...], work: Work) -> tuple[object, ...]:
    """The command that goes on with another."""
    return work.on(place) if work.on else (*words, *work.again)


def nothing_yet(ran: Ran) -> bool:
    """Whether what would go on says that one has to begin anew."""
    return ran.code == 2 and ("no run to resume" in ran.err or "fork again with --f" in ran.err)


def finish(place: Path, words: tuple[object, ...], work: Work, group: str) -> None:
    """Go on to the end, or begin anew where nothing was there yet; that must be said clearly."""
    ran = here(*(going_on(place, words, work) if begun(place) else words))
    if nothing_yet(ran):
        ran = here(*words, "--force")
    if ran.code != 0:
        kind = TRACEBACK if UNCLEAR.search(ran.err) else WRONG
        raise Defect(kind, group, f"{ran.line}: after a kill: exit {ran.code}: {ran.told()}")


def check_disk(place: Path, wanted: dict[str, int], group: str, ran: Ran) -> None:
    """Read everything that a killed command left, and count it."""
    there: Counter[str] = Counter()
    for path in sorted(place.rglob("*.mcap*")) if place.exists() else ():
        whole = path.suffix == ".mcap"
        try:
            counts = _counted(path, whole)
        except Exception as error:
            if not whole and path.stat().st_size == 0:
                continue
            raise Defect(
                WRONG, group, f"{ran.line}: {path.name} is not readable: {error}"
            ) from None
        for what, n in counts.items():
            # the log of a run that is resumed lies beside the new one
            there[what] = max(there[what], n) if what == "run" else there[what] + n
    for what, n in wanted.items():
        if there[what] < n:
            raise Defect(LOST, group, f"{ran.line}: {what} has {there[what]}, had {n}")


def _counted(path: Path, whole: bool) -> Counter[str]:
    counts: Counter[str] = Counter()
    with LogReader(path, salvage=not whole) as reader:
        for message in reader.messages(ordered=False):
            topic = message.channel.topic
            if topic == SIGNALS_TOPIC:
                counts["run"] += 1
            elif topic.startswith("/view/"):
                counts[topic.removeprefix("/view/")] += 1
        if whole and (reader.problems or not reader.complete):
            raise ValueError(f"it has its name and is not whole: {reader.problems}")
    return counts
