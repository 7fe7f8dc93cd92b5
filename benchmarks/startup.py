"""What a command takes beyond its work: starting, also where Python has no bytecode yet."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.report import SAMPLE, middle, ratio, save

LEARN = ("-m", "cdmisfa", "learn", "--max-iterations", "1", "--force", "--json", "-o")
VIEWS = (str(SAMPLE / "left.mcap"), str(SAMPLE / "right.mcap"), "--algorithm", "2.0")
VIEWS += ("--preset", "icub")
PROGRESS = (*VIEWS[:2], "--algorithm", "progress")
WARM = {
    "import of numpy": ("-c", "import numpy"),
    "import of numpy and rerun": ("-c", "import numpy, rerun"),
    "cdmisfa --help": ("-m", "cdmisfa", "--help"),
    "cdmisfa signals": ("-m", "cdmisfa", "signals"),
    "cdmisfa info RECORDING": ("-m", "cdmisfa", "info", str(SAMPLE / "left.mcap")),
    "learn oscillatory, no view": (*LEARN, "RUN", "oscillatory", "--no-rerun"),
    "learn oscillatory": (*LEARN, "RUN", "oscillatory"),
    "learn of two views by 2.0, no view": (*LEARN, "RUN", *VIEWS, "--no-rerun"),
    "learn of two views, no view": (*LEARN, "RUN", *PROGRESS, "--no-rerun"),
}
FIRST = [name for name in WARM if name.startswith("learn")]


def cpu_ms(words: tuple[str, ...], folder: Path, bytecode: str) -> float:
    """CPU milliseconds of a Python process with these words.

    Those of the processes that it begins are in it.

    Args:
        words: that follow `python`.
        folder: where it writes.
        bytecode: name of a folder there, for the bytecode of all that it imports.
    """
    command = [str(folder / "run") if word == "RUN" else word for word in words]
    environment = {**os.environ, "PYTHONPYCACHEPREFIX": str(folder / bytecode)}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, *command], env=environment, check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return 1e3 * (after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)


def main(*, quick: bool = False) -> None:
    """Measure, and write results/startup.json."""
    rounds = 2 if quick else 7
    times: dict[str, list[float]] = {name: [] for name in WARM}
    first: dict[str, list[float]] = {name: [] for name in FIRST}
    with tempfile.TemporaryDirectory() as path:
        folder = Path(path)
        for turn in range(rounds + 1):
            for name, words in WARM.items():
                spent = cpu_ms(words, folder, "kept")
                if turn:
                    times[name].append(spent)
                if turn and name in FIRST:
                    first[name].append(cpu_ms(words, folder, f"{turn} {name}"))
    least = times["import of numpy"]
    save(
        "startup",
        "Start-up",
        "CPU time of whole processes. `learn` runs one iteration.",
        [
            (
                ("process", "CPU ms", "relative"),
                [(n, middle(t), f"{ratio(t, least):.2f}x") for n, t in times.items()],
            ),
            (
                ("first run of", "CPU ms", "of a later run"),
                [(n, middle(t), f"{ratio(t, times[n]):.2f}x") for n, t in first.items()],
            ),
        ],
    )
