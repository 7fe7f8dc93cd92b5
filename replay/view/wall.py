"""The streams of a run as a wall of pictures: what each showed last, and what became of it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import rerun as rr

from cdmisfa.core.signals import STATES
from replay.palette import colour, packed_all
from replay.runs.columns import SignalColumns
from replay.runs.log import Batch
from replay.view.columns import Column, Target
from replay.view.labels import label, part
from replay.view.layouts import Bounds

WALL = "wall"
FRAME = f"{WALL}/frame"

SHAPE = 1.7
"""Width of the wall over its height, as near as whole pictures allow."""

ROOM, BETWEEN = 0.3, 0.06
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


def bounds(count: int, height: int, width: int) -> Bounds:
    """Ranges of x and y that hold a wall of so many pictures of a size."""
    x, y = (max(place[i] for place in places_of(count, width, height)) for i in (0, 1))
    margin = BETWEEN * height
    return (-margin, x + width + margin), (-margin, y + height * (1 + ROOM))


def places_of(count: int, width: int, height: int) -> list[tuple[float, float]]:
    """Corners (x, y) of so many pictures of a size on a wall, in rows."""
    across, down = width + BETWEEN * height, (1 + ROOM) * height

    def badness(columns: int) -> float:
        return abs(math.log(columns * across / (math.ceil(count / columns) * down) / SHAPE))

    columns = min(range(1, count + 1), key=badness)
    return [(i % columns * across, i // columns * down) for i in range(count)]
