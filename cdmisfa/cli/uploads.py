"""`-o s3://...`: a result is written on this machine, and uploaded when it is finished."""

from __future__ import annotations

import contextlib
import functools
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import click

from cdmisfa.cli import options
from cdmisfa.cli.making import Command
from cdmisfa.cli.printing import quoted, tell
from cdmisfa.cli.progress import bar
from cdmisfa.core.errors import CdmisfaError, UsageError

if TYPE_CHECKING:
    from replay.storage.location import Url

INTERRUPTED = 128
"""Exit codes from here on are of signals."""


class Destination(options.LocalPath):
    """A path on this machine, or an s3:// address, which stays a text."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """See `click.ParamType`."""
        if re.match(r"s3://", str(value), re.IGNORECASE):
            return str(value)
        return super().convert(value, param, ctx)


def out_option(
    meaning: str, *, required: bool = False, goes_on: bool = False
) -> Callable[[Command], Command]:
    """`-o` and `--local` of a command whose result may be uploaded; it is given the path.

    Args:
        meaning: of the option -o.
        required: whether it must be given.
        goes_on: whether the command always goes on with what is there; else --resume says so.
    """

    def wrapped(command: Command) -> Command:
        @functools.wraps(command)
        def uploading(*args: Any, local: Path | None, **values: Any) -> Any:
            address = values["out"]
            if not isinstance(address, str):
                if local is not None:
                    raise UsageError("--local goes with -o s3://...: it says where that is written")
                return command(*args, **values)
            force, dry = bool(values.get("force")), bool(values.get("dry_run"))
            resume = goes_on or bool(values.get("resume"))
            with uploaded(address, local, force=force, resume=resume, dry_run=dry) as place:
                values["out"] = place
                click.get_current_context().params |= {"out": place, "local": None}
                return command(*args, **values)

        written = click.option(
            "--local",
            type=options.OUT,
            metavar="PATH",
            help="Where what goes to s3:// is written first and kept; by default in the folder "
            "you are in, by its last name.",
        )(uploading)
        option = click.option(
            "-o", "--out", type=Destination(path_type=Path), required=required, help=meaning
        )
        return cast(Command, option(written))

    return wrapped


@contextlib.contextmanager
def uploaded(
    address: str, local: Path | None, *, force: bool, resume: bool, dry_run: bool
) -> Iterator[Path]:
    """Where to write what is uploaded to an s3:// address once the body has finished.

    The address is looked at before any work is done. Where work is resumed that is not on this
    machine, what is behind the address is fetched first.

    Args:
        address: of the result.
        local: where it is written; by default its last name, in the current folder.
        force: overwrite what is behind the address.
        resume: go on with it.
        dry_run: nothing will be written, so nothing is looked at, fetched or uploaded.

    Yields:
        The path; it is kept, whatever comes.

    Raises:
        UsageError: something is behind the address, and neither `force` nor `resume` is set.
        CdmisfaError: it cannot be uploaded.
    """
    from replay.storage.location import Url, location
    from replay.storage.uploads import fetch, objects_below

    url = location(address)
    assert isinstance(url, Url)
    place = local or Path(url.name)
    if dry_run:
        yield place
        return
    there = objects_below(url)
    if there and not (force or resume):
        go_on = "go on with --resume or " if "resume" in click.get_current_context().params else ""
        raise UsageError(f"{url} exists: choose another name, {go_on}overwrite with --force")
    if there and resume and not place.exists():
        with bar("fetching", "bytes") as shown:
            fetch(url, place, there, shown.update)
        tell(f"{place} was fetched from {url}")
    tell(f"written to {place}, and uploaded to {url} when it is finished")
    again = f"cdmisfa upload {quoted(place)} {quoted(str(url))}"
    try:
        yield place
    except UsageError:
        raise
    except BaseException as error:
        if isinstance(error, click.exceptions.Exit) and error.exit_code < INTERRUPTED:
            upload_now(place, url, again)
        elif place.exists():
            tell(f"{place} is not uploaded: when it is finished, {again}")
        raise
    upload_now(place, url, again)


def upload_now(place: Path, url: Url, again: str) -> tuple[int, int]:
    """Upload a result, and say so: how many files, and how many bytes.

    Args:
        place: of the file or folder.
        url: where to.
        again: the command that does it again.
    """
    from replay.storage.uploads import upload

    try:
        with bar("uploading", "bytes") as shown:
            files, size, others = upload(place, url, shown.update)
    except CdmisfaError as error:
        error.args = (f"{error}: {place} is kept, upload it with {again}",)
        raise
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"{place} is kept, upload it with {again}") from None
    if others:
        more = f" and {len(others) - 1} more" if len(others) > 1 else ""
        tell(f"warning: {url}{others[0]}{more} was there before, and is not of it")
    tell(f"uploaded {url}: {files} files, {size} bytes, checked")
    return files, size
