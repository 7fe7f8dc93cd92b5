"""`cdmisfa compare`, `check`, `inspect` and `signals`: compare and recompute runs."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cdmisfa.cli import options, printing
from cdmisfa.core.errors import NotReproducedError

if TYPE_CHECKING:
    from replay.runs.compare import ComparedRun


@options.command("compare")
@options.log_argument("runs", "RUN...")
@options.option("--save F.rrd", type=options.LOCAL)
@options.force
@options.as_json
def compare_command(runs: tuple[Path, ...], save: Path | None, force: bool, as_json: bool) -> int:
    """Compare runs: signals bit for bit, results and settings.

    Signals are the values that the learner computed in each iteration. For two runs, the command
    prints where their signals first differ and which settings and results differ. For more runs, it
    prints a table that compares each with the first. The exit code is 4 if any signal differs.

    RUN is one of:
        {run}
        {log of run}

    Options:
        --save F.rrd: Also write a Rerun view with the curves of all runs.

    Examples:
        cdmisfa compare runs/kitchen runs/again
        cdmisfa compare runs/kitchen runs/seed7 --save both.rrd
        cdmisfa compare runs/seed0 runs/seed1 runs/seed2 --json
    """
    from replay.runs.compare import side_by_side

    if len(runs) < 2:
        raise click.UsageError("compare needs two runs or more")
    rows = side_by_side(runs)
    if save is not None:
        from replay.view.comparison import build_overlay  # takes half a second

        build_overlay(runs, rows, save, force=force)
    different = [row.difference for row in rows if row.difference is not None]
    if as_json:
        printing.document(
            identical=not different,
            first_difference=different[0].as_json() if different else None,
            signals=different[0].signals if different and len(runs) == 2 else {},
            runs=[row.as_json() for row in rows],
            view=save,
        )
    else:
        _print_comparison(rows)
        if save is not None:
            command = f"cdmisfa view {printing.quoted(save)}"
            printing.status(f"view written to {save}; open it with {command}")
    return NotReproducedError.exit_code if different else 0


def _print_comparison(rows: Sequence[ComparedRun]) -> None:
    """Print how runs compare, and for two runs the signals that differ first."""
    from replay.runs.compare import HEAD, differing_outcomes

    first, second = rows[:2]
    names = first.name, second.name
    if len(rows) > 2:
        printing.table(HEAD, [row.cells() for row in rows])
    else:
        printing.line(second.verdict)
        if outcomes := differing_outcomes(first.outline, second.outline):
            printing.table(("", *names), outcomes)
        if second.difference is not None:
            printing.line(f"first difference: {second.difference.text(*names)}")
    for explanation in filter(None, (row.explanation() for row in rows)):
        printing.text(explanation)
    if len(rows) == 2 and second.difference and second.difference.signal:
        printing.line(f"signals of iteration {second.difference.iteration} that differ:")
        printing.table(("signal", *names), second.difference.differing_signals())


def _iterations(
    ctx: click.Context, param: click.Parameter, value: str | None
) -> tuple[int, int | None]:
    """Parse FIRST:END; without END as (FIRST, None)."""
    match = re.fullmatch(r"(\d{0,18}):(\d{0,18})", value or ":", re.ASCII)
    if match is None or (match[2] and int(match[2]) <= int(match[1] or 0)):
        what = "END must be greater than FIRST, such as 10:30"
        raise click.BadParameter(f"{value!r} is not a range FIRST:END: {what}")
    return int(match[1] or 0), int(match[2]) if match[2] else None


@options.command("check")
@click.argument("run", type=options.LOCAL)
@options.option("--iterations FIRST:END", callback=_iterations)
@options.source
@options.as_json
def check_command(
    run: Path, iterations: tuple[int, int | None], source: tuple[str, ...], as_json: bool
) -> int:
    """Learn a run again and compare every signal.

    Signals and stored states of the learner must be equal bit for bit. Otherwise the command prints
    the first difference and the changed source files; the exit code is then 4.

    RUN is:
        {run}

    Options:
        --iterations FIRST:END: Check only the iterations from FIRST to before END. [default: all]

    Examples:
        cdmisfa check runs/kitchen
        cdmisfa check runs/kitchen --iterations 100:200
        cdmisfa check runs/kitchen --source /data/left.mcap --source /data/right.mcap
    """
    from cdmisfa.experiments.resume import check_run

    checked = check_run(run, source, *iterations)
    if as_json:
        printing.document(run=str(run), **checked.as_json())
    else:
        printing.line(str(checked))
    return 0 if checked.holds else NotReproducedError.exit_code


@options.command("inspect")
@click.argument("run", type=options.LOCAL)
@options.option("--iteration K", name="iterations", type=options.Number(0), required=True)
@options.source
@options.as_json
def inspect_command(run: Path, iterations: int, source: tuple[str, ...], as_json: bool) -> None:
    """Print the state of the learner after an iteration of a run.

    The command loads the last state that the run stores before that iteration, and learns the rest
    again from the source of the run. One iteration is one block of frames. --json prints the
    values of all arrays.

    RUN is:
        {run}

    Options:
        --iteration K: Print the state after the first K iterations.

    Examples:
        cdmisfa inspect runs/kitchen --iteration 100
        cdmisfa inspect runs/kitchen --iteration 100 --json
        cdmisfa inspect runs/kitchen --iteration 100 --source /data/left.mcap
    """
    from cdmisfa.core.names import counted
    from cdmisfa.core.signals import ACTIONS
    from cdmisfa.experiments.resume import Recomputation
    from cdmisfa.experiments.run_folder import module_table

    with Recomputation.after(run, iterations, source) as again:
        log, learner, t = again.log, again.learner, again.t
    state, streams = learner.state, learner.spec.streams  # type: ignore[attr-defined]
    summary = learner.summary()
    if as_json:
        printing.document(
            run=str(log.parent),
            iterations=iterations,
            t=t,
            stream=streams[learner.stream],
            modules=[module_table(module) for module in learner.modules],
            **summary,
            policy_rng=state.policy_rng,
            arrays=state.arrays,
        )
        return
    done = counted(iterations, "iteration")
    printing.line(f"after {done}: frame {t}, next {streams[learner.stream]}")
    modules = ", ".join(f"{m.index} {m.stream}" for m in learner.modules)
    printing.line(f"modules: {modules or 'none'}")
    for outcome in summary.get("streams", ()):
        printing.stream_outcome(outcome)
    if "streams" not in summary and "final_policy" in summary:
        policy = zip(streams, summary["final_policy"], strict=True)
        printing.line(
            f"policy: {', '.join(f'{name} {ACTIONS[action]}' for name, action in policy)}"
        )
    size = sum(array.nbytes for array in state.arrays.values()) / 1000
    printing.line(f"memory: {len(state.arrays)} arrays, {size:.1f} kB; --json prints all of it")


@options.command("signals")
@options.as_json
def signals_command(as_json: bool) -> None:
    """List the signals that every run records.

    A signal is a value that the learner computes in each iteration. --json also prints its type and
    how the viewer shows it.

    Examples:
        cdmisfa signals
        cdmisfa signals --json
        cdmisfa export runs/kitchen -o signals.parquet
    """
    from cdmisfa.core.signals import SCHEMA_VERSION, SIGNALS

    signals: list[dict[str, Any]] = [dataclasses.asdict(signal) for signal in SIGNALS.values()]
    if as_json:
        printing.document(signals_version=SCHEMA_VERSION, signals=signals)
        return
    columns = ("name", "symbol", "equation", "unit", "dims", "about")
    printing.table(columns, [[signal[column] for column in columns] for signal in signals])
