"""The state of a log: one word and one exit code for it, whichever command says it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Final, Literal

from cdmisfa.core.errors import LogDamagedError
from recorder.mcap.reader import LogReader

State = Literal["whole", "cut short", "damaged"]
Crc = Literal["ok", "absent", "bad", "unchecked"]

EXIT_CODES: Final[Mapping[State, int]] = {
    "whole": 0,
    "cut short": LogDamagedError.exit_code,
    "damaged": LogDamagedError.exit_code,
}
"""Of the commands that say in which state a log is, the best state first."""


def state_of(reader: LogReader) -> State:
    """The state of a log, as far as it was read with `salvage`."""
    if reader.problems:
        return "damaged"
    return "cut short" if reader.missing else "whole"


def crc_of(reader: LogReader) -> Crc:
    """What the checksums of a log that was decoded amount to: "ok" only where it is whole."""
    state = state_of(reader)
    if state == "damaged":
        return "bad"
    if reader.crc_absent():
        return "absent"
    return "ok" if state == "whole" else "unchecked"


def worst(states: Iterable[State]) -> State:
    """The worst of some logs' states, "whole" of none."""
    order = list(EXIT_CODES)
    return max(states, key=order.index, default="whole")
