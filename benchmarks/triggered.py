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
from recorder.world.oscillatory import OscillatorySource
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

WAVES = {"x1": "x3", "x2": "x3"}
"""Streams of the scene oscillatory, and which other shows in an event."""

OF_WAVES = ("another stream", "half as large", "twice as fast")

Frames = NDArray[np.uint8]
Events = list[tuple[int, int]]
"""Where they are, [start, stop)."""


def shown(task: str, seed: int, count: int) -> tuple[Frames, float]:
    """Frames of a task played at random, and its rate."""
    with GymSource([task], size=SIZE, seed=seed) as source:
        parts = [source.take(0, 100).frames for _ in range(count // 100)]
        return np.concatenate(parts), source.spec.fps


def places(frames: int, fps: float, kinds: int, seed: int) -> Events:
    """Where events are, one of each kind."""
    rng, length, first = np.random.default_rng([77, seed]), round(SECONDS * fps), round(QUIET * fps)
    room = (frames - first) // kinds
    starts = [first + number * room + int(rng.integers(room - length)) for number in range(kinds)]
    return [(start, start + length) for start in starts]


def planted(frames: Frames, other: Frames, fps: float, seed: int) -> tuple[Frames, Events]:
    """Frames of a task with an event of each kind."""
    frames, events = frames.copy(), places(len(frames), fps, len(KINDS), seed)
    for (start, stop), kind in zip(events, KINDS, strict=True):
        own, length = frames[start:stop], stop - start
        if kind == "another task":
            own[:] = other[start:stop]
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
    return frames, events


def waves(name: str, count: int) -> NDArray[np.float64]:
    """Frames of a stream of the scene."""
    return OscillatorySource([name]).take(0, count).frames


def planted_in_waves(name: str, seed: int) -> tuple[NDArray[np.float64], Events]:
    """Frames of such a stream with an event of each kind."""
    frames, events = waves(name, FRAMES).copy(), places(FRAMES, 50.0, len(OF_WAVES), seed)
    another, fast = waves(WAVES[name], FRAMES), waves(name, 2 * FRAMES)[::2]
    for (start, stop), shown in zip(events, (another, frames / 2, fast), strict=True):
        frames[start:stop] = shown[start:stop]
    return frames, events


def kept(
    frames: NDArray[Any], fps: float, known: Application | None, events: Events
) -> tuple[float, list[bool]]:
    """The share of frames that is kept, and which events are, whole."""
    source = TriggeredSource(
        ArraySource({"stream": frames}, fps=fps), before=AROUND, after=AROUND, known=known
    )
    with contextlib.suppress(LogExhaustedError):
        while True:
            source.take_all(1)
    told = source.triggered()
    whole = [any(s.start <= a and b <= s.stop for s in source.segments) for a, b in events]
    return told["share"], whole


def learned(streams: dict[str, Any], fps: float, folder: Path) -> dict[str, Application | None]:
    """No run, and one learned from streams where any module was."""
    run(ArraySource(streams, fps=fps), ProgressConfig(), folder, rerun=False)
    found: dict[str, Application | None] = {"none": None}
    with contextlib.suppress(UsageError):
        found["of the usual"] = Application(folder)
    return found


def main(*, quick: bool = False, full: bool = False) -> None:
    """Measure each task and stream, without a run and with one learned from the usual."""
    rows: list[list[Any]] = []

    def add(what: str, seed: int, fps: float, frames: Any, events: Events, kinds: Any) -> None:
        around = len(events) * (SECONDS + 2 * AROUND) * fps / len(frames)
        for name, known in runs.items():
            share, whole = kept(frames, fps, known, events)
            missed = [kind for kind, found in zip(kinds, whole, strict=True) if not found]
            share_of = f"{share:.0%}", f"{around:.0%}"
            counted = f"{sum(whole)} of {len(whole)}"
            rows.append([what, seed, name, *share_of, counted, ", ".join(missed) or "-"])
            print(*rows[-1], flush=True)

    seeds = SEEDS[: 1 if quick else None]
    with tempfile.TemporaryDirectory() as folder:
        usual = {name: waves(name, FRAMES) for name in ("x1", "x2", "x3")}
        runs = learned(usual, 50.0, Path(folder) / "run")
        for name in WAVES:
            for seed in seeds:
                add(f"oscillatory {name}", seed, 50.0, *planted_in_waves(name, seed), OF_WAVES)
    for number, task in enumerate(TASKS):
        with tempfile.TemporaryDirectory() as folder:
            frames, fps = shown(task, 200, FRAMES)
            runs = learned({"stream": frames}, fps, Path(folder) / "run")
            for seed in seeds:
                other = shown(TASKS[(number + 1) % len(TASKS)], seed, FRAMES)[0]
                add(
                    *(task, seed, fps),
                    *planted(shown(task, seed, FRAMES)[0], other, fps, seed),
                    KINDS,
                )
    head = ("stream", "seed", "run", "kept", "by a perfect trigger", "events kept", "missed")
    save(
        "triggered",
        "Recording what is novel",
        f"The scene oscillatory, and tasks of Gymnasium and Atari played at random, {FRAMES:,} "
        f"frames each, with an event of each kind of {SECONDS} s ({', '.join(OF_WAVES)}; "
        f"{', '.join(KINDS)}); kept with {AROUND:g} s before and after it. Where there is no row "
        "with a run no module was learned.",
        [(head, rows)],
    )


if __name__ == "__main__":
    main()
