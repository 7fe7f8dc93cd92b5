"""Run campaigns from the command line."""

from __future__ import annotations

import argparse
import gc
import importlib
import itertools
import multiprocessing
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from ignored_signals import let_children_be_signalled

from . import __doc__ as about
from . import cases

CAMPAIGNS = ("kills", "failing", "damage")


def campaign(name: str, seed: int, deadline: float, jobs: int, only: bool) -> None:
    """Run the cases of a campaign; exit with 1 when one finds a defect."""
    module = importlib.import_module(f"{__package__}.{name}")
    with tempfile.TemporaryDirectory(prefix=f"torture-{name}-") as folder:
        shared = module.prepare(Path(folder))
        # Video decoders must not be freed in a fork, where their threads do not exist.
        gc.collect()
        gc.freeze()
        if only:
            running = cases.begin(module, seed, shared)
            print(f"folder: {running.folder}", flush=True)
            cases.wait([running], cases.SECONDS)
            counts = {cases.end(module, running, keep=True): 1}
        else:
            counts = cases.run(module, itertools.count(seed), shared, deadline, jobs)
    print(f"{name}: {', '.join(f'{n} {kind}' for kind, n in sorted(counts.items()))}", flush=True)
    sys.exit(cases.DEFECT in counts)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the chosen campaigns for equal shares of the time; return 1 when one found a defect."""
    parser = argparse.ArgumentParser(prog="python -m tools.torture", description=about)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("campaigns", nargs="*", metavar="CAMPAIGN", help=", ".join(CAMPAIGNS))
    parser.add_argument("--minutes", type=float, default=10, help="of all campaigns together")
    parser.add_argument("--seed", type=int, default=0, help="of the first case")
    parser.add_argument("--jobs", type=int, default=2, help="cases that compute at a time")
    parser.add_argument("--case", type=int, help="run this case alone and keep its folder")
    chosen = parser.parse_args(arguments)
    if unknown := set(chosen.campaigns) - set(CAMPAIGNS):
        parser.error(f"no campaign {min(unknown)}: there are {', '.join(CAMPAIGNS)}")
    let_children_be_signalled()
    names = chosen.campaigns or CAMPAIGNS
    seed, only = (chosen.seed, False) if chosen.case is None else (chosen.case, True)
    begin, codes = time.monotonic(), []
    for number, name in enumerate(names, 1):
        # A process of its own, so that the memory of its imports does not count for the next one.
        deadline = begin + 60 * chosen.minutes * number / len(names)
        process = multiprocessing.get_context("fork").Process(
            target=campaign, args=(name, seed, deadline, chosen.jobs, only)
        )
        process.start()
        process.join()
        codes.append(process.exitcode)
    return int(any(codes))


if __name__ == "__main__":
    sys.exit(main())
