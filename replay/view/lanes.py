"""Lanes: what was the case when, as labelled bars of colour.

A lane's label is its entity, and lanes stand in alphabetical order: so they have the names that
they have. A state that changes with many blocks has two lanes: `/attends` holds every change,
`/mostly/attends` the state of most of the blocks around, which reads when all of a run is in view.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import rerun as rr

from cdmisfa.core.arrays import IntArray
from cdmisfa.core.signals import ACTIONS, STATES
from replay import palette
from replay.palette import Rgb, colour, packed_all
from replay.runs.columns import SignalColumns
from replay.view.columns import Target
from replay.view.labels import label, part

Names = Callable[[int], tuple[str, Rgb]]
"""Gives the state that a code stands for, and its colour."""

Codes = Callable[[SignalColumns], IntArray]
"""Gives the code of each block's state, (n,)."""

ATTENDS, LEARNS, NOVELTY, DOES, EXPLORES = "attends", "learns", "novelty", "does", "explores"
"""Entities of lanes."""

MOSTLY = "mostly"
"""Parent entity of lanes with the state of most blocks."""

PIECES = 80
"""Pieces of a run for each of which such a lane has one state."""

MOST_OF = 2 / 3
"""Share of the blocks of a piece that is most of them."""

STAY, SWITCH = ACTIONS

_NOVEL = -1
_MIXED = -2
_KNOWN = STATES.index("known")


class Lanes:
    """All lanes of a run.

    Args:
        target: where they go.
        shown: the streams that get a lane of their own: of the policy, or of the stream's state.
        by_progress: the run is one of the progress learner, which has no gate.
        piece: blocks for which lanes of most blocks have one state; by default so many that they
            are written once all blocks are known.
    """

    def __init__(
        self,
        target: Target,
        shown: Sequence[int],
        *,
        by_progress: bool = False,
        piece: int | None = None,
    ) -> None:
        self._lanes: list[tuple[Codes, Lane]] = []
        spec, count = target.spec, len(target.spec.streams)
        self._known_by = np.zeros(count, dtype=np.int64)

        def attended(stream: int) -> tuple[str, Rgb]:
            return label(spec.streams[stream]), colour(stream)

        def done(code: int) -> tuple[str, Rgb]:
            name = f"{STAY} on {label(spec.streams[code % count])}"
            return (name, colour(code)) if code < count else (SWITCH, palette.GREY)

        def lane(path: str, codes: Codes, names: Names, mixed: str = "") -> None:
            self._lanes.append((codes, Lane(target, path, names)))
            if mixed:
                place = f"{MOSTLY}/{path}"
                mostly = MostlyLane(target, place, _or_mixed(names, mixed), piece)
                self._lanes.append((codes, mostly))

        lane(ATTENDS, lambda c: c["stream"], attended, "switches")
        if not by_progress:
            lane(LEARNS, lambda c: c["module"], _learned)
            lane(NOVELTY, _verdicts, _verdict, "both")
            lane(DOES, lambda c: c["stream"] + count * c["action"], done)
            lane(EXPLORES, lambda c: c["explored"], _explored)
        for s in shown:
            place = part(spec.streams, s)
            if by_progress:
                lane(f"state/{place}", partial(self._states, s), _state)
            else:
                lane(f"policy/{place}", partial(_policy, s), partial(_planned, s))

    def add(self, columns: SignalColumns) -> None:
        """Take the states of consecutive iterations in."""
        for codes, lane in self._lanes:
            lane.add(columns.frames, columns.iterations, codes(columns), columns.tau)

    def _states(self, s: int, columns: SignalColumns) -> IntArray:
        """Codes of a stream's state; of a known one with the module that knows it."""
        known = columns["state"][:, s] == _KNOWN
        told = known & (columns["stream"] == s) & (columns["known_by"] > 0)
        last = np.maximum.accumulate(np.where(told, np.arange(len(told)), -1))
        module = np.where(last < 0, self._known_by[s], columns["known_by"][last])
        self._known_by[s] = module[-1]
        return np.where(known, len(STATES) + module, columns["state"][:, s])

    def end(self, frames: int, iteration: int) -> None:
        """Write what is left; all lanes end with the run, at so many frames."""
        for _, lane in self._lanes:
            lane.end(frames, iteration)
        self.flush()

    def flush(self) -> None:
        """Hand over the changes since the last time."""
        for _, lane in self._lanes:
            lane.flush()


class Lane:
    """A row of the view: changes of state, waiting to be handed over.

    Between blocks there is no state: a bar ends where a gap begins.

    Args:
        target: where they go.
        path: the entity.
        names: the states of the codes.
    """

    def __init__(self, target: Target, path: str, names: Names) -> None:
        self._target, self._path, self._names = target, path, names
        self._state: str | None = None
        self._stop: int | None = None
        self._changes: list[tuple[int, int, str]] = []
        self._colours: dict[str, Rgb] = {}
        self._declared = 0

    def add(self, frames: IntArray, iterations: IntArray, codes: IntArray, tau: int) -> None:
        """Keep the places where the state of blocks of `tau` frames changes."""
        stops = np.concatenate([frames[:1] if self._stop is None else [self._stop], frames + tau])
        begins = np.diff(codes.astype(np.int64), prepend=int(codes[0]) + 1) != 0
        gaps, self._stop = frames != stops[:-1], int(stops[-1])
        for i in np.flatnonzero(begins | gaps).tolist():
            state, rgb = self._names(int(codes[i]))
            self._colours.setdefault(state, rgb)
            if gaps[i]:
                self._changes.append((int(stops[i]), int(iterations[i]), ""))
            if gaps[i] or state != self._state:
                self._state = state
                self._changes.append((int(frames[i]), int(iterations[i]), state))

    def end(self, frames: int, iteration: int) -> None:
        """There is no state any longer."""
        if self._state is not None:
            self._changes.append((frames, iteration, ""))

    def flush(self) -> None:
        """Hand over what waits, and declare the states where there are new ones."""
        if not self._changes:
            return
        if self._declared < len(self._colours):
            self._declared = len(self._colours)
            states, colours = list(self._colours), packed_all(list(self._colours.values()))
            known = rr.StateConfiguration(values=states, labels=states, colors=colours)
            self._target.log(self._path, known)
        frames, iterations = (np.array([row[i] for row in self._changes]) for i in (0, 1))
        changes = rr.StateChange.columns(state=[state for *_, state in self._changes])
        self._target.send(self._path, frames, iterations, changes)
        self._changes = []


class MostlyLane(Lane):
    """A lane with the state of most of the blocks of each piece of a run.

    Args:
        target: where they go.
        path: the entity.
        names: the states of the codes.
        piece: blocks of a piece; by default a run has `PIECES`, known at its end.
    """

    def __init__(self, target: Target, path: str, names: Names, piece: int | None) -> None:
        super().__init__(target, path, names)
        self._piece, self._tau = piece, 0
        self._waiting: list[tuple[IntArray, IntArray, IntArray]] = []

    def add(self, frames: IntArray, iterations: IntArray, codes: IntArray, tau: int) -> None:
        """Take the codes of consecutive blocks of `tau` frames."""
        self._tau = tau
        self._waiting.append((frames, iterations, codes))
        if self._piece is not None:
            self._summarise(self._piece, last=False)

    def end(self, frames: int, iteration: int) -> None:
        """Add what is left; there is no state any longer."""
        blocks = sum(len(codes) for *_, codes in self._waiting)
        self._summarise(self._piece or max(blocks // PIECES, 1), last=True)
        super().end(frames, iteration)

    def _summarise(self, piece: int, *, last: bool) -> None:
        if not self._waiting:
            return
        frames, iterations, codes = (np.concatenate(p) for p in zip(*self._waiting, strict=True))
        stop = len(codes) if last else len(codes) // piece * piece
        if stop:
            most = [_most(codes[i : min(i + piece, stop)]) for i in range(0, stop, piece)]
            every = np.repeat(np.array(most, dtype=np.int64), piece)[:stop]
            super().add(frames[:stop], iterations[:stop], every, self._tau)
        self._waiting = [(frames[stop:], iterations[stop:], codes[stop:])]


def _most(codes: IntArray) -> int:
    """The code that most of these are, `_MIXED` where there is none."""
    values, counts = np.unique(codes, return_counts=True)
    place = int(counts.argmax())
    return int(values[place]) if counts[place] >= MOST_OF * len(codes) else _MIXED


def _or_mixed(names: Names, mixed: str) -> Names:
    return lambda code: (mixed, palette.GREY) if code == _MIXED else names(code)


def _learned(module: int) -> tuple[str, Rgb]:
    return f"module {module}", palette.SAND if module % 2 else palette.KHAKI


def _verdicts(columns: SignalColumns) -> IntArray:
    return np.where(columns["novel"], _NOVEL, np.maximum(columns["known_by"], 0))


def _verdict(code: int) -> tuple[str, Rgb]:
    if code == _NOVEL:
        return "novel", palette.LILAC
    return (f"known by {code}", palette.MIST) if code else ("constant", palette.BROWN)


def _explored(explored: int) -> tuple[str, Rgb]:
    return ("explored", palette.ROSE) if explored else ("greedy", palette.MOSS)


def _policy(s: int, columns: SignalColumns) -> IntArray:
    return columns["policy"][:, s]


def _planned(stream: int, action: int) -> tuple[str, Rgb]:
    return (SWITCH, palette.GREY) if action else (STAY, colour(stream))


def _state(code: int) -> tuple[str, Rgb]:
    """A stream's state by its code in `STATES`; beyond them stand the modules that know it."""
    if code >= len(STATES):
        module = code - len(STATES)
        return f"known by {module}" if module else "known", palette.STATES[_KNOWN]
    return STATES[code].replace("_", " "), palette.STATES[code]
