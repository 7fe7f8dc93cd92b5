"""Building the Rerun view of a run or a recording from its logs.

The view can always be built again: the logs are the archive.
"""

from __future__ import annotations

import contextlib
import hashlib
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from cdmisfa.core.blocks import SourceSpec
from cdmisfa.core.errors import CdmisfaError, UsageError, are_for
from cdmisfa.core.untrusted import opened_regular
from recorder.images.options import InputOptions
from recorder.log.files import atomic_write, refuse_taken, refuse_unless
from replay.inputs import About, Logged, holds_run, open_to_look
from replay.recordings.source import RecordedSource
from replay.runs.folders import MODULES_FILE, run_log
from replay.runs.log import Frames, read_batches, read_header
from replay.runs.modules import load_modules
from replay.runs.run import Tally, read_outline
from replay.view.columns import FRAME, MOST_STREAMS, Target
from replay.view.labels import label, part
from replay.view.layouts import blueprint, lines, time_axis
from replay.view.modules import ModulesView
from replay.view.panels import run_layout
from replay.view.run import RunView
from replay.view.scene import SceneView, scene_view
from replay.view.summary import summary_text
from replay.view.world import WorldView, world_of_recording, write_learned

APPLICATION = "cdmisfa"
"""Rerun's application id: the viewer remembers one layout for it."""

FLUSH_SECONDS = 60.0

BLOCK = 500
"""Frames that are read at once."""


def build_view(
    path: Path,
    out: Path,
    *,
    every: int = 10,
    force: bool = True,
    tab: str | None = None,
    beside: Sequence[Path] = (),
    inputs: InputOptions | None = None,
    about: About = lambda source: None,
) -> None:
    """Write the view of a run, a recording or camera logs as an .rrd file, whole or not at all.

    Args:
        path: a run's folder or its run.mcap, a recording, or a camera log.
        out: the file.
        every: show every so many watched frames, of those that were kept.
        force: replace an existing file.
        tab: name of the tab that is open; by default the first.
        beside: more camera logs, or files of the recording.
        inputs: which streams of camera logs; by default all of images.
        about: given a recording or camera logs before they are shown, to say what they are.

    Raises:
        UsageError: there is no such run or recording, `every` is below 1, `out` exists and
            `force` is not set, the run did not learn from the recording `all_views`, or there is
            no such tab.
        LogDamagedError: it cannot be read.
        CdmisfaError: the view cannot be written.
    """
    out, path = Path(out), Path(path)
    if every < 1:
        raise UsageError(f"every {every} frames: it must be at least 1")
    if any(map(holds_run, (path, *beside))):
        if inputs is not None and (given := inputs.named()):
            raise UsageError(f"{path} is a run: {are_for(given, 'logs')}")
        if beside:
            raise UsageError(f"{path}: one run is shown at a time; compare --save shows several")
        log = run_log(path)
        with recording_to(out, _name(log), log, force=force) as recording:
            _write_run(recording, log, every, tab)
    else:
        with recording_to(out, path.resolve().stem, path, force=force) as recording:
            write_recording(recording, [path, *beside], every, tab, inputs, about)


@contextlib.contextmanager
def view_of(path: Path, *, tab: str | None = None, **how: Any) -> Iterator[Path]:
    """Yield the view of a run, a recording or logs as an .rrd file, which is temporary.

    Args:
        path: as for `build_view`, or an .rrd file, which is yielded as it is.
        tab: name of the tab that is open.
        how: see `build_view`.

    Raises:
        UsageError: there is no such file, or an .rrd file cannot have the tab.
    """
    if path.suffix == ".rrd":
        with opened_regular(path) as file:
            if file.read(4) != b"RRF2":  # for anything else the viewer shows nothing, without end
                raise UsageError(f"{path} is no file of Rerun: name a run or a recording")
        if tab is not None:
            raise UsageError(f"--tab {tab}: {path} is built already, name its run or recording")
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="cdmisfa-view-", ignore_cleanup_errors=True) as folder:
        view = Path(folder) / f"{path.resolve().stem}.rrd"
        build_view(path, view, tab=tab, **how)
        yield view


@contextlib.contextmanager
def recording_to(
    out: Path, name: str, source: Path, *, force: bool
) -> Iterator[rr.RecordingStream]:
    """A Rerun recording that becomes the file `out` once it is complete.

    Args:
        out: the file.
        name: what the viewer calls the recording.
        source: what it is made from, so that others of the same name are not taken for it.
        force: replace an existing file.

    Raises:
        UsageError: it exists and `force` is not set, or its folder is not there.
        CdmisfaError: the file cannot be written.
    """
    refuse_unless(out, "the view is a file of Rerun", ".rrd", "")
    refuse_taken(out, force=force)
    if not out.parent.is_dir():
        raise UsageError(f"{out} cannot be written: there is no folder {out.parent}")
    # Rerun merges recordings of the same name and id.
    place = hashlib.sha256(str(source.resolve()).encode()).hexdigest()[:12]
    recording = rr.RecordingStream(APPLICATION, recording_id=f"{name}-{place}")
    recording.set_log_time_enabled(False)
    with atomic_write(out) as partial:
        try:
            recording.save(partial)
            if not partial.exists():
                raise CdmisfaError(f"{out}: Rerun writes nothing, unset the variable RERUN")
            recording.send_recording_name(label(name))
            yield recording
            recording.flush(timeout_sec=FLUSH_SECONDS)
        except RuntimeError as error:
            raise CdmisfaError(f"{out} cannot be written: {error}") from error
        finally:
            recording.disconnect()


def _write_run(
    recording: rr.RecordingStream,
    log: Path,
    every: int,
    tab: str | None,
) -> None:
    header, folder = read_header(log), log.parent
    streams = list(range(len(header.spec.streams)))
    if len(streams) > MOST_STREAMS:  # which are watched most is known at the end only
        streams = read_outline(log).streams(MOST_STREAMS)
    tally, view = Tally(header), RunView(recording, header, streams, every)
    known = load_modules(folder) if (folder / MODULES_FILE).is_file() else ()
    modules = ModulesView(Target(recording, header.spec), known)
    world = WorldView(recording, header, folder, streams, every)
    truth: list[Frames] = []
    for note in world.notes:
        view.event(0, 0, note, "WARN")
    events: list[str] = []
    for batch in read_batches(log, header, every=every):
        for columns in batch.signals:
            tally.add(columns)
        view.take(batch)
        modules.take(batch)
        world.take(batch)
        truth += batch.truth
        events += [event.text for event in batch.events]
    outline = tally.outline()
    view.finish(outline)
    modules.finish(outline)
    for note in modules.notes:
        view.event(outline.end, outline.iterations, note, "WARN")
    text = label(summary_text(outline, _name(log), events))
    recording.log("summary", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN), static=True)
    world.flush()
    first = world.tab(write_learned(recording, log, outline, truth))
    recording.send_blueprint(run_layout(outline, first, sheets=modules.sheets(), tab=tab))


def _name(log: Path) -> str:
    return log.resolve().parent.name


def write_recording(
    recording: rr.RecordingStream,
    paths: Sequence[Path],
    every: int,
    tab: str | None = None,
    inputs: InputOptions | None = None,
    about: About = lambda source: None,
) -> None:
    """Write a recording's views and ground truth, and the layout for them.

    Args:
        recording: where they go.
        paths: the recording's folder, or files of its views; or camera logs of others.
        every: show images of every this many frames; values are all shown.
        tab: name of the tab that is open.
        inputs: which streams of camera logs; by default all of images.
        about: see `build_view`.

    Raises:
        UsageError: there is no such recording or tab.
        LogDamagedError: it cannot be read.
    """
    with contextlib.closing(open_to_look(paths, inputs)) as source:
        about(source)
        first, count, spec = source.t, source.frames, source.spec
        ours = isinstance(source, RecordedSource)
        scenery = world_of_recording(paths[0]) if ours else None
        target = Target(recording, spec)
        scene = None if scenery is None else SceneView(target, scenery, every)
        notes = [*source.warnings, *(scene.notes if scene is not None else ())]
        write_views(target, source, count, every, scene=scene)
        for note in notes:
            recording.set_time(FRAME, sequence=first)
            recording.log("events", rr.TextLog(label(note), level="WARN"))
    properties: Any = {"frames": count, "streams": label(", ".join(spec.streams)), "fps": spec.fps}
    recording.send_property("recording", rr.AnyValues(**properties))
    layout = recording_layout(spec, first + count, scene=scene is not None, tab=tab)
    recording.send_blueprint(layout)


def write_views(
    target: Target,
    source: Logged,
    count: int,
    every: int,
    scene: SceneView | None = None,
) -> None:
    """Write every view of a recording, and what the world knows, from the source's t on.

    Args:
        target: where they go.
        source: the recording.
        count: how many frames.
        every: show images of every this many frames.
        scene: where what the world knows is shown, too.
    """
    first, spec = source.t, source.spec
    columns = [target.frames(view) for view in view_entities(spec)]
    truth = target.lines("world/truth", spec.truth, within=1)
    for t in range(first, first + count, BLOCK):
        stop = min(t + BLOCK, first + count)
        for stream, column in enumerate(columns):
            for low, high in source.spans(stream, t, stop):
                source.seek(low)
                block = source.take(stream, high - low)
                frames = np.arange(low, high)
                keep = frames % (every if spec.images else 1) == 0
                column.add(frames[keep], None, block.frames[keep])
                if spec.truth and stream == 0:
                    truth.add(frames, None, block.truth)
                if scene is not None and stream == 0:
                    scene.move(frames, block.truth)
    for column in [*columns, truth]:
        column.flush()
    if scene is not None:
        scene.flush()


def view_entities(spec: SourceSpec) -> list[str]:
    """The entity of each view."""
    return [f"views/{part(spec.streams, s)}" for s in range(len(spec.streams))]


def recording_layout(
    spec: SourceSpec,
    frames: int,
    *,
    scene: bool = False,
    tab: str | None = None,
) -> rrb.Blueprint:
    """The tabs of a recording: its world, where there is one, its views, and what is known.

    Args:
        spec: of its source.
        frames: where it ends.
        scene: the world in 3D is there.
        tab: name of the one that is open.
    """
    axis, tabs = time_axis(frames), list[rrb.Container]()
    places = [(label(spec.streams[s]), f"/{view}") for s, view in enumerate(view_entities(spec))]
    if scene:
        images = rrb.Vertical(*(_image(*place) for place in places))
        tabs.append(rrb.Horizontal(scene_view(), images, column_shares=[5, 2], name="World"))
    views: rrb.Container
    if spec.images:
        views = rrb.Grid(*(_image(*place) for place in places), grid_columns=min(len(places), 3))
    else:
        views = rrb.Vertical(*(lines(name, [place], axis) for name, place in places))
    below = [lines("What the world knows", ["/world/truth"], axis)] if spec.truth else []
    tabs.append(rrb.Vertical(views, *below, name="Views"))
    return blueprint(*tabs, name="Recording", length=frames, tab=tab)


def _image(name: str, origin: str) -> rrb.View:
    return rrb.Spatial2DView(origin=origin, name=name)
