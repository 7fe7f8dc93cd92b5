"""`cdmisfa apply`: frozen modules over other logs."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cdmisfa.cli import options, uploads
from cdmisfa.cli.interrupts import Stop, stoppable
from cdmisfa.cli.making import WRITTEN, grouped, number, option, options_of
from cdmisfa.cli.printing import (
    bar,
    print_document,
    print_line,
    print_table,
    say_about,
    say_changes,
    tell,
    warn,
)
from cdmisfa.core.errors import CdmisfaError, UsageError
from cdmisfa.core.options import TIME
from replay.camera_logs.options import CameraOptions

if TYPE_CHECKING:
    from cdmisfa.core.blocks import FrameSource
    from cdmisfa.experiments.apply import Application
    from cdmisfa.experiments.applying import Tally
    from recorder.cameras.options import LiveOptions

OF_FILES = ("parquet", "csv", "mcap")

log_options = options_of(
    CameraOptions,
    "cameras",
    *("topics", "fields", "time", "stamp", "start", "gaps", "align", "rate", "depth"),
)


@grouped("apply", common=("out", "to", "frames", "loop"))
@options.path_argument("run")
@click.argument("source", nargs=-1, required=True)
@uploads.out_option(
    "The file of one log, .parquet, .csv or .mcap; of several the folder of theirs. Or s3://..."
)
@option(
    "--to",
    multiple=True,
    metavar="FORM|TIME",
    help=f"What is written, {', '.join(OF_FILES)}; or leave out images of logs from this TIME on.",
)
@number("--frames", "End after so many frames of each stream.", 1)
@options.loop
@options.salvage
@log_options
@options.live_options
@options.server_limits
@options.force
@options.as_json
@click.pass_context
def apply_command(
    ctx: click.Context,
    /,
    run: Path,
    source: tuple[str, ...],
    out: Path | None,
    to: tuple[str, ...],
    frames: int | None,
    loop: bool,
    salvage: bool,
    cameras: CameraOptions,
    live: LiveOptions,
    force: bool,
    as_json: bool,
) -> None:
    """Apply the modules of a run to other logs.

    SOURCE is what cdmisfa learn takes: a recording, logs of others, a scene. Each is a log by
    itself; pictures of any size become frames as those of the run did. A row a frame has the
    outputs of each module, their slowness within the block, whether the module is alive there,
    and how novel the block is: from 1 on the module does not know it.

    A log that cannot be read does not end the rest; the exit code is then 3, or 2.
    """
    from cdmisfa.experiments.apply import Application
    from cdmisfa.experiments.applying import places

    form, until = targets(ctx, to)
    logs = logs_of(source)
    outs = places(out, form, logs, force=force)
    application = Application(run)
    told: dict[str, Any] = {
        "cameras": replace(cameras, stop=until),
        "live": live,
        "loop": loop,
        "salvage": salvage,
    }
    rows: list[dict[str, Any]] = []
    failed: list[CdmisfaError] = []
    with stoppable() as stop:
        for log, place in zip(logs, outs, strict=True):
            row: dict[str, Any] = {"log": log, "out": None if place is None else str(place)}
            try:
                with contextlib.closing(application.open([log], say=tell, **told)) as opened:
                    say_about(opened)
                    tally = applied(application, opened, place, frames, stop, force=force)
                    say_changes(opened)
            except CdmisfaError as error:
                if len(logs) == 1:
                    raise
                warn(str(error))
                failed.append(error)
                rows.append(row | {"out": None, "frames": 0, "error": str(error), "modules": []})
                continue
            rows.append(row | {"frames": tally.frames, "error": None, "modules": tally.rows()})
            if tally.damaged is not None:
                tell(f"{tally.damaged}: what came before was applied, and is kept")
                failed.append(tally.damaged)
                rows[-1]["error"] = str(tally.damaged)
            if stop.number:
                break
    print_applied(str(run), rows, as_json=as_json)
    if stop.number:
        ctx.exit(stop.exit_code)
    if failed:
        ctx.exit(max(error.exit_code for error in failed))


def applied(
    application: Application,
    source: FrameSource,
    place: Path | None,
    frames: int | None,
    stop: Stop,
    *,
    force: bool,
) -> Tally:
    """Apply modules to an open source, into its file."""
    from cdmisfa.experiments.applying import Tally, follow, written

    if hasattr(source, "stop"):
        source.stop = stop
    modules, spec = application.modules, source.spec
    tally = Tally(spec, modules)
    with bar("applying", "frames") as shown, contextlib.ExitStack() as stack:
        sink = None
        if place is not None:
            sink = stack.enter_context(written(place, spec, modules, force=force))
        blocks = application.to(source, frames, stop)
        total = None if spec.length is None else spec.length * len(spec.streams)
        follow(blocks, sink, tally, lambda: shown.update(tally.frames, total))
    return tally


def targets(ctx: click.Context, words: Sequence[str]) -> tuple[str | None, float | None]:
    """The form and the time that --to names, each at most once."""
    form: str | None = None
    until: float | None = None
    for word in words:
        if word in OF_FILES:
            form = word
        elif word[:1].isdigit():
            until = WRITTEN[TIME].convert(word, None, ctx)
        else:
            raise UsageError(f"--to {word}: name {', '.join(OF_FILES)}, or a time, as 1:30")
    return form, until


def logs_of(source: Sequence[str]) -> list[str]:
    """The logs that words name, a pattern as what matches it."""
    from recorder.cameras.words import is_live
    from recorder.world.scenes import SCENES
    from replay.inputs import locations
    from replay.storage.location import Url

    found: list[str] = []
    for word in source:
        if is_live(word) or word in SCENES:
            found.append(word)
        else:
            places = locations([word])
            found += [place.address if isinstance(place, Url) else str(place) for place in places]
    return found


def print_applied(run: str, rows: Sequence[dict[str, Any]], *, as_json: bool) -> None:
    """Print what modules came to on each log."""
    if as_json:
        print_document(run=run, logs=rows)
        return
    for row in rows:
        if not row["modules"]:
            continue
        print_line(f"{row['log']}: {row['frames']} frames")
        cells = [
            (
                one["stream"],
                one["module"],
                "-" if one["slowness"] is None else f"{one['slowness']:.4f}",
                f"{one['alive']:.0%}",
                f"{one['known']:.0%}",
            )
            for one in row["modules"]
        ]
        print_table(("stream", "module", "slowness", "alive", "known"), cells)
        if row["out"] is not None:
            print_line(f"outputs {row['out']}")
