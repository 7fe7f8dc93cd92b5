"""Recordings of a world with planted events, noise and doubles among them, and a known run."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

import cdmisfa
from benchmarks.curation.worlds import World, shown
from cdmisfa.core.arrays import ByteArray
from cdmisfa.studies.arena.streams import make_footage
from recorder.cameras.stepped import ArraySource
from recorder.config import RecordConfig
from recorder.recording import record
from replay.corpus.index import index_logs

FPS: Final = 20
SECONDS: Final = 15
"""Of a recording."""

RECORDINGS: Final = 12
"""That show a world; half of them have an event."""

LASTS: Final = (40, 80)
"""Frames of an event, from and to."""

KNOWN_SECONDS: Final = 100
"""Of the recording, without an event, that the known run learned from."""

FRAMES: Final = FPS * SECONDS


@dataclass(frozen=True, slots=True)
class Event:
    """What was planted.

    Attributes:
        log: the recording.
        kind: of the event.
        start: its first frame.
        stop: the frame after its last.
    """

    log: str
    kind: str
    start: int
    stop: int


@dataclass(frozen=True, slots=True)
class Planted:
    """Recordings in a folder, and what is in them.

    Attributes:
        frames: of each recording.
        events: that were planted.
        noise: recordings of nothing but noise.
        twice: which recording another one is the double of.
        usual: frames of the recording that the known run learned from.
    """

    frames: Mapping[str, ByteArray]
    events: Sequence[Event]
    noise: Sequence[str]
    twice: Mapping[str, str]
    usual: ByteArray


def plant(folder: Path, world: World, noises: Sequence[str], seed: int) -> Planted:
    """Record a world; the recordings are numbered in an order that says nothing of them.

    Args:
        folder: of the recordings, FOLDER/logs, with their index, and of the run, FOLDER/run.
        world: what they show.
        noises: names of streams of the arena.
        seed: of all of it.
    """
    rng = np.random.default_rng(seed)
    total = RECORDINGS + len(noises) + 2
    names = [f"day-{i:02d}" for i in rng.permutation(total).tolist()]
    of_world, of_noise, (same, other) = names[:RECORDINGS], names[RECORDINGS:-2], names[-2:]
    frames: dict[str, ByteArray] = {}
    events: list[Event] = []
    kinds = list(world.events)
    for i, name in enumerate(of_world):
        own, kind, at = int(rng.integers(2**31)), "", range(0)
        if i < RECORDINGS // 2:
            length = int(rng.integers(LASTS[0], LASTS[1] + 1))
            start = int(rng.integers(FPS, FRAMES - FPS - length))
            kind, at = kinds[i % len(kinds)], range(start, start + length)
            events.append(Event(name, kind, at.start, at.stop))
        frames[name] = shown(world, own, FRAMES, kind, at)
    for name, noise in zip(of_noise, noises, strict=True):
        frames[name] = make_footage(noise, seed).frames[:FRAMES]
    logs = folder / "logs"
    for name, pictures in frames.items():
        _record(logs / name, pictures)
    twice = {same: of_world[0], other: of_world[RECORDINGS // 2]}
    shutil.copytree(logs / twice[same], logs / same)
    _record(logs / other, frames[twice[other]], RecordConfig(compression="lz4"))
    frames |= {name: frames[first] for name, first in twice.items()}
    index_logs([logs], deep=True)
    usual = shown(world, int(rng.integers(2**31)), FPS * KNOWN_SECONDS)
    _record(folder / "usual", usual)
    how = {"algorithm": "progress", "loop": True, "max_iterations": 400}
    cdmisfa.learn(str(folder / "usual"), folder / "run", **how)
    return Planted(frames, events, of_noise, twice, usual)


def _record(folder: Path, frames: ByteArray, settings: RecordConfig | None = None) -> None:
    record(ArraySource({"camera": frames}, fps=FPS), folder, settings=settings)
