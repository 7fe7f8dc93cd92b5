"""Options that several commands share, and how results are printed."""

from __future__ import annotations

import functools
import json
import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar, cast

import click

from cdmisfa.core.errors import CdmisfaError
from cdmisfa.experiments.documents import plain

Command = TypeVar("Command", bound=Callable[..., Any])

FETCHED = "cdmisfa.fetched"
"""Where a command's context keeps the paths of copies, and what they are copies of."""

SCHEMA = 1
"""Version of the JSON documents; rises when a key changes its meaning or goes away."""


class WrittenPath(click.Path):
    """A path to write at, which is on this machine: a URL would become a folder `s3:`."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """See `click.ParamType`."""
        if "://" in str(value):
            self.fail(f"{value} is a URL: name a path on this machine", param, ctx)
        return super().convert(value, param, ctx)


OUT = WrittenPath(path_type=Path)
"""Type of every option that says where something is written."""


as_json = click.option(
    "--json", "as_json", is_flag=True, help="Print one JSON document and nothing else."
)

seed = click.option(
    "--seed",
    type=click.IntRange(0, 2**63 - 1),
    default=0,
    show_default=True,
    help="Seed of every random choice.",
)

settings = click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="KEY=VALUE",
    help="Set a configuration key, as learner.nu=0.02; may be repeated.",
)

preset = click.option(
    "--preset",
    metavar="NAME",
    help="Preset (icub, oscillatory) or a .toml file; by default the one of the source.",
)

force = click.option("--force", is_flag=True, help="Overwrite what is already there.")

jobs = click.option(
    "--jobs",
    type=click.IntRange(1, 1024),
    default=1,
    show_default=True,
    help="Parallel processes.",
)


def together(*each: Callable[[Command], Command]) -> Callable[[Command], Command]:
    """Several options as one, in the order in which --help lists them."""
    return lambda command: functools.reduce(lambda c, option: option(c), reversed(each), command)


engine = together(
    click.option(
        "--engine",
        type=click.Choice(["local", "dask"]),
        default="local",
        show_default=True,
        help="Where to compute.",
    ),
    click.option("--scheduler", metavar="ADDRESS", help="A dask scheduler that runs."),
)


def out(meaning: str, *, required: bool = False) -> Callable[[Command], Command]:
    """`-o`: where the result goes."""
    return click.option("-o", "--out", type=OUT, required=required, help=meaning)


def path_argument(name: str) -> Callable[[Command], Command]:
    """A path; whether it exists is for the library to say, in its own words."""
    return click.argument(name, type=click.Path(path_type=Path))


def fetched_argument(name: str) -> Callable[[Command], Command]:
    """A path; a log behind a URL is copied into a file for as long as the command runs.

    What the command complains about then names the URL, not the copy.
    """

    def wrapped(command: Command) -> Command:
        @functools.wraps(command)
        def naming_the_url(*args: Any, **values: Any) -> Any:
            try:
                return command(*args, **values)
            except CdmisfaError as error:
                text = str(error)
                for copy, url in click.get_current_context().meta.get(FETCHED, ()):
                    text = text.replace(copy, url)
                error.args = (text,)
                raise

        return cast(Command, click.argument(name, callback=_fetched)(naming_the_url))

    return wrapped


def _fetched(ctx: click.Context, param: click.Parameter, value: str) -> Path:
    if "://" not in value:
        return Path(value)
    from replay.storage.location import location
    from replay.storage.opening import fetched

    place = location(value)
    copy = ctx.with_resource(fetched(place))
    ctx.meta[FETCHED] = [(str(copy), str(place)), (str(copy.parent), str(place.parent))]
    return copy


def quoted(path: str | Path) -> str:
    """A path as a shell takes it in a command to copy."""
    return shlex.quote(str(path))


def print_json(document: Mapping[str, Any]) -> None:
    """One JSON document on stdout; see `plain`."""
    click.echo(json.dumps(plain(document), allow_nan=False))


def print_table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Rows of cells in aligned columns under a ruled head, on stdout."""
    cells = [[str(cell) for cell in row] for row in (head, *rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(head))]
    cells.insert(1, ["-" * width for width in widths])
    for row in cells:
        click.echo("  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip())
