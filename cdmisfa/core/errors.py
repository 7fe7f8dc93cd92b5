"""Errors whose message tells a user what to do, and texts that several messages share.

The code that detects a problem writes the message: what is wrong, in which file or key, and what
to do. Only the command line turns an error into an exit code.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

Entry = TypeVar("Entry")


class CdmisfaError(Exception):
    """Base of all errors that a user can correct; the message is one line."""

    exit_code = 1


class UsageError(CdmisfaError):
    """Wrong option, configuration key or value, or a path that must not be used."""

    exit_code = 2


class MissingPackageError(UsageError):
    """Package that reads a log is not installed; the log may be whole."""


class LogDamagedError(CdmisfaError):
    """Log that contradicts its format, its checksums or its own index."""

    exit_code = 3


class LogWriteError(CdmisfaError):
    """Log that could not be written, for example because the disk is full."""


class LogExhaustedError(CdmisfaError):
    """End of a recording before the learner finished, without looping."""


class NotReproducedError(CdmisfaError):
    """Difference between a result and the result that it must equal."""

    exit_code = 4


@contextmanager
def needs(user: object, package: str, remedy: str = "") -> Iterator[None]:
    """Turn a failed import into the error that `user`, such as a path, needs a package.

    Args:
        user: beginning of the error, as PATH: not read.
        package: the package, or several.
        remedy: what pip installs, if it has another name.

    Raises:
        MissingPackageError: the import failed.
    """
    try:
        yield
    except ImportError:
        raise MissingPackageError(
            f"{user}: needs the package {package} (pip install {remedy or package})"
        ) from None


def missing_base(package: str, remedy: str) -> Any:
    """Return a base of classes that need a missing package: creating an object raises `needs`."""

    def refuse(cls: type, *_: object, **__: object) -> None:
        with needs(cls.__name__, package, remedy):
            raise ImportError

    return type("Missing", (), {"__new__": refuse})


def are_for(options: Sequence[str], purpose: str) -> str:
    """Return the text "--a and --b are for PURPOSE", for an error."""
    *first, last = options
    verb = f"{', '.join(first)} and {last} are" if first else f"{last} is"
    return f"{verb} for {purpose}"


def one_line(error: BaseException) -> str:
    """Return the message of a library's error in one line of at most 200 characters."""
    return " ".join(str(error).split())[:200] or type(error).__name__


class Registry(dict[str, Entry]):
    """Dictionary in which an unknown name raises a `UsageError` with the nearest name.

    Args:
        kind: kind of the entries in the error, such as "expansion".
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
        """Raise the error for an unknown name."""
        raise UsageError(f"no {self._kind} {name!r}: {did_you_mean(name, self)}")


def did_you_mean(name: str, known: Iterable[str], prefix: str = "") -> str:
    """Return the end of an error for an unknown name: the nearest name, or all names.

    Args:
        name: the name that was given.
        known: the names that exist.
        prefix: text before each name.
    """
    names = list(known)
    nearest = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    if nearest:
        return f"did you mean {prefix}{nearest[0]}?"
    return f"choose from {', '.join(names)}"
