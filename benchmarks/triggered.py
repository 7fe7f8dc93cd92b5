"""What is recorded of simulated tasks when it is novel: planted events kept, and how much else."""

from __future__ import annotations

import contextlib
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.report import save
from cdmisfa.agents.progress.config import ProgressConfig
from cdmisfa.core.errors import LogExhaustedError, UsageError
from cdmisfa.experiments.apply import Application
from cdmisfa.experiments.session import run
from recorder.cameras.stepped import ArraySource, GymSource
from replay.corpus.triggered import TriggeredSource

TASKS = ("CartPole-v1", "Pendulum-v1", "Acrobot-v1", "ALE/Pong-v5")
FRAMES, SIZE = 9000, (57, 85)
SEEDS = (100, 101)
"""Seeds 0 and 1 chose how far is new."""

KINDS = ("another task", "a bar", "half the light", "a small thing")
SECONDS = 2
AROUND = 5.0
QUIET = 40
"""Seconds before the first event."""

Frames = NDArray[np.uint8]


def shown(task: str, seed: int, count: int) -> tuple[Frames, float]:
    """Frames of a task played at random, and its rate."""
    with GymSource([task], size=SIZE, seed=seed) as source:
        parts = [source.take(0, 100).frames for _ in range(count // 100)]
        return np.concatenate(parts), source.spec.fps


def planted(
    frames: Frames, other: Frames, fps: float, seed: int
) -> tuple[Frames, list[tuple[int, int]]]:
    """Frames with an event of each kind, and where they are, [start, stop)."""
    rng, frames = np.random.default_rng([77, seed]), frames.copy()
    length, first = round(SECONDS * fps), round(QUIET * fps)
    room = (len(frames) - first) // len(KINDS)
    events = []
    for number, kind in enumerate(KINDS):
        start = first + number * room + int(rng.integers(room - length))
        own = frames[start : start + length]
        if kind == "another task":
            own[:] = other[start : start + length]
        elif kind == "half the light":
            own //= 2
        for k, frame in enumerate(own):
            if kind == "a bar":
                row = k * (SIZE[0] - 8) // length
                frame[row : row + 8] = 255 - frame[row : row + 8]
            elif kind == "a small thing":
                column = k * (SIZE[1] - 14) // length
                part = frame[20:34, column : column + 14]
                part[:] = 255 - part
        events.append((start, start + length))
    return frames, events


def kept(
    frames: Frames, fps: float, known: Application | None, events: list[tuple[int, int]]
) -> tuple[float, list[bool]]:
    """The share of frames that is kept, and which events are, whole."""
    source = TriggeredSource(
        ArraySource({"task": frames}, fps=fps), before=AROUND, after=AROUND, known=known
    )
    with contextlib.suppress(LogExhaustedError):
        while True:
            source.take_all(1)
    told = source.triggered()
    whole = [any(s.start <= a and b <= s.stop for s in source.segments) for a, b in events]
    return told["share"], whole


def main(*, quick: bool = False, full: bool = False) -> None:
    """Measure each task, without a run and with one learned on the same task."""
    rows: list[list[Any]] = []
    for number, task in enumerate(TASKS):
        with tempfile.TemporaryDirectory() as folder:
            frames, fps = shown(task, 200, FRAMES)
            learned = ArraySource({"task": frames}, fps=fps)
            run(learned, ProgressConfig(), Path(folder) / "run", rerun=False)
            runs: dict[str, Application | None] = {"none": None}
            with contextlib.suppress(UsageError):  # nothing was learned
                runs["of the task"] = Application(Path(folder) / "run")
            for seed in SEEDS[: 1 if quick else None]:
                frames, fps = shown(task, seed, FRAMES)
                other = shown(TASKS[(number + 1) % len(TASKS)], seed, FRAMES)[0]
                frames, events = planted(frames, other, fps, seed)
                around = len(events) * (SECONDS + 2 * AROUND) * fps / len(frames)
                for name, known in runs.items():
                    share, whole = kept(frames, fps, known, events)
                    rows.append(
                        [
                            *(task, seed, name),
                            *(f"{share:.0%}", f"{around:.0%}", f"{sum(whole)} of {len(whole)}"),
                            ", ".join(k for k, found in zip(KINDS, whole, strict=True) if not found)
                            or "-",
                        ]
                    )
                    print(*rows[-1], flush=True)
    head = ("task", "seed", "run", "frames kept", "by a perfect trigger", "events kept", "missed")
    save(
        "triggered",
        "Recording what is novel",
        f"Tasks of Gymnasium and Atari played at random, {FRAMES:,} frames of 85x57, with an event "
        f"of each of four kinds of {SECONDS} s ({', '.join(KINDS)}); kept with {AROUND:g} s before "
        "and after it. Of a task without a second row no module was learned in as many frames.",
        [(head, rows)],
    )


if __name__ == "__main__":
    main()
