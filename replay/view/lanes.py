"""Lanes: what was the case when, as labelled bars of colour."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from replay.palette import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SKY,
    VERMILLION,
    Rgb,
    colour,
    packed_all,
)
from replay.runs.columns import SignalColumns
from replay.view.columns import Clock
from replay.view.labels import label, part

STAY, SWITCH = "stay", "switch"


class Lanes:
    """Collects changes of state; a lane is a row of the view.

    Args:
        recording: where they go.
        clock: how frames become times.
        names: of all streams.
        shown: the streams whose policy gets a lane.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        clock: Clock,
        names: Sequence[str],
        shown: Sequence[int],
    ) -> None:
        self._recording = recording
        self._clock = clock
        self._names = names
        self._policies = {s: f"policy/{part(names, s)}" for s in shown}
        self._changes: dict[str, list[tuple[int, int, str]]] = {}
        self._colours: dict[str, dict[str, Rgb]] = {}
        self._sent: dict[str, int] = {}
        self._declared: dict[str, int] = {}
        self._iteration = 0

    def add(self, columns: SignalColumns) -> None:
        """Take the states of consecutive iterations in."""
        self._iteration = int(columns.iterations[-1])
        self._put(columns, "lanes/1_stream", columns["stream"], self._stream)
        self._put(columns, "lanes/2_learning", columns["module"], _learning)
        verdicts = np.where(columns["novel"], _NOVEL, np.maximum(columns["known_by"], 0))
        self._put(columns, "lanes/3_gate", verdicts, _verdict)
        self._put(columns, "lanes/4_action", columns["action"], _action)
        self._put(columns, "lanes/5_chosen_by", columns["explored"], _chosen)
        for s, path in self._policies.items():
            self._put(columns, path, columns["policy"][:, s], partial(_planned, stream=s))

    def end(self, frames: int) -> None:
        """Write what is left; all lanes end with the run.

        Args:
            frames: where the run ended.
        """
        for changes in self._changes.values():
            changes.append((frames, self._iteration, ""))
        self.flush()

    def flush(self) -> None:
        """Hand over the changes since the last time."""
        for path, changes in self._changes.items():
            rows = changes[self._sent.get(path, 0) :]
            if not rows:
                continue
            self._declare(path)
            self._sent[path] = len(changes)
            times = self._clock.columns(
                np.array([t for t, _, _ in rows]), np.array([k for _, k, _ in rows])
            )
            states = rr.StateChange.columns(state=[state for _, _, state in rows])
            self._recording.send_columns(path, times, states)

    def _declare(self, path: str) -> None:
        """Say which states there are, where there are new ones."""
        chosen = self._colours[path]
        if self._declared.get(path) == len(chosen):
            return
        self._declared[path] = len(chosen)
        self._recording.log(
            path,
            rr.StateConfiguration(
                values=list(chosen),
                labels=list(chosen),
                colors=packed_all(list(chosen.values())),
            ),
            static=True,
        )

    def _put(
        self,
        columns: SignalColumns,
        path: str,
        codes: NDArray[np.int64],
        name: Callable[[int], tuple[str, Rgb]],
    ) -> None:
        """Keep the places where what the codes stand for changes."""
        changes = self._changes.setdefault(path, [])
        colours = self._colours.setdefault(path, {})
        begins = np.flatnonzero(np.diff(codes.astype(np.int64), prepend=int(codes[0]) + 1))
        rows = zip(codes[begins], columns.frames[begins], columns.iterations[begins], strict=True)
        for code, t, iteration in rows:
            state, rgb = name(int(code))
            colours.setdefault(state, rgb)
            if not changes or changes[-1][2] != state:
                changes.append((int(t), int(iteration), state))

    def _stream(self, stream: int) -> tuple[str, Rgb]:
        return label(self._names[stream]), colour(stream)


_NOVEL = -1


def _learning(module: int) -> tuple[str, Rgb]:
    return f"module {module}", colour(module - 1)


def _verdict(code: int) -> tuple[str, Rgb]:
    if code == _NOVEL:
        return "novel", GREEN
    return (f"known by {code}", colour(code - 1)) if code else ("constant", PURPLE)


def _action(action: int) -> tuple[str, Rgb]:
    return (STAY, SKY) if action == 0 else (SWITCH, VERMILLION)


def _chosen(explored: int) -> tuple[str, Rgb]:
    return ("explored", ORANGE) if explored else ("greedy", BLUE)


def _planned(action: int, stream: int) -> tuple[str, Rgb]:
    return (SWITCH, GREY) if action else (STAY, colour(stream))
