"""`cdmisfa apply`: compute the outputs of a run's modules on other logs or live streams."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cdmisfa.cli import options, printing
from cdmisfa.cli.progress import bar, resumable_bar
from cdmisfa.core.errors import UsageError
from cdmisfa.core.interrupts import Stop, stoppable
from cdmisfa.core.names import counted

if TYPE_CHECKING:
    from cdmisfa.core.blocks import FrameSource
    from cdmisfa.experiments.apply import Application, Totals
    from cdmisfa.experiments.apply_logs import AppliedLogs

# Largest number of warnings and of failed logs that are printed, to keep the summary on one screen.
MOST_LINES = 20

FILE_FORMS = ("parquet", "csv", "mcap", "rrd")
STDOUT = "stdout"


@options.command("apply")
@click.argument("run", type=options.LOCAL)
@click.argument("source", nargs=-1, required=True, type=options.WORD)
@options.output(
    "File to write for one log: .parquet, .csv, .mcap or .rrd (a view). Or the folder to write "
    "into, one file for each log. [default: print a summary only]"
)
@options.option("--to FORMAT", type=click.Choice([*FILE_FORMS, STDOUT]))
@options.option("--frames N")
@options.loop
@options.skip_damaged
@options.inputs("topics", "fields", "rate", "start", "end", "align", "settings")
@options.jobs
@options.scheduler
@options.retry_failed
@options.force
@options.as_json
@options.quiet
def apply_command(
    run: Path,
    source: tuple[str, ...],
    output: Path | None,
    to: str | None,
    frames: int | None,
    jobs: int,
    scheduler: str | None,
    retry_failed: bool,
    force: bool,
    as_json: bool,
    **arguments: Any,
) -> int:
    """Compute learned features on other logs or cameras.

    For each frame, the result has the outputs of every module of RUN (a module is a learned slow
    feature). For each block of frames it has their slowness, whether the module responds as on
    the frames that it learned from (alive), and the novelty: above 1 the block is unknown to the
    module.

    With a folder as -o, SOURCE may be a folder with many logs; each log gets its own file. Run the
    same command again to resume. Logs that cannot be read are skipped; the exit code is then 2 or
    3.

    RUN is:
        {run}

    SOURCE is one of:
        {scene}
        {recording}
        {logs}
        {url}
        {index}
        {live}

    Options:
        --topic TOPIC: Read this topic of a log, or all that match a pattern such as '/cam*'; each
            becomes a stream. Repeatable. [default: all with images]
        --to FORMAT: Format of the files in the folder -o: parquet, csv, mcap or rrd. stdout writes
            no file: it prints a JSON line for each block as soon as the block is complete.
            [default: parquet]
        --frames N: Stop after this number of frames of each stream. [default: all]

    Examples:
        cdmisfa apply runs/kitchen today.mcap -o features.parquet
        cdmisfa apply runs/kitchen logs -o features --jobs 4
        cdmisfa apply runs/kitchen camera:/dev/video0 --to stdout
    """
    from recorder.cameras.words import is_live
    from recorder.log.files import refuse_taken
    from recorder.world.scenes import SCENES

    ending = "" if output is None else output.suffix.lower().removeprefix(".")
    is_stored = not any(is_live(word) or word in SCENES for word in source)
    if output is not None and is_stored and to != STDOUT and (output.is_dir() or not ending):
        from cdmisfa.experiments.apply_logs import apply_to_logs

        with resumable_bar(output, "applying", "logs") as progress_bar:
            applied = apply_to_logs(
                run,
                source,
                output,
                form=to or FILE_FORMS[0],
                frames=frames,
                jobs=jobs,
                scheduler=scheduler,
                retry_failed=retry_failed,
                force=force,
                indexing=progress_bar.update,
                progress=progress_bar.trials,
                **arguments,
            )
        _print_applied_logs(run, applied, as_json)
        return applied.exit_code
    logs = _logs(source)
    if output is None and to not in (None, STDOUT):
        raise UsageError(f"--to {to} needs a folder or file to write: name it with -o")
    if output is not None:
        if ending not in FILE_FORMS:
            endings = ", ".join(f".{form}" for form in FILE_FORMS)
            raise UsageError(f"-o {output} is no supported file: choose one of {endings}")
        if to not in (None, STDOUT, ending):
            raise UsageError(f"-o {output} is no {to} file: leave out --to, or change the ending")
        if len(logs) > 1:
            raise UsageError(f"-o {output} is one file, for {len(logs)} logs: name a folder")
        refuse_taken(output, force=force)
    return _apply_to_each(run, logs, output, frames, to == STDOUT, as_json, **arguments)


def _logs(source: Sequence[str]) -> list[list[str]]:
    """Return the words of each log: patterns and indexed folders name several.

    Live streams form one log.
    """
    from recorder.cameras.words import is_live
    from recorder.world.scenes import SCENES
    from replay.corpus.index import logs_of_corpus
    from replay.open_sources import locations

    if any(map(is_live, source)):
        return [list(source)]
    logs: list[list[str]] = []
    for word in source:
        if word in SCENES:
            logs.append([word])
        else:
            paths = logs_of_corpus([word]) or [[path] for path in locations([word])]
            logs += [list(map(str, log)) for log in paths]
    return logs


def _apply_to_each(
    run: Path,
    logs: Sequence[Sequence[str]],
    output: Path | None,
    frames: int | None,
    as_lines: bool,
    as_json: bool,
    **arguments: Any,
) -> int:
    """Apply modules to each log, print the results, and return the exit code.

    Further arguments go to `Application.open`.
    """
    from cdmisfa.experiments.apply import Application
    from cdmisfa.experiments.documents import about_source

    application = Application(run)
    rows: list[dict[str, Any]] = []
    code = 0
    with stoppable() as stop:
        for words in logs:
            opened = application.open(words, say=printing.status, **arguments)
            with contextlib.closing(opened) as source:
                totals = _apply(application, source, output, frames, stop, as_lines)
            error = None if totals.damaged is None else str(totals.damaged)
            if totals.damaged is not None:
                printing.status(f"{error}: the outputs before the damage are written")
                code = totals.damaged.exit_code
            row: dict[str, Any] = {"log": " ".join(words), "out": output and str(output)}
            row |= {"frames": totals.frames, "error": error, **about_source(source)}
            rows.append({**row, "modules": totals.rows()})
            if stop():
                break
    if as_json and not as_lines:
        printing.document(run=str(run), logs=rows)
    elif not as_lines:
        _print_rows(rows)
    return stop.exit_code if stop() else code


def _apply(
    application: Application,
    source: FrameSource,
    output: Path | None,
    frames: int | None,
    stop: Stop,
    as_lines: bool,
) -> Totals:
    """Apply modules to an open source; write the outputs to a file, and to stdout as lines."""
    from cdmisfa.experiments.apply import Totals, follow
    from cdmisfa.experiments.apply_logs import written_to
    from replay.export.applied import json_line

    if hasattr(source, "stop"):
        source.stop = stop  # so that a signal also ends waiting for frames
    else:
        printing.source(source)
    modules, spec = application.modules, source.spec
    totals, sinks = Totals(spec, modules), []
    with bar("applying", "frames") as progress_bar, contextlib.ExitStack() as stack:
        if output is not None:
            sinks.append(stack.enter_context(written_to(output, spec, modules)))
        if as_lines:
            sinks.append(lambda block: printing.line(json_line(block, spec, modules)))
        blocks = stack.enter_context(contextlib.closing(application.to(source, frames, stop)))
        total = None if spec.length is None else spec.length * len(spec.streams)
        follow(blocks, sinks, totals, lambda: progress_bar.update(totals.frames, total))
    printing.source_changes(source)
    return totals


def _print_rows(rows: Sequence[dict[str, Any]]) -> None:
    """Print a table for each log: how each module responds to the frames of each stream."""
    for row in rows:
        if not row["modules"]:
            continue
        warned = f", {counted(len(row['warnings']), 'warning')}" if row["warnings"] else ""
        printing.line(f"{row['log']}: {counted(row['frames'], 'frame')} in all streams{warned}")
        cells = []
        for module in row["modules"]:
            values = zip((".4f", ".0%", ".0%"), ("slowness", "alive", "explained"), strict=True)
            texts = ["-" if module[k] is None else format(module[k], form) for form, k in values]
            cells.append((module["stream"], module["module"], *texts))
        printing.table(("stream", "module", "slowness", "alive", "explained"), cells)
        if row["out"] is not None:
            printing.line(f"outputs written to {row['out']}")


def _print_applied_logs(run: Path, applied: AppliedLogs, as_json: bool) -> None:
    """Print the outcome of applying modules to many logs."""
    warnings = [f"{row['log']}: {text}" for row in applied.logs for text in row["warnings"]]
    for warning in warnings[:MOST_LINES]:
        printing.warning(warning)
    if as_json:
        rows = [{k: v for k, v in row.items() if k != "exit_code"} for row in applied.logs]
        counts = {"computed": applied.computed, "skipped": applied.skipped}
        printing.document(run=run, out=applied.out, **counts, logs=rows)
        return
    incomplete = sum(row["out"] is not None for row in applied.failed)
    warned = sum(bool(row["warnings"]) for row in applied.logs)
    printing.line(
        f"{counted(len(applied.logs), 'log')}: {applied.computed} processed now, "
        f"{applied.skipped} processed before; of all, {len(applied.failed) - incomplete} failed, "
        f"{incomplete} incomplete, {warned} with warnings"
    )
    for row in applied.failed[:MOST_LINES]:
        printing.line(f"failed: {row['log']}: {row['error']}")
    if (more := len(applied.failed) - MOST_LINES) > 0:
        printing.line(f"{more} more failed: list all with --json")
    printing.line(f"outputs written to {applied.out}")
