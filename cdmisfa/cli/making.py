"""Options made of the fields of dataclasses, and --help with options in groups."""

from __future__ import annotations

import dataclasses
import functools
import math
import re
import types
import typing
from collections.abc import Callable, Sequence
from typing import Any, Literal, TypeVar, cast

import click

from cdmisfa.core.options import RANGE, SIZE, TIME, option_name
from recorder.images.options import Color

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

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """See `click.Command`; what follows a `Switch` and is none of its words is an argument."""
        for param in self.params:
            if isinstance(kind := param.type, Switch):
                pairs = zip(args, [*args[1:], ""], strict=False)
                args = [
                    f"{word}=on" if word in param.opts and after not in kind.choices else word
                    for word, after in pairs
                ]
        return super().parse_args(ctx, args)

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


class Switch(click.Choice[str]):
    """On, off, or what else there is; an option of it that stands alone is on."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """See `click.ParamType`."""
        if isinstance(value, bool):
            return value
        found = super().convert(value, param, ctx)
        return {"on": True, "off": False}.get(found, found)


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


def _range(parts: Sequence[str | None]) -> tuple[float, float] | None:
    low, high = (float(part or 0) for part in parts)
    return (low, high) if low < high else None


_NUMBER = r"(-?\d{1,9}(?:\.\d{1,9})?)"

WRITTEN = {
    SIZE: Written("size", "WIDTHxHEIGHT, as 128x48", r"([1-9]\d{0,3})x([1-9]\d{0,3})", _size),
    TIME: Written(
        "time",
        "seconds, or MINUTES:SECONDS, as 1:30",
        r"(?:(?:(\d{1,4}):)?(\d{1,4}):)?(\d{1,9}(?:\.\d{1,9})?)",
        _seconds,
    ),
    RANGE: Written(
        "range",
        "NEAR:FAR in metres, as 0.3:5, or LOW:HIGH of numbers, as -3.2:3.2",
        f"{_NUMBER}:{_NUMBER}",
        _range,
    ),
}
"""How values of these units are read."""


def options_of(settings: type, argument: str, *names: str) -> Callable[[Command], Command]:
    """Options made of the fields of a dataclass; see `cdmisfa.core.options.setting`.

    Args:
        settings: the dataclass.
        argument: name of the command's argument that gets an object of it.
        names: of the fields; by default all.
    """
    fields = [
        field
        for field in dataclasses.fields(settings)
        if field.metadata and (not names or field.name in names)
    ]

    def wrapped(command: Command) -> Command:
        @functools.wraps(command)
        def with_settings(*args: Any, **values: Any) -> Any:
            chosen = {field.name: values.pop(field.name) for field in fields}
            return command(*args, **{argument: settings(**chosen)}, **values)

        made = together(*(option_of(settings, field) for field in fields))
        return made(cast(Command, with_settings))

    return wrapped


def option_of(
    settings: type, field: dataclasses.Field[Any], **how: Any
) -> Callable[[Command], Command]:
    """The option of one field of a dataclass.

    Args:
        settings: the dataclass.
        field: of it, with the metadata of `setting`.
        how: more for `option`.
    """
    told = field.metadata
    kind = typing.get_type_hints(settings)[field.name]
    if types.NoneType in typing.get_args(kind):
        kind = next(each for each in typing.get_args(kind) if each is not types.NoneType)
    of: dict[str, Any] = {"type": kind, "show_default": field.default is not None}
    if told["unit"] in WRITTEN:
        of = {"type": WRITTEN[told["unit"]]}
    elif typing.get_origin(kind) is Literal:
        of["type"] = click.Choice(typing.get_args(kind))
    elif kind is bool:
        of = {"is_flag": True}
    elif kind == Color:
        of = {"type": Switch(["on", "off", "auto"]), "is_flag": False, "flag_value": "on"}
    elif typing.get_origin(kind) is tuple:
        of = {"multiple": True}
    elif kind in (int, float):
        ranges = {int: WholeRange, float: FiniteRange}
        of["type"] = ranges[kind](told["least"], told["most"])
    of |= {"default": field.default, "help": told["about"], "metavar": told["unit"] or None}
    return option(option_name(field), field.name, group=told["group"], **(of | how))
