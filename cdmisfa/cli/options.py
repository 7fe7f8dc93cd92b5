"""Options that several commands share, and how results are printed."""

from __future__ import annotations

import dataclasses
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
    help="Preset (icub, oscillatory, cameras) or a .toml file; by default the one of the source.",
)

keyframes = click.option(
    "--keyframes",
    type=click.IntRange(1),
    metavar="N",
    help="Keep the learner's state every N iterations; by default every 100, or less often so "
    "that they stay a small part of the log.",
)

fsync_every = click.option(
    "--fsync-every",
    type=click.FloatRange(0.0, 1e6),
    metavar="SECONDS",
    help="Let the disk have what is written after so long, so that a power cut takes no more; by "
    "default the operating system decides until a file is finished.",
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


def one_of(
    name: str, values: Sequence[str], meaning: str, *, argument: str | None = None
) -> Callable[[Command], Command]:
    """An option that is one of some values, by default the first.

    Args:
        name: of the option.
        values: all there are.
        meaning: for --help.
        argument: name of the command's argument; by default the option's.
    """
    kind, named = click.Choice(list(values)), (name,) if argument is None else (name, argument)
    return click.option(*named, type=kind, default=values[0], show_default=True, help=meaning)


def seconds(
    name: str, default: float, meaning: str, *, least: float = 0.1, **how: Any
) -> Callable[[Command], Command]:
    """An option that is how long something may take."""
    kind = click.FloatRange(least, 1e6)
    told = {"metavar": "SECONDS", "help": meaning, **how}
    return click.option(name, type=kind, default=default, show_default=True, **told)


def _limit(option: str, name: str, default: float, meaning: str) -> Callable[[Command], Command]:
    """An option for one of the `Limits`, which hold while the command runs."""

    def hold(ctx: click.Context, param: click.Parameter, value: float) -> None:
        from replay.storage.location import limited, limits

        ctx.with_resource(limited(dataclasses.replace(limits(), **{name: value})))

    return seconds(option, default, meaning, callback=hold, is_eager=True, expose_value=False)


server_limits = together(
    _limit(
        *("--timeout", "total", 60.0),
        "Give up on a part of a log at a URL (of a large one, on each MiB) after so long.",
    ),
    _limit(
        *("--read-timeout", "read", 20.0),
        "Ask a server again that sends nothing for so long.",
    ),
)
"""How long the servers of URLs are waited for; a command with a URL among its arguments has it."""

engine = together(
    one_of(
        "--engine",
        ("local", "dask"),
        "Where to compute: in processes of this machine, or in workers of dask.",
    ),
    click.option("--scheduler", metavar="ADDRESS", help="Address of a dask scheduler that runs."),
)


def out(meaning: str, *, required: bool = False) -> Callable[[Command], Command]:
    """`-o`: where the result goes."""
    return click.option("-o", "--out", type=OUT, required=required, help=meaning)


def path_argument(name: str) -> Callable[[Command], Command]:
    """A path of this machine; whether it exists is for the library to say, in its own words."""
    return click.argument(name, type=OUT)


def fetched_argument(name: str, *, nargs: int = 1) -> Callable[[Command], Command]:
    """A path, or several; a log behind a URL is copied into a file while the command runs.

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

        argument = click.argument(name, nargs=nargs, required=True, callback=_fetched)
        return cast(Command, argument(naming_the_url))

    return wrapped


def is_fetched(path: Path) -> bool:
    """Whether a path is that of a copy, which goes when the command ends."""
    names = click.get_current_context().meta.get(FETCHED, ())
    return any(str(path) == copy for copy, _ in names)


def _fetched(
    ctx: click.Context, param: click.Parameter, value: str | tuple[str, ...]
) -> Path | tuple[Path, ...]:
    if isinstance(value, tuple):
        return tuple(_copy_of(ctx, word) for word in _matched(value))
    return _copy_of(ctx, value)


def _matched(words: tuple[str, ...]) -> tuple[str, ...]:
    """Words with patterns as what matches them."""
    if not any(letter in word for word in words for letter in "*?["):
        return words
    from replay.inputs import places
    from replay.storage.location import Url

    return tuple(p.address if isinstance(p, Url) else str(p) for p in places(words))


def _copy_of(ctx: click.Context, word: str) -> Path:
    from replay.storage.location import Url, location

    place = location(word)
    if not isinstance(place, Url):
        return place
    from replay.storage.opening import fetched

    copy = ctx.with_resource(fetched(place))
    names = ctx.meta.setdefault(FETCHED, [])
    names += [(str(copy), str(place)), (str(copy.parent), str(place.parent))]
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
