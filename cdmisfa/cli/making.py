"""Options made of the fields of dataclasses, and --help with options in groups."""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import click

Command = TypeVar("Command", bound=Callable[..., Any])

GROUPS = ("Source", "Images", "Live streams", "Learner", "Output")
"""The headings of --help below the options that are used most."""


class Option(click.Option):
    """An option with the heading of --help that it stands below."""

    def __init__(self, *names: Any, group: str = "Output", **how: Any) -> None:
        super().__init__(*names, **how)
        self.group = group


class GroupedCommand(click.Command):
    """A command whose --help lists the options used most, and then the others by `GROUPS`.

    Args:
        common: names of the arguments whose options are used most.
        how: see `click.Command`.
    """

    def __init__(self, *args: Any, common: Sequence[str], **how: Any) -> None:
        super().__init__(*args, **how)
        self._common = common

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """See `click.Command`."""
        params = [param for param in self.get_params(ctx) if isinstance(param, click.Option)]
        common = [param for name in self._common for param in params if param.name == name]
        listed = {"Most used": common, **{group: [] for group in GROUPS}}
        for param in params:
            if param not in common:
                listed[getattr(param, "group", GROUPS[-1])].append(param)
        for heading, each in listed.items():
            if rows := [row for param in each if (row := param.get_help_record(ctx))]:
                with formatter.section(heading):
                    formatter.write_dl(rows)


def grouped(name: str, common: Sequence[str]) -> Callable[[Callable[..., Any]], click.Command]:
    """`click.command` with its options in groups.

    Args:
        name: of the command.
        common: names of the arguments whose options are used most.
    """
    return click.command(name, cls=GroupedCommand, common=common)


class WholeRange(click.IntRange):
    """A range of whole numbers."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """See `click.ParamType`."""
        try:
            int(value)
        except ValueError:
            self.fail(f"{value!r} is no whole number", param, ctx)
        return super().convert(value, param, ctx)


class FiniteRange(click.FloatRange):
    """A range of numbers, of which one that is none is not a part."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """See `click.ParamType`."""
        try:
            float(value)
        except ValueError:
            self.fail(f"{value!r} is no number", param, ctx)
        found = super().convert(value, param, ctx)
        if not math.isfinite(found):
            self.fail(f"{value} is no finite number", param, ctx)
        return found


def option(*names: str, **how: Any) -> Callable[[Command], Command]:
    """`click.option`, with a `group`: the heading of --help that it stands below."""
    return click.option(*names, cls=Option, **how)


def flag(name: str, about: str, **how: Any) -> Callable[[Command], Command]:
    """An option that is given or not."""
    return option(name, is_flag=True, help=about, **how)


def number(
    name: str, about: str, least: float, most: float | None = None, unit: str = "", **how: Any
) -> Callable[[Command], Command]:
    """An option that is a number; a whole one where the least that it may be is."""
    kind = FiniteRange if isinstance(least, float) else WholeRange
    shown = how.get("default") is not None
    told: dict[str, Any] = {"metavar": unit or None, "help": about, "show_default": shown, **how}
    return option(name, type=kind(least, most), **told)


def choice(
    name: str, about: str, values: Sequence[str], **how: Any
) -> Callable[[Command], Command]:
    """An option that is one of some words, by default the first."""
    kind = click.Choice(list(values))
    return option(name, type=kind, default=values[0], show_default=True, help=about, **how)


def word(name: str, unit: str, about: str, **how: Any) -> Callable[[Command], Command]:
    """An option that is a text."""
    return option(name, metavar=unit, help=about, **how)


def together(*each: Callable[[Command], Command]) -> Callable[[Command], Command]:
    """Several options as one, in the order in which --help lists them."""
    return lambda command: functools.reduce(lambda c, option: option(c), reversed(each), command)


class Written(click.ParamType[Any]):
    """A value that is written in a way of its own.

    Args:
        name: what it is, for messages.
        remedy: how it is written.
        pattern: of its text.
        read: what its parts come to; None where they are no such value.
    """

    def __init__(
        self, name: str, remedy: str, pattern: str, read: Callable[[Sequence[str | None]], Any]
    ) -> None:
        self.name, self._remedy, self._pattern, self._read = name, remedy, pattern, read

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """See `click.ParamType`."""
        if not isinstance(value, str):
            return value
        found = re.fullmatch(self._pattern, value, re.ASCII)
        result = None if found is None else self._read(found.groups())
        if result is None:
            self.fail(f"{value!r} is no {self.name}: write {self._remedy}", param, ctx)
        return result


def _size(parts: Sequence[str | None]) -> tuple[int, ...]:
    return tuple(int(part or 0) for part in reversed(parts))


def _seconds(parts: Sequence[str | None]) -> float:
    hours, minutes, seconds = (float(part or 0) for part in parts)
    return hours * 3600 + minutes * 60 + seconds


WRITTEN = {
    "WxH": Written("size", "WIDTHxHEIGHT, as 128x48", r"([1-9]\d{0,3})x([1-9]\d{0,3})", _size),
    "TIME": Written(
        "time",
        "seconds, or MINUTES:SECONDS, as 1:30",
        r"(?:(?:(\d{1,4}):)?(\d{1,4}):)?(\d{1,9}(?:\.\d{1,9})?)",
        _seconds,
    ),
}
"""How values of these units are read."""
