"""`cdmisfa sweep`, `results`, `reproduce` and `demo`: many trials, and the whole story."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from cdmisfa.cli import options
from cdmisfa.cli.printing import (
    print_document,
    print_json,
    print_line,
    print_table,
    print_text,
    quoted,
    say_failed,
    tell,
)
from cdmisfa.cli.progress import Bar, bar

MOST_SEEDS = 1_000_000


@click.command("sweep")
@click.argument("source", nargs=-1, required=True, type=options.WORD)
@options.out("Folder of the sweep; what is finished in it is not computed again.", required=True)
@click.option(
    "--grid",
    metavar="KEY=V1,V2,...",
    multiple=True,
    help="Values to try for a configuration key; several grids multiply.",
)
@click.option(
    "--seeds",
    metavar="FIRST:END",
    default="0:20",
    show_default=True,
    help="Seeds of every point: a range without its end, or numbers with commas, as 1,5,9.",
)
@options.preset
@options.settings()
@options.end_after("iterations", "End each trial after so many iterations.")
@options.end_after("modules", "End each trial after so many modules.")
@options.loop
@options.input_options()
@options.jobs
@options.scheduler
@options.retry_failed
@options.as_json
@options.quiet
@click.pass_context
def sweep_command(
    ctx: click.Context,
    /,
    source: tuple[str, ...],
    out: Path,
    grid: tuple[str, ...],
    seeds: str,
    as_json: bool,
    **how: Any,
) -> None:
    """Learn from a source many times, over a grid of settings and seeds.

    SOURCE is what learn takes, but for live streams: record these first. A sweep that was
    stopped is resumed when it is asked for again. Look at what it found with: cdmisfa results DIR
    """
    from cdmisfa.experiments.sweep import sweep

    values, numbers = parse_grid(grid), parse_seeds(seeds)
    with bar("sweep", "trials") as shown:

        def progress(finished: int, failed: int, total: int) -> None:
            shown.update(finished, total, f"{failed} failed" if failed else "")

        try:
            report = sweep(source, out, grid=values, seeds=numbers, progress=progress, **how)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                f"{out} keeps the trials that are finished: say the same again to go on"
            ) from None
    failed = [{key: row[key] for key in ("id", "point", "seed", "error")} for row in report.failed]
    if as_json:
        counts = ("trials", "skipped", "computed")
        each = {name: getattr(report, name) for name in counts}
        print_document(sweep=report.folder, **each, failed=failed)
    else:
        print_line(
            f"{report.trials} trials: {report.computed} computed, {report.skipped} finished "
            f"before, {len(failed)} failed"
        )
        say_failed(failed)
        print_line(f"look at it: cdmisfa results {quoted(out)}")
    if failed:
        ctx.exit(1)


def parse_grid(words: tuple[str, ...]) -> dict[str, list[str]]:
    """`KEY=V1,V2` words as values by key."""
    grid: dict[str, list[str]] = {}
    for each in words:
        key, equals, values = each.partition("=")
        found = [value.strip() for value in values.split(",") if value.strip()]
        if not (equals and key.strip() and found):
            raise click.UsageError(f"--grid {each}: write it as section.key=value,value")
        if key.strip() in grid:
            raise click.UsageError(f"--grid {key.strip()} is given twice: put all values in one")
        grid[key.strip()] = found
    return grid


def parse_seeds(text: str) -> list[int]:
    """`0:20` (without 20), `3`, or `1,5,9:12` as seeds."""
    seeds: list[int] = []
    try:
        for part in text.split(","):
            first, colon, end = part.partition(":")
            span = range(int(first), int(end) if colon else int(first) + 1)
            if not span or span[0] < 0 or len(seeds) + len(span) > MOST_SEEDS:
                raise ValueError
            seeds.extend(span)
    except ValueError:
        raise click.UsageError(f"--seeds {text}: write it as 0:20 or 1,5,9") from None
    if twice := [seed for seed, times in Counter(seeds).items() if times > 1]:
        raise click.UsageError(f"--seeds {text}: {twice[0]} stands there twice")
    return seeds


@click.command("results")
@options.path_argument("folder")
@click.option("--csv", is_flag=True, help="Print comma-separated values.")
@options.as_json
def results_command(folder: Path, csv: bool, as_json: bool) -> None:
    """Print mean and standard deviation over seeds at each point of a sweep.

    FOLDER is that of the sweep, the trials are those that it was asked for last.
    """
    from cdmisfa.experiments import results

    if csv and as_json:
        raise click.UsageError("choose one of --csv and --json")
    points = results.results(folder)
    for key, values in results.varied(points).items():
        tell(f"{key} differs: {', '.join(map(str, values))}")
    if as_json:
        print_json(results.as_json(points))
    elif csv:
        print_text(results.as_csv(points))
    else:
        print_table(*results.as_table(points))


@click.command("reproduce")
@click.argument("name")
@options.out("Folder of the results [default: reproduction].")
@click.option(
    "--trials", type=click.IntRange(1), help="Trials per condition, instead of the paper's number."
)
@options.jobs
@options.scheduler
@options.path("--recording", "DIR", "Recording of the iCub scene.")
@click.option("--quick", is_flag=True, help="Few trials, enough to test the claim.")
@options.as_json
@options.quiet
def reproduce_command(
    name: str, out: Path | None, recording: Path | None, as_json: bool, **how: Any
) -> None:
    """Reproduce an experiment of the paper: numbers, tables and figures.

    NAME is oscillatory, five, stability, nonstationary, icub or all. Finished trials are kept and
    not run again. Exit code 4 says that a claim of the paper did not come out.
    """
    from cdmisfa.studies.paper.reproduce import (
        EXPERIMENTS,
        check_claims,
        markdown_tables,
        reproduce,
    )

    root, documents = out or Path("reproduction"), []
    for each in EXPERIMENTS if name == "all" else (name,):
        if each == "icub" and recording is None:
            tell(f"{each}: records the scene into {root}/icub-recording, unless it is there")
        with bar(each, "trials") as shown:
            document = reproduce(
                each, root / each, recording=recording, progress=shown.update, **how
            )
        documents.append(document)
    if as_json:
        print_document(experiments=documents)
    else:
        print_text("\n".join(f"{d['title']}\n\n{markdown_tables(d)}" for d in documents))
    for document in documents:
        check_claims(document)


@click.command("demo")
@options.out("Folder of the recordings and runs; by default the one you are in.")
@options.seed()
@click.option(
    "--frames", type=click.IntRange(400), show_default=True, default=8000, help="Frames a view."
)
@options.jobs
@options.as_json
@options.quiet
def demo_command(out: Path | None, as_json: bool, **how: Any) -> None:
    """Record, learn, check and show: the whole story in minutes.

    It replaces the results of an earlier demo in the same folder. Without PyBullet, which has
    wheels for Python 3.11 and older, it records the scene oscillatory instead of icub.
    """
    from cdmisfa.studies.demo import demo

    report = demo(out or Path(), stage=_stage, **how)
    if as_json:
        print_json(report)
        return
    head = ("module", "view", "policy", "iteration", "follows", "correlation")
    told = {"policy": " ".join, "correlation": "{:.3f}".format}
    rows = [[told.get(key, str)(module[key]) for key in head] for module in report["modules"]]
    print_table(head, rows)
    print_line()
    print_line(f"report     {report['report'].resolve().as_uri()}")
    print_line(f"look at it {quoted(sys.argv[0])} view {quoted(report['run'])}")


@contextmanager
def _stage(title: str, unit: str) -> Iterator[Bar]:
    """Announce a stage and say how long it took, also where nobody sees a bar."""
    start = time.monotonic()
    tell(title)
    with bar("", unit) as shown:
        yield shown
    tell(f"    {time.monotonic() - start:.0f} s")
