"""Run the benchmarks named on the command line, by default all but the long ones."""

from __future__ import annotations

import argparse
import importlib
import pkgutil

import benchmarks
from benchmarks.report import write_page

# Benchmarks that run only if they are named: these take half an hour or more.
ONLY_BY_NAME = {"constants", "dots", "episode_peers", "episodes", "features", "policies"}

# Modules without a benchmark of their own.
NO_BENCHMARKS = {
    "__main__", "arena", "paper", "report", "robot_bench", "robot_episodes", "trajectories"
}  # fmt: skip


def main() -> None:
    """Run benchmarks one after another; each writes results/NAME.json, `page` the page."""
    modules = pkgutil.iter_modules(benchmarks.__path__)
    names = sorted({m.name for m in modules} - NO_BENCHMARKS)
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("name", nargs="*", choices=[*names, "page", []], metavar="NAME")
    parser.add_argument("--quick", action="store_true", help="fewer rounds")
    arguments = parser.parse_args()
    default = [name for name in names if name not in ONLY_BY_NAME]
    for name in arguments.name or [*default, "page"]:
        if name == "page":
            print(write_page())
        else:
            importlib.import_module(f"benchmarks.{name}").main(quick=arguments.quick)


if __name__ == "__main__":
    main()
