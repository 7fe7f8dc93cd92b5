"""`cdmisfa info`, `verify` and `recover`: what is in a log, is it whole, what can be saved."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click

from cdmisfa.cli import options
from cdmisfa.core.errors import LogDamagedError


@click.command("info")
@options.place_argument("path")
@options.as_json
@click.pass_context
def info_command(ctx: click.Context, path: str, as_json: bool) -> None:
    """Say what is in a recording, a run or any MCAP file.

    Exits with 3 when a checksum is wrong.
    """
    from replay.integrity.info import describe

    document = describe(path)
    if as_json:
        options.print_json(document)
    else:
        _print_info(path, document)
    if document["crc"] == "bad":
        ctx.exit(LogDamagedError.exit_code)


def _print_info(path: str, document: dict[str, Any]) -> None:
    state = "complete" if document["complete"] else "cut short"
    words = [document["kind"], state, f"checksums {document['crc']}"]
    if document["seed"] is not None:
        words.append(f"seed {document['seed']}")
    if document["ended"] is not None:
        words.append(f"ended: {document['ended']}")
    click.echo(f"{path}: {', '.join(words)}")
    if document["signals"] is not None and document["signals"]["missing"]:
        version, lacks = (document["signals"][key] for key in ("version", "missing"))
        click.echo(f"signals of version {version}: {', '.join(lacks)} are not in it, read as NaN")
    options.print_table(
        ("topic", "messages", "encoding", "schema", "from", "to"),
        [
            [
                *(c[key] for key in ("topic", "messages", "encoding", "schema")),
                _clock(c["start_ns"]),
                _clock(c["end_ns"]),
            ]
            for c in document["channels"]
        ],
    )


def _clock(ns: int | None) -> str:
    """A log time as date and time of day, UTC, to the millisecond."""
    if ns is None:
        return "-"
    whole, rest = divmod(ns, 10**9)
    time = datetime.fromtimestamp(whole, tz=UTC)
    return f"{time:%Y-%m-%d %H:%M:%S}.{rest // 10**6:03}Z"


@click.command("verify")
@options.place_argument("path")
@options.as_json
@click.pass_context
def verify_command(ctx: click.Context, path: str, as_json: bool) -> None:
    """Check that a log is whole: structure, checksums, no gaps.

    Exits with 3 when anything is wrong.
    """
    from replay.integrity.verify import verify

    document = {"schema": options.SCHEMA, **verify(path)}
    if as_json:
        options.print_json(document)
    elif document["ok"]:
        click.echo(f"{path}: whole")
    else:
        options.print_table(
            ("where", "what"), [(p["where"], p["what"]) for p in document["problems"]]
        )
    if not document["ok"]:
        ctx.exit(LogDamagedError.exit_code)


@click.command("recover")
@options.place_argument("path")
@options.out("The whole log to write.", required=True)
@options.force
@options.as_json
@click.pass_context
def recover_command(ctx: click.Context, path: str, out: Path, force: bool, as_json: bool) -> None:
    """Save what can be read of a damaged log as a whole one.

    Exits with 3 when something could not be saved.
    """
    from replay.integrity.recover import recover

    report = recover(path, out, force=force)
    if as_json:
        options.print_json(report)
    else:
        options.print_table(
            ("topic", "kept", "lost"),
            [
                (c["topic"], c["kept"], "unknown" if c["lost"] is None else c["lost"])
                for c in report["channels"]
            ],
        )
        click.echo(f"written {out}")
    if not report["complete"]:
        ctx.exit(LogDamagedError.exit_code)
