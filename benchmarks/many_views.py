"""What thousands of views take where few files may be open."""

from __future__ import annotations

import contextlib
import json
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.report import save
from cdmisfa.core.blocks import Block, ClockedSource, SourceSpec, check_request, freeze
from cdmisfa.experiments.session import run
from cdmisfa.experiments.sources import configure
from recorder.recording import record
from replay.recordings.source import RecordedSource

OPEN_FILES = 1024
"""The limit of most systems."""

FRAMES = 100


class ManyViews(ClockedSource):
    """Streams of two numbers each."""

    def __init__(self, count: int) -> None:
        names = tuple(f"v{i:04d}" for i in range(count))
        self._spec = SourceSpec(names, (2,), "float64", (), 25.0, 0, FRAMES)

    def take(self, stream: int, n: int) -> Block:
        """See `FrameSource`."""
        check_request(self._spec, stream, n)
        values = np.arange(self._t, self._t + n, dtype=np.float64)
        self._t += n
        frames = freeze(np.stack([np.sin(values), np.full(n, float(stream))], axis=1))
        return Block(stream, self._t - n, frames, freeze(np.zeros((n, 0))))

    def describe(self) -> dict[str, object]:
        """See `FrameSource`."""
        return {"kind": "many"}


def _seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def record_and_learn(views: int, folder: Path) -> dict[str, float]:
    """CPU seconds of recording views, and of opening and learning them; megabytes on disk."""
    start = _seconds()
    record(ManyViews(views), folder)
    recorded = _seconds()
    with contextlib.closing(RecordedSource(folder)) as source:
        config = configure("oscillatory", None, ("learner.tau=20",)).learner
        run(source, config, None, seed=0, max_iterations=FRAMES // config.tau)
    size = sum(path.stat().st_size for path in folder.iterdir())
    return {"record": recorded - start, "learn": _seconds() - recorded, "MB": size / 1e6}


def measured(views: int) -> dict[str, float]:
    """`record_and_learn` in a process that may have few files open."""
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            [sys.executable, "-m", "benchmarks.many_views", str(views), folder],
            check=True,
            capture_output=True,
            text=True,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (OPEN_FILES, OPEN_FILES)),
        )
    found: dict[str, float] = json.loads(done.stdout)
    return found


def main(*, quick: bool = False, full: bool = False) -> None:
    """Measure, and write results/many_views.json."""
    counts = (30, 120) if quick else (300, 3000)
    few, many = map(measured, counts)
    rows = [
        [what, round(few[what], 2), round(many[what], 2), f"{many[what] / few[what]:.1f}x"]
        for what in few
    ]
    save(
        "many_views",
        "Many views",
        f"{FRAMES} frames of two numbers of each view, where {OPEN_FILES} files may be open. CPU "
        "seconds of recording; of opening the recording and learning from it to its end; the size "
        f"of its files. There are {counts[1] / counts[0]:.0f} times as many views. Measured once.",
        [(["what", *(f"{count} views" for count in counts), "ratio"], rows)],
    )


if __name__ == "__main__":
    folder = Path(sys.argv[2])
    record_and_learn(2, folder / "warm")  # imports what it needs
    print(json.dumps(record_and_learn(int(sys.argv[1]), folder / "measured")))
