"""Read broken logs, and store those that break the reader.

    python -m tools.fuzz.logs --cases 100000 --jobs 2 [--first 0]

Stored logs are in tools/fuzz/cases, which the tests read.
"""

from __future__ import annotations

import argparse
import hashlib
import multiprocessing
import sys
import tempfile
import time
import traceback
from collections.abc import Sequence
from pathlib import Path

from . import mutations, oracle
from .mutations import Case

ROOT = Path(__file__).resolve().parents[2]
KEPT = Path(__file__).parent / "cases"
MEMORY_EVERY = 50
"""Cases between two whose memory is traced, which makes them slow."""
SECONDS = 5.0
"""Processor time within which a small file must be answered."""


def examine(number: int, path: Path) -> str | None:
    """Read one broken log; return a line about what it broke, or None."""
    case = mutations.mutated(number)
    before = time.process_time()
    try:
        if number % MEMORY_EVERY == 0:
            oracle.check_memory(case, path)
        else:
            oracle.check(case, path, number)
        if time.process_time() - before > SECONDS:
            raise oracle.BrokenPromise(f"it took more than {SECONDS} s")
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{Path(last.filename).name}:{last.lineno}"
        return f"{type(error).__name__} at {where}: {error}; stored {keep(case)}"
    return None


def keep(case: Case) -> Path:
    """Store a log for the tests; its name says how it was made."""
    trusted = "trusted" if case.trusted else "mended"
    digest = hashlib.sha256(case.raw).hexdigest()[:10]
    path = KEPT / f"{case.base.replace(' ', '-')}.{trusted}.{digest}.mcap"
    KEPT.mkdir(parents=True, exist_ok=True)
    path.write_bytes(case.raw)
    return path


def kept(path: Path) -> Case:
    """Return the case that a stored log was."""
    base, trusted, *_ = path.name.split(".")
    return Case(path.read_bytes(), base.replace("-", " "), trusted == "trusted")


def examine_all(numbers: range) -> int:
    """Examine broken logs; return how many break something."""
    defects = 0
    with tempfile.TemporaryDirectory() as folder:
        for number in numbers:
            if what := examine(number, Path(folder) / "log.mcap"):
                defects += 1
                print(f"case {number}: {what}", flush=True)
    return defects


def main(arguments: Sequence[str] | None = None) -> int:
    """Examine broken logs; return 1 when one breaks something."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=100_000)
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--jobs", type=int, default=1)
    chosen = parser.parse_args(arguments)
    end = chosen.first + chosen.cases
    shares = [range(chosen.first + job, end, chosen.jobs) for job in range(chosen.jobs)]
    with multiprocessing.get_context("fork").Pool(chosen.jobs) as pool:
        defects = sum(pool.map(examine_all, shares))
    print(f"{chosen.cases} cases, {defects} defects")
    return int(defects > 0)


if __name__ == "__main__":
    sys.exit(main())
