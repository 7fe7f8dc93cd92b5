"""`cdmisfa learn`: learn modules from a live scene or a recording."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cdmisfa.cli import options
from cdmisfa.cli.commands.report import report_beside
from cdmisfa.cli.printing import (
    print_result,
    quoted,
    say_about,
    say_changes,
    say_counts,
    tell,
)
from cdmisfa.cli.progress import bar, learning
from cdmisfa.core.errors import LogDamagedError, UsageError, are_for

if TYPE_CHECKING:
    from cdmisfa.core.blocks import FrameSource
    from cdmisfa.experiments.sources import Configuration
    from recorder.images.options import InputOptions

OPENED = ("preset", "seed", "loop", "salvage", "episodes")
"""Options that say how a source is opened."""

KEPT = ("seed", "max_iterations", "max_modules")
"""Options that are handed on to the run as they are."""


@click.command("learn")
@click.argument("source", nargs=-1, type=options.WORD)
@options.out("Folder of the run; without it nothing is written.")
@options.seed()
@options.preset
@options.settings()
@click.option(
    "--algorithm",
    metavar="NAME",
    help="The learner, short for --set learner.algorithm=: 2.0, 1.0, progress, or a "
    "class of your own, package.module:Class. "
    "By default 2.0 for scenes and their recordings, progress for all other streams.",
)
@options.end_after("iterations", "End after so many iterations.")
@options.end_after(
    "modules",
    "End after so many modules; by default the paper's learners end after as many as there are "
    "streams.",
)
@options.loop
@click.option("--resume", is_flag=True, help="Resume the run in -o where it was stopped.")
@options.salvage
@click.option("--live-view", is_flag=True, help="Show the run in Rerun while it learns.")
@options.no_rerun
@click.option("--episodes", is_flag=True, help="Take each log as an episode, one after the other.")
@click.option(
    "--record",
    "record_to",
    type=options.OUT,
    metavar="DIR",
    help="Record what every live stream shows while learning, to learn the same from it again.",
)
@options.input_options()
@options.force
@options.as_json
@options.quiet
@click.pass_context
def learn_command(
    ctx: click.Context,
    /,
    source: tuple[str, ...],
    out: Path | None,
    resume: bool,
    force: bool,
    as_json: bool,
    inputs: InputOptions,
    **told: Any,
) -> None:
    """Learn slow feature modules from a scene, a recording, logs or cameras.

    SOURCE is a live scene (icub, oscillatory), the folder of a recording, or the MCAP
    files of its views. The same seed gives the same signals, bit for bit, from each.

    Or it is a corpus, a folder that cdmisfa index indexed: its logs are episodes, one after the
    other by when each begins and then by its path, and nothing is learned across two of them.

    Or it is other people's logs: MCAP files, ROS bags, LeRobot datasets, tables of numbers (CSV,
    Parquet), or a video or a folder of pictures for each stream. Logs may be URLs: s3://, http://
    and https://.

    Or it is live streams, one or several: camera:/dev/video0, rtsp://, http://.../x.mjpg, tcp://,
    av:ADDRESS, foxglove://HOST:PORT/TOPIC, gym:TASK.

    With --resume it need not be given: it is what the run learned from.
    """
    if resume and out is None:
        raise click.UsageError("--resume needs -o RUN, the run to resume")
    if resume and force:
        raise click.UsageError("--force starts anew and --resume goes on: use one of them")
    if not source:
        resume_as_started(ctx, out if resume else None)
        return
    from cdmisfa.experiments.loop import INTERRUPTED
    from cdmisfa.experiments.run_folder import command_of
    from cdmisfa.experiments.session import run
    from recorder.cameras.words import is_live

    of_cameras = any(map(is_live, source))
    opened = opened_live if of_cameras else opened_logs
    with opened(ctx.params, source, inputs) as (frames, configuration):
        color = getattr(frames, "color", inputs.color)  # what auto chose stays
        with learning(frames.spec, told["max_iterations"]) as (stop, reporter):
            if hasattr(frames, "stop"):
                frames.stop = stop  # waiting for frames ends with a signal, too
            result = run(
                frames,
                configuration.learner,
                out,
                sections=configuration.tables(),
                command=command_of(source, {**ctx.params, "color": color}, out or Path()),
                force=force,
                resume=resume,
                rerun=not told["no_rerun"],
                live=_watched() if told["live_view"] else None,
                sinks=(reporter,),
                stop=stop,
                hashing=reporter.hashing,
                **{name: told[name] for name in KEPT},
            )
    if resume and not reporter.told and not stop():
        tell("nothing was left to do: the run had come as far before")
    print_result(result, as_json=as_json)
    if result.run is not None and result.ended != INTERRUPTED:
        report_beside(result.run, quiet=as_json)
    if result.ended == INTERRUPTED:
        if result.run is not None and not of_cameras:
            tell(f"go on with cdmisfa learn --resume -o {quoted(result.run)}")
        ctx.exit(stop.exit_code)
    if getattr(frames, "left_out", ()):
        ctx.exit(LogDamagedError.exit_code)


def _watched() -> Callable[[str], contextlib.AbstractContextManager[None]]:
    from replay.viewer import watched

    return partial(watched, say=tell)


@contextlib.contextmanager
def opened_logs(
    told: Mapping[str, Any], source: tuple[str, ...], inputs: InputOptions
) -> Iterator[tuple[FrameSource, Configuration]]:
    """A scene, a recording or logs, and what is said of them before and after.

    Args:
        told: the options of the command.
        source: its words.
        inputs: how images of others become frames.
    """
    from cdmisfa.experiments.holdout import hold_out
    from cdmisfa.experiments.sources import is_scene, open_source

    vain = [f"--{name}" for name in ("loop", "salvage") if told[name]]
    if vain and is_scene(source):
        raise UsageError(f"{source[0]} is a scene: {are_for(vain, 'logs')}")
    if told["record_to"] is not None:
        raise UsageError("--record is for live streams: leave it out, or see cdmisfa record")
    with bar("opening", "logs") as shown:
        frames, configuration = open_source(
            source,
            settings=settings_of(told),
            inputs=inputs,
            resumed=told["resume"],
            told=shown.update,
            **{name: told[name] for name in OPENED},
        )
    with contextlib.closing(frames):
        hold_out(frames, configuration)
        say_about(frames)
        try:
            yield frames, configuration
        finally:
            say_changes(frames)


@contextlib.contextmanager
def opened_live(
    told: Mapping[str, Any], source: tuple[str, ...], inputs: InputOptions
) -> Iterator[tuple[FrameSource, Configuration]]:
    """Live streams, recorded meanwhile where that is asked for; see `opened_logs`."""
    from cdmisfa.experiments.sources import open_source
    from recorder.live import RecordedWhileWatched
    from recorder.log.files import refuse_existing

    refused = ("resume", "loop", "salvage", "episodes")
    if any(told[name] for name in refused):
        raise UsageError(
            "live streams cannot go back: leave out --resume, --loop, --salvage and --episodes, "
            "or learn from a recording of them"
        )
    out, record_to, force = told["out"], told["record_to"], told["force"]
    for folder in (out, record_to):
        if folder is not None:
            refuse_existing(folder, force=force, goes_on=False)
    frames, configuration = open_source(
        source,
        inputs=inputs,
        preset=told["preset"],
        settings=settings_of(told),
        seed=told["seed"],
        say=tell,
    )
    with contextlib.closing(frames):
        try:
            if record_to is None:
                yield frames, configuration
                return
            with RecordedWhileWatched(
                frames,
                record_to,
                settings=configuration.record,
                force=force,
            ) as recorded:
                yield recorded, configuration
            tell(f"recording {record_to}")
        finally:
            say_counts(frames)


def settings_of(told: Mapping[str, Any]) -> tuple[str, ...]:
    """The settings of a command, --algorithm among them."""
    algorithm = told["algorithm"]
    named = () if algorithm is None else (f"learner.algorithm={algorithm}",)
    return (*told["settings"], *named)


def resume_as_started(ctx: click.Context, run: Path | None) -> None:
    """Resume a run with the source and options it was started with; options given now win."""
    from cdmisfa.experiments.run_folder import read_command

    if run is None:
        source = next(param for param in ctx.command.params if param.name == "source")
        raise click.MissingParameter(ctx=ctx, param=source)
    words, begun = read_command(run)
    kept = {
        name: value
        for name, value in begun.items()
        if ctx.get_parameter_source(name) is not click.core.ParameterSource.COMMANDLINE
    }
    kept["settings"] = (*begun.get("settings", ()), *ctx.params["settings"])
    ctx.invoke(learn_command, **{**ctx.params, **kept, "source": words})
