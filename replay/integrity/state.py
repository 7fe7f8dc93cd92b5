"""The state of a log: one word and one exit code for it, whichever command says it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final, Literal

from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError
from recorder.mcap.reader import LogReader
from replay.inputs import locations

State = Literal["whole", "unchecked", "not read", "cut short", "damaged"]
"""Unchecked: nothing is wrong as far as was looked. Not read: no log, or not one that is read."""
Crc = Literal["ok", "absent", "bad", "unchecked"]

EXIT_CODES: Final[Mapping[State, int]] = {
    "whole": 0,
    "unchecked": 0,
    "not read": UsageError.exit_code,
    "cut short": LogDamagedError.exit_code,
    "damaged": LogDamagedError.exit_code,
}
"""Of the commands that say in which state a log is, the best state first."""


def state_of(reader: LogReader) -> State:
    """The state of a log, as far as it was read with `salvage`."""
    if reader.problems:
        return "damaged"
    return "cut short" if reader.missing else "whole"


def failed_state(error: CdmisfaError) -> tuple[Crc, State]:
    """The checksums and the state of a log, one of several, that ended in an error."""
    damaged = isinstance(error, LogDamagedError)
    return ("bad", "damaged") if damaged else ("unchecked", "not read")


def located(
    words: Sequence[str | Path],
) -> tuple[list[Path], list[tuple[str, CdmisfaError]]]:
    """The places that words name, and each word of several that names none, with why.

    Raises:
        UsageError: there is one word, and it names none.
    """
    places: list[Path] = []
    refused: list[tuple[str, CdmisfaError]] = []
    for word in words:
        try:
            places += locations([word])
        except CdmisfaError as error:
            if len(words) == 1:
                raise
            refused.append((str(word), error))
    return places, refused


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
