"""Options that several commands share."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import click

from cdmisfa.cli.making import (
    WRITTEN,
    Command,
    choice,
    flag,
    number,
    option,
    together,
    word,
)
from cdmisfa.cli.printing import Stderr
from cdmisfa.core.errors import TooSmallError, UsageError
from cdmisfa.core.options import parse_settings
from replay.storage.location import location

if TYPE_CHECKING:
    from recorder.images.options import InputOptions


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


INPUTS: Mapping[str, Callable[[Command], Command]] = {
    "topics": option(
        "--topic",
        "topics",
        metavar="TOPIC",
        help="A topic of a log, a stream each, or a pattern of them, as '/cam*'; repeatable.",
        multiple=True,
    ),
    "fields": option(
        "--field",
        "fields",
        metavar="FIELD",
        help="Take numbers instead of images: a field of a topic's messages, as pose.position.x or "
        "ranges[0:100], or a column of a table; several are one vector.",
        multiple=True,
    ),
    "size": word(
        "--size",
        "WxH",
        "Shrink images to this size; by default to what has their ratio of the sides and no more "
        "pixels than 128x48.",
        type=WRITTEN["WxH"],
    ),
    "rate": number("--rate", "Frames a second; by default the first stream's.", *(1e-3, 1e6, "HZ")),
    "start": word(
        "--start",
        "TIME",
        "Leave out what a log has before this time, in seconds or as MINUTES:SECONDS.",
        type=WRITTEN["TIME"],
        default="0",
    ),
    "end": word(
        "--end", "TIME", "Leave out what a log has from this time on.", type=WRITTEN["TIME"]
    ),
    "align": option(
        "--align",
        type=click.Choice(["index", "time"]),
        help="Put streams that differ on one clock: the i-th image of each, or the last image at "
        "each time. By default they are refused.",
    ),
    "color": option(
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


def input_options(*names: str, keys: bool = False) -> Callable[[Command], Command]:
    """Options of `INPUTS`, all or those named; the command gets them as `inputs`.

    Args:
        names: of `InputOptions`.
        keys: also `--set`, for keys `input.*` alone.
    """
    chosen = names or tuple(INPUTS)

    def wrapped(command: Command) -> Command:
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

        each = [INPUTS[name] for name in chosen]
        if keys:
            each.append(settings("Set a key input.*, as input.fit=pad; repeatable.", "KEY=VALUE"))
        return together(*each)(cast(Command, with_inputs))

    return wrapped


def _with_keys(inputs: InputOptions, settings: Sequence[str]) -> InputOptions:
    words = parse_settings(settings)
    if other := next((section for section in words if section != "input"), None):
        raise UsageError(f"{other}.* is not for this command, which takes input.* alone")
    return inputs.configured(words.get("input", {}))


loop = flag("--loop", "Start a recording or log again at its end.", group="Source")
salvage = flag("--salvage", "Pass over damaged parts and images of a log.", group="Source")
force = flag("--force", "Overwrite what is already there.")
no_rerun = flag("--no-rerun", "Do not build the Rerun view run.rrd.")
retry_failed = flag("--retry-failed", "Compute trials again that failed before.")
as_json = option(
    "--json", "as_json", is_flag=True, help="Print one JSON document and nothing else."
)
jobs = number("--jobs", "Parallel processes.", 1, 1024, default=1)
preset = word(
    "--preset",
    "NAME",
    "Preset (icub, icub-real, oscillatory, cameras) or a .toml file; by default the source's.",
    group="Learner",
)
engine = together(
    choice(
        "--engine",
        "Where to compute: in processes of this machine, or in workers of dask.",
        ("local", "dask"),
    ),
    word("--scheduler", "ADDRESS", "Address of a dask scheduler that runs."),
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


def seed(
    about: str = "Seed of every random choice.", default: int | None = 0
) -> Callable[[Command], Command]:
    """`--seed`."""
    return number("--seed", about, 0, 2**63 - 1, default=default, group="Learner")


def seeds(about: str, default: str) -> Callable[[Command], Command]:
    """`--seeds`, which `parse_seeds` reads."""
    about += ": a range without its end, or numbers with commas, as 1,5,9."
    return word("--seeds", "FIRST:END", about, default=default, show_default=True)


def settings(
    about: str = "Set a configuration key, as learner.nu=0.02; may be repeated.",
    unit: str = "KEY=VALUE",
) -> Callable[[Command], Command]:
    """`--set`."""
    how: dict[str, Any] = {"metavar": unit, "help": about, "group": "Learner"}
    return option("--set", "settings", multiple=True, **how)


def end_after(what: str, about: str) -> Callable[[Command], Command]:
    """`--max-iterations` or `--max-modules`."""
    return number(f"--max-{what}", about, 1, group="Learner")


def path(
    name: str, about: str, unit: str | None = None, **how: Any
) -> Callable[[Command], Command]:
    """An option that is a path of this machine."""
    return option(name, type=OUT, metavar=unit, help=about, **how)


def out(meaning: str, *, required: bool = False) -> Callable[[Command], Command]:
    """`-o`: where the result goes."""
    return option("-o", "--out", type=OUT, required=required, help=meaning)


def path_argument(name: str) -> Callable[[Command], Command]:
    """A path of this machine; whether it exists is for the library to say, in its own words."""
    return click.argument(name, type=OUT)


def log_argument(
    name: str, *, nargs: int = 1, required: bool = True
) -> Callable[[Command], Command]:
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

    how: dict[str, Any] = {"callback": opened, "type": WORD}
    return click.argument(name, nargs=nargs, required=required, **how)


look_options = input_options("topics", "fields", "rate", keys=True)
"""Which streams of external logs are shown or exported."""
