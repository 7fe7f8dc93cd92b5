"""Names that a user wrote, against those there are."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


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
