"""Entries of one kind by their names, and the hint of an error about an unknown name."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from typing import TypeVar

from cdmisfa.core.errors import UsageError

Entry = TypeVar("Entry")


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
    """The end of an error about an unknown name: the nearest one, or all there are.

    Args:
        name: as it was written.
        known: the names there are.
        prefix: what stands before each of them.
    """
    names = list(known)
    nearest = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    if nearest:
        return f"did you mean {prefix}{nearest[0]}?"
    return f"there are {', '.join(names)}"
