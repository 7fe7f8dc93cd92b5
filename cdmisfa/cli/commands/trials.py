"""`cdmisfa sweep`, `reproduce` and `demo`: many trials, and complete examples."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from cdmisfa.cli import options, printing
from cdmisfa.cli.progress import Bar, bar, resumable_bar
from cdmisfa.core.errors import CdmisfaError

if TYPE_CHECKING:
    from cdmisfa.core.blocks import FrameSource

# Number of seeds of a sweep, so that a typing error does not fill the memory.
MOST_SEEDS = 1_000_000


@options.command("sweep")
@click.argument("source", nargs=-1, required=True, type=options.WORD)
@options.output(
    "Folder of the sweep to write, required without --summary. Finished trials in it are skipped."
)
@options.option("--grid KEY=V1,V2,...", multiple=True)
@options.option("--seeds FIRST:END", default="0:20", show_default=True)
@options.preset
@options.settings()
@options.algorithm
@options.max_iterations
@options.max_modules
@options.loop
@options.passes
@options.inputs(*options.ALL_INPUTS)
@options.jobs
@options.scheduler
@options.retry_failed
@options.option("--summary")
@options.option("--csv")
@options.as_json
@options.quiet
@click.pass_context
def sweep_command(
    ctx: click.Context,
    /,
    source: tuple[str, ...],
    output: Path | None,
    grid: tuple[str, ...],
    seeds: str,
    algorithm: str | None,
    summary: bool,
    csv: bool,
    as_json: bool,
    **arguments: Any,
) -> int:
    """Learn with many settings and seeds, and summarize the results.

    The command learns once for every seed and every combination of the --grid values: each is a
    trial. To resume an interrupted sweep, run the same command again. With --summary, it prints the
    results of the sweep in the folder SOURCE.

    SOURCE is one of:
        {scene}
        {recording}
        {logs}
        {url}
        {index}

    Options:
        --grid KEY=V1,V2,...: Try these values of a configuration key. Repeatable: every combination
            is tried.
        --seeds FIRST:END: Use each of these seeds: from FIRST to before END, or a list such as
            1,5,9.
        --summary: Learn nothing; print mean, standard deviation (SD) and 95 % interval over the
            seeds of the sweep in the folder SOURCE.
        --csv: Print the summary as comma-separated values.

    Examples:
        cdmisfa sweep oscillatory --grid learner.nu=0.02,0.05 --jobs 4 -o sweeps/nu
        cdmisfa sweep recordings/kitchen --loop --seeds 0:5 -o sweeps/kitchen
        cdmisfa sweep sweeps/nu --summary --csv
    """
    if summary:
        _print_summary(_folder_of_sweep(ctx), as_csv=csv, as_json=as_json)
        return 0
    if csv:
        raise click.UsageError("--csv needs --summary: write cdmisfa sweep DIR --summary --csv")
    if output is None:
        raise click.UsageError("name the folder of the sweep with -o, or print one with --summary")
    from cdmisfa.experiments.documents import about_source
    from cdmisfa.experiments.sweep import sweep

    values, numbers, before = parse_grid(grid), parse_seeds(seeds), _requested(output)
    stated: dict[str, list[str]] = {"warnings": [], "notes": []}

    def about(logs: FrameSource) -> None:
        printing.source(logs)
        stated.update(about_source(logs))

    if algorithm is not None:
        arguments["settings"] += (f"learner.algorithm={algorithm}",)
    with resumable_bar(output, "sweep", "trials") as progress_bar:
        report = sweep(
            source,
            output,
            grid=values,
            seeds=numbers,
            progress=progress_bar.trials,
            about=about,
            **arguments,
        )
    if left_out := len(before - _requested(output)):
        printing.status(
            f"{output}: --summary leaves out {left_out} trials of the command before, which "
            "are not in this one"
        )
    failed = [{key: row[key] for key in ("id", "point", "seed", "error")} for row in report.failed]
    if as_json:
        counts = {name: getattr(report, name) for name in ("trials", "skipped", "computed")}
        printing.document(sweep=report.folder, **counts, failed=failed, **stated)
    else:
        printing.line(
            f"{report.trials} trials: {report.computed} computed, {report.skipped} finished "
            f"before, {len(failed)} failed"
        )
        for row in failed:
            point = " ".join(f"{key}={value}" for key, value in row["point"].items())
            printing.line(f"failed: {point} seed {row['seed']}: {row['error']}")
        printing.line(f"print the results with cdmisfa sweep {printing.quoted(output)} --summary")
    return 1 if failed else 0


def _requested(folder: Path) -> set[str]:
    """Return the ids of the trials of the last command in a folder; none if there is no sweep."""
    from replay.runs.folders import read_request

    with suppress(CdmisfaError):
        return {trial for trial, _ in read_request(folder)}
    return set()


def parse_grid(words: tuple[str, ...]) -> dict[str, list[str]]:
    """Return the values of `KEY=V1,V2` words by key."""
    grid: dict[str, list[str]] = {}
    for word in words:
        key, _, values = word.partition("=")
        grid[key.strip()] = [value.strip() for value in values.split(",") if value.strip()]
        if not key.strip() or not grid[key.strip()]:
            raise click.UsageError(f"--grid {word}: write KEY=V1,V2, such as learner.nu=0.02,0.05")
    return grid


def parse_seeds(text: str) -> list[int]:
    """Return the seeds of `0:20` (without 20), `3`, or `1,5,9:12`."""
    seeds: list[int] = []
    try:
        for part in text.split(","):
            first, colon, end = part.partition(":")
            span = range(int(first), int(end) if colon else int(first) + 1)
            if not span or span[0] < 0 or len(seeds) + len(span) > MOST_SEEDS:
                raise ValueError
            seeds.extend(span)
        if max(Counter(seeds).values()) > 1:
            raise ValueError
    except ValueError:
        raise click.UsageError(f"--seeds {text}: list each seed once, as 0:20 or 1,5,9") from None
    return seeds


def _folder_of_sweep(ctx: click.Context) -> Path:
    """Return the folder that `--summary` takes; raise an error for other arguments and options."""
    applies = ("source", "summary", "csv", "as_json", "quiet")
    for param in ctx.command.params:
        name = param.name or ""
        if name not in applies and ctx.get_parameter_source(name) is ParameterSource.COMMANDLINE:
            raise click.UsageError(f"--summary only prints results: leave out {param.opts[0]}")
    if ctx.params["csv"] and ctx.params["as_json"]:
        raise click.UsageError("choose one of --csv and --json")
    if len(ctx.params["source"]) > 1:
        raise click.UsageError("--summary takes the folder of one sweep")
    return Path(ctx.params["source"][0])


def _print_summary(folder: Path, *, as_csv: bool, as_json: bool) -> None:
    """Print the statistics of the trials that the last sweep command asked for."""
    from cdmisfa.experiments import results

    points = results.results(folder)
    for key, values in results.varied(points).items():
        printing.status(f"{key} differs: {', '.join(map(str, values))}")
    if as_json:
        printing.json_document(results.as_json(points))
    elif as_csv:
        printing.text(results.as_csv(points))
    else:
        printing.table(*results.as_table(points))


@options.command("reproduce")
@click.argument("name", metavar="EXPERIMENT")
@options.output("Folder of the results to write. [default: reproduction]")
@options.option("--trials N")
@options.jobs
@options.scheduler
@options.option("--recording DIR", type=options.LOCAL)
@options.option("--quick")
@options.as_json
@options.quiet
def reproduce_command(
    name: str, output: Path | None, recording: Path | None, as_json: bool, **arguments: Any
) -> None:
    """Reproduce an experiment of the CD-MISFA paper.

    The command writes numbers, tables and figures, and skips trials that are finished. The exit
    code is 4 if a claim of the paper is not reproduced.

    EXPERIMENT is one of:
        oscillatory           order in which three synthetic streams are learned
        five                  the same with five streams
        stability             CD-MISFA 1.0 against 2.0: which policy is stable
        nonstationary         whether the learner follows a changing stream
        icub                  order in which the robot's three views are learned
        all                   all of them

    Options:
        --trials N: Number of trials of each condition. [default: as in the paper]
        --recording DIR: Folder of a recording of the scene icub to use. [default: record it now]
        --quick: Run only a few trials, enough to test the claims.

    Examples:
        cdmisfa reproduce oscillatory --quick
        cdmisfa reproduce icub --recording recordings/table --jobs 4
        cdmisfa reproduce all -o reproduction --jobs 8
    """
    from cdmisfa.studies.paper import reproduce as paper

    root, documents = output or Path("reproduction"), []
    for experiment in paper.EXPERIMENTS if name == "all" else (name,):
        if experiment == "icub" and recording is None:
            printing.status(
                f"icub: the scene is recorded into {root}/icub-recording, if not yet done"
            )
        with bar(experiment, "trials") as progress_bar:
            document = paper.reproduce(
                experiment,
                root / experiment,
                recording=recording,
                progress=progress_bar.update,
                **arguments,
            )
        documents.append(document)
    if as_json:
        printing.document(experiments=documents)
    else:
        printing.text("\n".join(f"{d['title']}\n\n{paper.markdown_tables(d)}" for d in documents))
    for document in documents:
        paper.check_claims(document)


@options.command("demo")
@options.output("Folder to write recordings/ and runs/ into. [default: current folder]")
@options.seed
@options.option("--frames N", type=options.Number(400), show_default=True, default=8000)
@options.jobs
@options.as_json
@options.quiet
def demo_command(output: Path | None, seed: int, frames: int, jobs: int, as_json: bool) -> None:
    """Record, learn, check and show an example in a few minutes.

    The command simulates the iCub robot at a table, learns from its three views, and writes a
    report. It overwrites the results of an earlier demo in the same folder. Without PyBullet, which
    needs Python 3.11 or older, it uses the scene oscillatory instead.

    Options:
        --frames N: Number of frames to record of each view, at least 400.

    Examples:
        cdmisfa demo
        cdmisfa demo -o demo --frames 4000 --jobs 2
        cdmisfa demo --seed 7 --json
    """
    from cdmisfa.studies.demo import demo

    report = demo(output or Path(), stage=_stage, seed=seed, frames=frames, jobs=jobs)
    if as_json:
        printing.json_document(report)
        return
    head = ("module", "view", "policy", "iteration", "follows", "correlation")
    rows = [
        (m["module"], m["view"], " ".join(m["policy"]), m["iteration"], m["follows"],
         f"{m['correlation']:.3f}")
        for m in report["modules"]
    ]  # fmt: skip
    printing.table(head, rows)
    printing.line()
    printing.line(f"report written to {report['report'].resolve().as_uri()}")
    command = f"{printing.quoted(sys.argv[0])} view {printing.quoted(report['run'])}"
    printing.line(f"view the run with {command}")


@contextmanager
def _stage(title: str, unit: str) -> Iterator[Bar]:
    """Print the title of a stage, show its progress, and print how long it took."""
    start = time.monotonic()
    printing.status(title)
    with bar("", unit) as progress_bar:
        yield progress_bar
    printing.status(f"    {time.monotonic() - start:.0f} s")
