"""What a command takes beyond its work: starting, and compiling the first time."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.report import SAMPLE, middle, ratio, save

LEARN = ("-m", "cdmisfa", "learn", "--max-iterations", "1", "--force", "--json", "-o")
VIEWS = (str(SAMPLE / "left.mcap"), str(SAMPLE / "right.mcap"), "--algorithm", "2.0")
VIEWS += ("--preset", "icub")
PROGRESS = (*VIEWS[:2], "--algorithm", "progress")
WARM = {
    "import of numba": ("-c", "import numba"),
    "import of numba and rerun": ("-c", "import numba, rerun"),
    "cdmisfa --help": ("-m", "cdmisfa", "--help"),
    "cdmisfa signals": ("-m", "cdmisfa", "signals"),
    "cdmisfa info of a recording": ("-m", "cdmisfa", "info", str(SAMPLE / "left.mcap")),
    "learn oscillatory --no-rerun": (*LEARN, "RUN", "oscillatory", "--no-rerun"),
    "learn oscillatory": (*LEARN, "RUN", "oscillatory"),
    "learn of two views --no-rerun": (*LEARN, "RUN", *VIEWS, "--no-rerun"),
    "learn of two views by progress --no-rerun": (*LEARN, "RUN", *PROGRESS, "--no-rerun"),
}
COLD = [name for name in WARM if name.endswith("--no-rerun")]


def cpu_ms(words: tuple[str, ...], folder: Path, kept: Path) -> float:
    """CPU milliseconds of a Python process with these words, its compiled code in `kept`.

    Those of the processes that it begins are in it.
    """
    command = [str(folder / "run") if word == "RUN" else word for word in words]
    # What is kept of imports must be there, too, wherever the environment has it.
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(kept)}
    environment["PYTHONPYCACHEPREFIX"] = str(folder / "imports")
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, *command], env=environment, check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return 1e3 * (after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)


def main(*, quick: bool = False, full: bool = False) -> None:
    """Measure, and write results/startup.json."""
    rounds = 2 if quick else 7
    times: dict[str, list[float]] = {name: [] for name in WARM}
    cold: dict[str, tuple[float, float]] = {}
    with tempfile.TemporaryDirectory() as path:
        folder = Path(path)
        cpu_ms(WARM["learn oscillatory"], folder, folder / "imports only")
        for number, name in enumerate(COLD):
            begin = time.perf_counter()
            spent = cpu_ms(WARM[name], folder, folder / f"cold {number}")
            cold[name] = time.perf_counter() - begin, spent / 1e3
        for turn in range(rounds + 1):
            for name, words in WARM.items():
                spent = cpu_ms(words, folder, folder / "kept")
                if turn:
                    times[name].append(spent)
    least = times["import of numba"]
    save(
        "startup",
        "Starting",
        "CPU time of whole processes; `learn` learns one iteration. What they import is compiled "
        "to byte code before. Cold is a first run, with no compiled code on disk: measured once, "
        "two processes compile.",
        [
            (
                ("warm: process", "CPU ms", "times the import of numba"),
                [(n, middle(t), f"{ratio(t, least):.2f}x") for n, t in times.items()],
            ),
            (
                ("cold: process", "wall s", "CPU s"),
                [(n, round(wall, 1), round(cpu, 1)) for n, (wall, cpu) in cold.items()],
            ),
        ],
    )
