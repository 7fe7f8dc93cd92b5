"""Lanes: what was the case when, as labelled bars of colour.

A lane's label is its entity, and lanes stand in the order of the alphabet: so they have the names
that they have. What changes with many blocks has two lanes. `/attends` holds every change;
`/mostly/attends` what was the case in most of the blocks around, which reads when all of a run
is in view.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from cdmisfa.core.blocks import SourceSpec
from cdmisfa.core.signals import ACTIONS, STATES
from replay import palette
from replay.palette import Rgb, colour, packed_all
from replay.runs.columns import SignalColumns
from replay.view.columns import time_columns
from replay.view.labels import label, part

NameOf = Callable[[int], tuple[str, Rgb]]
"""The state that a code stands for, and its colour."""

Codes = NDArray[np.int64]

ATTENDS, LEARNS, NOVELTY, DOES, EXPLORES = "attends", "learns", "novelty", "does", "explores"
"""Entities of lanes."""

MOSTLY = "mostly"
"""Where the lanes are that say what was mostly the case."""

PIECES = 80
"""Pieces of a run of which such a lane says one thing each."""

MOST_OF = 2 / 3
"""Share of the blocks of a piece that is most of them."""

STAY, SWITCH = ACTIONS

_NOVEL = -1
_MIXED = -2
_KNOWN = STATES.index("known")


class Lanes:
    """All lanes of a run.

    Args:
        recording: where they go.
        spec: of the source.
        shown: the streams that get a lane of their own: of the policy, or of the stream's state.
        by_progress: the run is one of the progress learner, which has no gate.
        piece: blocks of which one thing is said in lanes of what was mostly the case; by default
            so many that they are told once all blocks are known.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        spec: SourceSpec,
        shown: Sequence[int],
        *,
        by_progress: bool = False,
        piece: int | None = None,
    ) -> None:
        def attended(stream: int) -> tuple[str, Rgb]:
            return label(spec.streams[stream]), colour(stream)

        names: dict[str, NameOf] = {ATTENDS: attended}
        self._known_by = np.zeros(len(spec.streams), dtype=np.int64)
        kind = "state" if by_progress else "policy"
        self._of_stream = {s: f"{kind}/{part(spec.streams, s)}" for s in shown}
        mostly: dict[str, NameOf] = {ATTENDS: partial(_or_mixed, name=attended, mixed="switches")}
        if by_progress:
            self._codes = self._became
            names |= dict.fromkeys(self._of_stream.values(), _became)
        else:
            self._codes = self._decided
            names |= {LEARNS: _learned, NOVELTY: _verdict, EXPLORES: _chosen}
            names[DOES] = partial(_done, streams=[label(name) for name in spec.streams])
            names |= {path: partial(_planned, stream=s) for s, path in self._of_stream.items()}
            mostly[NOVELTY] = partial(_or_mixed, name=_verdict, mixed="both")
        self._lanes = {p: Lane(recording, spec, p, name) for p, name in names.items()}
        self._mostly = {
            path: MostlyLane(Lane(recording, spec, f"{MOSTLY}/{path}", name), piece)
            for path, name in mostly.items()
        }
        self._iteration = 0

    def add(self, columns: SignalColumns) -> None:
        """Take the states of consecutive iterations in."""
        self._iteration = int(columns.iterations[-1])
        codes = {ATTENDS: columns["stream"]} | self._codes(columns)
        for path, lane in self._lanes.items():
            lane.add(columns.frames, columns.iterations, codes[path], columns.tau)
        for path, mostly in self._mostly.items():
            mostly.add(columns.frames, columns.iterations, codes[path], columns.tau)

    def _decided(self, columns: SignalColumns) -> dict[str, Codes]:
        """What CD-MISFA does and decides."""
        codes = {
            LEARNS: columns["module"],
            NOVELTY: np.where(columns["novel"], _NOVEL, np.maximum(columns["known_by"], 0)),
            DOES: columns["stream"] + len(self._known_by) * columns["action"],
            EXPLORES: columns["explored"],
        }
        return codes | {path: columns["policy"][:, s] for s, path in self._of_stream.items()}

    def _became(self, columns: SignalColumns) -> dict[str, Codes]:
        """What became of each stream; where it is known, by which module."""
        codes: dict[str, Codes] = {}
        for s, path in self._of_stream.items():
            known = columns["state"][:, s] == _KNOWN
            told = known & (columns["stream"] == s) & (columns["known_by"] > 0)
            last = np.maximum.accumulate(np.where(told, np.arange(len(told)), -1))
            module = np.where(last < 0, self._known_by[s], columns["known_by"][last])
            self._known_by[s] = module[-1]
            codes[path] = np.where(known, len(STATES) + module, columns["state"][:, s])
        return codes

    def end(self, frames: int) -> None:
        """Write what is left; all lanes end with the run.

        Args:
            frames: where the run ended.
        """
        for mostly in self._mostly.values():
            mostly.end()
        for lane in self._every():
            lane.end(frames, self._iteration)
        self.flush()

    def flush(self) -> None:
        """Hand over the changes since the last time."""
        for lane in self._every():
            lane.flush()

    def _every(self) -> list[Lane]:
        return [*self._lanes.values(), *(mostly.lane for mostly in self._mostly.values())]


class MostlyLane:
    """A lane that says of each piece of a run what was the case in most of its blocks.

    Args:
        lane: where it is said.
        piece: blocks of a piece; by default a run has `PIECES`, known at its end.
    """

    def __init__(self, lane: Lane, piece: int | None) -> None:
        self.lane, self._piece = lane, piece
        self._tau = 0
        self._waiting: list[tuple[Codes, Codes, Codes]] = []

    def add(self, frames: Codes, iterations: Codes, codes: Codes, tau: int) -> None:
        """Take what was the case in consecutive blocks of `tau` frames."""
        self._tau = tau
        self._waiting.append((frames, iterations, codes))
        if self._piece is not None:
            self._say(self._piece, last=False)

    def end(self) -> None:
        """Say what is left."""
        blocks = sum(len(codes) for *_, codes in self._waiting)
        self._say(self._piece or max(blocks // PIECES, 1), last=True)

    def _say(self, piece: int, *, last: bool) -> None:
        if not self._waiting:
            return
        frames, iterations, codes = (np.concatenate(p) for p in zip(*self._waiting, strict=True))
        stop = len(codes) if last else len(codes) // piece * piece
        starts = np.arange(0, stop, piece)
        said = np.array([_most(codes[i : i + piece]) for i in starts], dtype=np.int64)
        if len(starts):
            every = np.repeat(said, piece)[:stop]
            self.lane.add(frames[:stop], iterations[:stop], every, self._tau)
        self._waiting = [(frames[stop:], iterations[stop:], codes[stop:])]


def _most(codes: Codes) -> int:
    """The code that most of these are, `_MIXED` where there is none."""
    values, counts = np.unique(codes, return_counts=True)
    place = int(counts.argmax())
    return int(values[place]) if counts[place] >= MOST_OF * len(codes) else _MIXED


class Lane:
    """A row of the view: changes of state, waiting to be handed over.

    Where nothing was watched, nothing is the case: a bar ends where a gap begins.

    Args:
        recording: where they go.
        spec: of the source.
        path: the entity.
        name: what the codes stand for.
    """

    def __init__(
        self, recording: rr.RecordingStream, spec: SourceSpec, path: str, name: NameOf
    ) -> None:
        self._recording = recording
        self._spec = spec
        self._path = path
        self._name = name
        self._state: str | None = None
        self._stop: int | None = None
        self._changes: list[tuple[int, int, str]] = []
        self._colours: dict[str, Rgb] = {}
        self._declared = 0

    def add(self, frames: Codes, iterations: Codes, codes: Codes, tau: int) -> None:
        """Keep the places where what the codes of blocks of `tau` frames stand for changes."""
        stops = np.concatenate([frames[:1] if self._stop is None else [self._stop], frames + tau])
        begins = np.diff(codes.astype(np.int64), prepend=int(codes[0]) + 1) != 0
        gaps, self._stop = frames != stops[:-1], int(stops[-1])
        for i in np.flatnonzero(begins | gaps).tolist():
            state, rgb = self._name(int(codes[i]))
            self._colours.setdefault(state, rgb)
            if gaps[i]:
                self._changes.append((int(stops[i]), int(iterations[i]), ""))
            if gaps[i] or state != self._state:
                self._state = state
                self._changes.append((int(frames[i]), int(iterations[i]), state))

    def end(self, frames: int, iteration: int) -> None:
        """Nothing is the case any longer."""
        if self._state is not None:
            self._changes.append((frames, iteration, ""))

    def flush(self) -> None:
        """Hand over what waits, and say which states there are, where there are new ones."""
        if not self._changes:
            return
        if self._declared < len(self._colours):
            self._declared = len(self._colours)
            states, colours = list(self._colours), packed_all(list(self._colours.values()))
            known = rr.StateConfiguration(values=states, labels=states, colors=colours)
            self._recording.log(self._path, known, static=True)
        frames, iterations = (np.array([row[i] for row in self._changes]) for i in (0, 1))
        changes = rr.StateChange.columns(state=[state for _, _, state in self._changes])
        times = time_columns(self._spec, frames, iterations)
        self._recording.send_columns(self._path, times, changes)
        self._changes = []


def _or_mixed(code: int, name: NameOf, mixed: str) -> tuple[str, Rgb]:
    return (mixed, palette.GREY) if code == _MIXED else name(code)


def _learned(module: int) -> tuple[str, Rgb]:
    return f"module {module}", palette.SAND if module % 2 else palette.KHAKI


def _verdict(code: int) -> tuple[str, Rgb]:
    if code == _NOVEL:
        return "novel", palette.LILAC
    return (f"known by {code}", palette.MIST) if code else ("constant", palette.BROWN)


def _done(code: int, streams: Sequence[str]) -> tuple[str, Rgb]:
    if code >= len(streams):
        return SWITCH, palette.GREY
    return f"{STAY} on {streams[code]}", colour(code)


def _chosen(explored: int) -> tuple[str, Rgb]:
    return ("explored", palette.ROSE) if explored else ("greedy", palette.MOSS)


def _planned(action: int, stream: int) -> tuple[str, Rgb]:
    return (SWITCH, palette.GREY) if action else (STAY, colour(stream))


def _became(code: int) -> tuple[str, Rgb]:
    """A stream's state by its code in `STATES`; beyond them stand the modules that know it."""
    if code >= len(STATES):
        module = code - len(STATES)
        return f"known by {module}" if module else "known", palette.STATES[_KNOWN]
    return STATES[code].replace("_", " "), palette.STATES[code]
