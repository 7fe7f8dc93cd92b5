"""Recording a scene: every view at every frame, one MCAP file for each view."""

from __future__ import annotations

import contextlib
import dataclasses
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType
from typing import Any, cast

from cdmisfa.core.blocks import FrameSource, HeadPose, SourceSpec
from cdmisfa.core.config import as_table
from cdmisfa.core.errors import CdmisfaError, LogWriteError, UsageError
from recorder.config import RecordConfig, SceneConfig
from recorder.log.folder import held
from recorder.log.manifest import Manifest, forget_views, keep_recording, read_recording
from recorder.log.parts import Split, ViewParts, view_logs
from recorder.log.viewlog import FramesHeld, Identity, frames_held, sha256
from recorder.world.rendering import render_here, render_in_processes, requests
from recorder.world.scenes import open_scene

MAX_JOBS = 256

DEFAULT_FRAMES = 1000
"""Frames of each view where nothing else is asked for."""

Progress = Callable[[float], None]
"""Told, after every block, how many frames have been written of every view."""


@dataclass(frozen=True, slots=True)
class ViewRecording:
    """One finished file of a recording.

    Attributes:
        name: of the view.
        file: the file's path.
        frames: how many it holds.
        bytes: its size.
        sha256: its checksum.
    """

    name: str
    file: Path
    frames: int
    bytes: int
    sha256: str

    def as_json(self) -> dict[str, Any]:
        """The file as plain JSON values."""
        return {**dataclasses.asdict(self), "file": str(self.file)}


def record(
    kind: str,
    folder: Path,
    scene: SceneConfig | None = None,
    settings: RecordConfig | None = None,
    *,
    frames: int | None = None,
    views: Sequence[str] | None = None,
    jobs: int = 1,
    force: bool = False,
    resume: bool = False,
    split: Split | None = None,
    progress: Progress | None = None,
) -> list[ViewRecording]:
    """Record the first frames of a scene into a folder.

    The files depend on the scene's configuration and seed only: not on `jobs`, not on
    which views are recorded, not on having been interrupted and resumed. Ctrl-C,
    SIGTERM and errors leave readable `.partial` files.

    Args:
        kind: name of the scene.
        folder: made if it does not exist.
        scene: the world; a seed of None is 0.
        settings: the clock and the files.
        frames: how many, of each view; by default `DEFAULT_FRAMES`, and where a recording is
            resumed as many as it was asked to have.
        views: which views; by default all.
        jobs: processes that render.
        force: overwrite an earlier recording in the folder.
        resume: go on where an earlier attempt with the same arguments ended.
        split: write every view as parts of limited size or duration; where a recording is
            resumed by default as it was begun.
        progress: called after every block; never where there was nothing left to record.

    Raises:
        UsageError: the folder exists, or an argument is wrong.
        LogWriteError: the disk does not take it.
        CdmisfaError: the scene cannot be opened.
    """
    scene = dataclasses.replace(scene or SceneConfig(), kind=cast(Any, kind))
    scene = dataclasses.replace(scene, seed=scene.seed or 0)
    settings = settings or RecordConfig()
    folder = Path(folder)
    if frames is not None and frames < 1:
        raise UsageError(f"--frames is {frames}: record at least one")
    if not 1 <= jobs <= MAX_JOBS:
        raise UsageError(f"--jobs is {jobs}: use 1 to {MAX_JOBS}")
    if force and resume:
        raise UsageError("--force starts anew and --resume goes on: use one of them")
    if not resume:
        refuse_existing(folder, force=force, remedy="go on with --resume or overwrite with --force")
    with contextlib.closing(open_scene(kind, scene, settings)) as source:
        names = _chosen(source.spec, views)
        identity = Identity(
            kind,
            scene.seed or 0,
            source.spec,
            {"scene": as_table(scene), "record": as_table(settings)},
        )
        make_folder(folder)
        with _stoppable() as stopped, ExitStack() as open_logs:
            open_logs.enter_context(held(folder))
            if force:
                remove_views(folder, names)
            earlier: dict[str, dict[Path, FramesHeld]] = {}
            if resume:
                split = _as_begun(folder, kind, scene.seed or 0, names, split)
                earlier = {n: {p: frames_held(p, n) for p in view_logs(folder, n)} for n in names}
                frames = _length(folder, earlier, frames)
            frames = frames or DEFAULT_FRAMES
            poses = _poses(source)
            logs = [
                ViewParts(
                    folder,
                    name,
                    identity,
                    settings,
                    split=split,
                    pose=poses.get(name),
                    resume=frames if resume else None,
                    earlier=earlier.get(name),
                )
                for name in names
            ]
            unfinished = [log.view for log in logs if not log.complete]
            limits = {} if split is None else dict.fromkeys(unfinished, str(split))
            lengths = dict.fromkeys(unfinished, frames)
            if unfinished:
                options = {"seed": scene.seed or 0, "frames": lengths, "split": limits}
                keep_recording(folder, Manifest((kind,), options))
            for log in logs:
                open_logs.callback(log.abandon)
                log.open()
            by_stream = {log.stream: log for log in logs}
            wanted = requests({log.stream: log.t for log in logs}, frames)
            blocks = (
                render_here(source, wanted)
                if jobs == 1 or not unfinished
                else render_in_processes(kind, scene, settings, wanted, jobs)
            )
            with contextlib.closing(blocks):
                for block in blocks:
                    by_stream[block.stream].write(block)
                    if progress is not None:
                        progress(min(log.t for log in logs))
                    if stopped():
                        raise _StoppedError(f"{folder} is not finished: go on with --resume")
            for log in logs:
                log.finish()
            forget_views(folder, names)
    return [written(log.view, path, n) for log in logs for path, n in log.parts]


def written(view: str, path: Path, frames: int) -> ViewRecording:
    """What a finished file of a view came to."""
    return ViewRecording(view, path, frames, path.stat().st_size, sha256(path))


class _StoppedError(CdmisfaError):
    """A signal asked the recording to end."""

    exit_code = 130


def _chosen(spec: SourceSpec, views: Sequence[str] | None) -> list[str]:
    for view in views or ():
        if view not in spec.streams:
            raise UsageError(f"no view {view!r}: the scene has {', '.join(spec.streams)}")
    return [name for name in spec.streams if not views or name in views]


def _poses(source: FrameSource) -> dict[str, HeadPose]:
    poses: Sequence[HeadPose] = getattr(source, "head_poses", ())
    return dict(zip(source.spec.streams, poses, strict=False))


def refuse_existing(folder: Path, *, force: bool, remedy: str = "overwrite with --force") -> None:
    """Refuse to write a recording where there is something.

    Raises:
        UsageError: the folder is not empty, or no folder, and `force` is not set.
    """
    if folder.exists() and not force and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(f"{folder} exists: choose another folder, {remedy}")


def make_folder(folder: Path) -> None:
    """Make a recording's folder.

    Raises:
        LogWriteError: it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LogWriteError(f"{folder} cannot be used: {error.strerror}") from error


def remove_views(folder: Path, names: Sequence[str]) -> None:
    """Remove what a recording holds of some views.

    Raises:
        LogWriteError: it cannot be removed.
    """
    try:
        for name in names:
            for old in view_logs(folder, name):
                old.unlink()
    except OSError as error:
        raise LogWriteError(f"{folder} cannot be used: {error.strerror}") from error


def _length(
    folder: Path, earlier: Mapping[str, Mapping[Path, FramesHeld]], frames: int | None
) -> int:
    """Frames of each view of a recording that is gone on with.

    Raises:
        UsageError: a file has more frames than asked for.
    """
    longest = 0
    for path, there in (item for files in earlier.values() for item in files.items()):
        if frames is not None and there.end > frames:
            raise UsageError(
                f"{path} holds {there.end} frames, more than --frames {frames}: --resume shortens "
                f"nothing, give --frames {there.end} or more, or overwrite with --force"
            )
        longest = max(longest, there.end)
    begun = read_recording(folder).options["frames"]
    wanted = max((begun[view] for view in earlier if view in begun), default=0)
    return frames or max(longest, wanted or (longest if _finished(earlier) else DEFAULT_FRAMES))


def _as_begun(
    folder: Path, kind: str, seed: int, views: Sequence[str], split: Split | None
) -> Split | None:
    """Where parts end in a recording that is gone on with.

    Raises:
        UsageError: it was begun with another scene, seed or split.
    """
    begun = read_recording(folder)
    splits = begun.options["split"]
    limits = sorted({splits[view] for view in views if view in splits})
    now = {"": kind, "seed": seed}
    if limits and split is not None:
        now["split"] = str(split)
    replace(begun, options={**begun.options, "split": limits[0] if limits else ""}).refuse_other(
        folder, now
    )
    return split if split is not None or not limits else Split.parse(limits[0])


def _finished(earlier: Mapping[str, Mapping[Path, FramesHeld]]) -> bool:
    """Whether every view has files, and all of them are finished."""
    return all(
        files and all(path.suffix == ".mcap" for path in files) for files in earlier.values()
    )


@contextlib.contextmanager
def _stoppable() -> Iterator[Callable[[], bool]]:
    """Turn Ctrl-C and SIGTERM into a question asked between blocks.

    An exception in the middle of a write could tear a file. Once the files are closed
    the signal is sent on to whom it was for. A second signal is not waited for.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    received: list[int] = []

    def note(number: int, _: FrameType | None) -> None:
        received.append(number)
        signal.signal(number, before[number])

    before = {
        int(number): signal.signal(number, note) or signal.SIG_DFL
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield lambda: bool(received)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if received:
            signal.raise_signal(received[0])
