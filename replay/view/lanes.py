"""Lanes: labelled bars of colour, one for each state of a run.

The viewer labels a lane with its entity and sorts lanes by these labels.
A state that changes often has two lanes: `/attended/each_block` has every change, and
`/attended/most_blocks` has the state of most of the surrounding blocks, which is readable when the
whole run is visible.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import rerun as rr

from cdmisfa.core.arrays import IntArray
from cdmisfa.core.signals import ACTIONS, STATE_WORDS, STATES
from replay import palette
from replay.palette import Rgb, colour, packed_all
from replay.runs.columns import SignalColumns
from replay.runs.log import Batch
from replay.view.rows import Rows, drawable, part

# Gives the code of each block's state, (n,).
Codes = Callable[[SignalColumns], IntArray]

# Gives the name and the colour of the state that a code stands for.
States = Callable[[int], tuple[str, Rgb]]

# Pieces of a run, in each of which a lane of most blocks has one state.
PIECES = 80

# Share of the blocks of a piece that is most of them.
MOST_OF = 2 / 3

# Codes of blocks most of which have no state in common, and of novel ones.
_MIXED, _NOVEL = -2, -1
_KNOWN = STATES.index("known")


class Lanes:
    """Writes all lanes of a run.

    Args:
        rows: of the recording.
        selected: the streams that get a lane of their own: of the policy, or of the stream's state.
        by_progress: the run is one of the progress learner, which has no gate.
        piece: blocks for which lanes of most blocks have one state; by default a run has `PIECES`,
            which are written at its end.
    """

    def __init__(
        self, rows: Rows, selected: Sequence[int], *, by_progress: bool, piece: int | None = None
    ) -> None:
        streams, count = rows.spec.streams, len(rows.spec.streams)
        names, (stay, switch) = [drawable(name) for name in streams], ACTIONS
        self._known_by = np.zeros(count, dtype=np.int64)
        self._lanes: list[tuple[Codes, Lane]] = []

        def lane(path: str, codes: Codes, states: States, mixed: str = "") -> None:
            entity = f"{path}/each_block" if mixed else path
            self._lanes.append((codes, Lane(rows, entity, states)))
            if mixed:
                entity = f"{path}/most_blocks"
                self._lanes.append((codes, Lane(rows, entity, states, piece, mixed)))

        attended = {s: (name, colour(s)) for s, name in enumerate(names)}
        lane("attended", lambda c: c["stream"], attended.__getitem__, "several")
        if by_progress:
            for s in selected:
                lane(f"state/{part(streams, s)}", partial(self._states, s), _state)
            return
        done = {s: (f"{stay} on {name}", colour(s)) for s, name in enumerate(names)}
        done |= {count + s: (switch, palette.GREY) for s in range(count)}
        explored = {0: ("best known", palette.MOSS), 1: ("random", palette.ROSE)}
        lane("candidate", lambda c: c["module"], _learned)
        lane("novelty", _verdicts, _verdict, "mixed")
        lane("action", lambda c: c["stream"] + count * c["action"], done.__getitem__)
        lane("action_choice", lambda c: c["explored"], explored.__getitem__)
        for s in selected:
            planned = {0: (stay, colour(s)), 1: (switch, palette.GREY)}
            codes = partial(lambda s, c: c["policy"][:, s], s)
            lane(f"policy/{part(streams, s)}", codes, planned.__getitem__)

    def take(self, batch: Batch) -> None:
        """Write the states of some iterations."""
        for codes, lane in self._lanes:
            for columns in batch.signals:
                at = columns.frames, columns.iterations
                lane.add_codes(*at, codes(columns), columns.tau)
            lane.send_changes()

    def _states(self, s: int, columns: SignalColumns) -> IntArray:
        """Return codes of a stream's state; where it is known, with the module that knows it."""
        known = columns["state"][:, s] == _KNOWN
        tested = known & (columns["stream"] == s) & (columns["known_by"] > 0)
        last = np.maximum.accumulate(np.where(tested, np.arange(len(tested)), -1))
        module = np.where(last < 0, self._known_by[s], columns["known_by"][last])
        self._known_by[s] = module[-1]
        return np.where(known, len(STATES) + module, columns["state"][:, s])

    def end(self, frames: int, iteration: int) -> None:
        """End all lanes with the run, at so many frames."""
        for _, lane in self._lanes:
            lane.end(frames, iteration)
            lane.send_changes()


class Lane:
    """Changes of a state, waiting to be sent.

    Between blocks there is no state: a bar ends where a gap begins.

    Args:
        rows: of the recording.
        path: the entity.
        states: of the codes.
        piece: blocks that have one state, that of most of them; see `Lanes`.
        mixed: name of the state of blocks that have no state in common.
    """

    def __init__(
        self, rows: Rows, path: str, states: States, piece: int | None = 1, mixed: str = ""
    ) -> None:
        self._rows, self._path, self._states = rows, path, states
        self._piece, self._mixed, self._tau = piece, mixed, 0
        self._blocks: list[tuple[IntArray, IntArray, IntArray]] = []
        self._state: str | None = None
        self._stop: int | None = None
        self._changes: list[tuple[int, int, str]] = []
        self._colours: dict[str, Rgb] = {}

    def add_codes(self, frames: IntArray, iterations: IntArray, codes: IntArray, tau: int) -> None:
        """Take the codes of consecutive blocks of `tau` frames."""
        self._tau = tau
        self._blocks.append((frames, iterations, codes))
        if self._piece is not None:
            self._summarise(self._piece)

    def end(self, frames: int, iteration: int) -> None:
        """Take the blocks that are left, and end the last state."""
        blocks = sum(len(codes) for *_, codes in self._blocks)
        self._summarise(self._piece or max(blocks // PIECES, 1), last=True)
        if self._state is not None:
            self._changes.append((frames, iteration, ""))

    def _summarise(self, piece: int, *, last: bool = False) -> None:
        """Take the blocks of whole pieces, or all."""
        if not self._blocks:
            return
        frames, iterations, codes = (np.concatenate(p) for p in zip(*self._blocks, strict=True))
        stop = len(codes) if last else len(codes) // piece * piece
        self._blocks = [(frames[stop:], iterations[stop:], codes[stop:])]
        if not stop:
            return
        codes = codes[:stop].astype(np.int64)
        for i in range(0, stop, piece) if piece > 1 else ():
            values, counts = np.unique(codes[i : i + piece], return_counts=True)
            most = int(counts.argmax())
            is_most = counts[most] >= MOST_OF * counts.sum()
            codes[i : i + piece] = values[most] if is_most else _MIXED
        self._change(frames[:stop], iterations[:stop], codes)

    def _change(self, frames: IntArray, iterations: IntArray, codes: IntArray) -> None:
        """Keep the places where the state changes."""
        first = frames[:1] if self._stop is None else [self._stop]
        stops = np.concatenate([first, frames + self._tau])
        gaps, self._stop = frames != stops[:-1], int(stops[-1])
        for i in np.flatnonzero(gaps | (np.diff(codes, prepend=codes[0] + 1) != 0)).tolist():
            code = int(codes[i])
            state, rgb = (self._mixed, palette.GREY) if code == _MIXED else self._states(code)
            self._colours.setdefault(state, rgb)
            if gaps[i]:
                self._changes.append((int(stops[i]), int(iterations[i]), ""))
            if gaps[i] or state != self._state:
                self._state = state
                self._changes.append((int(frames[i]), int(iterations[i]), state))

    def send_changes(self) -> None:
        """Declare the states, and send the changes that wait."""
        if not self._changes:
            return
        known, rgbs = list(self._colours), packed_all(list(self._colours.values()))
        config = rr.StateConfiguration(values=known, labels=known, colors=rgbs)
        self._rows.log(self._path, config)
        frames, iterations, states = zip(*self._changes, strict=True)
        at = np.array(frames), np.array(iterations)
        self._rows.send(self._path, at, rr.StateChange.columns(state=states))
        self._changes = []


def _learned(module: int) -> tuple[str, Rgb]:
    return f"module {module}", palette.SAND if module % 2 else palette.KHAKI


def _verdicts(columns: SignalColumns) -> IntArray:
    return np.where(columns["novel"], _NOVEL, np.maximum(columns["known_by"], 0))


def _verdict(code: int) -> tuple[str, Rgb]:
    if code == _NOVEL:
        return "novel", palette.LILAC
    return (f"explained by module {code}", palette.MIST) if code else ("constant", palette.BROWN)


def _state(code: int) -> tuple[str, Rgb]:
    """Return the name of a stream's state in `STATES`; beyond are the modules that know it."""
    if code >= len(STATES):
        module = code - len(STATES)
        text = STATE_WORDS[_KNOWN]
        return f"{text} by module {module}" if module else text, palette.STATES[_KNOWN]
    return STATE_WORDS[code], palette.STATES[code]
