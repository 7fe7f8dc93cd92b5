"""`cdmisfa info`, `verify`, `recover`, `upload`: what is in a log, is it whole, can it be saved."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click

from cdmisfa.cli import options, uploads
from cdmisfa.cli.printing import SCHEMA, print_json, print_table
from cdmisfa.core.errors import LogDamagedError, UsageError

if TYPE_CHECKING:
    from replay.integrity.info import LogInfo


@click.command("info")
@click.argument("path", nargs=-1, required=True)
@options.server_limits
@options.as_json
@click.pass_context
def info_command(ctx: click.Context, path: tuple[str, ...], as_json: bool) -> None:
    """Say what is in a recording, a run, any MCAP file, or a camera log.

    PATH may be several, a pattern such as 'logs/*.mcap', or a URL. Exits with 3 when a checksum
    is wrong.
    """
    from replay.integrity.info import describe

    found = describe(*path)
    if as_json:
        print_json(found.as_json())
    else:
        _print_info(found)
    if found.crc == "bad":
        ctx.exit(LogDamagedError.exit_code)


def _print_info(found: LogInfo) -> None:
    state = "complete" if found.complete else "cut short"
    words = [found.kind, state, f"checksums {found.crc}"]
    if found.seed is not None:
        words.append(f"seed {found.seed}")
    if found.ended is not None:
        from cdmisfa.experiments.loop import ENDINGS

        words.append(f"ended: {ENDINGS.get(found.ended, found.ended)}")
    click.echo(f"{found.path}: {', '.join(words)}")
    if found.signals is not None and found.signals.missing:
        version, lacks = found.signals.version, ", ".join(found.signals.missing)
        click.echo(f"signals of version {version}: {lacks} are not in it, read as NaN")
    head: tuple[str, ...] = ("topic", "messages", "encoding", "schema", "from", "to")
    rows: list[tuple[object, ...]] = [
        (c.topic, c.messages, c.encoding, c.schema, _clock(c.start_ns), _clock(c.end_ns))
        for c in found.channels
    ]
    files = [(c.file,) for c in found.channels]
    if len(set(files)) > 1:
        head, rows = (*head, "file"), [(*row, *file) for row, file in zip(rows, files, strict=True)]
    print_table(head, rows)


def _clock(ns: int | None) -> str:
    """A log time as date and time of day, UTC, to the millisecond."""
    if ns is None:
        return "-"
    whole, rest = divmod(ns, 10**9)
    time = datetime.fromtimestamp(whole, tz=UTC)
    return f"{time:%Y-%m-%d %H:%M:%S}.{rest // 10**6:03}Z"


@click.command("verify")
@click.argument("path", nargs=-1, required=True)
@options.server_limits
@options.as_json
@click.pass_context
def verify_command(ctx: click.Context, path: tuple[str, ...], as_json: bool) -> None:
    """Check that a log is whole: structure, checksums, nothing lost.

    Of a camera log without checksums every image is decoded. PATH may be several, a pattern such
    as 'logs/*.mcap', or a URL. Exits with 3 when anything is wrong.
    """
    from replay.integrity.verify import check_logs

    found = check_logs(*path)
    if as_json:
        print_json(found.as_json())
    elif found.ok:
        click.echo(f"{' '.join(path)}: whole")
        for note in found.notes:
            click.echo(note)
    else:
        print_table(("where", "what"), [(p.where, p.what) for p in found.problems])
    if not found.ok:
        ctx.exit(LogDamagedError.exit_code)


@click.command("recover")
@click.argument("path")
@options.out("The whole log to write.", required=True)
@options.server_limits
@options.force
@options.as_json
@click.pass_context
def recover_command(ctx: click.Context, path: str, out: Path, force: bool, as_json: bool) -> None:
    """Save what can be read of a damaged log as a whole one.

    PATH is an MCAP file, as a view of a recording or the run.mcap of a run, or its URL. Exits with
    3 when something could not be saved.
    """
    from replay.integrity.recover import recover_log

    found = recover_log(path, out, force=force)
    if as_json:
        print_json(found.as_json())
    else:
        print_table(
            ("topic", "kept", "lost"),
            [(c.topic, c.kept, "unknown" if c.lost is None else c.lost) for c in found.channels],
        )
        if found.lost:
            print_table(("lost", "what"), [(p.where, p.what) for p in found.lost])
        for mended in found.mended:
            click.echo(f"{mended.where}: {mended.what}", err=True)
        click.echo(f"written {out}")
    if not found.complete:
        ctx.exit(LogDamagedError.exit_code)


@click.command("upload")
@options.path_argument("result")
@click.argument("url")
@options.server_limits
@options.as_json
def upload_command(result: Path, url: str, as_json: bool) -> None:
    """Upload a result to an S3 bucket, as `-o s3://...` does.

    RESULT is the file or folder of a recording, a run, a sweep or an export, URL is
    s3://BUCKET/NAME. What is there already with the same size and checksum is not sent again.
    """
    from replay.storage.location import Url, location

    to = location(url)
    if not isinstance(to, Url) or to.scheme != "s3":
        raise UsageError(f"{url} is no s3:// address: write s3://BUCKET/NAME")
    files, size = uploads.upload_now(result, to, "the same command")
    if as_json:
        document = {"schema": SCHEMA, "url": str(to), "files": files, "bytes": size}
        print_json(document)
