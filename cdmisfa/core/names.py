"""Names of streams and columns made from those in a log; counts and durations in words."""

from __future__ import annotations

import itertools
import re
import unicodedata
from collections.abc import Iterable
from datetime import timedelta

_OF_VIEWS = re.compile(r"(/view/|observation\.images\.)+(?=.)")
_LONGEST = 64

# How a column of truth is called that is the action for a frame, that is 1 where an episode of a
# task begins, or that is a joint of the robot.
ACTION, BEGINS, JOINT = "action_", "begins_", "head_"


def counted(number: int, what: str, form: str = "") -> str:
    """Return how many there are, as 1 block or 2 blocks; the number in such a format, as ','."""
    return f"{number:{form}} {what}{'' if number == 1 else 's'}"


def lasting(seconds: float | None) -> str:
    """Return a length of time, as 1:02:03; a line where it is not known."""
    return "-" if seconds is None else str(timedelta(seconds=round(seconds)))


def stream_name(said: str) -> str:
    """Return the name of a stream, valid as one of a file, from what a log or a camera calls it.

    The topic /cam/left is cam_left. A view has its own name also where it is a topic (/view/left)
    or a column of a dataset (observation.images.left). Letters lose their accents, those of other
    scripts stay.
    """
    letters = unicodedata.normalize("NFKD", _OF_VIEWS.sub("", said))
    bare = "".join(c for c in letters if not unicodedata.combining(c))
    return re.sub(r"[^\w.-]+", "_", bare).strip("._-")[:_LONGEST].rstrip("._-") or "stream"


def stream_names(said: Iterable[str]) -> tuple[str, ...]:
    """`stream_name` of each stream, distinct: a number behind those like an earlier one, as cam-2.

    One with which an earlier one begins, as cam after cam-left, counts as like it.
    """
    found: list[str] = []
    for name in map(stream_name, said):
        like = sum(other == name or other.startswith(f"{name}-") for other in found)
        numbered = (f"{name}-{number}" for number in itertools.count(like + 1))
        found.append(next(n for n in numbered if n not in found) if like else name)
    return tuple(found)
