"""The command line of the campaigns."""

from __future__ import annotations

import argparse
import gc
import json
import math
import os
import platform
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

from ignored_signals import let_children_be_signalled

from . import __doc__ as about
from . import harness, page
from .campaigns import CAMPAIGNS, campaign
from .outcomes import WRONG, Limits, Outcome

ROOT = Path(__file__).resolve().parents[2]
FEWEST = 4
"""Cases of each campaign, however long preparing takes."""

MEMORY = Path("/dev/shm")
"""Where cases write, if there is room: what a killed process wrote is kept here as on a disk."""

ROOM = 2 << 30
DIRTY = "-dirty"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run campaigns; 1 when anything was found."""
    parser = argparse.ArgumentParser(prog="python -m tools.torture", description=about)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("campaigns", nargs="*", metavar="CAMPAIGN", help=", ".join(CAMPAIGNS))
    parser.add_argument("--minutes", type=float, default=math.inf, help="stop then; 0: page only")
    parser.add_argument("--seed", type=int, default=0, help="of each campaign's first case")
    parser.add_argument("--jobs", type=int, default=2, help="cases that compute at a time")
    parser.add_argument("-o", "--out", type=Path, default=ROOT / "build" / "torture")
    parser.add_argument("--case", type=int, help="run this case alone, and keep its folder")
    parser.add_argument("--page", type=Path, help="write the results as a page, too")
    chosen = parser.parse_args(arguments)
    unknown = [name for name in chosen.campaigns if name not in CAMPAIGNS]
    if unknown:
        parser.error(f"no campaign {unknown[0]}: there are {', '.join(CAMPAIGNS)}")
    let_children_be_signalled()
    if MEMORY.is_dir() and shutil.disk_usage(MEMORY).free > ROOM:
        tempfile.tempdir = str(MEMORY)
    names = chosen.campaigns or list(CAMPAIGNS)
    results = chosen.out / harness.CASES
    if chosen.case is not None:
        return _alone(names[0], chosen.case)
    told = {**_about(), "seed": chosen.seed}
    if chosen.page and told["commit"].endswith(DIRTY):
        parser.error("--page names the commit: commit first")
    if chosen.minutes > 0:
        print(f"commit {told['commit']}, seed {chosen.seed}: {', '.join(names)}", flush=True)
        kept = harness.Results(results)
        kept.begin(told)
        deadline = time.monotonic() + 60 * chosen.minutes
        names = [n for n in names if kept.cases(n) < (_limits(n).enough or math.inf)]
        for number, name in enumerate(names):
            # Each in a process of its own, so that what one imports is none of another's memory.
            shares = [_limits(other).share for other in names[number:]]
            left = (deadline - time.monotonic()) * shares[0] / sum(shares)
            if (pid := os.fork()) == 0:
                _in_child(name, results, chosen.seed, time.monotonic() + left, chosen.jobs)
            os.waitpid(pid, 0)
    summary = page.summary(harness.Results(results).lines)
    if not summary["runs"]:
        parser.error(f"no results in {results}: run campaigns first")
    if chosen.page and _about()["commit"] != told["commit"]:
        parser.error(f"the files changed: they were those of {told['commit']}")
    (chosen.out / "torture.json").write_text(json.dumps(summary, indent=1) + "\n")
    if chosen.page is not None:
        data = chosen.page.with_suffix(".json")
        data.write_text(json.dumps(summary) + "\n")
        chosen.page.write_text(page.markdown(summary, data.name))
    print(page.short(summary))
    return 1 if summary["defects"] else 0


def _limits(name: str) -> Limits:
    return getattr(campaign(name), "LIMITS", Limits())


def _in_child(name: str, path: Path, first_seed: int, deadline: float, jobs: int) -> NoReturn:
    results, code = harness.Results(path), 1
    try:
        with tempfile.TemporaryDirectory(prefix="torture-shared-") as shared:
            opened = _opened(name, Path(shared), results.seeds(name, first_seed))
            gc.freeze()  # so that cases need not copy what they share
            harness.run(opened, results, deadline, jobs, sys.stderr, fewest=FEWEST)
        code = 0
    except BaseException as error:  # other campaigns go on
        results.add(_broken_off(name, error))
        print(f"{name} broke off: {error}", file=sys.stderr, flush=True)
    finally:
        os._exit(code)


def _opened(name: str, shared: Path, seeds: Iterator[int]) -> harness.Campaign:
    module = campaign(name)
    prepare = getattr(module, "prepare", None)
    given = prepare(shared) if prepare else None
    return harness.Campaign(name, module, seeds, given, _limits(name))


def _broken_off(name: str, error: BaseException) -> dict[str, Any]:
    outcome = Outcome(WRONG, "the campaign itself", f"{type(error).__name__}: {error}").as_json()
    told = {"campaign": name, "seed": -1, **outcome, "seconds": 0.0, "megabytes": 0}
    return {**told, "defect": outcome["detail"]}


def _alone(name: str, seed: int) -> int:
    folder = Path(tempfile.mkdtemp(prefix=f"torture-{name}-{seed}-"))
    with tempfile.TemporaryDirectory(prefix="torture-shared-") as shared:
        opened = _opened(name, Path(shared), iter(()))
        case = harness.begin(opened, seed, folder)
        if not select.select([case.pidfd], [], [], opened.limits.seconds)[0]:
            os.kill(case.pid, signal.SIGKILL)
        line = harness.end(case, keep=True)
    print(json.dumps({**line, "folder": str(folder)}, indent=1))
    return 1 if "defect" in line else 0


def _git(*words: str) -> str:
    done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=False)
    return done.stdout.strip()


def _about() -> dict[str, str]:
    others = (".", ":!docs/results/reliability.md", ":!docs/results/reliability.json")
    changed = _git("status", "--porcelain", "--untracked-files=no", "--", *others)
    commit = _git("rev-parse", "--short=7", "HEAD") or "unknown"
    return {
        "commit": commit + (DIRTY if changed else ""),
        "python": platform.python_version(),
        "platform": platform.platform(),
    }


if __name__ == "__main__":
    sys.exit(main())
