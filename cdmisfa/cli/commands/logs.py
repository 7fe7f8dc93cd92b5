"""Commands on what is there: logs, recordings, runs, and what can be made of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cdmisfa.cli import options
from cdmisfa.cli.printing import (
    print_document,
    print_json,
    print_line,
    print_table,
    print_text,
    quoted,
    say_about,
    tell,
)
from cdmisfa.core.errors import LogDamagedError, NotReproducedError

if TYPE_CHECKING:
    from replay.runs.compare import Row


@click.command("verify")
@click.argument("path", nargs=-1, required=True, type=options.WORD)
@options.as_json
@click.pass_context
def verify_command(ctx: click.Context, path: tuple[str, ...], as_json: bool) -> None:
    """Check that a log is whole: structure, checksums, nothing lost.

    Of a camera log without checksums every image is decoded. PATH may be several, a pattern such
    as 'logs/*.mcap', or a URL. Exits with 3 when anything is wrong, else with 2 when one of
    several is no log.
    """
    from replay.integrity.report import EXIT_CODES
    from replay.integrity.verify import check_logs

    found = check_logs(*path)
    if as_json:
        print_json(found.check_json())
    else:
        if found.problems:
            print_table(("where", "what"), [(p.where, p.what) for p in found.problems])
        print_line(f"{' '.join(path)}: {found.state}")
        for note in found.notes:
            print_line(note)
    ctx.exit(EXIT_CODES[found.state])


@click.command("recover")
@click.argument("path", type=options.WORD)
@options.out("The whole log to write.", required=True)
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
            tell(f"{mended.where}: {mended.what}")
        print_line(f"written {out}")
    if not found.complete:
        ctx.exit(LogDamagedError.exit_code)


@click.command("compare")
@options.log_argument("runs", nargs=-1)
@options.path("--save", "F.rrd", "Also write their curves, one over the other, as a view.")
@options.force
@options.as_json
@click.pass_context
def compare_command(
    ctx: click.Context, runs: tuple[Path, ...], save: Path | None, force: bool, as_json: bool
) -> None:
    """Check that runs' signals are the same bits, and show their curves.

    Of two runs it says whether they came to the same, where they first differ, in which signals
    there, and what they were told or computed otherwise, and exits with 4 if they do. Of more it
    prints a table, each run compared with the first, and exits with 0. A run may be the URL of
    its run.mcap, of which a copy is made.
    """
    if len(runs) < 2:
        raise click.UsageError("name two runs, or more")
    from replay.runs.compare import side_by_side

    rows = side_by_side(runs)
    if save is not None:
        from replay.view.overlay import build_overlay  # takes half a second

        build_overlay(runs, rows, save, force=force)
    different = [row.difference for row in rows if row.difference is not None]
    if as_json:
        print_document(
            identical=not different,
            first_difference=different[0].as_json() if different else None,
            signals=different[0].signals if different and len(runs) == 2 else {},
            runs=[row.as_json() for row in rows],
            view=save,
        )
    else:
        _print_comparison(rows)
    if save is not None and not as_json:
        tell(f"view {save}    look at it: cdmisfa view {quoted(save)}")
    if different and len(runs) == 2:
        ctx.exit(NotReproducedError.exit_code)


def _print_comparison(rows: Sequence[Row]) -> None:
    """Print the outcome of each run, and where two runs differ."""
    from replay.runs.compare import HEAD, differing_outcomes

    one, *others = rows
    if len(others) > 1:
        print_table(HEAD, [row.cells() for row in rows])
    else:
        (other,) = others
        both = one.name, other.name
        print_line(other.verdict)
        if outcomes := differing_outcomes(one.outline, other.outline):
            print_table(("", *both), outcomes)
        if other.difference is not None:
            print_line(f"first difference: {other.difference}")
    for explanation in filter(None, (row.explanation() for row in rows)):
        print_text(explanation)
    if len(others) == 1 and other.difference and other.difference.signal:
        print_line(f"signals of iteration {other.difference.iteration} that differ:")
        print_table(("signal", *both), other.difference.differing_signals())


@click.command("export")
@options.log_argument("path", nargs=-1)
@click.option(
    "--to",
    "form",
    metavar="FORM",
    help="Form: parquet, npz, csv, images, mp4, lerobot; by default what the file's name ends in.",
)
@options.out("The file to write, for a recording the folder.", required=True)
@click.option("--lossless", is_flag=True, help="Keep every value of images in a video.")
@click.option(
    "--task", metavar="TEXT", help="What is done in a LeRobot dataset; by default what a log says."
)
@options.look_options
@options.force
@options.as_json
def export_command(
    path: tuple[Path, ...],
    form: str | None,
    out: Path,
    force: bool,
    as_json: bool,
    **chosen: Any,
) -> None:
    """Write a run's signals as a table or arrays, a recording as images, videos or a dataset.

    Signals go to one file, Parquet, CSV or NumPy's npz. CSV has no room for the
    outputs frame by frame (y, y_frozen) and leaves them out. A recording goes to a folder:
    PNG files, an MP4 file per view (of one view also to a file), or a LeRobot dataset v3.0. So do
    camera logs of others, several at once, too, and numbers in them with --field. Folders of
    several recordings become episodes of one dataset.
    """
    from replay.export.forms import export
    from replay.export.tables import CSV_LEAVES_OUT, TABLES

    if str(out) == "-":
        raise click.UsageError("-o - would be a file of this name: name another")
    form = form or out.suffix.removeprefix(".")
    rows = export(path, out, form, force=force, about=say_about, **chosen)
    if form == "csv":
        left_out = " and ".join(CSV_LEAVES_OUT)
        tell(f"CSV leaves out {left_out}: Parquet and npz hold them")
    if form in ("mp4", "lerobot") and not chosen["lossless"] and _is_film(out):
        tell("H.264 changes pixels a little: --lossless keeps them all")
    if as_json:
        print_document(path=" ".join(map(str, path)), file=str(out), rows=rows)
        return
    unit = "iterations" if form in TABLES else "images" if form == "images" else "frames"
    print_line(f"{rows} {unit} written to {out}")


def _is_film(out: Path) -> bool:
    """Whether there is a video in what was exported: a dataset of numbers has none."""
    return out.is_file() or next(out.rglob("*.mp4"), None) is not None


@click.command("signals")
@click.option("--markdown", is_flag=True, help="Print the page docs/reference/signals.md.")
@options.as_json
def signals_command(markdown: bool, as_json: bool) -> None:
    """List every signal that a run records.

    Of each there is more with --json and --markdown: its type, and how it is shown.
    """
    from cdmisfa.core.signals import SCHEMA_VERSION, SIGNALS

    signals = [dataclasses.asdict(signal) for signal in SIGNALS.values()]
    if as_json:
        print_document(signals_version=SCHEMA_VERSION, signals=signals)
        return
    more = ("dtype", "show") if markdown else ()
    columns = ("name", "symbol", "equation", "unit", "dims", *more, "about")
    rows = [[signal[column] for column in columns] for signal in signals]
    if markdown:
        print_text(_page(SCHEMA_VERSION, columns, rows))
    else:
        print_table(columns, rows)


def _page(version: int, columns: tuple[str, ...], rows: list[list[Any]]) -> str:
    from cdmisfa.experiments.documents import markdown

    return "\n".join(
        [
            "# Signals",
            "",
            "Made by `cdmisfa signals --markdown`; a test fails when page and code differ.",
            f"Version {version} of the record. One record is one iteration, that is one block of",
            "T = `learner.tau` frames. A signal that does not exist in an iteration is NaN.",
            "",
            "Letters of `dims`: T frames of the block, J outputs of an abstraction, M frozen",
            "modules, S streams, A actions (stay, switch); nothing is a scalar. `equation` is the",
            "paper's number. `show` is how the viewer shows it.",
            "",
            markdown(columns, [[f"`{row[0]}`", *row[1:]] for row in rows]),
        ]
    )
