"""Run the benchmark named on the command line, or all of them."""

from __future__ import annotations

import argparse
import importlib
import pkgutil

import benchmarks


def main() -> None:
    """Run benchmarks one after another; each writes results/NAME.json and NAME.md."""
    modules = pkgutil.iter_modules(benchmarks.__path__)
    names = sorted(m.name for m in modules if not m.name.startswith("_") and m.name != "report")
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("name", nargs="*", metavar="NAME", help=f"one of {', '.join(names)}")
    parser.add_argument("--quick", action="store_true", help="fewer rounds")
    arguments = parser.parse_args()
    for name in arguments.name or names:
        if name not in names:
            parser.error(f"no benchmark {name}: there are {', '.join(names)}")
        importlib.import_module(f"benchmarks.{name}").main(quick=arguments.quick)


if __name__ == "__main__":
    main()
