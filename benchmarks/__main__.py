"""Run the benchmark named on the command line, or all of them."""

from __future__ import annotations

import argparse
import importlib
import pkgutil

import benchmarks
from benchmarks.history import draw, keep
from benchmarks.report import PAGE, PICTURE, write_page


def main() -> None:
    """Run benchmarks one after another; each writes results/NAME.json, `page` the pages.

    The ratios of a run that is not quick are kept under the commit, too.
    """
    modules = pkgutil.iter_modules(benchmarks.__path__)
    names = sorted({m.name for m in modules} - {"__main__", "arena", "history", "report"})
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument(
        "name", nargs="*", metavar="NAME", help=f"one of {', '.join(names)}, or page"
    )
    parser.add_argument("--quick", action="store_true", help="fewer rounds")
    parser.add_argument("--full", action="store_true", help="the longest cases too (scaling)")
    arguments = parser.parse_args()
    for name in arguments.name or [*names, "page"]:
        if name == "page":
            draw(PAGE.parent / PICTURE)
            print(write_page())
            continue
        if name not in names:
            parser.error(f"no benchmark {name}: there are {', '.join(names)}")
        importlib.import_module(f"benchmarks.{name}").main(
            quick=arguments.quick, full=arguments.full
        )
        if not arguments.quick and keep(name) is None:
            print("not kept for the history: the code is not that of a commit")


if __name__ == "__main__":
    main()
