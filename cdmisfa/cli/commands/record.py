"""`cdmisfa record` and `convert`: write recordings of scenes, of live streams, of external logs."""

from __future__ import annotations

import contextlib
import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from cdmisfa.cli import options, printing
from cdmisfa.cli.progress import Bar, bar
from cdmisfa.core.errors import LogDamagedError, UsageError, are_for
from cdmisfa.core.interrupts import Stop, stoppable

if TYPE_CHECKING:
    from recorder.images.options import InputOptions
    from recorder.recording import ViewRecording

# Lines about a source that makes its images itself.
NO_LINES: Mapping[str, Any] = {"warnings": [], "notes": []}


@options.command("record")
@click.argument("source", nargs=-1, type=options.WORD)
@options.output("Folder of the recording to write.", required=True)
@options.option("--frames N")
@options.option("--seed N", type=options.SEED)
@options.option("--view NAME", name="views", multiple=True)
@options.jobs
@options.preset
@options.settings()
@options.option("--resume")
@options.option("--split TIME")
@options.inputs("fields", "size", "rate", "color")
@options.force
@options.as_json
@options.quiet
def record_command(
    source: tuple[str, ...],
    output: Path,
    frames: int | None,
    seed: int | None,
    views: tuple[str, ...],
    jobs: int,
    preset: str | None,
    settings: tuple[str, ...],
    resume: bool,
    split: str | None,
    inputs: InputOptions,
    force: bool,
    as_json: bool,
) -> int:
    """Record a simulated scene or live cameras as MCAP files.

    The recording is a folder with one MCAP file for each camera or stream. A scene is simulated:
    the same seed gives the same bytes. To record existing logs, use cdmisfa convert.

    SOURCE is one of:
        {scene}
        {live}

    Options:
        --frames N: Stop after this number of frames of each stream. [default: 1000; cameras: until
            Ctrl-C; with --resume: as before]
        --seed N: Seed of every random choice. [default: 0; with --resume: as before]
        --view NAME: Record only this view (stream) of the scene. Repeatable. [default: all]
        --resume: Continue the interrupted recording in the folder -o.
        --field FIELD: Read these numbers of the messages of a foxglove:// stream, such as
            pose.position.x or ranges[0:100]. Repeatable; several form one vector. [default: images]
        --split TIME: Begin a new file for each stream after this time, such as 90s or 10min.
            [default: one file; with --resume: as before]

    Examples:
        cdmisfa record icub -o recordings/table --frames 2000 --seed 3
        cdmisfa record camera:/dev/video0 -o recordings/desk --split 10min
        cdmisfa record --resume -o recordings/table
    """
    from cdmisfa.experiments.sources import Layers, configure
    from recorder.cameras.words import is_live
    from recorder.config import parse_split
    from recorder.log.manifest import RecordingStart, read_start
    from recorder.recording import DEFAULT_FRAMES, record_scene, recorded
    from recorder.world.scenes import SCENES

    limit = parse_split(split) if split else None
    if any(map(is_live, source)):
        given = {"--view": views, "--jobs": jobs > 1, "--resume": resume}
        if options := [name for name, value in given.items() if value]:
            raise UsageError(f"{source[0]} is a live stream: {are_for(options, 'scenes')}")
        arguments = {"inputs": inputs, "preset": preset, "settings": settings, "seed": seed or 0}
        return _record_live(source, output, frames, limit, force, as_json, **arguments)
    if any(w not in SCENES and (Path(w).exists() or set("*?:") & set(w)) for w in source):
        command = f"cdmisfa convert {shlex.join(source)} -o REC"
        raise UsageError(f"{source[0]} is a log, not a scene: convert it with {command}")
    start = read_start(output) if resume else RecordingStart()
    _check_resumable(output, start.scene)
    scene = " ".join(source) or start.scene
    if not scene and resume and not (frames or split) and (files := recorded(output)):
        printing.status(f"{output} is complete: there is nothing to resume")
        return _print_recording(output, files, as_json)
    if not scene:
        why = f"{output}: there is no recording to resume: " if resume else ""
        raise click.UsageError(f"{why}name a scene: {' or '.join(SCENES)}")
    seed = seed if seed is not None else start.seed or 0
    configuration = configure(scene, Layers.read(preset, settings), seed, inputs)
    with _writing(output, "recording", notice="") as (progress_bar, stop):
        files = record_scene(
            scene,
            output,
            configuration.scene,
            configuration.record,
            frames=frames,
            views=views or None,
            jobs=jobs,
            split=limit,
            resume=resume,
            stop=stop,
            progress=lambda done: progress_bar.update(done, max(done, frames or DEFAULT_FRAMES)),
            force=force,
        )
    return _print_recording(output, files, as_json)


def _check_resumable(output: Path, scene: str) -> None:
    """Raise an error for a recording of live streams and for a conversion."""
    if scene in ("cameras", "gym"):
        raise UsageError(f"{output}: a recording of live streams cannot be resumed")
    if scene == "foreign":
        command = f"cdmisfa convert SOURCE -o {printing.quoted(output)} --resume"
        raise UsageError(f"{output} is a conversion: resume it with {command}")


def _record_live(
    words: Sequence[str],
    output: Path,
    frames: int | None,
    split: float | None,
    force: bool,
    as_json: bool,
    **arguments: Any,
) -> int:
    """Record live streams until they have `frames` frames, they end, or Ctrl-C is pressed.

    Further arguments go to `open_source`.
    """
    from cdmisfa.experiments.sources import open_source
    from recorder.live import LiveRecorder, record_live
    from recorder.log.files import refuse_existing
    from recorder.recording import DEFAULT_FRAMES

    refuse_existing(output, force=force, resumable=False)
    source, configuration = open_source(words, say=printing.status, **arguments)
    notice = "finishing the recording; press Ctrl-C again to stop at once\n"
    with contextlib.closing(source), stoppable(notice) as stop:
        frames = frames or (None if getattr(source, "gaps", False) else DEFAULT_FRAMES)
        recorded = LiveRecorder(
            source, output, settings=configuration.record, split=split, force=force
        )
        with bar("recording", "frames") as progress_bar:
            record_live(
                recorded,
                frames=frames,
                stop=stop,
                progress=lambda done: progress_bar.update(done, frames),
            )
    if recorded.ended and not stop():
        printing.status(f"ended at frame {recorded.t}: {recorded.ended}")
    printing.source_changes(recorded)
    _print_recording(output, recorded.files, as_json)
    return stop.exit_code if stop() and frames is not None and recorded.t < frames else 0


@options.command("convert")
@click.argument("source", nargs=-1, required=True, type=options.WORD)
@options.output("Folder of the recording to write.", required=True)
@options.inputs(*options.ALL_INPUTS, "settings")
@options.skip_damaged
@options.option("--resume")
@options.force
@options.as_json
@options.quiet
def convert_command(
    source: tuple[str, ...],
    output: Path,
    inputs: InputOptions,
    skip_damaged: bool,
    resume: bool,
    force: bool,
    as_json: bool,
) -> int:
    """Convert logs, videos, images or tables to a recording.

    The recording is a folder with one MCAP file for each stream. All its frames are on one clock
    and have the size that the learner sees. If the recording was interrupted, --resume continues
    it.

    SOURCE is one of:
        {recording}
        {logs}
        {url}

    Options:
        --resume: Continue the interrupted recording in the folder -o.

    Examples:
        cdmisfa convert left.mp4 right.mp4 -o recordings/kitchen
        cdmisfa convert robot.mcap --topic '/camera/*' --end 1:30 -o recordings/robot
        cdmisfa convert joints.csv --field elbow --field wrist -o recordings/joints
    """
    from cdmisfa.experiments.documents import about_source
    from recorder.cameras.words import is_live
    from recorder.log.files import refuse_existing
    from recorder.recording import record
    from replay.open_sources import locations, open_external, refuse_non_logs

    if live := next(filter(is_live, source), None):
        command = f"cdmisfa record {shlex.join(source)} -o REC"
        raise UsageError(f"{live} is a live stream: record it with {command}")
    paths = locations(source)
    refuse_non_logs(paths)
    if not resume:
        refuse_existing(output, force=force)
    opened = open_external(paths, inputs, skip_damaged=skip_damaged)
    with contextlib.closing(opened) as frames:
        printing.source(frames)
        with _writing(output, "converting") as (progress_bar, stop):
            files = record(
                frames,
                output,
                resume=resume,
                stop=stop,
                progress=lambda done: progress_bar.update(done, frames.spec.length),
                force=force,
            )
        printing.source_changes(frames)
        about = about_source(frames)
    _print_recording(output, files, as_json, about)
    return LogDamagedError.exit_code if frames.left_out else 0


@contextlib.contextmanager
def _writing(output: Path, title: str, **notice: Any) -> Iterator[tuple[Bar, Stop]]:
    """Show the progress of writing a recording; exit if a signal stops it."""
    from recorder.recording import RecordingStoppedError

    with bar(title, "frames") as progress_bar, stoppable(**notice) as stop:
        try:
            yield progress_bar, stop
        except (RecordingStoppedError, KeyboardInterrupt):
            printing.status(
                f"cdmisfa: interrupted: {output} is not finished: continue with --resume"
            )
            raise SystemExit(stop.exit_code) from None


def _print_recording(
    folder: Path,
    files: Sequence[ViewRecording],
    as_json: bool,
    about: Mapping[str, Any] = NO_LINES,
) -> int:
    """Print the file of each view of a recording; return the exit code 0."""
    if as_json:
        frames = sum(file.frames for file in files if file.name == files[0].name)
        views = [file.as_json() for file in files]
        printing.document(recording=str(folder), frames=frames, views=views, **about)
    else:
        rows = [(f.name, f.file, f.frames, f.bytes, f.sha256) for f in files]
        printing.table(("view", "file", "frames", "bytes", "sha256"), rows)
    return 0
