"""Options and types of values that several commands share."""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from cdmisfa.cli.help import Command
from cdmisfa.cli.printing import Stderr

Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]

# Makes a command of a function whose docstring is the help page.
command = functools.partial(click.command, cls=Command)

# Paths


class LocalPath(click.Path):
    """A path on this machine; else a URL would become a folder `s3:`, and "" the current one."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """See `click.ParamType`."""
        if not str(value):
            self.fail("the path is empty: name a file or folder", param, ctx)
        if "://" in str(value):
            self.fail(f"{value} is a URL: name a path on this machine", param, ctx)
        return super().convert(value, param, ctx)


# Type of paths that are written, and of those that are read but cannot be URLs.
LOCAL = LocalPath(path_type=Path)

# Type of paths, URLs and other words that name a source. As a click.Path, a shell completes it.
WORD = click.Path(readable=False)


def output(help: str, *, required: bool = False) -> Decorator:
    """Return the option `-o` for the result of a command."""
    return click.option("-o", "--output", type=LOCAL, required=required, help=help)


def log_argument(name: str, metavar: str | None = None) -> Decorator:
    """Return an argument of one or more paths, URLs or patterns, passed as existing paths."""

    def located(
        ctx: click.Context, param: click.Parameter, words: tuple[str, ...]
    ) -> tuple[Path, ...]:
        if ctx.resilient_parsing:  # a shell completes the line: the files may not exist yet
            return ()
        from replay.open_sources import locations

        return tuple(locations(words))

    about: Any = {"nargs": -1, "required": True, "metavar": metavar}
    return click.argument(name, callback=located, type=WORD, **about)


# How external logs and live streams become streams of frames


def parse_size(text: str) -> tuple[int, int]:
    """Parse WIDTHxHEIGHT as (height, width)."""
    match = re.fullmatch(r"([1-9]\d{0,3})x([1-9]\d{0,3})", text, re.ASCII)
    if match is None:
        raise click.BadParameter(f"{text!r} is no size: write WIDTHxHEIGHT, such as 128x48")
    return int(match[2]), int(match[1])


def parse_seconds(text: str) -> float:
    """Parse [[HOURS:]MINUTES:]SECONDS as seconds."""
    pattern = r"(?:(?:(\d{1,4}):)?(\d{1,4}):)?(\d{1,9}(?:\.\d{1,9})?)"
    match = re.fullmatch(pattern, text, re.ASCII)
    if match is None:
        raise click.BadParameter(
            f"{text!r} is no time: write seconds or MINUTES:SECONDS, such as 1:30"
        )
    hours, minutes, seconds = (float(part or 0) for part in match.groups())
    return hours * 3600 + minutes * 60 + seconds


class Number(click.ParamType[Any]):
    """A number within limits, which only errors print.

    Args:
        low: smallest value.
        high: largest value.
        kind: type of the number.
    """

    name = "n"

    def __init__(self, low: float, high: float = math.inf, kind: type = int) -> None:
        self.low, self.high, self.kind = low, high, kind

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """See `click.ParamType`."""
        try:
            number = self.kind(value)
        except ValueError:
            number = math.nan
        if not self.low <= number <= self.high:
            least = f"of at least {self.low:g}"
            limits = least if self.high == math.inf else f"from {self.low:g} to {self.high}"
            kind = "whole number" if self.kind is int else "number"
            self.fail(f"{value} is wrong: give a {kind} {limits}", param, ctx)
        return number


COUNT = Number(1)
SEED = Number(0, 2**63 - 1)
PROCESSES = Number(1, 1024)


def option(spec: str, help: str = "", *, name: str | None = None, **about: Any) -> Decorator:
    """Return an option of a command.

    Args:
        spec: its name and the word for its value, as "--frames N"; without a word and without
            a `type` it is a flag.
        help: its help text; by default that below "Options:" in the docstring of the command.
        name: name of the parameter, if it is not that of the option.
        about: see `click.option`; the type of a value N is by default a whole number from 1.
    """
    flag, _, value = spec.partition(" ")
    if value:
        about |= {"metavar": value, "type": about.get("type", COUNT if value == "N" else None)}
    elif "type" not in about:
        about["is_flag"] = True
    return click.option(flag, *filter(None, (name,)), help=help, **about)


# Options by the names of `InputOptions`; `settings` are the keys `input.*` of commands that have
# no other keys.
INPUTS: dict[str, Decorator] = {
    "topics": option(
        "--topic TOPIC",
        "Read this topic of a log, or all with images that match a pattern such as '/cam*'; each "
        "becomes a stream, without images one of numbers. Repeatable. [default: the only one with "
        "images]",
        name="topics",
        multiple=True,
    ),
    "fields": option(
        "--field FIELD",
        "Read these numbers: a field of the messages, such as pose.position.x or ranges[0:100], or "
        "a column of a table. Repeatable; several form one vector. [default: images; all numbers "
        "of a table, or of a --topic without images]",
        name="fields",
        multiple=True,
    ),
    "size": option(
        "--size WxH",
        "Shrink images to frames of this width and height in pixels. [default: same aspect ratio, "
        "at most as many pixels as 128x48]",
        type=parse_size,
    ),
    "rate": option(
        "--rate HZ",
        "Frames per second. [default: rate of the first stream]",
        type=Number(1e-3, 1_000_000, float),
    ),
    "start": option(
        "--start TIME",
        "Skip the part of a log before this time, in seconds or as MINUTES:SECONDS.",
        type=parse_seconds,
        default="0",
        show_default=True,
    ),
    "end": option(
        "--end TIME",
        "Skip the part of a log from this time on, in seconds or as MINUTES:SECONDS. [default: end "
        "of the log]",
        type=parse_seconds,
    ),
    "align": option(
        "--align",
        "Combine streams of different rates: by message number (index), or by the newest message "
        "at each time (time). [default: stop with an error]",
        type=click.Choice(["index", "time"]),
    ),
    "color": click.option(
        "--color",
        type=click.Choice(["on", "off", "auto"]),
        is_flag=False,
        flag_value="on",
        default="off",
        show_default=True,
        help="Put red, green and blue side by side in frames of three times the width. auto does "
        "so if the hue varies in the first 2,000 frames, independently of brightness.",
    ),
    "settings": option(
        "--set KEY=VALUE",
        "Set a key input.* of docs/reference/configuration.md, such as input.fit=pad. Repeatable.",
        name="input_settings",
        multiple=True,
    ),
}

ALL_INPUTS = ("topics", "fields", "size", "rate", "start", "end", "align", "color")


def inputs(*names: str) -> Decorator:
    """Return some options of `INPUTS`; the command gets them as one `InputOptions`, `inputs`."""

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(command)
        def call(*args: Any, input_settings: tuple[str, ...] = (), **values: Any) -> Any:
            from cdmisfa.core.config import parse_settings
            from recorder.images.options import InputOptions

            chosen = {name: values.pop(name) for name in names if name != "settings"}
            if "color" in chosen:  # a run stores it as a truth value
                chosen["color"] = {"on": True, "off": False}.get(chosen["color"], chosen["color"])
            sections = parse_settings(input_settings)
            if other := set(sections) - {"input"}:
                raise click.UsageError(f"--set takes keys input.* here, not {min(other)}.*")
            options = InputOptions(**chosen).configured(sections.get("input", {}))
            return command(*args, inputs=options, **values)

        decorated: Callable[..., Any] = call
        for name in reversed(names):
            decorated = INPUTS[name](decorated)
        return decorated

    return decorate


# Options of several commands


def settings(
    help: str = "Set a key of docs/reference/configuration.md, such as learner.tau=20. Repeatable.",
) -> Decorator:
    """Return the option `--set`."""
    return click.option("--set", "settings", multiple=True, metavar="KEY=VALUE", help=help)


algorithm = option(
    "--algorithm NAME",
    "Use this learner: progress, 2.0 or 1.0 (of the paper), or your package.module:Class. "
    "[default: 2.0 for scenes and their recordings, else progress]",
)
max_iterations = option(
    "--max-iterations N", "Stop after this number of iterations. [default: no limit]"
)
max_modules = option(
    "--max-modules N",
    "Stop after this number of modules. [default: no limit; learners 2.0 and 1.0: number of "
    "streams]",
)
seed = option("--seed N", "Seed of every random choice.", type=SEED, default=0, show_default=True)
preset = option(
    "--preset NAME",
    "Use the configuration values of a preset (icub, icub-real, oscillatory or cameras) or of your "
    ".toml file. [default: the preset for SOURCE]",
)
source = option(
    "--source SOURCE",
    "Read the source of the run here, if it was moved. Repeatable. [default: as the run states]",
    multiple=True,
)

loop = option("--loop", "Start a recording or log again when it ends, without limit.")
passes = option(
    "--passes N",
    "Read a log at most this number of times, until each stream is decided. [default: 20; learners "
    "2.0 and 1.0 and recordings of a scene: 1]",
    type=Number(1),
)
skip_damaged = option(
    "--skip-damaged",
    "Skip damage inside a log, and damaged images, instead of stopping with an error.",
)
force = option("--force", "Overwrite existing files.")
no_rerun = option("--no-rerun", "Do not write the Rerun view run.rrd.")
retry_failed = option("--retry-failed", "Compute failed trials or logs again.")
as_json = option("--json", "Print the results as one JSON document.", name="as_json")
jobs = option(
    "--jobs N", "Number of parallel processes.", type=PROCESSES, default=1, show_default=True
)
scheduler = option(
    "--scheduler ADDRESS",
    "Compute on the dask cluster with this scheduler, instead of in --jobs processes.",
)


def _set_quiet(ctx: click.Context, param: click.Parameter, value: bool) -> None:
    Stderr.quiet = Stderr.quiet or value


# `-q`, before the command or after it.
quiet = click.option(
    "-q",
    "--quiet",
    is_flag=True,
    expose_value=False,
    callback=_set_quiet,
    help="Print no progress and no warnings, only errors.",
)
