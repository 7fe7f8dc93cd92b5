"""Options and types of values that several commands share."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from cdmisfa.cli.printing import Stderr

Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]

# Paths


class LocalPath(click.Path):
    """A path on this machine; else a URL would become a folder `s3:`, and "" the current one."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """See `click.ParamType`."""
        if not str(value):
            self.fail("it is empty: name a path", param, ctx)
        if "://" in str(value):
            self.fail(f"{value} is a URL: name a path on this machine", param, ctx)
        return super().convert(value, param, ctx)


# Type of paths that are written, and of those that are read but cannot be URLs.
LOCAL = LocalPath(path_type=Path)

# Type of paths, URLs and other words that name a source; a shell completes them as files.
WORD = click.Path(readable=False)


def output(help: str, *, required: bool = False) -> Decorator:
    """Return the option `-o` for the result of a command."""
    return click.option("-o", "--output", type=LOCAL, required=required, help=help)


def log_argument(name: str) -> Decorator:
    """Return an argument of one or more paths, URLs or patterns, passed as existing paths."""

    def located(
        ctx: click.Context, param: click.Parameter, words: tuple[str, ...]
    ) -> tuple[Path, ...]:
        if ctx.resilient_parsing:  # while a shell completes what follows
            return ()
        from replay.inputs import locations

        return tuple(locations(words))

    return click.argument(name, nargs=-1, required=True, callback=located, type=WORD)


# How external logs and live streams become streams of frames


def parse_size(text: str) -> tuple[int, int]:
    """Parse WIDTHxHEIGHT as (height, width)."""
    match = re.fullmatch(r"([1-9]\d{0,3})x([1-9]\d{0,3})", text, re.ASCII)
    if match is None:
        raise click.BadParameter(f"{text!r} is no size: write WIDTHxHEIGHT, as 128x48")
    return int(match[2]), int(match[1])


def parse_seconds(text: str) -> float:
    """Parse [[HOURS:]MINUTES:]SECONDS as seconds."""
    pattern = r"(?:(?:(\d{1,4}):)?(\d{1,4}):)?(\d{1,9}(?:\.\d{1,9})?)"
    match = re.fullmatch(pattern, text, re.ASCII)
    if match is None:
        raise click.BadParameter(f"{text!r} is no time: write seconds, or MINUTES:SECONDS, as 1:30")
    hours, minutes, seconds = (float(part or 0) for part in match.groups())
    return hours * 3600 + minutes * 60 + seconds


# Options by the names of `InputOptions`; `settings` are the keys `input.*` of commands that have
# no other keys.
INPUTS = {
    "topics": click.option(
        "--topic",
        "topics",
        multiple=True,
        metavar="TOPIC",
        help="Topic of a log, or a pattern such as '/cam*'; each topic is a stream. Repeatable.",
    ),
    "fields": click.option(
        "--field",
        "fields",
        multiple=True,
        metavar="FIELD",
        help="Read numbers instead of images: a field of the messages, as pose.position.x or "
        "ranges[0:100], or a column of a table. Several fields become one vector.",
    ),
    "size": click.option(
        "--size",
        type=parse_size,
        metavar="WxH",
        help="Shrink images to this size. By default the aspect ratio stays, and frames have at "
        "most as many pixels as 128x48.",
    ),
    "rate": click.option(
        "--rate",
        type=click.FloatRange(1e-3, 1e6),
        metavar="HZ",
        help="Frames per second; by default the rate of the first stream.",
    ),
    "start": click.option(
        "--start",
        type=parse_seconds,
        metavar="TIME",
        default="0",
        help="Skip what a log has before this time, in seconds or as MINUTES:SECONDS.",
    ),
    "end": click.option(
        "--end", type=parse_seconds, metavar="TIME", help="Skip what a log has from this time on."
    ),
    "align": click.option(
        "--align",
        type=click.Choice(["index", "time"]),
        help="Align streams of different rates: by message number, or by the latest message at "
        "each time. By default such streams are refused.",
    ),
    "color": click.option(
        "--color",
        type=click.Choice(["on", "off", "auto"]),
        is_flag=False,
        flag_value="on",
        default="off",
        help="Use color: red, green and blue side by side in a frame of three times the width. "
        "auto uses it if hue varies in the first frames of a log and brightness does not.",
    ),
    "settings": click.option(
        "--set",
        "input_settings",
        multiple=True,
        metavar="KEY=VALUE",
        help="Set a configuration key input.*, as input.fit=pad. Repeatable.",
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
            if "color" in chosen:  # a run keeps it as a truth value
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

COUNT = click.IntRange(1)
SEED = click.IntRange(0, 2**63 - 1)


def settings(help: str = "Set a configuration key, as learner.nu=0.02. Repeatable.") -> Decorator:
    """Return the option `--set`."""
    return click.option("--set", "settings", multiple=True, metavar="KEY=VALUE", help=help)


seed = click.option(
    "--seed", type=SEED, default=0, show_default=True, help="Seed of every random choice."
)
preset = click.option(
    "--preset",
    metavar="NAME",
    help="Preset (icub, icub-real, oscillatory, cameras) or a .toml file; by default the source's.",
)
source = click.option(
    "--source",
    metavar="SOURCE",
    multiple=True,
    help="What the run learned from, if that has moved. Repeatable.",
)
max_iterations = click.option(
    "--max-iterations", type=COUNT, help="End after this number of iterations."
)
max_modules = click.option(
    "--max-modules",
    type=COUNT,
    help="End after this number of learned modules. By default the paper's learners end after as "
    "many modules as there are streams.",
)
loop = click.option("--loop", is_flag=True, help="Start a recording or log again at its end.")
skip_damaged = click.option(
    "--skip-damaged", is_flag=True, help="Skip damaged parts and images of a log."
)
force = click.option("--force", is_flag=True, help="Overwrite existing results.")
no_rerun = click.option("--no-rerun", is_flag=True, help="Do not build the Rerun view run.rrd.")
retry_failed = click.option(
    "--retry-failed", is_flag=True, help="Compute again what failed before."
)
as_json = click.option(
    "--json", "as_json", is_flag=True, help="Print one JSON document and nothing else."
)
jobs = click.option(
    "--jobs", type=click.IntRange(1, 1024), default=1, show_default=True, help="Parallel processes."
)
scheduler = click.option(
    "--scheduler",
    metavar="ADDRESS",
    help="Compute on the dask cluster with this scheduler, instead of --jobs.",
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
    help="Print nothing on stderr but errors.",
)
