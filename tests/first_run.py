"""What runs call of compiled code: `python -m tests.first_run` lists it for first runs."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

from cdmisfa.agents.learners import open_learner
from cdmisfa.agents.progress.config import ProgressConfig
from cdmisfa.core.arithmetic.compiled import _ForPython
from cdmisfa.core.arithmetic.first_run import LISTED
from cdmisfa.core.arithmetic.kept import described
from cdmisfa.core.config import LearnerConfig, load_preset
from cdmisfa.experiments.loop import learn, parts_of
from replay.recordings.source import RecordedSource

SAMPLES = Path(__file__).parents[1] / "sample_logs"

ITERATIONS = 12
"""A run calls nothing after them that it has not called before."""


@contextmanager
def noted_calls() -> Iterator[dict[str, float]]:
    """Functions called meanwhile and the types of their arguments, with seconds of first calls."""
    found: dict[str, float] = {}
    plain = _ForPython.__call__

    def noted(function: Any, *args: Any) -> Any:
        begin = time.perf_counter()
        result = plain(function, *args)
        name = f"{function.__module__}:{function.__qualname__}"
        call = json.dumps([name, [described(value) for value in args]])
        found.setdefault(call, time.perf_counter() - begin)
        return result

    with mock.patch.object(_ForPython, "__call__", noted):
        yield found


def calls_by_part() -> dict[str, dict[str, float]]:
    """What runs of all kinds call, by the part of a run."""
    parts: dict[str, dict[str, float]] = defaultdict(dict)
    for scene in ("oscillatory", "icub"):
        for config in (LearnerConfig(**load_preset(scene)["learner"]), ProgressConfig()):
            with closing(RecordedSource(SAMPLES / scene)) as source, noted_calls() as found:
                learner = open_learner(config, source.spec, 0)
                learn(source, learner, max_iterations=ITERATIONS)
                learning, reading = parts_of(source, learner)
            for call, seconds in found.items():
                took = parts[reading if call.startswith('["replay.') else learning]
                took[call] = max(seconds, took.get(call, 0.0))
    return dict(parts)


def main() -> None:
    """Write what is called with the longest to compile first, all of it compiled anew."""
    if "listed" in sys.argv:
        found = calls_by_part()
        took: dict[str, float] = {}
        for calls in found.values():
            for call, seconds in calls.items():
                took[call] = max(seconds, took.get(call, 0.0))
        parts = []
        for part, calls in sorted(found.items()):
            longest_first = sorted(calls, key=lambda call: -took[call])
            parts.append(f"{json.dumps(part)}: [\n" + ",\n".join(longest_first) + "\n]")
        LISTED.write_text("{\n" + ",\n".join(parts) + "\n}\n", "utf-8")
        return
    with tempfile.TemporaryDirectory() as folder:
        here = {**os.environ, "NUMBA_CACHE_DIR": folder}
        subprocess.run([sys.executable, "-m", "tests.first_run", "listed"], env=here, check=True)


if __name__ == "__main__":
    main()
