"""Builds the Rerun view of a run or a recording from its logs.

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
from replay.open_sources import Announce, holds_run, open_for_viewing
from replay.runs.folders import MODULES_FILE, run_log
from replay.runs.log import read_batches, read_header
from replay.runs.modules import load_modules
from replay.runs.run import Tally, read_outline
from replay.view.layouts import blueprint, curve_view, images, scene
from replay.view.run import RunView
from replay.view.run_layout import run_layout
from replay.view.scene import SceneView, scenery_of_recording
from replay.view.summary import summary_text
from replay.view.writer import MOST_STREAMS, Writer, drawable, part

# Rerun's application id: the viewer remembers one layout for it.
APPLICATION = "cdmisfa"

FLUSH_SECONDS = 60.0

# Frames of a recording that are read at once.
BLOCK = 500


def build_view(
    path: Path,
    out: Path,
    *,
    every: int = 10,
    force: bool = True,
    tab: str | None = None,
    beside: Sequence[Path] = (),
    inputs: InputOptions | None = None,
    about: Announce = lambda source: None,
) -> None:
    """Write the view of a run, a recording or camera logs as an .rrd file, whole or not at all.

    Args:
        path: a run's folder or its run.mcap, a recording, or a camera log.
        out: the file.
        every: frames from one image that is shown to the next, of those in the log.
        force: replace an existing file.
        tab: name of the tab that is open; by default the first.
        beside: more camera logs, or files of the recording.
        inputs: streams of external logs; by default all with images.
        about: called with a recording or camera logs before they are shown, to print what they are.

    Raises:
        UsageError: there is no such run, recording or tab, or `out` exists and `force` is not set.
        LogDamagedError: a log cannot be read.
        CdmisfaError: the view cannot be written.
    """
    if not any(map(holds_run, (path, *beside))):
        with recording_to(out, path.resolve().stem, path, force=force) as recording:
            _write_recording(recording, [path, *beside], every, tab, inputs, about)
        return
    if inputs is not None and (given := inputs.named()):
        raise UsageError(f"{path} is a run: {are_for(given, 'logs')}")
    if beside:
        raise UsageError(f"{path}: view shows one run at a time; for several use compare --save")
    log = run_log(path)
    with recording_to(out, log.resolve().parent.name, log, force=force) as recording:
        _write_run(recording, log, every, tab)


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
                raise UsageError(f"{path} is not an .rrd file: give a run or a recording")
        if tab is not None:
            raise UsageError(f"--tab {tab} does not apply to {path}: give its run or recording")
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
    """Yield a Rerun recording that becomes the file `out` once it is complete.

    Args:
        out: the file.
        name: what the viewer calls the recording.
        source: log that it is made from: Rerun merges recordings of the same name and source.
        force: replace an existing file.

    Raises:
        UsageError: it exists and `force` is not set.
        CdmisfaError: the file cannot be written.
    """
    refuse_unless(out, "a view is a Rerun file", ".rrd", "")
    refuse_taken(out, force=force)
    place = hashlib.sha256(str(source.resolve()).encode()).hexdigest()[:12]
    recording = rr.RecordingStream(APPLICATION, recording_id=f"{name}-{place}")
    recording.set_log_time_enabled(False)
    with atomic_write(out) as partial:
        try:
            recording.save(partial)
            if not partial.exists():
                raise CdmisfaError(
                    f"{out}: Rerun wrote nothing: unset the environment variable RERUN"
                )
            recording.send_recording_name(drawable(name))
            yield recording
            recording.flush(timeout_sec=FLUSH_SECONDS)
        except RuntimeError as error:
            what = f"{out} cannot be written: {error}; check the free space there"
            raise CdmisfaError(what) from error
        finally:
            recording.disconnect()


def _write_run(recording: rr.RecordingStream, log: Path, every: int, tab: str | None) -> None:
    header, folder = read_header(log), log.parent
    streams = list(range(len(header.spec.streams)))
    if len(streams) > MOST_STREAMS:  # the most attended streams are known only at the end
        streams = read_outline(log).streams(MOST_STREAMS)
    known = load_modules(folder) if (folder / MODULES_FILE).is_file() else ()
    tally, writer = Tally(header), Writer(recording, header.spec)
    view = RunView(writer, header, streams, folder, every=every, modules=known)
    events: list[str] = []
    for batch in read_batches(log, header, every=every):
        for columns in batch.signals:
            tally.add(columns)
        view.take(batch)
        events += [event.text for event in batch.events]
    outline = tally.outline()
    view.finish(outline)
    text = drawable(summary_text(outline, log.resolve().parent.name, events))
    writer.log("summary", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))
    has_scene, followed = isinstance(view.world, SceneView), view.modules.followed(outline)
    layout = run_layout(
        outline, writer, has_scene=has_scene, followed=followed, sheets=view.modules.sheets, tab=tab
    )
    recording.send_blueprint(layout)


def _write_recording(
    recording: rr.RecordingStream,
    paths: Sequence[Path],
    every: int,
    tab: str | None,
    inputs: InputOptions | None,
    about: Announce,
) -> None:
    """Write a recording's views and ground truth, and the layout for them."""
    with contextlib.closing(open_for_viewing(paths, inputs)) as source:
        about(source)
        first, count, spec = source.t, source.frames, source.spec
        files = [view.path for stream in source.streams for view in stream.views]
        scenery = scenery_of_recording(files) if source.recorded else None
        writer = Writer(recording, spec)
        world = None if scenery is None else SceneView(writer, scenery, every)
        for note in (*source.warnings, *(world.notes if world is not None else ())):
            writer.event(first, None, note, "WARN")
        entities = view_entities(spec)
        steps = [every if spec.of(s).images else 1 for s in range(len(entities))]
        for t in range(first, first + count, BLOCK):
            for stream, entity in enumerate(entities):
                for low, high in source.spans(stream, t, min(t + BLOCK, first + count)):
                    source.seek(low)
                    block, frames = source.take(stream, high - low), np.arange(low, high)
                    drawn = frames % steps[stream] == 0
                    writer.frames(entity, (frames[drawn], None), block.frames[drawn], stream)
                    if spec.truth and stream == 0:
                        writer.lines("world/truth", spec.truth, (frames, None), block.truth, gap=1)
                        if world is not None:
                            world.move(frames, block.truth)
        writer.flush()
    names = drawable(", ".join(spec.streams))
    properties: Any = {"frames": count, "streams": names, "fps": spec.fps}
    recording.send_property("recording", rr.AnyValues(**properties))
    layout = recording_layout(spec, first + count, has_scene=world is not None, tab=tab)
    recording.send_blueprint(layout)


def view_entities(spec: SourceSpec) -> list[str]:
    """Return the entity of each view."""
    return [f"views/{part(spec.streams, s)}" for s in range(len(spec.streams))]


def recording_layout(
    spec: SourceSpec, end: int, *, has_scene: bool = False, tab: str | None = None
) -> rrb.Blueprint:
    """Return the tabs of a recording: its world, where there is one, and its views.

    Args:
        spec: specification of its source.
        end: the frame where it ends.
        has_scene: the world is there in 3D.
        tab: name of the one that is open.
    """
    places = list(zip(view_entities(spec), map(drawable, spec.streams), strict=True))
    tabs = list[rrb.Container]()
    views_of = [
        images(f"/{entity}", name)
        if spec.of(stream).images
        else curve_view(name, [f"/{entity}"], end)
        for stream, (entity, name) in enumerate(places)
    ]
    views: rrb.Container = rrb.Vertical(*views_of)
    if spec.images:
        views = rrb.Grid(*views_of, grid_columns=min(len(views_of), 3))
    if has_scene:
        column = rrb.Vertical(*(images(f"/{entity}", name) for entity, name in places))
        tabs.append(rrb.Horizontal(scene(), column, column_shares=[5, 2], name="World"))
    below = [curve_view("Ground truth", ["/world/truth"], end)] if spec.truth else []
    tabs.append(rrb.Vertical(views, *below, name="Views"))
    return blueprint(*tabs, name="Recording", length=end, tab=tab)
