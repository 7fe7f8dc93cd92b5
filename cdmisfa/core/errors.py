"""Errors whose message a user can act on.

The message is built where the fact is known and names the file or key and the
remedy. Only the command line turns these into exit codes.
"""

from __future__ import annotations

from collections.abc import Sequence


class CdmisfaError(Exception):
    """Something the user can mend; the message is one line that says how."""

    exit_code = 1


class UsageError(CdmisfaError):
    """A wrong option, configuration key or value, or a path that must not be used."""

    exit_code = 2


class TooSmallError(UsageError):
    """An image is smaller than a frame; commands that have --size name it, too."""


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
    """The text "--a and --b are for WHAT", for an error."""
    *others, last = options
    return f"{', '.join(others)} and {last} are for {what}" if others else f"{last} is for {what}"


def one_line(error: BaseException) -> str:
    """What an error of others says, short and in one line."""
    return " ".join(str(error).split())[:200] or type(error).__name__
