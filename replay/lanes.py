"""Lanes: what was the case when, as labelled bars of colour."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr

from cdmisfa.signals import BlockSignals
from replay.columns import Clock
from replay.labels import label, part
from replay.palette import BLUE, GREEN, GREY, ORANGE, PURPLE, SKY, VERMILLION, Rgb, colour, packed

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

    def add(self, signals: BlockSignals) -> None:
        """Take the state of one iteration in."""
        stream = label(self._names[signals.stream])
        self._iteration = signals.iteration
        self._put(signals, "lanes/1_stream", stream, colour(signals.stream))
        learned = f"module {signals.module}"
        self._put(signals, "lanes/2_learning", learned, colour(signals.module - 1))
        self._put(signals, "lanes/3_gate", *_verdict(signals))
        action = (STAY, SKY) if signals.action == 0 else (SWITCH, VERMILLION)
        self._put(signals, "lanes/4_action", *action)
        drawn = ("explored", ORANGE) if signals.explored else ("greedy", BLUE)
        self._put(signals, "lanes/5_chosen_by", *drawn)
        for s, path in self._policies.items():
            planned = (SWITCH, GREY) if signals.policy[s] else (STAY, colour(s))
            self._put(signals, path, *planned)

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
                colors=np.array([packed(c) for c in chosen.values()], dtype=np.uint32),
            ),
            static=True,
        )

    def _put(self, signals: BlockSignals, path: str, state: str, rgb: Rgb) -> None:
        changes = self._changes.setdefault(path, [])
        self._colours.setdefault(path, {}).setdefault(state, rgb)
        if not changes or changes[-1][2] != state:
            changes.append((signals.t, signals.iteration, state))


def _verdict(signals: BlockSignals) -> tuple[str, Rgb]:
    if signals.novel:
        return "novel", GREEN
    if signals.known_by > 0:
        return f"known by {signals.known_by}", colour(signals.known_by - 1)
    return "constant", PURPLE
