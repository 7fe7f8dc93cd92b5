"""`cdmisfa at`, `fork` and `check`: restore, continue and recompute a run."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import click

from cdmisfa.cli import options
from cdmisfa.cli.commands.report import report_beside
from cdmisfa.cli.printing import (
    outcome_line,
    print_document,
    print_line,
    print_result,
    quoted,
    tell,
)
from cdmisfa.cli.progress import learning
from cdmisfa.core.errors import NotReproducedError
from cdmisfa.core.names import counted

source = click.option(
    "--source",
    metavar="SOURCE",
    multiple=True,
    help="What it learned from, where that is no longer what the run says, as its recording; "
    "repeatable.",
)


@click.command("at")
@options.path_argument("run")
@click.argument("iterations", metavar="K", type=click.IntRange(0))
@source
@options.as_json
def at_command(run: Path, iterations: int, source: tuple[str, ...], as_json: bool) -> None:
    """Say what a learner was after K iterations of a run, exactly.

    K is the number of iterations that were done, from 0 on. The learner is put where a keyframe in
    the run's log says and learns on from there, from what the run learned from. Right after a
    keyframe no source is needed. --json prints all of its memory.
    """
    from cdmisfa.core.signals import ACTIONS
    from cdmisfa.experiments.resume import Recomputation
    from cdmisfa.experiments.run_folder import module_table

    with Recomputation.after(run, iterations, source) as again:
        log, learner, t = again.log, again.learner, again.t
    state, streams = learner.state, learner.spec.streams  # type: ignore[attr-defined]
    if as_json:
        print_document(
            run=str(log.parent),
            iterations=iterations,
            t=t,
            stream=streams[learner.stream],
            modules=[module_table(module) for module in learner.modules],
            **learner.summary(),
            policy_rng=state.policy_rng,
            arrays=state.arrays,
        )
        return
    print_line(
        f"after {counted(iterations, 'iteration')}: frame {t}, next {streams[learner.stream]}"
    )
    learned = ", ".join(f"{m.index} {m.stream}" for m in learner.modules)
    print_line(f"modules: {learned or 'none'}")
    summary = learner.summary()
    for outcome in summary.get("streams", ()):
        print_line(outcome_line(outcome))
    if "streams" not in summary and "final_policy" in summary:
        policy = zip(streams, summary["final_policy"], strict=True)
        print_line(f"policy: {', '.join(f'{name} {ACTIONS[action]}' for name, action in policy)}")
    size = sum(array.nbytes for array in state.arrays.values()) / 1000
    print_line(f"memory: {len(state.arrays)} arrays, {size:.1f} kB; --json prints all of it")


def _part(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[int, int | None]:
    """Parse a range of iterations."""
    found = re.fullmatch(r"(\d{0,18}):(\d{0,18})", value or ":", re.ASCII)
    if found is None:
        raise click.BadParameter(f"{value!r} is no range: write FIRST:END, as 100:200")
    first, end = found.groups()
    return int(first or 0), int(end) if end else None


@click.command("check")
@options.path_argument("run")
@click.option(
    "--iterations",
    metavar="FIRST:END",
    callback=_part,
    help="Check these iterations alone, without END; by default all.",
)
@source
@options.as_json
@click.pass_context
def check_command(
    ctx: click.Context,
    run: Path,
    iterations: tuple[int, int | None],
    source: tuple[str, ...],
    as_json: bool,
) -> None:
    """Learn a run again from its source, and compare every signal bit for bit.

    So are the keyframes in its log. It says the first signal or memory that differs, and which
    files are no longer those it learned from, and exits with 4 if there are any. A part begins at
    the newest keyframe before it.
    """
    from cdmisfa.experiments.resume import check_run

    checked = check_run(run, source, *iterations)
    if as_json:
        print_document(run=str(run), **checked.as_json())
    else:
        print_line(str(checked))
    if not checked.holds:
        ctx.exit(NotReproducedError.exit_code)


@click.command("fork")
@options.path_argument("run")
@click.option(
    "--iteration",
    "at",
    type=click.IntRange(0),
    required=True,
    metavar="K",
    help="Continue after K iterations of the run.",
)
@options.out("Folder of the fork.", required=True)
@options.settings("Set a key learner.* from there on; repeatable.")
@options.seed("Seed of the random choices from there on; the world stays.", default=None)
@options.end_after("iterations", "End after so many iterations in all; by default as the run.")
@options.end_after("modules", "End after so many modules in all; by default as the run.")
@source
@options.no_rerun
@options.force
@options.as_json
@options.quiet
@click.pass_context
def fork_command(
    ctx: click.Context,
    /,
    run: Path,
    out: Path,
    max_iterations: int | None,
    max_modules: int | None,
    no_rerun: bool,
    as_json: bool,
    **told: Any,
) -> None:
    """Go on from some iteration of a run with other settings, as a run of its own.

    It has the run's first K iterations as they are; resume, check and view it like any run.
    """
    from cdmisfa.experiments.loop import INTERRUPTED
    from cdmisfa.experiments.session import Session

    given = {"max_iterations": max_iterations, "max_modules": max_modules}
    limits = {name: value for name, value in given.items() if value is not None}
    with (
        Session.fork(run, folder=out, limits=limits, **told) as session,
        learning(session.source.spec, max_iterations) as (stop, reporter),
    ):
        session.hashing = reporter.hashing
        result = session.learn(sinks=(reporter,), stop=stop, rerun=not no_rerun)
    print_result(result, as_json=as_json)
    if result.run is not None and result.ended != INTERRUPTED:
        report_beside(result.run, quiet=as_json)
    both = f"cdmisfa compare {quoted(run)} {quoted(out)} --save both.rrd"
    tell(f"both in one view: {both}")
    if result.ended == INTERRUPTED:
        ctx.exit(stop.exit_code)
