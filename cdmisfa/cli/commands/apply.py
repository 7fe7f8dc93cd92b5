"""`cdmisfa apply`: frozen modules over other logs."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cdmisfa.cli import options
from cdmisfa.cli.interrupts import Stop, stoppable
from cdmisfa.cli.printing import (
    print_document,
    print_line,
    print_table,
    say_about,
    say_changes,
    say_counts,
    tell,
    warn,
)
from cdmisfa.cli.progress import bar
from cdmisfa.core.errors import CdmisfaError, UsageError
from cdmisfa.core.names import counted
from recorder.images.options import InputOptions

if TYPE_CHECKING:
    from cdmisfa.core.blocks import FrameSource
    from cdmisfa.experiments.apply import Application, Totals
    from recorder.images.options import InputOptions

MOST_SAID = 20
"""Logs of which is said what went wrong."""

FILE_FORMS = ("parquet", "csv", "mcap", "rrd")
STDOUT = "stdout"


@click.command("apply")
@options.path_argument("run")
@click.argument("source", nargs=-1, required=True, type=options.WORD)
@options.out(
    "The file of one log, .parquet, .csv, .mcap or .rrd (a view); or a folder, of a file a log."
)
@click.option(
    "--to",
    type=click.Choice([*FILE_FORMS, STDOUT]),
    help=f"Format of the files in a folder, by default {FILE_FORMS[0]}; or {STDOUT}: print each "
    "block as a JSON line as soon as it is complete.",
)
@click.option("--frames", type=click.IntRange(1), help="End after so many frames of each stream.")
@options.loop
@options.salvage
@options.input_options("topics", "fields", "rate", "start", "end", "align", keys=True)
@options.jobs
@options.scheduler
@options.retry_failed
@options.force
@options.as_json
@options.quiet
@click.pass_context
def apply_command(
    ctx: click.Context,
    /,
    run: Path,
    source: tuple[str, ...],
    out: Path | None,
    to: str | None,
    frames: int | None,
    loop: bool,
    salvage: bool,
    inputs: InputOptions,
    force: bool,
    as_json: bool,
    **where: Any,
) -> None:
    """Apply the modules of a run to other logs.

    SOURCE is what cdmisfa learn takes: recordings, logs of others, a scene, live streams. Each log
    is by itself, live streams are on one clock; pictures of any size become frames as those of the
    run did. A row a frame has the outputs of each module, their slowness within the block, whether
    the module is alive there, and how novel the block is: from 1 on the module does not know it.

    With a folder as -o, SOURCE is also a folder with many logs, or an index of them: OUT gets a
    file a log, which together are one table. The same command does what is missing.

    A log that cannot be read does not end the rest; the exit code is then 3, or 2.
    """
    from cdmisfa.experiments.apply import Application

    form, lines = None if to == STDOUT else to, to == STDOUT
    refuse_unfit(source, again=loop or salvage, lines=lines, as_json=as_json)
    if out is not None and is_folder(out) and are_logs(source):
        if lines:
            raise UsageError("--to stdout is for what is applied at once: leave out -o FOLDER")
        where |= {"form": form or FILE_FORMS[0], "inputs": inputs, "force": force}
        where |= {"frames": frames, "loop": loop, "salvage": salvage}
        _apply_to_many(ctx, run, source, out, as_json=as_json, **where)
        return
    typed = click.core.ParameterSource.COMMANDLINE
    if given := [name for name in where if ctx.get_parameter_source(name) == typed]:
        raise UsageError(f"--{given[0].replace('_', '-')} goes with logs, and a folder as -o")
    if form is not None and (out is None or out.suffix != f".{form}"):
        raise UsageError(f"--to {form}: name it with -o, a folder or a file like out.{form}")
    logs = logs_of(source)
    place = place_of(out, logs, force=force)
    application = Application(run)
    told: dict[str, Any] = {"inputs": inputs, "loop": loop, "salvage": salvage, "say": tell}
    rows, failed = list[dict[str, Any]](), list[CdmisfaError]()
    with stoppable() as stop:
        for words in logs:
            row: dict[str, Any] = {"log": " ".join(words), "out": place and str(place)}
            try:
                with contextlib.closing(application.open(words, **told)) as opened:
                    totals = applied(
                        application, opened, place, frames, stop, lines=lines, force=force
                    )
            except CdmisfaError as error:
                if len(logs) == 1:
                    raise
                warn(str(error))
                failed.append(error)
                rows.append(row | {"out": None, "frames": 0, "error": str(error), "modules": []})
                continue
            rows.append(row | {"frames": totals.frames, "error": None, "modules": totals.rows()})
            if (damaged := totals.damaged) is not None:
                tell(f"{damaged}: what came before was applied, and is kept")
                failed.append(damaged)
                rows[-1]["error"] = str(damaged)
            if stop.number:
                break
    if not lines:
        print_applied(str(run), rows, as_json=as_json)
    if stop.number:
        ctx.exit(stop.exit_code)
    if failed:
        ctx.exit(max(error.exit_code for error in failed))


def _apply_to_many(
    ctx: click.Context, run: Path, source: Sequence[str], out: Path, *, as_json: bool, **how: Any
) -> None:
    """Apply modules to each of many logs, into a folder, and print what became of them."""
    from cdmisfa.experiments.apply_logs import apply_to_logs

    calls = itertools.count()
    with bar("indexing", "logs") as shown:

        def progress(finished: int, failed: int, total: int) -> None:
            if next(calls) == 0:
                shown.turn_to("applying", "logs")
            shown.update(finished, total, f"{failed} failed" if failed else "")

        try:
            found = apply_to_logs(run, source, out, **how, indexing=shown.update, progress=progress)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                f"{out} keeps the outputs that are finished: say the same again to go on"
            ) from None
    said = (f"{row['log']}: {line}" for row in found.logs for line in row["warnings"])
    for line in itertools.islice(said, MOST_SAID):
        warn(line)
    if as_json:
        counts = {name: getattr(found, name) for name in ("computed", "skipped")}
        rows = [{k: v for k, v in row.items() if k != "exit_code"} for row in found.logs]
        print_document(run=run, out=found.out, **counts, logs=rows)
    else:
        print_line(
            f"{counted(len(found.logs), 'log')}: {found.computed} tried now, "
            f"{found.skipped} before; of these {len(found.failed)} failed, or ended early"
        )
        for row in found.failed[:MOST_SAID]:
            print_line(f"failed: {row['log']}: {row['error']}")
        if (more := len(found.failed) - MOST_SAID) > 0:
            print_line(f"failed: {more} more, which --json lists")
        print_line(f"outputs {out}")
    if found.exit_code:
        ctx.exit(found.exit_code)


def refuse_unfit(source: Sequence[str], *, again: bool, lines: bool, as_json: bool) -> None:
    """Refuse options that do not go with the source, or with one another.

    Raises:
        UsageError: some are given.
    """
    from recorder.cameras.words import is_live

    if lines and as_json:
        raise UsageError("--to stdout prints JSON lines, --json one document: use one of them")
    if again and any(map(is_live, source)):
        raise UsageError("live streams cannot go back: leave out --loop and --salvage")


def applied(
    application: Application,
    source: FrameSource,
    place: Path | None,
    frames: int | None,
    stop: Stop,
    *,
    lines: bool,
    force: bool,
) -> Totals:
    """Apply modules to an open source, into its file and to where blocks go as they come."""
    from cdmisfa.experiments.apply import Totals, follow
    from cdmisfa.experiments.apply_logs import written_to
    from replay.export.applied import line

    live = hasattr(source, "stop")
    if hasattr(source, "stop"):
        source.stop = stop  # waiting for frames ends with a signal, too
    else:
        say_about(source)
    modules, spec = application.modules, source.spec
    totals, sinks = Totals(spec, modules), []
    with bar("applying", "frames") as shown, contextlib.ExitStack() as stack:
        if place is not None:
            sinks.append(stack.enter_context(written_to(place, spec, modules, force=force)))
        if lines:
            sinks.append(lambda block: print_line(line(block, spec, modules)))
        blocks = stack.enter_context(contextlib.closing(application.to(source, frames, stop)))
        total = None if spec.length is None else spec.length * len(spec.streams)
        follow(blocks, sinks, totals, lambda: shown.update(totals.frames, total))
    if live:
        say_counts(source)
    else:
        say_changes(source)
    return totals


def place_of(out: Path | None, logs: Sequence[Sequence[str]], *, force: bool) -> Path | None:
    """Return the file that is written of one log; None where nothing is.

    Raises:
        UsageError: a file for several logs, or it exists.
    """
    from recorder.log.files import refuse_taken

    if out is None:
        return None
    ending = out.suffix.lower().removeprefix(".")
    if is_folder(out):
        raise UsageError(f"{out}: name a file, {' '.join(logs[0])} is none of many logs")
    if len(logs) > 1:
        raise UsageError(
            f"{len(logs)} logs are a file each: name a folder with -o, without .{ending}"
        )
    refuse_taken(out, force=force)
    return out


def is_folder(out: Path) -> bool:
    """Whether what is written is a folder, by its name.

    Raises:
        UsageError: it has the ending of something else.
    """
    ending = out.suffix.lower().removeprefix(".")
    if out.is_dir() or not ending:
        return True
    if ending not in FILE_FORMS:
        endings = ", ".join(f".{one}" for one in FILE_FORMS)
        raise UsageError(f"{out}: name a file with {endings}, or a folder without an ending")
    return False


def are_logs(source: Sequence[str]) -> bool:
    """Whether all of a source is stored."""
    from recorder.cameras.words import is_live
    from recorder.world.scenes import SCENES

    return not any(is_live(word) or word in SCENES for word in source)


def logs_of(source: Sequence[str]) -> list[list[str]]:
    """The words of each log, of a pattern those that match it; live streams are together.

    Of a corpus they are those of each log in its index.
    """
    from recorder.cameras.words import is_live
    from recorder.world.scenes import SCENES
    from replay.corpus.finding import may_be_corpus
    from replay.inputs import locations

    if any(map(is_live, source)):
        return [list(source)]
    found: list[list[str]] = []
    for word in source:
        if word in SCENES:
            found.append([word])
            continue
        logs: Sequence[Sequence[Path]] | None = None
        if may_be_corpus([word]):
            from replay.corpus.logs import logs_of_corpus

            logs = logs_of_corpus([word])
        for log in logs or [[place] for place in locations([word])]:
            found.append(list(map(str, log)))
    return found


def print_applied(run: str, rows: Sequence[dict[str, Any]], *, as_json: bool) -> None:
    """Print what modules came to on each log."""
    if as_json:
        print_document(run=run, logs=rows)
        return
    for row in rows:
        if not row["modules"]:
            continue
        print_line(f"{row['log']}: {counted(row['frames'], 'frame')}")
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
