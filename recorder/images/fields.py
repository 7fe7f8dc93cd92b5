"""Numbers in a message: named by a path, and read as a vector."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

import numpy as np

from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.errors import UsageError
from recorder.images.options import Depth
from recorder.images.pixels import MalformedImage

MOST: Final = 100_000
"""Most numbers that a message may give."""

EXACT: Final = 2.0**53
"""Up to here float64 holds every whole number."""

_STEP: Final = re.compile(r"\.?([^.\[\]]+)|\[(\d{1,9})\]|\[(\d{0,9}):(\d{0,9})\]")
_PATH: Final = re.compile(rf"[^.\[\]]+(?:\.[^.\[\]]+|{_STEP.pattern.partition('|')[2]})*")

_Step = str | int | slice


def is_path(text: str) -> bool:
    """Whether a text can be a path to numbers in a message."""
    return _PATH.fullmatch(text) is not None


class Field:
    """Where numbers stand in a message: `position`, `pose.position.x`, `ranges[0:100]`, `p[2].x`.

    What follows a list or a part of one is taken of each of its members.

    Args:
        path: as the user wrote it.
        plain: it is a name, whatever that is made of.

    Raises:
        UsageError: it is no such path.
    """

    def __init__(self, path: str, *, plain: bool = False) -> None:
        if not path:
            raise UsageError("--field is empty: name a field of the messages")
        if not plain and not is_path(path):
            raise UsageError(
                f"--field {path} is no field: write names with dots, an index or a part of "
                "it, as pose.position.x or ranges[0:100]"
            )
        self.path = path
        self._steps: list[_Step] = [path] if plain else list(map(_step, _STEP.finditer(path)))
        self.first = str(self._steps[0])

    def numbers(self, message: Any) -> list[float]:
        """The numbers at the path in a message; NaN where it is null.

        Raises:
            UsageError: there is no such field, or what is there is no number.
        """
        found: list[float] = []
        _collect(self._value(message, self._steps), self.path, found)
        return found

    def _value(self, value: Any, steps: Sequence[_Step]) -> Any:
        for place, step in enumerate(steps):
            if value is None and not isinstance(step, slice):
                return None
            if isinstance(step, str) and _is_list(value):
                return [self._value(member, steps[place:]) for member in value]
            value = self._member(value, step)
        return value

    def _member(self, value: Any, step: _Step) -> Any:
        if isinstance(step, str):
            names = members(value)
            if step not in names:
                there = "it is no message"
                if names or isinstance(value, Mapping):
                    there = f"it has {', '.join(names) or 'no fields at all'}"
                raise UsageError(f"--field {self.path}: there is no {step}, {there}")
            return field_value(value, step)
        if not _is_list(value):
            raise UsageError(f"--field {self.path}: what the index is of is no list")
        last = (step.stop or step.start + 1) if isinstance(step, slice) else step + 1
        if last > len(value):
            remedy = ", all of them are [0:]" if isinstance(step, slice) else ""
            raise UsageError(f"--field {self.path}: there are {len(value)} members only{remedy}")
        return value[step]


def _step(found: re.Match[str]) -> _Step:
    name, index, start, stop = found.groups()
    if name is not None:
        return str(name)
    return int(index) if index is not None else slice(int(start or 0), int(stop) if stop else None)


def numbers_of(fields: Iterable[Field], message: Any, bounds: Depth | None) -> FloatArray:
    """The numbers of all fields of a message, one after the other, (I,) float64.

    Args:
        fields: where they stand.
        message: decoded.
        bounds: what they are kept in; what is no finite number becomes the first of them.

    Raises:
        UsageError: a field is not there, or is no number, or one that is not finite, and there
            are no bounds.
        MalformedImage: a field is of no size that is read.
    """
    found: list[float] = []
    for field in fields:
        try:
            own = field.numbers(message)
        except (OverflowError, RecursionError):
            raise MalformedImage(f"--field {field.path} is of no size that is read") from None
        if bounds is None and not np.isfinite(own).all():
            place = int(np.flatnonzero(~np.isfinite(own))[0])
            held = "NaN or null" if np.isnan(own[place]) else own[place]
            raise UsageError(
                f"--field {field.path} holds {held} at place {place}, which is no finite "
                "number: leave it out, or keep numbers in a range, as --set input.range=0.1,10"
            )
        found += own
    if not 0 < len(found) <= MOST:
        raise UsageError(f"its fields hold {len(found)} numbers: choose from 1 to {MOST}")
    return bounded(np.array(found, np.float64), bounds)


def bounded(numbers: FloatArray, bounds: Depth | None) -> FloatArray:
    """Numbers within bounds; those that are not finite become the first of them."""
    if bounds is None:
        return numbers
    return np.clip(np.where(np.isfinite(numbers), numbers, bounds[0]), *bounds)


def rounded(fields: Sequence[str], numbers: FloatArray) -> str:
    """A warning where float64 may round whole numbers, (I,); "" of others.

    Args:
        fields: what their fields are called.
        numbers: of a message, finite.
    """
    if not len(numbers) or np.abs(numbers).max() <= EXACT:
        return ""
    place = int(np.argmax(np.abs(numbers) > EXACT))
    name = fields[place] if len(fields) == len(numbers) else ", ".join(fields) or "a message"
    return f"{name} holds {numbers[place]:.17g}: whole numbers beyond 2^53 are rounded to float64"


def members(value: Any) -> list[str]:
    """The names of a message's fields, whatever library decoded it; none of other values."""
    if isinstance(value, Mapping):
        return [str(name) for name in value]
    descriptor = getattr(value, "DESCRIPTOR", None)
    if descriptor is not None:
        return [field.name for field in descriptor.fields]
    return [n for n in getattr(value, "__dataclass_fields__", ()) if not n.startswith("__")]


def field_value(value: Any, name: str) -> Any:
    """The value of a field of a message, one of its `members`."""
    return value[name] if isinstance(value, Mapping) else getattr(value, name)


def _is_list(value: Any) -> bool:
    if isinstance(value, str | bytes | Mapping):
        return False
    return isinstance(value, np.ndarray) or hasattr(value, "__getitem__")


def _collect(value: Any, path: str, found: list[float]) -> None:
    if value is None:
        found.append(np.nan)
    elif isinstance(value, bool | int | float | np.generic):
        found.append(float(value))
    elif isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        found += value.astype(np.float64).reshape(-1).tolist()
    elif _is_list(value):
        for member in value:
            _collect(member, path, found)
    else:
        names = members(value)
        name = f"one of its fields: {', '.join(names)}" if names else "another"
        kind = "a text" if isinstance(value, str) else type(value).__name__
        raise UsageError(f"--field {path} is no number but {kind}: name {name}")
