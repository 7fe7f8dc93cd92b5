"""Building the Rerun view of a run or a recording from its logs.

The view can always be built again: the logs are the archive.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import rerun as rr
from rerun.chunk import Chunk

from cdmisfa.core.errors import CdmisfaError, UsageError
from recorder.log.files import atomic_write, refuse_taken
from replay.camera_logs.options import CameraOptions
from replay.inputs import holds_run
from replay.runs.folders import MODULES_FILE, run_log
from replay.runs.log import Frames, read_batches, read_header
from replay.runs.modules import load_modules
from replay.runs.run import Tally, read_outline
from replay.view.labels import label
from replay.view.layouts.of_run import run_layout
from replay.view.layouts.panels import MOST_STREAMS
from replay.view.properties import APPLICATION, identity, properties_of, property_chunks
from replay.view.recording import write_recording, write_unwatched
from replay.view.run import RunView
from replay.view.summary import summary_text
from replay.view.world.first import WorldView
from replay.view.world.learned import write_learned

FLUSH_SECONDS = 60.0


def build_view(
    path: Path,
    out: Path,
    *,
    every: int = 10,
    force: bool = True,
    all_views: Path | None = None,
    tab: str | None = None,
    beside: Sequence[Path] = (),
    cameras: CameraOptions | None = None,
    body: bool = True,
) -> None:
    """Write the view of a run, a recording or camera logs as an .rrd file, whole or not at all.

    Args:
        path: a run's folder or its run.mcap, a recording, or a camera log.
        out: the file.
        every: show every so many watched frames, of those that were kept.
        force: replace an existing file.
        all_views: the recording that the run learned from, to show what was not watched too.
        tab: name of the tab that is open; by default the first.
        beside: more camera logs, or files of the recording.
        cameras: which streams of camera logs; by default all of images.
        body: show the robot's, where there is one.

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
        if beside:
            raise UsageError(f"{path}: one run is shown at a time; compare --save shows several")
        log = run_log(path)
        with recording_to(out, _name(log), log, force=force) as recording:
            _write_run(recording, log, every, all_views, tab, body=body)
    elif all_views is not None:
        raise UsageError(f"{path} is a recording: all of its views are shown anyway")
    else:
        with recording_to(out, path.resolve().stem, path, force=force) as recording:
            write_recording(recording, [path, *beside], every, tab, cameras)


@contextlib.contextmanager
def view_of(
    path: Path, every: int, all_views: Path | None, tab: str | None = None
) -> Iterator[Path]:
    """The view of a run, a recording or an .rrd file, there for as long as it is looked at.

    Raises:
        UsageError: there is no such file, or an .rrd file cannot have the tab.
    """
    if path.suffix == ".rrd":
        if not path.is_file():
            raise UsageError(f"{path} does not exist: name a run, a recording or an .rrd file")
        if tab is not None:
            raise UsageError(f"--tab {tab}: {path} is built already, name its run or recording")
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="cdmisfa-view-") as folder:
        view = Path(folder) / f"{path.resolve().stem}.rrd"
        build_view(path, view, every=every, all_views=all_views, tab=tab)
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
    refuse_taken(out, force=force)
    if not out.parent.is_dir():
        raise UsageError(f"{out} cannot be written: there is no folder {out.parent}")
    recording = rr.RecordingStream(APPLICATION, recording_id=identity(name, source))
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
    all_views: Path | None,
    tab: str | None,
    *,
    body: bool,
) -> None:
    header, folder = read_header(log), log.parent
    streams = list(range(len(header.spec.streams)))
    if len(streams) > MOST_STREAMS:  # which are watched most is known at the end only
        streams = read_outline(log).streams(MOST_STREAMS)
    tally, view = Tally(header), RunView(recording, header, streams, every)
    world = WorldView(recording, header, folder, streams, every, all_views, body=body)
    truth: list[Frames] = []
    for note in world.notes:
        view.event(0, 0, note, "WARN")
    events: list[str] = []
    for batch in read_batches(log, header, every=every):
        for columns in batch.signals:
            tally.add(columns)
        view.take(batch)
        world.take(batch)
        truth += batch.truth
        events += [event.text for event in batch.events]
    outline = tally.outline()
    view.finish(outline, load_modules(folder) if (folder / MODULES_FILE).is_file() else ())
    # Not as `AnyValues`, which lose a value of another type than the process's first of its name.
    recording.send_chunks([Chunk(c) for c in property_chunks(properties_of(outline, folder))])
    text = label(summary_text(outline, _name(log), events))
    recording.log("summary", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN), static=True)
    head = all_views is not None and write_unwatched(recording, all_views, log, outline, every)
    world.flush()
    first = world.first(write_learned(recording, log, outline, truth))
    recording.send_blueprint(
        run_layout(outline, first, all_views=all_views is not None, head=head, tab=tab)
    )


def _name(log: Path) -> str:
    return log.resolve().parent.name
