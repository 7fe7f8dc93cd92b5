"""`cdmisfa learn`: learn modules from a live scene or a recording."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cdmisfa.agents.learners import LEARNERS
from cdmisfa.cli import options, uploads
from cdmisfa.cli.interrupts import stoppable
from cdmisfa.cli.making import grouped, option
from cdmisfa.cli.printing import (
    print_json,
    print_plan,
    print_table,
    quoted,
    say_about,
    say_changes,
    say_counts,
    tell,
)
from cdmisfa.cli.progress import Bar, bar
from cdmisfa.core.errors import UsageError
from cdmisfa.core.learning import Sink

if TYPE_CHECKING:
    from cdmisfa.cli.interrupts import Stop
    from cdmisfa.core.blocks import Block, FrameSource
    from cdmisfa.core.learning import Learner
    from cdmisfa.core.signals import BlockSignals
    from cdmisfa.experiments.run_folder import RunResult
    from cdmisfa.experiments.sources import Configuration
    from recorder.cameras.options import LiveOptions
    from replay.camera_logs.options import CameraOptions

MEGABYTE, GIGABYTE = 10**6, 10**9

TICK = 0.1
"""Seconds between two updates of the bar: a block may take only microseconds."""


@grouped("learn", common=("out", "seed", "settings", "max_iterations", "loop", "resume"))
@click.argument("source", nargs=-1)
@uploads.out_option("Folder of the run, or s3://...; without it nothing is written.")
@options.seed
@options.preset
@options.settings
@option(
    "--algorithm",
    metavar="NAME",
    help=f"The learner, short for --set learner.algorithm=: {', '.join(LEARNERS)}, or a plugin's. "
    "By default 2.0 for scenes and their recordings, progress for all other streams.",
    group="Learner",
)
@option("--portable", is_flag=True, expose_value=False, hidden=True)  # of older scripts
@options.end_after("iterations", "End after so many iterations.")
@options.end_after(
    "modules",
    "End after so many modules; by default the paper's learners end after as many as there are "
    "streams.",
)
@options.loop
@option("--resume", is_flag=True, help="Resume the run in -o where it was stopped.")
@options.salvage
@option("--live-view", is_flag=True, help="Show the run in Rerun while it learns.")
@options.no_rerun
@option(
    "--follow",
    is_flag=True,
    help="Wait for the frames of a recording being written.",
    group="Source",
)
@option(
    "--follow-timeout",
    type=click.FloatRange(0.1, 1e6),
    default=60.0,
    show_default=True,
    metavar="SECONDS",
    help="With --follow, give up when no frame came for so long.",
    group="Source",
)
@option(
    "--record",
    "record_to",
    type=options.OUT,
    metavar="DIR",
    help="Record what every live stream shows while learning, to learn the same from it again.",
    group="Live streams",
)
@options.keyframes
@options.fsync_every
@options.log_options
@options.dry_run
@options.live_options
@options.server_limits
@options.force
@options.as_json
@click.pass_context
def learn_command(
    ctx: click.Context,
    /,
    source: tuple[str, ...],
    out: Path | None,
    resume: bool,
    force: bool,
    as_json: bool,
    dry_run: bool,
    no_rerun: bool,
    live_view: bool,
    live: LiveOptions,
    cameras: CameraOptions,
    **told: Any,
) -> None:
    """Learn slow feature modules from a scene, a recording, logs or cameras.

    SOURCE is a live scene (icub, oscillatory), the folder of a recording, or the MCAP
    files of its views. The same seed gives the same signals, bit for bit, from each.

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
        learn_as_begun(ctx, out if resume else None)
        return
    from cdmisfa.experiments.command import command_of
    from cdmisfa.experiments.loop import INTERRUPTED
    from cdmisfa.experiments.session import run
    from recorder.cameras.words import is_live

    of_cameras = any(map(is_live, source))
    if of_cameras:
        opened = opened_live(ctx.params, source, live, cameras)
    else:
        opened = opened_logs(ctx.params, source, cameras)
    with opened as (frames, configuration):
        if dry_run:
            print_plan(frames, as_json=as_json)
            return
        with learning(told["max_iterations"], as_json=as_json) as (stop, reporter):
            if hasattr(frames, "stop"):
                frames.stop = stop  # waiting for frames ends with a signal, too
            kept = ("seed", "max_iterations", "max_modules", "keyframes", "fsync_every")
            result = run(
                frames,
                configuration.learner,
                out,
                sections=configuration.tables(),
                command=command_of(source, ctx.params, out or Path()),
                force=force,
                resume=resume,
                rerun=not no_rerun,
                live=live_view,
                announce=announce,
                sinks=(reporter,),
                stop=stop,
                hashing=reporter.hashing,
                **{name: told[name] for name in kept},
            )
    if resume and not reporter.told and not stop():
        click.echo("nothing was left to do: the run had come as far before", err=True)
    show(result, as_json=as_json)
    if result.ended == INTERRUPTED:
        if result.run is not None and not of_cameras:
            again = f"cdmisfa learn --resume -o {quoted(result.run)}"
            click.echo(f"go on with {again}", err=True)
        ctx.exit(stop.exit_code)


@contextlib.contextmanager
def opened_logs(
    told: Mapping[str, Any], source: tuple[str, ...], cameras: CameraOptions
) -> Iterator[tuple[FrameSource, Configuration]]:
    """A scene, a recording or logs, and what is said of them before and after.

    Args:
        told: the options of the command.
        source: its words.
        cameras: how images of others become frames.
    """
    from cdmisfa.experiments.sources import open_source

    if told["record_to"] is not None:
        raise UsageError("--record is for live streams: leave it out, or see cdmisfa record")
    frames, configuration = open_source(
        source,
        settings=settings_of(told),
        cameras=cameras,
        follow=told["follow_timeout"] if told["follow"] else None,
        resumed=told["resume"],
        **{name: told[name] for name in ("preset", "seed", "loop", "salvage")},
    )
    with contextlib.closing(frames):
        if told["dry_run"]:
            yield frames, configuration
            return
        say_about(frames)
        try:
            yield frames, configuration
        finally:
            say_changes(frames)


@contextlib.contextmanager
def opened_live(
    told: Mapping[str, Any], source: tuple[str, ...], live: LiveOptions, cameras: CameraOptions
) -> Iterator[tuple[FrameSource, Configuration]]:
    """Live streams, recorded meanwhile where that is asked for; see `opened_logs`."""
    from cdmisfa.experiments.sources import open_cameras_now
    from recorder.live import RecordedWhileWatched
    from recorder.log.files import refuse_existing

    if any(told[name] for name in ("resume", "loop", "salvage", "follow", "dry_run")):
        raise UsageError(
            "live streams cannot go back: leave out --resume, --loop, --salvage, --follow "
            "and --dry-run, or learn from a recording of them"
        )
    record_to = told["record_to"]
    for folder in filter(None, (told["out"], record_to)):  # before the cameras are opened
        refuse_existing(folder, force=told["force"], goes_on=False)
    frames, configuration = open_cameras_now(
        source,
        replace(live, seed=told["seed"]),
        cameras=cameras,
        preset=told["preset"],
        settings=settings_of(told),
        say=tell,
    )
    with contextlib.closing(frames):
        try:
            if record_to is None:
                yield frames, configuration
                return
            how = {name: told[name] for name in ("fsync_every", "force")}
            settings = configuration.record
            with RecordedWhileWatched(frames, record_to, settings=settings, **how) as recorded:
                yield recorded, configuration
            tell(f"recording {record_to}")
        finally:
            say_counts(frames)


def settings_of(told: Mapping[str, Any]) -> tuple[str, ...]:
    """The settings of a command, --algorithm among them."""
    algorithm = told["algorithm"]
    named = () if algorithm is None else (f"learner.algorithm={algorithm}",)
    return (*told["settings"], *named)


@contextlib.contextmanager
def learning(max_iterations: int | None, *, as_json: bool) -> Iterator[tuple[Stop, Reporter]]:
    """Show the progress of a run, end it at a signal, and print its result if its source ended."""
    from cdmisfa.experiments.run_folder import RunExhaustedError

    try:
        with bar("learning", "blocks") as shown, stoppable() as stop:
            yield stop, Reporter(shown, max_iterations)
    except RunExhaustedError as error:
        show(error.result, as_json=as_json)
        raise


def learn_as_begun(ctx: click.Context, run: Path | None) -> None:
    """Resume a run with the command that began it; options that are given win."""
    from cdmisfa.experiments.command import read_command

    if run is None:
        source = next(param for param in ctx.command.params if param.name == "source")
        raise click.MissingParameter(ctx=ctx, param=source)
    words, begun = read_command(run)
    kept = {
        name: value
        for name, value in begun.items()
        if ctx.get_parameter_source(name) is not click.core.ParameterSource.COMMANDLINE
    }
    ctx.invoke(learn_command, **{**ctx.params, **kept, "source": words})


def announce(address: str) -> None:
    """Say where a live view is, and open it where there is a display."""
    from replay.viewer.program import has_display, open_privately

    click.echo(f"live view {address}    look at it: rerun {address}", err=True)
    if has_display():
        open_privately(address)


class Reporter(Sink):
    """Shows a run's progress: every module once, the rest a few times a second.

    Attributes:
        told: whether any block was learned.
    """

    def __init__(self, shown: Bar, max_iterations: int | None) -> None:
        self.told = self._hashing = False
        self._shown, self._max_iterations = shown, max_iterations
        self._next = 0.0

    def block(self, block: Block, signals: BlockSignals, learner: Learner) -> None:
        """See `Sink`."""
        self.told, modules = True, len(learner.modules)
        for text in learner.events:
            self._shown.say(f"iteration {signals.iteration}: {text}")
        now = time.monotonic()
        if now >= self._next:
            self._next = now + TICK
            if self._hashing:
                self._hashing = False
                self._shown.turn_to("learning", "blocks")
            learning = int((signals.state == 0).sum())
            left = f"{learning} being learned" if learning else f"ε {signals.epsilon:.2f}"
            note = f"{modules} saved, {left}"
            self._shown.update(learner.iteration, self._max_iterations, note)

    def hashing(self, done: int, size: int) -> None:
        """Show how far the source's files are hashed, once that is waited for."""
        if not self._hashing:
            self._hashing = True
            self._shown.turn_to("hashing", "MB")
            read = f"{done / GIGABYTE:.1f} of {size / GIGABYTE:.1f} GB are read"
            self._shown.say(f"waiting for the SHA-256 of what is learned from: {read}")
        self._shown.update(done / MEGABYTE, size / MEGABYTE)


def outcome_line(outcome: Mapping[str, Any]) -> str:
    """What became of a stream, in words."""
    came = outcome["state"].replace("_", " ")
    if outcome["module"] is not None:
        came += f" by module {outcome['module']}"
    if outcome["slowness"] is not None:
        came += f", slowness {outcome['slowness']:.4f} on frames not learned from"
    because = f": {outcome['why']}" if outcome["why"] else ""
    return f"{outcome['stream']}: {came}, after {outcome['blocks']} blocks{because}"


def show(result: RunResult, *, as_json: bool) -> None:
    """Print what a run came to."""
    from cdmisfa.core.signals import ACTIONS
    from cdmisfa.experiments.loop import ENDINGS

    if as_json:
        print_json(result.as_json())
        return
    rows = [
        (
            module.index,
            module.stream,
            module.iteration,
            " ".join(ACTIONS[action] for action in module.policy),
            ", ".join(f"{eta:.4f}" for eta in module.eta),
        )
        for module in result.modules
    ]
    if rows and "streams" not in result.summary:
        print_table(("module", "stream", "iteration", "policy", "eta"), rows)
    elif rows:  # no policy led to them
        plain = [(index, stream, iteration, eta) for index, stream, iteration, _, eta in rows]
        print_table(("module", "stream", "iteration", "eta"), plain)
    else:
        click.echo("no module was learned")
    for outcome in result.summary.get("streams", ()):
        click.echo(outcome_line(outcome))
    click.echo(f"ended after {result.iterations} iterations: {ENDINGS[result.ended]}")
    click.echo(f"signals sha256 {result.signals_sha256}")
    if result.run is not None:
        look = f"look at it: cdmisfa view {quoted(result.run)}"
        click.echo(f"run {result.run}    {look}")
