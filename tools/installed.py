"""Use what is installed where there is no checkout: `python tools/installed.py ENVIRONMENT...`.

It needs nothing but Python, and gives the commands nothing but a folder.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

COMMANDS = (
    "--version",
    "doctor",
    "record oscillatory --frames 2000 -o recording",
    "learn recording --loop --max-modules 1 -o run",
    "check run",
    "view run --save run.rrd",
    "apply run recording -o applied.parquet",
    "demo --frames 800",
)


def use(environment: Path, commands: Sequence[str] = COMMANDS) -> None:
    """Run commands of an environment in a folder of their own; the first that fails is raised."""
    program = environment.resolve() / "bin" / "cdmisfa"
    with tempfile.TemporaryDirectory() as folder:
        for line in commands:
            print(f"{environment}: cdmisfa {line}", flush=True)
            words = [program, *line.split()]
            asked = {"cwd": folder, "env": {"HOME": folder}, "stdin": subprocess.DEVNULL}
            subprocess.check_output(words, text=True, **asked)  # type: ignore[call-overload]


if __name__ == "__main__":
    for name in sys.argv[1:]:
        use(Path(name))
