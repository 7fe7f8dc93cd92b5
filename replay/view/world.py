"""The world of a run as the first tab of its view shows it, and what was learned of it."""

from __future__ import annotations

import contextlib
import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr

from cdmisfa.core.errors import CdmisfaError, LogDamagedError
from cdmisfa.core.signals import STATES
from cdmisfa.core.untrusted import parse_json
from recorder.log.scenery import KIND, Scenery, scenery_of
from recorder.log.viewlog import CONFIG_NAME
from recorder.mcap.reader import LogReader
from replay.following import read_outputs
from replay.palette import GREY, colour, packed_all
from replay.recordings.source import first_pose
from replay.runs.columns import SignalColumns
from replay.runs.log import Batch, Frames, RunHeader
from replay.runs.run import Outline
from replay.storage.opening import log_files
from replay.view.columns import Column, Target
from replay.view.labels import label, part
from replay.view.layouts import Bounds, Lesson, WorldTab
from replay.view.scene import SceneView

WALL = "wall"
FRAME = f"{WALL}/frame"

SHAPE = 1.7
"""Width of the wall over its height, as near as whole pictures allow."""

ROOM, BETWEEN = 0.5, 0.06
"""Room below a picture for its words, and between two, in heights of a picture."""


class WallView:
    """Writes the streams of a run as pictures on a wall.

    Each shows the last picture of the last block in which its stream was watched. The stream that
    is watched is framed.

    Args:
        target: where they go.
        streams: those that are shown.
        by_progress: the run is one of the progress learner.
    """

    def __init__(self, target: Target, streams: Sequence[int], *, by_progress: bool) -> None:
        self._target, self._spec, self._streams = target, target.spec, list(streams)
        self._by_progress = by_progress
        height, width = self._spec.frame_shape
        self._places = places_of(len(self._streams), width, height)
        self._pictures: dict[int, Column] = {}
        self._last, self._said = -1, dict.fromkeys(self._streams, "")
        for s, (x, y) in zip(self._streams, self._places, strict=True):
            path = f"{WALL}/{part(self._spec.streams, s)}"
            target.log(path, rr.Transform3D(translation=[x, y, 0.0]))
            self._pictures[s] = target.images(path)

    def take(self, batch: Batch) -> None:
        """Take what a log holds of some iterations."""
        for columns in batch.signals:
            self._frame(columns)
            self._say(columns)
        blocks = batch.blocks
        for frames, images in batch.watched if len(blocks.starts) else ():
            places = blocks.places(frames)
            last = np.flatnonzero(np.diff(places, append=len(blocks.starts)))
            for s in np.unique(blocks.streams[places[last]]).tolist():
                if (column := self._pictures.get(s)) is not None:
                    shown = last[blocks.streams[places[last]] == s]
                    column.add(frames[shown], blocks.iterations[places[shown]], images[shown])

    def flush(self) -> None:
        """Hand over what waits."""
        for column in self._pictures.values():
            column.flush()

    def _frame(self, columns: SignalColumns) -> None:
        """Put the frame around what is watched."""
        streams = columns["stream"].astype(np.int64)
        turns = np.flatnonzero(np.diff(streams, prepend=self._last))
        self._last = int(streams[-1])
        if not len(turns):
            return
        height, width = self._spec.frame_shape
        place = dict(zip(self._streams, self._places, strict=True))
        watched = streams[turns].tolist()
        boxes = rr.Boxes2D.columns(  # of a stream that is not shown the frame has no size
            half_sizes=[(width / 2, height / 2) if s in place else (0.0, 0.0) for s in watched],
            centers=[
                (place[s][0] + width / 2, place[s][1] + height / 2) if s in place else (0.0, 0.0)
                for s in watched
            ],
            colors=packed_all([colour(s) for s in watched]),
            radii=[height / 80] * len(watched),
        )
        self._target.send(FRAME, columns.frames[turns], columns.iterations[turns], boxes)

    def _say(self, columns: SignalColumns) -> None:
        """Write below each picture its stream's name and what became of it."""
        height, width = self._spec.frame_shape
        for s in self._streams:
            rows, texts = [], []
            for i, text in self._states(columns, s):
                if text != self._said[s]:
                    self._said[s] = text
                    rows.append(i)
                    texts.append(text)
            if not rows:
                continue
            path = f"{WALL}/{part(self._spec.streams, s)}/state"
            words = rr.Points2D.columns(
                positions=[(width / 2, (1 + ROOM / 2) * height)] * len(rows),
                labels=texts,
                colors=packed_all([colour(s)] * len(rows)),
                radii=[0.0] * len(rows),
                show_labels=[True] * len(rows),
            )
            self._target.send(path, columns.frames[rows], columns.iterations[rows], words)

    def _states(self, columns: SignalColumns, s: int) -> list[tuple[int, str]]:
        """Rows at which a stream's state may change, and its words from there on."""
        name = label(self._spec.streams[s])
        if self._by_progress:
            codes = columns["state"][:, s].astype(np.int64)
            places = [0, *(np.flatnonzero(np.diff(codes)) + 1).tolist()]
            words = {i: STATES[code].replace("_", " ") for i in places if (code := codes[i]) >= 0}
            return [(i, f"{name}: {words[i]}" if i in words else name) for i in places]
        saves = np.flatnonzero(columns["saved"] & (columns["stream"] == s)).tolist()
        learned = [(i, f"{name}: module {int(columns['module'][i])}") for i in saves]
        return learned if self._said[s] else [(0, name), *learned]


def bounds(count: int, height: int, width: int, columns: int | None = None) -> Bounds:
    """Ranges of x and y that hold a wall of so many pictures of a size; see `places_of`."""
    places = places_of(count, width, height, columns)
    x, y = (max(place[i] for place in places) for i in (0, 1))
    margin = BETWEEN * height
    return (-margin, x + width + margin), (-margin, y + height * (1 + ROOM))


def places_of(
    count: int, width: int, height: int, columns: int | None = None
) -> list[tuple[float, float]]:
    """Corners (x, y) of so many pictures of a size on a wall, in rows of so many, or as fit."""
    across, down = width + BETWEEN * height, (1 + ROOM) * height

    def badness(columns: int) -> float:
        return abs(math.log(columns * across / (math.ceil(count / columns) * down) / SHAPE))

    columns = columns or min(range(1, count + 1), key=badness)
    return [(i % columns * across, i // columns * down) for i in range(count)]


PRESET = (
    "the recording that it learned from is not where it was: the table, the eyes and the sizes of "
    "the objects are those of the scene's preset"
)


def world_of_run(header: RunHeader, run: Path) -> tuple[Scenery | None, str | None]:
    """Scenery of a run, and what is uncertain about it.

    Args:
        header: of its log.
        run: its folder.

    Returns:
        No world where the run was in none that is described here.
    """
    source = _table(header.manifest.get("source"))
    if source.get("kind") == KIND:
        return _told(_table(source.get("scene")))
    if source.get("scene") != KIND:
        return None, None
    for place in _places(header, run):
        with contextlib.suppress(CdmisfaError, OSError):
            found = world_of_recording(place, sha256=str(source.get("config_sha256")))
            if found is not None:
                return found, None
    scenery, _ = _told(_table(_table(header.manifest.get("config")).get("scene")))
    return scenery, PRESET if scenery is not None else None


def world_of_recording(path: Path, sha256: str | None = None) -> Scenery | None:
    """Scenery of a recording.

    Args:
        path: of the recording.
        sha256: the checksum that its configuration must have.

    Returns:
        None of other scenes and recordings.

    Raises:
        UsageError: there is no such recording.
        LogDamagedError: it cannot be read.
    """
    data, pose = b"{}", None
    for file in log_files(path):  # the first has it, unless they are many
        with LogReader(file) as reader:
            if own := [entry for entry in reader.attachments if entry.name == CONFIG_NAME]:
                data, pose = bytes(reader.attachment_data(own[0])), first_pose(reader)
                break
    if sha256 is not None and hashlib.sha256(data).hexdigest() != sha256:
        return None
    try:
        config = _table(_table(parse_json(data)).get("scene"))
    except ValueError as error:
        raise LogDamagedError(f"{file}: its {CONFIG_NAME} is broken ({error})") from error
    return scenery_of(config, None if pose is None else pose.position)


def _places(header: RunHeader, run: Path) -> Iterator[Path]:
    """Places where the recording may be that a run learned from."""
    named = _table(header.manifest.get("command")).get("source")
    for name in named if isinstance(named, list) else []:
        with contextlib.suppress(OSError, ValueError):
            if (place := run / str(name)).exists():
                yield place


def _told(config: Mapping[str, Any]) -> tuple[Scenery | None, str | None]:
    try:
        return scenery_of(config), None
    except LogDamagedError as error:
        return None, str(error)


def _table(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


class WorldView:
    """Writes the world of a run.

    Args:
        recording: where it goes.
        header: of the run's log.
        run: its folder.
        streams: those that are shown.
        every: where things are is shown at every so many frames, as pictures are.

    Attributes:
        notes: what a person should know of it.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        header: RunHeader,
        run: Path,
        streams: Sequence[int],
        every: int,
    ) -> None:
        target = Target(recording, header.spec)
        scenery, unsure = world_of_run(header, run)
        self._tab = WorldTab(scene=scenery is not None)
        self._view: SceneView | WallView | None = None
        self.notes: list[str] = [] if unsure is None else [unsure]
        if scenery is not None:
            self._view = SceneView(target, scenery, every)
            self.notes += self._view.notes
        elif header.spec.images:
            self._tab = WorldTab(wall=bounds(len(streams), *header.spec.frame_shape))
            self._view = WallView(target, streams, by_progress=header.by_progress)

    def take(self, batch: Batch) -> None:
        """Take what a log holds of some iterations."""
        if self._view is not None:
            self._view.take(batch)

    def flush(self) -> None:
        """Hand over everything that waits."""
        if self._view is not None:
            self._view.flush()

    def tab(self, lessons: Sequence[Lesson] = ()) -> WorldTab:
        """The first tab: the world, and what was learned of it."""
        return replace(self._tab, lessons=lessons)


LEARNED = "learned"

MOST = 6
"""Modules that are shown: the first."""

MOST_FRAMES = 1_000_000
"""Last frames of a run for which it is shown."""

BROAD, NARROW = 4.0, 1.5
"""Widths of the line that is followed, and of the one that follows."""


def write_learned(
    recording: rr.RecordingStream,
    log: Path,
    outline: Outline,
    truth: Sequence[Frames],
) -> list[Lesson]:
    """Write each module's output where its stream was watched, and what it follows at all frames.

    Args:
        recording: where it goes.
        log: of the run.
        outline: the run in short.
        truth: what the world knew at each frame, piece after piece.
    """
    names, spec = outline.names(), outline.header.spec
    target = Target(recording, spec)
    if not truth or not outline.saved:
        return []
    frames, values = (np.concatenate(part)[-MOST_FRAMES:] for part in zip(*truth, strict=True))
    iterations, lessons = outline.blocks.iteration(frames), []
    for output in read_outputs(log, outline, (frames, values), MOST, MOST_FRAMES):
        found = output.best_fit(spec.truth)
        if found is None:
            continue
        followed = found(values[:, found.column])
        said = np.full(len(frames), np.nan)
        said[np.isin(frames, output.t)] = output.y[np.isin(output.t, frames)]
        stream, root = names[output.stream], f"{LEARNED}/{output.module}"
        whose = f"module {output.module} on {stream}"
        for path, name, rgb, width, line in (
            ("followed", f"{found.function}, fitted to it", GREY, BROAD, followed),
            ("output", whose, colour(output.stream), NARROW, said),
        ):
            place, how = f"{root}/{path}", ([name], [rgb], width)
            column = target.lines(place, *how, within=1)
            column.add(frames, iterations, line)
            column.flush()
        both = np.concatenate([followed, output.y])
        title = (
            f"Module {output.module} on {label(stream)} has learned {label(found.function)} "
            f"(grey): |r| = {found.r:.2f}"
        )
        entities = (f"/{root}/followed", f"/{root}/output")
        lessons.append(Lesson(title, entities, (float(both.min()), float(both.max()))))
    return lessons
