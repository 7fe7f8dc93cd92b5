"""Options that several commands share."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

import click

from cdmisfa.cli.making import (
    Command,
    choice,
    flag,
    number,
    option,
    options_of,
    together,
    word,
)
from cdmisfa.cli.printing import Stderr
from cdmisfa.core.errors import TooSmallError, UsageError, are_for
from recorder.cameras.options import LiveOptions
from recorder.images.options import ImageOptions
from replay.camera_logs.options import CameraOptions
from replay.storage.location import location


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

WORD = click.Path(readable=False)
"""A path, URL or other word of a source; a shell completes it as a file."""
"""Type of every option that says where something is written, and of what is read from no URL."""


def _with_size(made: Callable[[Command], Command]) -> Callable[[Command], Command]:
    """Options of which --size is one, which an error about small images then names."""

    def wrapped(command: Command) -> Command:
        @functools.wraps(command)
        def naming_size(*args: Any, **values: Any) -> Any:
            try:
                return command(*args, **values)
            except TooSmallError as error:
                raise UsageError(f"{error}, or a smaller --size") from None

        return made(cast(Command, naming_size))

    return wrapped


image_options = _with_size(options_of(ImageOptions, "images"))
"""How images of cameras, live or stored, become frames."""

log_options = _with_size(options_of(CameraOptions, "cameras"))
"""What of camera logs becomes frames, and how."""

look_options = options_of(CameraOptions, "cameras", "topics", "fields", "time", "rate", "depth")
"""What of camera logs is shown or exported."""

live_options = options_of(LiveOptions, "live", "hold", "on_loss", "stall")
"""How live streams are put on one clock."""


def refuse_live_options(live: LiveOptions, source: Sequence[str]) -> None:
    """Refuse options of live streams for a source that is none.

    Raises:
        UsageError: some are given.
    """
    if given := live.given():
        raise UsageError(f"{source[0]} is no live stream: {are_for(given, 'live streams')}")


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
keyframes = number(
    "--keyframes",
    "Keep the learner's state every N iterations; by default every 100, or less often so that they "
    "stay a small part of the log.",
    *(1, None, "N"),
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
