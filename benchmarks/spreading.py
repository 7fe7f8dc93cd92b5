"""Ten modules applied to many camera logs by one dask worker, and by two."""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from benchmarks.applying import MODULES, OUTPUTS, make_run
from benchmarks.foreign import VGA, pictures
from benchmarks.report import middle, save
from cdmisfa.experiments.apply_logs import apply_to_logs
from recorder.images.options import InputOptions
from replay.export.frames import write_video
from replay.open_sources import open_arrays

LOGS, FRAMES = 16, 500


@contextlib.contextmanager
def cluster(workers: int) -> Iterator[tuple[str, list[psutil.Process]]]:
    """A dask scheduler's address, and its workers, each of one thread."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    address, dask = f"tcp://127.0.0.1:{port}", [sys.executable, "-m", "dask"]
    commands = [["scheduler", "--host", "127.0.0.1", "--port", str(port)]]
    commands += [["worker", address, "--nthreads", "1", "--no-nanny"]] * workers
    how: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    how["env"] = {**os.environ, "OMP_NUM_THREADS": "1"}
    processes = [subprocess.Popen([*dask, *words, "--no-dashboard"], **how) for words in commands]
    try:
        yield address, [psutil.Process(one.pid) for one in processes[1:]]
    finally:
        for process in processes:
            process.kill()
            process.wait()


def seconds(
    run: Path, logs: Path, address: str, workers: list[psutil.Process]
) -> tuple[float, ...]:
    """Return wall seconds, and CPU seconds of the workers, for all logs."""

    def used() -> float:
        return sum(sum(worker.cpu_times()[:2]) for worker in workers)

    out = run.parent / "out"
    before, start = used(), time.perf_counter()
    assert not apply_to_logs(run, [str(logs)], out, scheduler=address).failed
    took = time.perf_counter() - start, used() - before
    shutil.rmtree(out)
    return took


def main(*, quick: bool = False) -> None:
    """Measure, and write results/spreading.json."""
    with tempfile.TemporaryDirectory() as place, contextlib.ExitStack() as stack:
        run, logs = make_run(Path(place) / "run", OUTPUTS[-1]), Path(place) / "logs"
        logs.mkdir()
        source = open_arrays({"cam": np.stack(pictures(FRAMES, *VGA))}, InputOptions(size=VGA))
        write_video(source, 0, logs / "0.mp4", lossless=False)
        for number in range(1, LOGS):
            shutil.copyfile(logs / "0.mp4", logs / f"{number}.mp4")
        clusters = {n: stack.enter_context(cluster(n)) for n in (1, 2)}
        time.sleep(10)  # until all workers are there
        took: dict[int, list[tuple[float, float]]] = {1: [], 2: []}
        for turn in range(3 if quick else 8):
            for workers, about in clusters.items():
                duration = seconds(run, logs, *about)
                if turn:
                    took[workers].append(duration)
    load = os.getloadavg()[1]
    faster = [one[0] / two[0] for one, two in zip(took[1], took[2], strict=True)]
    rows = [
        [
            workers,
            middle([wall for wall, _ in each], 2),
            middle([cpu for _, cpu in each], 2),
            f"{middle(faster, 2) if workers == 2 else 1}x",
        ]
        for workers, each in took.items()
    ]
    save(
        "spreading",
        "Apply modules to many logs with dask",
        f"{MODULES} modules of {OUTPUTS[-1]} outputs applied to {LOGS} videos of {FRAMES} "
        "frames of 640x480 by `cdmisfa apply --scheduler`, from the call to the last file. "
        "Workers have one thread each and are started before. Average load of the machine: "
        f"{load:.1f}.",
        [(["workers", "seconds", "of processors", "faster"], rows)],
    )
