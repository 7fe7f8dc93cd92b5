"""Errors whose message a user can act on, and the words that messages share.

The message is built where the fact is known and names the file or key and the
remedy. Only the command line turns these into exit codes.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence
from typing import TypeVar

Entry = TypeVar("Entry")


class CdmisfaError(Exception):
    """Something the user can mend; the message is one line that says how."""

    exit_code = 1


class UsageError(CdmisfaError):
    """A wrong option, configuration key or value, or a path that must not be used."""

    exit_code = 2


class LogDamagedError(CdmisfaError):
    """A log that is not what its format, its checksums or its own index say."""

    exit_code = 3


class LogWriteError(CdmisfaError):
    """A log could not be written: a full disk, a lost mount, missing rights."""


class LogExhaustedError(CdmisfaError):
    """A recording ended before the learner did, and looping was not asked for."""


class NotReproducedError(CdmisfaError):
    """A result differs from the one it was compared with."""

    exit_code = 4


def are_for(options: Sequence[str], what: str) -> str:
    """Return the text "--a and --b are for WHAT", for an error."""
    *before, last = options
    return f"{', '.join(before)} and {last} are for {what}" if before else f"{last} is for {what}"


def one_line(error: BaseException) -> str:
    """Return the message of a library's error, short and in one line."""
    return " ".join(str(error).split())[:200] or type(error).__name__


class Registry(dict[str, Entry]):
    """Entries by name; looking up an unknown name raises a `UsageError` with the nearest name.

    Args:
        kind: what an entry is, for the error: "expansion".
        entries: the entries by name, in the order in which they are listed.

    Example:
        >>> sizes = Registry("size", {"small": 1, "large": 100})
        >>> list(sizes), sizes["large"]
        (['small', 'large'], 100)
    """

    def __init__(self, kind: str, entries: Mapping[str, Entry]) -> None:
        super().__init__(entries)
        self._kind = kind

    def __missing__(self, name: str) -> Entry:
        """Raise the error about an unknown name."""
        raise UsageError(f"no {self._kind} {name!r}: {did_you_mean(name, self)}")


def did_you_mean(name: str, known: Iterable[str], prefix: str = "") -> str:
    """Return the end of an error about an unknown name: the nearest one, or all there are.

    Args:
        name: as it was written.
        known: the names there are.
        prefix: text before each of them.
    """
    names = list(known)
    nearest = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    if nearest:
        return f"did you mean {prefix}{nearest[0]}?"
    return f"there are {', '.join(names)}"
