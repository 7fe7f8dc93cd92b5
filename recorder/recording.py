"""Record a source: every frame of every view, in one MCAP file for each view."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from cdmisfa.core.blocks import Block, FrameSource, HeadPose, description
from cdmisfa.core.clock import RECORDED_FPS
from cdmisfa.core.config import section_table
from cdmisfa.core.errors import CdmisfaError, UsageError
from recorder.config import RecordConfig, SceneConfig
from recorder.log.files import holds_recording, local_folder, prepared_folder, refuse_existing
from recorder.log.manifest import RecordingSpec, RecordingStart, store_start
from recorder.log.resume import (
    ViewResume,
    begin_view,
    finished_logs,
    other_recordings,
    resume_views,
    set_log_aside,
)
from recorder.log.viewlog import ViewLog
from recorder.world.scenes import (
    SCENES,
    OpenScene,
    blocks_in_process,
    open_scene,
    render_in_processes,
    scene_of,
)

_FILE_NAME = re.compile(r"[\w-][\w.-]*")

# Number of frames of each view if the source is endless and no number is given.
DEFAULT_FRAMES: Final = 1000


@dataclass(frozen=True, slots=True)
class ViewRecording:
    """A finished file of a recording.

    Attributes:
        name: name of the view.
        file: path of the file.
        frames: number of frames.
        bytes: size of the file.
        sha256: SHA-256 of the file.
    """

    name: str
    file: Path
    frames: int
    bytes: int
    sha256: str

    def as_json(self) -> dict[str, Any]:
        """Return the attributes as JSON values."""
        return {**dataclasses.asdict(self), "file": str(self.file)}


class RecordingStoppedError(CdmisfaError):
    """Request to stop a recording; its `.partial` files are readable and can be resumed."""

    exit_code = 130


def record(
    source: FrameSource,
    folder: str | Path,
    *,
    frames: int | None = None,
    views: Sequence[str] | None = None,
    settings: RecordConfig | None = None,
    split: float | None = None,
    jobs: int = 1,
    force: bool = False,
    resume: bool = False,
    stop: Callable[[], bool] = lambda: False,
    progress: Callable[[float], None] = lambda done: None,
) -> list[ViewRecording]:
    """Record the first frames of a source into a folder.

    The bytes of the files depend only on the frames and the description of the source: not on
    `jobs`, on the selection of views, or on interruptions that were resumed. Errors, and exceptions
    that signal handlers raise, leave readable `.partial` files.

    Args:
        source: a source of frames, also one that cannot go back; it stays open.
        folder: folder of the recording; it is created if missing.
        frames: number of frames of each view; None: all of the source, or `DEFAULT_FRAMES` if it is
            endless, or for `resume` as many as at the start.
        views: names of the views; None: all.
        settings: settings of the files; the clock is that of the source.
        split: length of the parts of each view (s); None: one file, or for `resume` as at the
            start.
        jobs: number of processes that render; only a scene can use more than one.
        force: True to overwrite an earlier recording in the folder.
        resume: True to continue an earlier attempt with the same arguments.
        stop: called after every block; True ends the recording with an error.
        progress: called after every block with the number of frames written of every view.

    Raises:
        UsageError: the folder exists, or an argument is not valid.
        LogWriteError: a file cannot be written.
        LogExhaustedError: the source has fewer frames.
        LogDamagedError: the source was replaced while it was read.
        RecordingStoppedError: `stop` returned True.
    """
    scene = scene_of(source)
    settings = settings or (RecordConfig() if scene is None else scene.record)
    folder = local_folder(folder)
    length = source.spec.length
    if frames is not None and not 1 <= frames <= (length or frames):
        limit = "" if length is None else f", and at most the {length} of the source"
        raise UsageError(f"--frames is {frames}: record at least one{limit}")
    if not resume:
        refuse_existing(folder, force=force)
    elif force:
        raise UsageError("--resume continues what exists: leave out --force")
    elif not holds_recording(folder):
        raise UsageError(f"{folder} has no recording to resume: leave out --resume to start one")
    recording = recording_spec(source, settings, scene)
    streams = recording.spec.streams
    if unknown := [view for view in views or () if view not in streams]:
        raise UsageError(f"no view {unknown[0]!r}: name one of {', '.join(streams)}")
    chosen = [name for name in streams if not views or name in views]
    default = length or DEFAULT_FRAMES
    with ExitStack() as open_logs:
        stale = other_recordings(folder, recording) if force else []
        open_logs.enter_context(prepared_folder(folder, chosen if force else (), stale))
        if resume:
            places, split, frames = resume_views(folder, recording, chosen, split, frames, default)
        else:
            places = {view: begin_view(folder, view, split) for view in chosen}
        frames = frames or default
        poses = getattr(source, "head_poses", ())
        logs = ViewLogs(folder, recording, settings, places, frames, split, poses)
        open_logs.callback(logs.abandon)
        starts = logs.starts()
        blocks = blocks_in_process(source, starts, frames)
        if scene and jobs > 1 and starts:
            blocks = render_in_processes(scene, starts, frames, jobs)
        with contextlib.closing(blocks):
            for block in blocks:
                logs.write(block)
                done = min(logs.starts().values())
                progress(done)
                if stop() and done < frames:
                    raise RecordingStoppedError(f"{folder} is not finished: continue with --resume")
        if starts:
            source.describe()  # raises an error if the source was replaced while it was read
        return logs.finish()


class ViewLogs:
    """The logs of a recording while they are written.

    Args:
        folder: folder of the recording, created and locked.
        recording: specification of the recording.
        settings: settings of the files.
        places: file and frame at which each view begins or is resumed.
        frames: number of frames that each view will have.
        split: length of a part (s); None: one file.
        poses: pose of the head in each view of the source; empty without a head.
    """

    def __init__(
        self,
        folder: Path,
        recording: RecordingSpec,
        settings: RecordConfig,
        places: Mapping[str, ViewResume],
        frames: int,
        split: float | None,
        poses: Sequence[HeadPose] = (),
    ) -> None:
        self._folder, self._recording = folder, recording
        self._parts = {view: list(place.parts) for view, place in places.items()}
        self._logs: dict[int, ViewLog] = {}
        streams = recording.spec.streams
        pose_of = dict(zip(streams, poses, strict=False))
        if unfinished := [view for view, place in places.items() if not place.complete]:
            limits = {} if split is None else dict.fromkeys(unfinished, split)
            lengths = dict.fromkeys(unfinished, frames)
            start = RecordingStart(recording.kind, recording.seed, lengths, limits)
            store_start(folder, unfinished, start)
        try:
            for view, place in places.items():
                earlier = set_log_aside(place)
                if place.complete:
                    continue
                pose, parts = pose_of.get(view), self._parts[view]
                log = ViewLog(folder, view, recording, settings, pose, split, parts, place.first)
                self._logs[streams.index(view)] = log
                if earlier is not None:
                    log.copy(earlier, place.stop)
        except BaseException:
            self.abandon()
            raise

    def starts(self) -> dict[int, int]:
        """Return the next frame of each stream that is being written."""
        return {stream: log.t for stream, log in self._logs.items()}

    def write(self, block: Block) -> None:
        """Write a block; raise an error if it contradicts the specification of its source."""
        shape, dtype, spec = block.frames.shape[1:], block.frames.dtype, self._recording.spec
        stated = spec.kind(block.stream)
        if (shape, str(dtype)) != stated:
            raise CdmisfaError(
                f"frame {block.t} of {spec.streams[block.stream]} is {shape} {dtype}, but its "
                f"source states {stated[0]} {stated[1]}: correct the source"
            )
        self._logs[block.stream].write(block)

    def add_metadata(self, stream: int, name: str, values: Mapping[str, str]) -> None:
        """Add a metadata record to the log of a stream."""
        self._logs[stream].add_metadata(name, values)

    def finish(self) -> list[ViewRecording]:
        """Finish the files, and return the files of all views."""
        for log in self._logs.values():
            log.finish()
        store_start(self._folder, list(self._parts))
        parts = ((view, *part) for view, done in self._parts.items() for part in done)
        return [view_recording(*part) for part in parts]

    def abandon(self) -> None:
        """Close unfinished files as readable partial files."""
        for log in self._logs.values():
            log.abandon()


def record_scene(
    name: str,
    folder: Path,
    config: SceneConfig | None = None,
    settings: RecordConfig | None = None,
    **options: Any,
) -> list[ViewRecording]:
    """Open a scene by name, record it, and close it.

    Args:
        name: name of the scene, one of `SCENES`.
        folder: folder of the recording.
        config: configuration of the scene; None: the preset's, with seed 0.
        settings: settings of the clock and the files.
        options: further arguments of `record`.

    Raises:
        CdmisfaError: the scene cannot be opened, or as for `record`.
    """
    with contextlib.closing(open_scene(name, config, settings)) as source:
        return record(source, folder, **options)


def recorded(folder: Path) -> list[ViewRecording]:
    """Return the files of a complete recording; nothing for an incomplete one.

    Raises:
        LogDamagedError: the disk cannot read a file.
    """
    return [view_recording(*log) for log in finished_logs(folder)]


def view_recording(view: str, path: Path, frames: int) -> ViewRecording:
    """Return a finished file with its size and checksum; this reads all of it."""
    with path.open("rb") as file:
        checksum = hashlib.file_digest(file, "sha256").hexdigest()
    return ViewRecording(view, path, frames, path.stat().st_size, checksum)


def recording_spec(
    source: FrameSource, settings: RecordConfig, scene: OpenScene | None
) -> RecordingSpec:
    """Return the specification of the recording of a source.

    Raises:
        UsageError: a recording cannot hold the source.
    """
    spec = source.spec
    for name in spec.streams:
        if not _FILE_NAME.fullmatch(name) or spec.streams.count(name) > 1:
            raise UsageError(f"a view cannot be called {name!r}: use distinct file names")
    for shape, dtype in spec.every_kind:
        if (dtype, len(shape)) not in (("uint8", 2), ("float64", 1)):
            raise UsageError(
                f"frames of the source are {shape} {dtype}: a recording holds gray images, "
                "(height, width) uint8, or vectors, (n,) float64"
            )
    slowest, fastest = RECORDED_FPS
    if not slowest <= spec.fps <= fastest:
        raise UsageError(
            f"the source has {spec.fps:g} frames a second: a recording has {slowest:g} to "
            f"{fastest:.0f}; set another fps, or read a log with --align time --rate"
        )
    if scene is None:
        stated = description(source)
        seed = stated.get("seed")
        known = seed if isinstance(seed, int) else 0
        gaps = bool(getattr(source, "gaps", False))
        return RecordingSpec(stated["kind"], known, spec, {"source": stated}, gaps=gaps)
    clock = replace(settings, fps=spec.fps, start_ns=spec.start_ns)
    config = {"scene": scene.table(), "record": section_table(clock)}
    seed, packages = scene.config.seed or 0, SCENES[scene.name].packages
    return RecordingSpec(scene.name, seed, spec, config, packages)
