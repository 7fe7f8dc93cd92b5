"""`cdmisfa learn` and `fork`: learn modules from a source, or continue a run differently."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cdmisfa.cli import options, printing
from cdmisfa.cli.progress import RunProgress, bar, learning
from cdmisfa.core.errors import LogDamagedError, UsageError, are_for, one_line
from cdmisfa.core.interrupts import Stop

if TYPE_CHECKING:
    from cdmisfa.core.blocks import FrameSource
    from cdmisfa.experiments.run_folder import RunResult
    from cdmisfa.experiments.session import Session
    from cdmisfa.experiments.sources import Configuration
    from recorder.images.options import InputOptions


@options.command("learn")
@click.argument("source", nargs=-1, type=options.WORD)
@options.output("Folder of the run to write. [default: write nothing]")
@options.seed
@options.preset
@options.settings()
@options.algorithm
@options.max_iterations
@options.max_modules
@options.loop
@options.passes
@options.option("--resume")
@options.skip_damaged
@options.option("--live-view")
@options.no_rerun
@options.option("--episodes")
@options.option("--record DIR", name="record_to", type=options.LOCAL)
@options.inputs(*options.ALL_INPUTS)
@options.force
@options.as_json
@options.quiet
@click.pass_context
def learn_command(
    ctx: click.Context,
    /,
    source: tuple[str, ...],
    output: Path | None,
    seed: int,
    settings: tuple[str, ...],
    algorithm: str | None,
    max_iterations: int | None,
    max_modules: int | None,
    resume: bool,
    live_view: bool,
    no_rerun: bool,
    record_to: Path | None,
    inputs: InputOptions,
    force: bool,
    as_json: bool,
    **arguments: Any,
) -> int:
    """Learn slow features from a scene, logs or live cameras.

    With -o, the command writes a run: a folder with the learned features, every value that the
    learner computed, a report (report.html) and a view for Rerun (run.rrd). It stops when each
    stream is learned, explained by an earlier module, or rejected because nothing in it is slow;
    when SOURCE ends; or with Ctrl-C. A log that is cut short is read to its end, with a warning.

    SOURCE is one of:
        {scene}
        {recording}
        {logs}
        {url}
        {index}
        {live}

    Words:
        stream     the images of one camera, or the numbers of one topic
        block      a number of frames of one stream: 40, scene oscillatory: 100
        iteration  learning from one block
        module     a slow feature that is learned and no longer changes
        gap        a pause of more than ten frames in a stream; no block crosses it
        preset     a named set of configuration values

    Options:
        --resume: Continue the interrupted run in the folder -o; SOURCE and options may be left out.
        --live-view: Show the run in the Rerun viewer while it learns.
        --episodes: Learn from the logs one after the other; no block crosses from one to the next.
        --record DIR: Also record all live streams into this folder, to learn from them again.

    Examples:
        cdmisfa learn left.mcap right.mcap -o runs/kitchen
        cdmisfa learn camera:/dev/video0 --record recordings/desk -o runs/desk
        cdmisfa learn recordings/kitchen --loop --max-modules 2 -o runs/kitchen
    """
    from cdmisfa.experiments.run_folder import command_of
    from cdmisfa.experiments.session import Session
    from recorder.cameras.words import is_live

    if resume and (output is None or force):
        raise click.UsageError("--resume needs -o RUN, the run to resume, without --force")
    if not source:
        return _resume_run(ctx, output if resume else None)
    if algorithm is not None:
        settings = (*settings, f"learner.algorithm={algorithm}")
    live = any(map(is_live, source))
    arguments |= {"inputs": inputs, "settings": settings, "seed": seed, "resumed": resume}
    with (
        _opened_source(source, output, record_to, force, **arguments) as (frames, configuration),
        learning(frames, max_iterations) as (stop, progress),
    ):
        color = getattr(frames, "color", inputs.color)  # what --color auto chose
        session = Session(
            frames,
            configuration.learner,
            output,
            seed=seed,
            max_iterations=max_iterations,
            max_modules=max_modules,
            sections=configuration.tables(),
            command=command_of(source, {**ctx.params, "color": color}, output or Path()),
            force=force,
            resume=resume,
            hashing=progress.hashing,
        )
        result = _run_learner(session, stop, progress, rerun=not no_rerun, live_view=live_view)
    code = _print_run(result, stop, frames, can_resume=not live, as_json=as_json)
    return code or (LogDamagedError.exit_code if getattr(frames, "left_out", ()) else 0)


def _resume_run(ctx: click.Context, run: Path | None) -> int:
    """Resume a run with its stored source and options; new options take precedence."""
    from cdmisfa.experiments.run_folder import read_command

    if run is None:
        raise click.UsageError(
            "name a SOURCE, such as left.mcap, or a run to resume with --resume -o RUN"
        )
    words, stored = read_command(run)
    restored = {
        name: value
        for name, value in stored.items()
        if ctx.get_parameter_source(name) is not click.core.ParameterSource.COMMANDLINE
    }
    restored["settings"] = (*stored.get("settings", ()), *ctx.params["settings"])
    code: int = ctx.invoke(learn_command, **{**ctx.params, **restored, "source": words})
    return code


@contextlib.contextmanager
def _opened_source(
    words: Sequence[str], output: Path | None, record_to: Path | None, force: bool, **arguments: Any
) -> Iterator[tuple[FrameSource, Configuration]]:
    """Open a source, with the arguments of `open_source`; print its notes and warnings."""
    from cdmisfa.experiments.holdout import arrange_frames
    from cdmisfa.experiments.run_folder import OPENING
    from cdmisfa.experiments.sources import is_scene, open_source
    from recorder.cameras.words import is_live
    from recorder.log.files import refuse_existing

    live = any(map(is_live, words))
    if live and arguments["resumed"]:
        raise UsageError(f"{words[0]} is a live stream: --resume needs a source that can go back")
    if record_to is not None and not live:
        raise UsageError(f"{words[0]} is no live stream: {are_for(['--record'], 'live streams')}")
    unused = [f"--{n.replace('_', '-')}" for n in (*OPENING, "passes") if arguments[n]]
    passes = arguments.pop("passes")
    if unused and (live or is_scene(words)):
        raise UsageError(f"{words[0]} is no log: {are_for(unused, 'logs')}")
    for folder in filter(None, () if arguments["resumed"] else (output, record_to)):
        refuse_existing(folder, force=force, resumable=not live)
    with bar("opening", "logs") as progress_bar:
        frames, configuration = open_source(
            words, progress=progress_bar.update, say=printing.status, **arguments
        )
    with contextlib.ExitStack() as stack:
        stack.enter_context(contextlib.closing(frames))
        arrange_frames(frames, configuration, passes)
        if not live:
            printing.source(frames)
        stack.callback(printing.source_changes, frames)
        if record_to is not None:
            from recorder.live import LiveRecorder

            stack.callback(printing.status, f"recording {record_to}")
            recorded = LiveRecorder(frames, record_to, settings=configuration.record, force=force)
            frames = stack.enter_context(recorded)
        yield frames, configuration


def _run_learner(
    session: Session, stop: Stop, progress: RunProgress, *, rerun: bool, live_view: bool = False
) -> RunResult:
    """Run the learner, on request with a live view, until the run ends or a signal stops it."""
    viewer = None
    if live_view:
        from replay.viewer import live_window

        viewer = partial(live_window, say=printing.status)
    if hasattr(session.source, "stop"):
        session.source.stop = stop  # so that a signal also ends waiting for frames
    session.hashing = progress.hashing
    return session.learn(sinks=(progress,), stop=stop, rerun=rerun, live=viewer)


def _print_run(
    result: RunResult, stop: Stop, source: FrameSource, *, can_resume: bool, as_json: bool
) -> int:
    """Print the result of a run, write its report unless interrupted; return the exit code."""
    from cdmisfa.core.outcomes import INTERRUPTED
    from cdmisfa.experiments.documents import about_source
    from cdmisfa.experiments.reports import write_report

    printing.result(result, about_source(source) if as_json else None)
    folder = printing.quoted(result.run or "")
    if result.ended == INTERRUPTED:
        if folder and can_resume:
            printing.status(f"continue with cdmisfa learn --resume -o {folder}")
        return stop.exit_code
    if result.run is not None:
        try:
            page = write_report([result.run])
        except Exception as error:  # the run is complete, even if its report cannot be written
            printing.warning(
                f"no report was written ({one_line(error)}): try again with cdmisfa report {folder}"
            )
        else:
            if not as_json:
                printing.line(f"report written to {page}")
    if more := result.more_passes:
        again = f"continue with cdmisfa learn --resume --passes {more} -o {folder}"
        again = again if folder else f"learn again with --passes {more}"
        printing.status(f"{', '.join(result.undecided)} not decided: {again}")
    return 0


@options.command("fork")
@click.argument("run", type=options.LOCAL)
@options.option("--iteration K", type=options.Number(0), required=True)
@options.output("Folder of the new run to write.", required=True)
@options.settings("Set a configuration key learner.* from iteration K on. Repeatable.")
@options.option("--seed N", type=options.SEED)
@options.max_iterations
@options.max_modules
@options.source
@options.no_rerun
@options.force
@options.as_json
@options.quiet
def fork_command(
    run: Path,
    iteration: int,
    output: Path,
    max_iterations: int | None,
    max_modules: int | None,
    no_rerun: bool,
    as_json: bool,
    **arguments: Any,
) -> int:
    """Continue a run from an earlier iteration with other settings.

    The new run begins with the first K iterations of RUN and learns the rest from the source of
    RUN. Limits and settings that are not given are those of RUN.

    RUN is:
        {run}

    Options:
        --max-iterations N: Stop after this number of iterations. [default: limit of RUN]
        --max-modules N: Stop after this number of modules. [default: limit of RUN]
        --iteration K: Begin with the first K iterations of RUN.
        --seed N: Seed of every random choice from iteration K on. [default: the seed of RUN]

    Examples:
        cdmisfa fork runs/kitchen --iteration 100 --set learner.visit=9 -o runs/slower
        cdmisfa fork runs/kitchen --iteration 100 --seed 7 -o runs/seed7
        cdmisfa fork runs/kitchen --iteration 0 --max-modules 2 -o runs/two
    """
    from cdmisfa.experiments.session import Session

    given = {"max_iterations": max_iterations, "max_modules": max_modules}
    limits = {name: limit for name, limit in given.items() if limit is not None}
    with (
        Session.fork(run, iteration, output, limits=limits, **arguments) as session,
        learning(session.source, max_iterations) as (stop, progress),
    ):
        result = _run_learner(session, stop, progress, rerun=not no_rerun)
    both = f"{printing.quoted(run)} {printing.quoted(output)}"
    printing.status(f"compare both with cdmisfa compare {both} --save both.rrd")
    return _print_run(result, stop, session.source, can_resume=True, as_json=as_json)
