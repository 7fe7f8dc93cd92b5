"""The command line of the campaigns."""

from __future__ import annotations

import argparse
import json
import os
import platform
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from . import __doc__ as about
from . import harness, page
from .campaigns import CAMPAIGNS, campaign
from .outcomes import WRONG, Limits, Outcome

ROOT = Path(__file__).resolve().parents[2]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run campaigns; 1 when anything was found."""
    parser = argparse.ArgumentParser(prog="python -m tests.torture", description=about)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("campaigns", nargs="*", metavar="CAMPAIGN", help=", ".join(CAMPAIGNS))
    parser.add_argument("--minutes", type=float, default=30, help="with preparing; 0: page only")
    parser.add_argument("--seed", type=int, default=0, help="of each campaign's first case")
    parser.add_argument("--jobs", type=int, default=2, help="cases at a time")
    parser.add_argument("-o", "--out", type=Path, default=ROOT / "build" / "torture")
    parser.add_argument("--case", type=int, help="run this case alone, and keep its folder")
    parser.add_argument("--page", type=Path, help="write the results as a page, too")
    chosen = parser.parse_args(arguments)
    unknown = [name for name in chosen.campaigns if name not in CAMPAIGNS]
    if unknown:
        parser.error(f"no campaign {unknown[0]}: there are {', '.join(CAMPAIGNS)}")
    names = chosen.campaigns or CAMPAIGNS
    results = harness.Results(chosen.out / harness.CASES)
    deadline = time.monotonic() + 60 * chosen.minutes
    with tempfile.TemporaryDirectory(prefix="torture-shared-") as shared:
        if chosen.case is not None:
            return _alone(_opened(names[0], Path(shared), results, chosen.seed), chosen.case)
        if chosen.minutes > 0:
            print(f"seed {chosen.seed}: {', '.join(names)} for {chosen.minutes:g} min", flush=True)
            results.add({"run": {**_about(), "seed": chosen.seed, "minutes": chosen.minutes}})
            opened = []
            for name in names:
                try:
                    opened.append(_opened(name, Path(shared), results, chosen.seed))
                except Exception as error:  # others go on
                    results.add(_unprepared(name, error))
                    print(f"{name}: not prepared: {error}", file=sys.stderr, flush=True)
            harness.run(opened, results, deadline, chosen.jobs, sys.stderr)
    summary = page.summary(results.lines)
    (chosen.out / "torture.json").write_text(json.dumps(summary, indent=1) + "\n")
    if chosen.page is not None:
        chosen.page.write_text(page.markdown(summary))
    print(page.short(summary))
    return 1 if summary["defects"] else 0


def _opened(name: str, shared: Path, results: harness.Results, first_seed: int) -> harness.Campaign:
    module = campaign(name)
    (shared / name).mkdir()
    prepare = getattr(module, "prepare", None)
    given = prepare(shared / name) if prepare else None
    limits = getattr(module, "LIMITS", Limits())
    return harness.Campaign(name, module, results.seeds(name, first_seed), given, limits)


def _unprepared(name: str, error: Exception) -> dict[str, Any]:
    outcome = Outcome(WRONG, "preparation", f"{type(error).__name__}: {error}").as_json()
    told = {"campaign": name, "seed": -1, **outcome, "seconds": 0.0, "megabytes": 0}
    return {**told, "defect": outcome["detail"]}


def _alone(opened: harness.Campaign, seed: int) -> int:
    folder = Path(tempfile.mkdtemp(prefix=f"torture-{opened.name}-{seed}-"))
    case = harness.begin(opened, seed, folder)
    if not select.select([case.pidfd], [], [], opened.limits.seconds)[0]:
        os.kill(case.pid, signal.SIGKILL)
    line = harness.end(case, keep=True)
    print(json.dumps({**line, "folder": str(folder)}, indent=1))
    return 1 if "defect" in line else 0


def _about() -> dict[str, str]:
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    return {
        "commit": commit.stdout.strip() or "unknown",
        "python": platform.python_version(),
        "platform": platform.platform(),
    }


if __name__ == "__main__":
    sys.exit(main())
