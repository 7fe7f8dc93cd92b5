"""State timelines of a run: rows of labelled bars, as the attended stream or a stream's state.

The viewer labels a row with its entity and sorts rows by these labels.
A state that changes often has two rows: `/attended/each_block` has every change, and
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
from replay.view.writer import Writer, drawable, part

# Returns the code of the state in each of n blocks, (n,).
Codes = Callable[[SignalColumns], IntArray]

# Returns name and color of the state with a code.
States = Callable[[int], tuple[str, Rgb]]

# Pieces of a run in a timeline of most blocks: more would be narrower than their labels.
PIECES = 80

# Share of a piece's blocks that must have one state; with a lower share a mixed piece would be
# named after one of its states.
MOST_OF = 2 / 3

# Code of pieces without a common state, and code of novel blocks; other codes are not negative.
_MIXED, _NOVEL = -2, -1
_KNOWN = STATES.index("known")


class StateTimelines:
    """Writes all state timelines of a run.

    Args:
        writer: writer of the Rerun recording.
        selected: streams with a timeline of their policy or state.
        by_progress: whether the progress learner learned the run; its streams have states.
        piece: number of blocks that share one state in timelines of most blocks; by default a run
            has `PIECES` pieces, which are written at its end.
    """

    def __init__(
        self,
        writer: Writer,
        selected: Sequence[int],
        *,
        by_progress: bool,
        piece: int | None = None,
    ) -> None:
        streams, count = writer.spec.streams, len(writer.spec.streams)
        names, (stay, switch) = [drawable(name) for name in streams], ACTIONS
        self._known_by = np.zeros(count, dtype=np.int64)
        self._timelines: list[tuple[Codes, StateTimeline]] = []

        def add(path: str, codes: Codes, states: States, mixed: str = "") -> None:
            entity = f"{path}/each_block" if mixed else path
            self._timelines.append((codes, StateTimeline(writer, entity, states)))
            if mixed:
                entity = f"{path}/most_blocks"
                self._timelines.append((codes, StateTimeline(writer, entity, states, piece, mixed)))

        attended = {s: (name, colour(s)) for s, name in enumerate(names)}
        add("attended", lambda c: c["stream"], attended.__getitem__, "several")
        if by_progress:
            for s in selected:
                add(f"state/{part(streams, s)}", partial(self._states, s), _state)
            return
        done = {s: (f"{stay} on {name}", colour(s)) for s, name in enumerate(names)}
        done |= {count + s: (switch, palette.GREY) for s in range(count)}
        explored = {0: ("best known", palette.MOSS), 1: ("random", palette.ROSE)}
        add("candidate", lambda c: c["module"], _learned)
        add("novelty", _verdicts, _verdict, "mixed")
        add("action", lambda c: c["stream"] + count * c["action"], done.__getitem__)
        add("action_choice", lambda c: c["explored"], explored.__getitem__)
        for s in selected:
            planned = {0: (stay, colour(s)), 1: (switch, palette.GREY)}
            codes = partial(lambda s, c: c["policy"][:, s], s)
            add(f"policy/{part(streams, s)}", codes, planned.__getitem__)

    def take(self, batch: Batch) -> None:
        """Write the states of some iterations."""
        for codes, timeline in self._timelines:
            for columns in batch.signals:
                timeline.add_codes(columns.frames, columns.iterations, codes(columns), columns.tau)
            timeline.send_changes()

    def _states(self, s: int, columns: SignalColumns) -> IntArray:
        """Return codes of a stream's state, or of the module that explains it."""
        known = columns["state"][:, s] == _KNOWN
        tested = known & (columns["stream"] == s) & (columns["known_by"] > 0)
        last = np.maximum.accumulate(np.where(tested, np.arange(len(tested)), -1))
        module = np.where(last < 0, self._known_by[s], columns["known_by"][last])
        self._known_by[s] = module[-1]
        return np.where(known, len(STATES) + module, columns["state"][:, s])

    def end(self, frames: int, iteration: int) -> None:
        """End all timelines with the run, after `frames` frames."""
        for _, timeline in self._timelines:
            timeline.end(frames, iteration)
            timeline.send_changes()


class StateTimeline:
    """Buffers the changes of one state and sends them to the recording.

    Between blocks there is no state: a bar ends where a gap begins.

    Args:
        writer: writer of the Rerun recording.
        path: entity of the timeline.
        states: name and color of the state with a code.
        piece: number of blocks that share one state; see `StateTimelines`.
        mixed: name of the state of pieces without a common state.
    """

    def __init__(
        self, writer: Writer, path: str, states: States, piece: int | None = 1, mixed: str = ""
    ) -> None:
        self._writer, self._path, self._states = writer, path, states
        self._piece, self._mixed, self._tau = piece, mixed, 0
        self._blocks: list[tuple[IntArray, IntArray, IntArray]] = []
        self._state: str | None = None
        self._stop: int | None = None
        self._changes: list[tuple[int, int, str]] = []
        self._colours: dict[str, Rgb] = {}

    def add_codes(self, frames: IntArray, iterations: IntArray, codes: IntArray, tau: int) -> None:
        """Add the codes of consecutive blocks of `tau` frames."""
        self._tau = tau
        self._blocks.append((frames, iterations, codes))
        if self._piece is not None:
            self._summarise(self._piece)

    def end(self, frames: int, iteration: int) -> None:
        """Add the remaining blocks, and end the last state."""
        blocks = sum(len(codes) for *_, codes in self._blocks)
        self._summarise(self._piece or max(blocks // PIECES, 1), last=True)
        if self._state is not None:
            self._changes.append((frames, iteration, ""))

    def _summarise(self, piece: int, *, last: bool = False) -> None:
        """Add the blocks of complete pieces; with `last` all blocks."""
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
        """Append the changes of the state."""
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
        """Declare the states, and send the buffered changes."""
        if not self._changes:
            return
        known, rgbs = list(self._colours), packed_all(list(self._colours.values()))
        config = rr.StateConfiguration(values=known, labels=known, colors=rgbs)
        self._writer.log(self._path, config)
        frames, iterations, states = zip(*self._changes, strict=True)
        at = np.array(frames), np.array(iterations)
        self._writer.send(self._path, at, rr.StateChange.columns(state=states))
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
    """Return name and color of a stream's state; codes from `len(STATES)` name a module."""
    if code >= len(STATES):
        module = code - len(STATES)
        text = STATE_WORDS[_KNOWN]
        return f"{text} by module {module}" if module else text, palette.STATE_COLOURS[_KNOWN]
    return STATE_WORDS[code], palette.STATE_COLOURS[code]
