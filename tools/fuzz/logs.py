"""Read broken logs by the million, and keep those that break the reader.

    python tests/logs.py --cases 1000000 --jobs 2

A job goes on where the one before was stopped; --restart begins again. What is found is
kept in tools/fuzz/cases, and the tests read it from then on.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import multiprocessing
import os
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from . import mutations, oracle
from .mutations import Case

ROOT = Path(__file__).resolve().parents[2]
KEPT = Path(__file__).parent / "cases"
STATE = ROOT / "build" / "fuzz"
EVERY = 1000
"""Cases between two notes of how far a job is."""
MEMORY_EVERY = 50
"""Cases between two whose memory is watched, which makes them slow."""
SLOW = 5.0
"""Seconds in which any small file must have been answered."""


def examine(number: int, path: Path) -> str | None:
    """Read one broken log; what it broke, or None. The log is kept if it did."""
    case = mutations.mutated(number)
    before = time.process_time()
    try:
        if number % MEMORY_EVERY == 0:
            oracle.check_memory(case, path)
        else:
            oracle.check(case, path, number)
        if time.process_time() - before > SLOW:
            raise oracle.BrokenPromise(f"it took more than {SLOW} s")
    except Exception as error:
        keep(case)
        last = traceback.extract_tb(error.__traceback__)[-1]
        return f"{type(error).__name__} at {Path(last.filename).name}:{last.lineno}: {error}"
    return None


def keep(case: Case) -> Path:
    """Store a log that broke something for the tests to read; names tell how it was made."""
    KEPT.mkdir(parents=True, exist_ok=True)
    kind = case.base.replace(" ", "-") or "bytes"
    trusted = "trusted" if case.trusted else "mended"
    name = f"{kind}.{trusted}.{hashlib.sha256(case.raw).hexdigest()[:10]}.mcap"
    (KEPT / name).write_bytes(case.raw)
    return KEPT / name


def kept(path: Path) -> Case:
    """A log that was kept, as the case that it was."""
    base, trusted, *_ = path.name.split(".")
    base = "" if base == "bytes" else base.replace("-", " ")
    return Case(path.read_bytes(), base, trusted == "trusted")


def _job(job: int, jobs: int, cases: int, state: Path) -> int:
    """Examine every `jobs`th case; how many were found that break something."""
    first, found = job, 0
    with contextlib.suppress(OSError, ValueError, KeyError):
        stored = json.loads(state.read_text())
        first, found = stored["next"], stored["found"]
    told: Counter[str] = Counter()
    began, at_start = time.monotonic(), first
    with tempfile.TemporaryDirectory(dir=memory_folder()) as folder:
        path = Path(folder) / "log.mcap"
        for number in range(first, cases, jobs):
            what = examine(number, path)
            if what is not None:
                found += 1
                told[what.split(": ")[0]] += 1
                if told[what.split(": ")[0]] <= 3:
                    print(f"case {number}: {what}", flush=True)
            if (number - job) // jobs % EVERY == EVERY - 1:
                state.write_text(json.dumps({"next": number + jobs, "found": found}))
                rate = (number - at_start) / jobs / (time.monotonic() - began)
                print(f"job {job}: case {number}, {found} found, {rate:.0f}/s", flush=True)
    state.write_text(json.dumps({"next": cases + job, "found": found}))
    return found


def memory_folder() -> str | None:
    """Where a file costs no disk, where there is such a place."""
    return "/dev/shm" if os.access("/dev/shm", os.W_OK) else None


def structured(cases: int, jobs: int, *, restart: bool) -> int:
    """Examine the cases 0 to `cases` with some processes; how many break something."""
    STATE.mkdir(parents=True, exist_ok=True)
    states = [STATE / f"{cases}-{jobs}-{job}.json" for job in range(jobs)]
    for state in states if restart else ():
        state.unlink(missing_ok=True)
    work = [(job, jobs, cases, state) for job, state in enumerate(states)]
    if jobs == 1:
        return _job(*work[0])
    with multiprocessing.get_context("spawn").Pool(jobs) as pool:
        return sum(pool.starmap(_job, work))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the job; 1 when something was found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=1_000_000)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--restart", action="store_true", help="begin again with case 0")
    chosen = parser.parse_args(arguments)
    found = structured(chosen.cases, chosen.jobs, restart=chosen.restart)
    print(f"{chosen.cases} cases, {found} found")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
