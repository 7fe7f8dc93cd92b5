"""Options that several commands share."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cdmisfa.cli.printing import Stderr
from cdmisfa.core.config import parse_settings
from cdmisfa.core.errors import TooSmallError, UsageError
from replay.storage.location import location

if TYPE_CHECKING:
    from recorder.images.options import InputOptions

Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]


class LocalPath(click.Path):
    """A path on this machine: a URL would become a folder `s3:`, no name at all the current one."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """See `click.ParamType`."""
        if not str(value):
            self.fail("it is empty: name a path", param, ctx)
        if "://" in str(value):
            self.fail(f"{value} is a URL: name a path on this machine", param, ctx)
        return super().convert(value, param, ctx)


OUT = LocalPath(path_type=Path)
"""Type of every option that says where something is written, and of what is read from no URL."""

WORD = click.Path(readable=False)
"""A path, URL or other word of a source; a shell completes it as a file."""


class Size(click.ParamType[Any]):
    """A size, WIDTHxHEIGHT, as (height, width)."""

    name = "size"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """See `click.ParamType`."""
        if not isinstance(value, str):
            return value
        found = re.fullmatch(r"([1-9]\d{0,3})x([1-9]\d{0,3})", value, re.ASCII)
        if found is None:
            self.fail(f"{value!r} is no size: write WIDTHxHEIGHT, as 128x48", param, ctx)
        return int(found[2]), int(found[1])


class Time(click.ParamType[Any]):
    """A time, [[HOURS:]MINUTES:]SECONDS, as seconds."""

    name = "time"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """See `click.ParamType`."""
        if not isinstance(value, str):
            return value
        pattern = r"(?:(?:(\d{1,4}):)?(\d{1,4}):)?(\d{1,9}(?:\.\d{1,9})?)"
        found = re.fullmatch(pattern, value, re.ASCII)
        if found is None:
            words = "write seconds, or MINUTES:SECONDS, as 1:30"
            self.fail(f"{value!r} is no time: {words}", param, ctx)
        hours, minutes, seconds = (float(part or 0) for part in found.groups())
        return hours * 3600 + minutes * 60 + seconds


INPUTS: Mapping[str, Decorator] = {
    "topics": click.option(
        "--topic",
        "topics",
        multiple=True,
        metavar="TOPIC",
        help="A topic of a log, a stream each, or a pattern of them, as '/cam*'; repeatable.",
    ),
    "fields": click.option(
        "--field",
        "fields",
        multiple=True,
        metavar="FIELD",
        help="Take numbers instead of images: a field of a topic's messages, as pose.position.x or "
        "ranges[0:100], or a column of a table; several are one vector.",
    ),
    "size": click.option(
        "--size",
        type=Size(),
        metavar="WxH",
        help="Shrink images to this size; by default to one of their ratio of the sides with no "
        "more pixels than 128x48.",
    ),
    "rate": click.option(
        "--rate",
        type=click.FloatRange(1e-3, 1e6),
        metavar="HZ",
        help="Frames a second; by default the first stream's.",
    ),
    "start": click.option(
        "--start",
        type=Time(),
        metavar="TIME",
        default="0",
        help="Leave out what a log has before this time, in seconds or as MINUTES:SECONDS.",
    ),
    "end": click.option(
        "--end",
        type=Time(),
        metavar="TIME",
        help="Leave out what a log has from this time on.",
    ),
    "align": click.option(
        "--align",
        type=click.Choice(["index", "time"]),
        help="Put streams that differ on one clock: the i-th image of each, or the last image at "
        "each time. By default they are refused.",
    ),
    "color": click.option(
        "--color",
        type=click.Choice(["on", "off", "auto"]),
        is_flag=False,
        flag_value="on",
        default="off",
        help="Show red, green and blue beside one another, as a frame of three times the width; "
        "auto does so where hue varies in the first frames of a log and brightness does not.",
    ),
}
"""Options of commands that read external logs, by the names of `InputOptions`."""


def input_options(*names: str, keys: bool = False) -> Decorator:
    """Options of `INPUTS`, all or those named; the command gets them as `inputs`.

    Args:
        names: of `InputOptions`.
        keys: also `--set`, for keys `input.*` alone.
    """
    chosen = names or tuple(INPUTS)

    def wrapped(command: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(command)
        def with_inputs(*args: Any, **values: Any) -> Any:
            from recorder.images.options import InputOptions

            given = {name: values.pop(name) for name in chosen}
            if "color" in given:  # a run keeps it as a truth value
                given["color"] = {"on": True, "off": False}.get(given["color"], given["color"])
            inputs = InputOptions(**given)
            if keys:
                inputs = _with_keys(inputs, values.pop("settings"))
            try:
                return command(*args, inputs=inputs, **values)
            except TooSmallError as error:
                remedy = ", or a smaller --size" if "size" in given else ""
                raise UsageError(f"{error}{remedy}") from None

        decorated: Callable[..., Any] = with_inputs
        if keys:
            decorated = settings("Set a key input.*, as input.fit=pad; repeatable.")(decorated)
        for name in reversed(chosen):
            decorated = INPUTS[name](decorated)
        return decorated

    return wrapped


def _with_keys(inputs: InputOptions, settings: Sequence[str]) -> InputOptions:
    words = parse_settings(settings)
    if other := next((section for section in words if section != "input"), None):
        raise UsageError(f"{other}.* is not for this command, which takes input.* alone")
    return inputs.configured(words.get("input", {}))


look_options = input_options("topics", "fields", "rate", keys=True)
"""Which streams of external logs are shown or exported."""

loop = click.option("--loop", is_flag=True, help="Start a recording or log again at its end.")
salvage = click.option(
    "--salvage", is_flag=True, help="Pass over damaged parts and images of a log."
)
force = click.option("--force", is_flag=True, help="Overwrite what is already there.")
no_rerun = click.option("--no-rerun", is_flag=True, help="Do not build the Rerun view run.rrd.")
retry_failed = click.option(
    "--retry-failed", is_flag=True, help="Compute trials again that failed before."
)
as_json = click.option(
    "--json", "as_json", is_flag=True, help="Print one JSON document and nothing else."
)
jobs = click.option(
    "--jobs", type=click.IntRange(1, 1024), default=1, show_default=True, help="Parallel processes."
)
preset = click.option(
    "--preset",
    metavar="NAME",
    help="Preset (icub, icub-real, oscillatory, cameras) or a .toml file; by default the source's.",
)
scheduler = click.option(
    "--scheduler",
    metavar="ADDRESS",
    help="Compute in the workers of the dask cluster at this address, instead of --jobs.",
)


def _be_quiet(ctx: click.Context, param: click.Parameter, given: bool) -> None:
    Stderr.quiet = Stderr.quiet or given


quiet = click.option(
    "-q",
    "--quiet",
    is_flag=True,
    expose_value=False,
    callback=_be_quiet,
    help="Print nothing on stderr but errors.",
)
"""`-q`, of the program and of commands that show how far they are."""


def settings(help: str = "Set a configuration key, as learner.nu=0.02; repeatable.") -> Decorator:
    """`--set`."""
    return click.option("--set", "settings", multiple=True, metavar="KEY=VALUE", help=help)


def seed(help: str = "Seed of every random choice.", default: int | None = 0) -> Decorator:
    """`--seed`."""
    kind = click.IntRange(0, 2**63 - 1)
    return click.option("--seed", type=kind, default=default, show_default=True, help=help)


def end_after(what: str, help: str) -> Decorator:
    """`--max-iterations` or `--max-modules`."""
    return click.option(f"--max-{what}", type=click.IntRange(1), help=help)


def out(help: str, *, required: bool = False) -> Decorator:
    """`-o`: where the result goes."""
    return click.option("-o", "--out", type=OUT, required=required, help=help)


def path(name: str, metavar: str, help: str) -> Decorator:
    """An option that is a path of this machine."""
    return click.option(name, type=OUT, metavar=metavar, help=help)


def path_argument(name: str) -> Decorator:
    """A path of this machine; whether it exists is for the library to say, in its own words."""
    return click.argument(name, type=OUT)


def log_argument(name: str, *, nargs: int = 1, required: bool = True) -> Decorator:
    """A log's path or URL, or several, of which patterns are replaced by what matches them."""

    def opened(
        ctx: click.Context, param: click.Parameter, value: str | tuple[str, ...]
    ) -> Path | tuple[Path, ...]:
        if ctx.resilient_parsing:  # a shell completes what follows
            return Path()
        if isinstance(value, tuple):
            from replay.inputs import locations

            return tuple(locations(value))
        return location(value)

    return click.argument(name, nargs=nargs, required=required, callback=opened, type=WORD)
