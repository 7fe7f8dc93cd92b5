"""Settings that are options of commands, too: fields of dataclasses, each stated once.

The command line makes its options of them; see `cdmisfa.cli.making.options_of`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping
from numbers import Real
from typing import Any, Final

from cdmisfa.core.config import shown
from cdmisfa.core.errors import UsageError

SIZE, TIME, RANGE = "WxH", "TIME", "LOW:HIGH"
"""Units that are written in a way of their own: (height, width), seconds, two numbers, seconds."""

_WRITTEN: Final[Mapping[str, Callable[[Any], str]]] = {
    SIZE: lambda size: f"{size[1]}x{size[0]}",
    RANGE: lambda ends: f"{ends[0]:g}:{ends[1]:g}",
}


def setting(
    default: Any,
    about: str,
    *,
    unit: str = "",
    name: str = "",
    least: float | None = None,
    most: float | None = None,
    group: str = "Source",
) -> Any:
    """A field of a dataclass that is also an option; its type says what the option takes.

    Args:
        default: of both.
        about: one sentence, for --help.
        unit: what the option's value is written in, as "HZ".
        name: of the option, where it is not the field's.
        least: of a number.
        most: of a number.
        group: the heading of --help that it stands below.
    """
    told = {"about": about, "unit": unit, "name": name, "least": least, "most": most}
    return dataclasses.field(default=default, metadata={**told, "group": group})


def option_name(field: dataclasses.Field[Any]) -> str:
    """How a setting is called on the command line."""
    return f"--{(field.metadata['name'] or field.name).replace('_', '-')}"


def given(settings: Any) -> list[dataclasses.Field[Any]]:
    """The settings of a dataclass that are not the defaults."""
    each = (field for field in dataclasses.fields(settings) if field.metadata)
    return [field for field in each if getattr(settings, field.name) != field.default]


def option_words(settings: Any) -> list[str]:
    """The words of a command line that give these settings; of defaults, none."""
    words = []
    for field in given(settings):
        value = getattr(settings, field.name)
        for each in value if field.metadata["unit"] and field.default == () else [value]:
            words.append(option_name(field))
            if isinstance(each, float):
                words.append(f"{each:g}")
            elif not isinstance(each, bool):
                words.append(_WRITTEN.get(field.metadata["unit"], str)(each))
    return words


def check_settings(settings: Any) -> None:
    """Refuse numbers that their settings do not take: a log's or a caller's, not typed by hand.

    Raises:
        UsageError: it names the option.
    """
    for field in given(settings):
        value, told = getattr(settings, field.name), field.metadata
        if told["unit"] == SIZE and not _all_numbers(value, 2, 1):
            raise UsageError(f"{option_name(field)} is {value}: give height and width above 0")
        if told["unit"] == TIME and not _all_numbers([value], 1, 0):
            raise UsageError(f"{option_name(field)} is {value}: give seconds from 0 on")
        least, most = told["least"], told["most"]
        if least is not None and not _all_numbers([value], 1, least, most):
            raise UsageError(
                f"{option_name(field)} is {value}: it must be in [{least:g}, {most:.0f}]"
            )


def _all_numbers(values: Any, count: int, least: float, most: float = math.inf) -> bool:
    """Whether these are so many finite numbers within bounds."""
    return (
        isinstance(values, list | tuple)
        and len(values) == count
        and all(isinstance(value, Real) for value in values)
        and all(math.isfinite(value) and least <= value <= most for value in values)
    )


def parse_settings(words: Iterable[str]) -> dict[str, dict[str, str]]:
    """Turn `section.key=value` words into sections of texts.

    Raises:
        UsageError: a word of another form.
    """
    sections: dict[str, dict[str, str]] = {}
    for word in words:
        key, equals, value = word.partition("=")
        section, dot, name = key.strip().partition(".")
        if not (equals and section and dot and name):
            raise UsageError(
                f"--set {shown(word)}: write it as section.key=value, as learner.nu=0.02"
            )
        sections.setdefault(section, {})[name] = value.strip()
    return sections
