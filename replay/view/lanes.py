"""Lanes: what was the case when, as labelled bars of colour."""

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

STAY, SWITCH = ACTIONS

_NOVEL = -1
_KNOWN = STATES.index("known")


class Lanes:
    """All lanes of a run.

    Args:
        recording: where they go.
        spec: of the source.
        shown: the streams that get a lane of their own: of the policy, or of the stream's state.
        by_progress: the run is one of the progress learner, which has no gate.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        spec: SourceSpec,
        shown: Sequence[int],
        *,
        by_progress: bool = False,
    ) -> None:
        names: dict[str, NameOf] = {
            "lanes/1_stream": lambda stream: (label(spec.streams[stream]), colour(stream)),
        }
        self._known_by = np.zeros(len(spec.streams), dtype=np.int64)
        kind = "streams/state" if by_progress else "policy"
        self._of_stream = {s: f"{kind}/{part(spec.streams, s)}" for s in shown}
        if by_progress:
            self._codes = self._became
            names |= dict.fromkeys(self._of_stream.values(), _became)
        else:
            self._codes = self._decided
            names |= _GATED
            names |= {path: partial(_planned, stream=s) for s, path in self._of_stream.items()}
        self._lanes = {p: Lane(recording, spec, p, name) for p, name in names.items()}
        self._iteration = 0

    def add(self, columns: SignalColumns) -> None:
        """Take the states of consecutive iterations in."""
        self._iteration = int(columns.iterations[-1])
        codes = {"lanes/1_stream": columns["stream"]} | self._codes(columns)
        for path, lane in self._lanes.items():
            lane.add(columns, codes[path])

    def _decided(self, columns: SignalColumns) -> dict[str, Codes]:
        """What CD-MISFA does and decides."""
        codes = {
            "lanes/2_learning": columns["module"],
            "lanes/3_gate": np.where(columns["novel"], _NOVEL, np.maximum(columns["known_by"], 0)),
            "lanes/4_action": columns["action"],
            "lanes/5_chosen_by": columns["explored"],
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
        for lane in self._lanes.values():
            lane.end(frames, self._iteration)
        self.flush()

    def flush(self) -> None:
        """Hand over the changes since the last time."""
        for lane in self._lanes.values():
            lane.flush()


class Lane:
    """A row of the view: changes of state, waiting to be handed over.

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
        self._changes: list[tuple[int, int, str]] = []
        self._colours: dict[str, Rgb] = {}
        self._declared = 0

    def add(self, columns: SignalColumns, codes: NDArray[np.int64]) -> None:
        """Keep the places where what the codes stand for changes."""
        begins = np.flatnonzero(np.diff(codes.astype(np.int64), prepend=int(codes[0]) + 1))
        rows = zip(codes[begins], columns.frames[begins], columns.iterations[begins], strict=True)
        for code, t, iteration in rows:
            state, rgb = self._name(int(code))
            self._colours.setdefault(state, rgb)
            if state != self._state:
                self._state = state
                self._changes.append((int(t), int(iteration), state))

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


def _verdict(code: int) -> tuple[str, Rgb]:
    if code == _NOVEL:
        return "novel", palette.GREEN
    return (f"known by {code}", colour(code - 1)) if code else ("constant", palette.PURPLE)


def _action(action: int) -> tuple[str, Rgb]:
    return (STAY, palette.SKY) if action == 0 else (SWITCH, palette.VERMILLION)


def _chosen(explored: int) -> tuple[str, Rgb]:
    return ("explored", palette.ORANGE) if explored else ("greedy", palette.BLUE)


def _planned(action: int, stream: int) -> tuple[str, Rgb]:
    return (SWITCH, palette.GREY) if action else (STAY, colour(stream))


def _became(code: int) -> tuple[str, Rgb]:
    """A stream's state by its code in `STATES`; beyond them stand the modules that know it."""
    if code >= len(STATES):
        module = code - len(STATES)
        return f"known by {module}" if module else "known", palette.STATES[_KNOWN]
    return STATES[code].replace("_", " "), palette.STATES[code]


_GATED: dict[str, NameOf] = {
    "lanes/2_learning": lambda module: (f"module {module}", colour(module - 1)),
    "lanes/3_gate": _verdict,
    "lanes/4_action": _action,
    "lanes/5_chosen_by": _chosen,
}
"""Lanes of CD-MISFA."""
