"""Numbers in the fields of a message: a path names them, and they are read as a vector."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np

from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.errors import UsageError
from recorder.images.options import Depth
from recorder.images.pixels import MalformedImage, lost

# Largest number of values from a message, more than any laser scan has.
MAX_NUMBERS: Final = 100_000

# Largest value up to which float64 represents every whole number.
EXACT: Final = 2.0**53

# Warning about larger numbers.
ROUNDED: Final = "numbers above 2^53 may be rounded to float64"

_STEP: Final = re.compile(r"\.?([^.\[\]]+)|\[(\d{1,9})\]|\[(\d{0,9}):(\d{0,9})\]")
_PATH: Final = re.compile(rf"[^.\[\]]+(?:\.[^.\[\]]+|{_STEP.pattern.partition('|')[2]})*")

_Step = str | int | slice


def is_path(text: str) -> bool:
    """Return whether a text can be a path to numbers in a message."""
    return _PATH.fullmatch(text) is not None


# Field that means every number of a message.
EVERY: Final = ("*",)

# Members of messages that are times, and not read as numbers unless they are named.
_TIMES: Final = ("header", "time", "timestamp", "stamp")


def number_paths(message: Any, above: str = "") -> Iterator[str]:
    """Yield the paths to all numbers in a message except its time."""
    for name in members(message):
        member = field_value(message, name)
        while _is_list(member) and len(member):
            member = member[0]
        if members(member) and name not in _TIMES:
            yield from number_paths(member, f"{above}{name}.")
        elif isinstance(member, bool | int | float | np.generic) and name not in _TIMES:
            yield above + name


class Field:
    """A path to numbers in a message: `position`, `pose.position.x`, `ranges[0:100]`, `p[2].x`.

    A name after a list, or after a part of one, is looked up in each of its members.

    Args:
        path: the path as the user wrote it.
        plain: True if the path is one name, whatever its characters.

    Raises:
        UsageError: the text is not a path.
    """

    def __init__(self, path: str, *, plain: bool = False) -> None:
        if not plain and not is_path(path):
            raise UsageError(
                f"--field {path} is not a field: write names with dots, an index or a part of "
                "it, as pose.position.x or ranges[0:100]"
            )
        self.path = path
        self._steps: list[_Step] = [path] if plain else list(map(_step, _STEP.finditer(path)))
        self.first = str(self._steps[0])

    def numbers(self, message: Any) -> list[float]:
        """Return the numbers at the path in a message; NaN for null.

        Raises:
            UsageError: the message has no such field, or it is not a number.
            MalformedImage: a number or the nesting is too large.
        """
        numbers: list[float] = []
        try:
            _collect(_value(message, self._steps), numbers)
        except LookupError as error:
            raise UsageError(f"--field {self.path}: {error.args[0]}") from None
        except (OverflowError, RecursionError):
            raise MalformedImage(f"--field {self.path} is too large or nested too deep") from None
        return numbers


def _step(match: re.Match[str]) -> _Step:
    name, index, start, stop = match.groups()
    if name is not None:
        return str(name)
    return int(index) if index is not None else slice(int(start or 0), int(stop) if stop else None)


def _value(value: Any, steps: Sequence[_Step]) -> Any:
    """Follow steps into a message; raise a LookupError with a message for the user."""
    for place, step in enumerate(steps):
        if value is None and not isinstance(step, slice):
            return None
        if isinstance(step, str):
            if _is_list(value):
                return [_value(member, steps[place:]) for member in value]
            names = members(value)
            if step not in names:
                raise LookupError(f"there is no {step}: it has {', '.join(names) or 'no fields'}")
            value = field_value(value, step)
        elif not _is_list(value):
            raise LookupError("it is not a list: leave out the index")
        else:
            last = (step.stop or step.start + 1) if isinstance(step, slice) else step + 1
            if last > len(value):
                raise LookupError(f"the list has {len(value)} members: take all of them with [0:]")
            value = value[step]
    return value


def _collect(value: Any, numbers: list[float]) -> None:
    """Append all numbers of a value; raise a LookupError with a message for the user."""
    if value is None:
        numbers.append(np.nan)
    elif isinstance(value, bool | int | float | np.generic):
        numbers.append(float(value))
    elif isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        numbers += value.astype(np.float64).reshape(-1).tolist()
    elif _is_list(value):
        for member in value:
            _collect(member, numbers)
    else:
        kind = "a text" if isinstance(value, str) else type(value).__name__
        names = f": name one of {', '.join(members(value))}" if members(value) else ""
        raise LookupError(f"it is not a number but {kind}{names}")


def numbers_of(fields: Iterable[Field], message: Any, bounds: Depth | None) -> FloatArray:
    """Return the numbers of all fields of a message in order, (I,) float64.

    Args:
        fields: paths to the numbers.
        message: the decoded message.
        bounds: range to limit numbers to; values that are not finite become its lower bound.

    Raises:
        UsageError: a field is missing or not a number, or is not finite without bounds.
        MalformedImage: a field is too large.
    """
    numbers: list[float] = []
    for field in fields:
        part = field.numbers(message)
        if bounds is None and not np.isfinite(part).all():
            place = int(np.flatnonzero(~np.isfinite(part))[0])
            value = "NaN or null" if np.isnan(part[place]) else part[place]
            raise UsageError(
                f"--field {field.path} holds {value} at index {place}, which is not finite: leave "
                "it out, or limit numbers to a range such as --set input.range=0.1,10"
            )
        numbers += part
    if not 0 < len(numbers) <= MAX_NUMBERS:
        raise UsageError(f"its fields hold {len(numbers)} numbers: choose from 1 to {MAX_NUMBERS}")
    return bounded(np.array(numbers, np.float64), bounds)


def bounded(numbers: FloatArray, bounds: Depth | None) -> FloatArray:
    """Limit numbers to bounds; values that are not finite become the lower bound."""
    if bounds is None:
        return numbers
    lost(f"numbers that are not finite become {bounds[0]:g}", not np.isfinite(numbers).all())
    return np.clip(np.where(np.isfinite(numbers), numbers, bounds[0]), *bounds)


def column_names(field: str, count: int) -> list[str]:
    """Return a name for each number of a field: `x`, or `position[0]` and following."""
    whole = re.fullmatch(r"(.*)\[(\d*):\d*\]", field)
    name, start = (whole[1], int(whole[2] or 0)) if whole else (field, 0)
    return [field] if count == 1 and not whole else [f"{name}[{start + i}]" for i in range(count)]


def members(value: Any) -> list[str]:
    """Return the names of a decoded message's fields, whatever library decoded it; else []."""
    if isinstance(value, Mapping):
        return [str(name) for name in value]
    descriptor = getattr(value, "DESCRIPTOR", None)
    if descriptor is not None:
        return [field.name for field in descriptor.fields]
    return [n for n in getattr(value, "__dataclass_fields__", ()) if not n.startswith("__")]


def field_value(value: Any, name: str) -> Any:
    """Return the value of a field of a message, one of its `members`."""
    return value[name] if isinstance(value, Mapping) else getattr(value, name)


def joints_of(message: Any) -> list[str]:
    """Return the names of the joints in a JointState message."""
    names = field_value(message, "name") if "name" in members(message) else ()
    return list(map(str, names))


def with_joints(where: object, joints: Sequence[str], message: Any) -> Any:
    """Return a JointState message with its values in the order of `joints`; as `joint_places`."""
    if (stated := joints_of(message)) == joints:
        return message
    places = joint_places(where, joints, stated)
    values = {name: field_value(message, name) for name in members(message)}
    for name, value in values.items():
        if _is_list(value) and len(value) == len(places):
            values[name] = [value[place] for place in places]
    return values


def joint_places(where: object, joints: Sequence[str], stated: Sequence[str]) -> list[int]:
    """Return the place of each joint in a list; a UsageError if the list has other joints."""
    if sorted(joints) != sorted(stated):
        raise UsageError(
            f"{where} has the joints {', '.join(stated) or 'without names'} after messages with "
            f"{', '.join(joints)}: write the joints of each publisher to a topic or log of its own"
        )
    return [stated.index(joint) for joint in joints]


def _is_list(value: Any) -> bool:
    if isinstance(value, str | bytes | Mapping | np.generic):
        return False
    return isinstance(value, np.ndarray) or hasattr(value, "__getitem__")
