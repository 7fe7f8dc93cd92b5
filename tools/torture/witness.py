"""What a command had done when it was killed: it notes every block in a file as it goes.

A witness is written by the command's own process, unbuffered, so it outlives a kill; it also makes
blocks take as long as a case wants.
"""

from __future__ import annotations

import itertools
import os
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

KEYFRAMES = 25
SECOND = 1.0


def witnessing(path: Path, pause: float) -> Callable[[], None]:
    """What makes a process write a witness; see `Fork`.

    Args:
        path: of the witness.
        pause: seconds for which every block is waited after it was written.
    """

    def tweak() -> None:
        from cdmisfa.experiments import session
        from recorder.log.viewlog import ViewLog
        from replay.runs.writer import RunWriter

        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)

        def note(what: str, number: int) -> None:
            os.write(file, f"{what} {number} {time.monotonic()}\n".encode())
            time.sleep(pause)

        def after(kind: Any, name: str, told: Callable[..., tuple[str, int]]) -> None:
            method = getattr(kind, name)

            def noted(self: Any, *arguments: Any) -> None:
                method(self, *arguments)
                note(*told(self, *arguments))

            setattr(kind, name, noted)

        after(ViewLog, "write", lambda log, block: (log._view, log.t))
        after(RunWriter, "block", lambda log, block, signals, learner: ("run", learner.iteration))
        kept = session.Keyframes
        session.Keyframes = lambda *given: kept(*given[:-1], KEYFRAMES)  # type: ignore

    return tweak


def due(path: Path, killed: float, log_fps: float) -> dict[str, int]:
    """How much must be on disk after a kill: what came more than a second before.

    Args:
        path: of the witness.
        killed: when, by the monotonic clock.
        log_fps: frames of a second of log time, after which a recording flushes.

    Returns:
        Of each view its frames, of "run" its iterations.
    """
    if not path.exists():
        return {}
    seen: dict[str, list[tuple[int, float]]] = defaultdict(list)
    for line in path.read_text().splitlines():
        what, number, at = line.split()
        seen[what].append((int(number), float(at)))
    wanted = {}
    for what, notes in seen.items():
        steps = [b - a for (a, _), (b, _) in itertools.pairwise(notes)]
        times = [b - a for (_, a), (_, b) in itertools.pairwise(notes)]
        if what == "run":
            before = killed - SECOND - max(times, default=0.0)
            wanted[what] = max((n for n, at in notes if at <= before), default=0)
        else:
            block = max([*steps, notes[0][0]])
            wanted[what] = max(0, notes[-1][0] - round(SECOND * log_fps) - block)
    return wanted
