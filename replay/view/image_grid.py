"""A grid of labelled images: the streams of a run without a known 3D scene."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import rerun as rr

from cdmisfa.core.signals import STATE_WORDS
from replay.module_outputs import SAMPLE_FRAMES
from replay.palette import Rgb, colour, packed_all
from replay.runs.columns import SignalColumns
from replay.runs.log import Batch
from replay.view.writer import Interval, Writer, changes, drawable, part

GRID = "latest_frames"

# Aspect ratio of the grid, about that of its panel.
SHAPE = 1.7

# Space below an image for its label, and between images, in heights of an image.
ROOM, SPACE = 0.5, 0.06

# Pixels between two frames of a contact sheet.
BETWEEN = 4


def grid_positions(
    count: int, width: int, height: int, columns: int | None = None
) -> list[tuple[float, float]]:
    """Return corners (x, y) of images in a grid; `columns` follows from `SHAPE` by default."""
    across, down = width + SPACE * height, (1 + ROOM) * height

    def badness(columns: int) -> float:
        return abs(math.log(columns * across / (math.ceil(count / columns) * down) / SHAPE))

    columns = columns or min(range(1, count + 1), key=badness)
    return [(i % columns * across, i // columns * down) for i in range(count)]


def grid_bounds(
    count: int, height: int, width: int, columns: int | None = None
) -> tuple[Interval, Interval]:
    """Return ranges of x and y that enclose a grid of images; see `grid_positions`."""
    x, y = map(max, zip(*grid_positions(count, width, height, columns), strict=True))
    margin = SPACE * height
    return (-margin, x + width + margin), (-margin, y + height * (1 + ROOM))


def sheet_size(height: int, width: int) -> tuple[int, int]:
    """Return width and height of one row of a contact sheet."""
    return SAMPLE_FRAMES * (width + BETWEEN) - BETWEEN, height


def place_image(
    writer: Writer, path: str, corner: Sequence[float], size: Sequence[int], words: str, rgb: Rgb
) -> None:
    """Place an image of a size (width, height) in the grid, with a border and a label."""
    width, height = size
    writer.log(path, rr.Transform3D(translation=[*corner, 0.0]))
    rgbs = packed_all([rgb])
    frame = rr.Boxes2D(mins=[[0, 0]], sizes=[size], colors=rgbs, show_labels=False)
    writer.log(f"{path}/frame", frame)
    place, texts = [[width / 2, (1 + ROOM / 8) * height]], [drawable(words)]
    text = rr.Points2D(place, labels=texts, colors=rgbs, radii=[0.0], show_labels=True)
    writer.log(f"{path}/words", text)


class ImageGridView:
    """Writes the streams of a run as a grid of images.

    Each image is the last one of the latest block in which its stream was attended. The attended
    stream has a border.

    Args:
        writer: writer of the Rerun recording.
        streams: indices of the visible streams.
        by_progress: the run is one of the progress learner.
    """

    def __init__(self, writer: Writer, streams: Sequence[int], *, by_progress: bool) -> None:
        self._writer, self._by_progress = writer, by_progress
        height, width = writer.spec.frame_shape
        self._size = width, height
        self._corners = dict(zip(streams, grid_positions(len(streams), width, height), strict=True))
        self._paths = {s: f"{GRID}/{part(writer.spec.streams, s)}" for s in streams}
        self._framed, self._words = -1, dict.fromkeys(streams, "")
        for s, corner in self._corners.items():
            writer.log(self._paths[s], rr.Transform3D(translation=[*corner, 0.0]))

    def take(self, batch: Batch) -> None:
        """Write the messages of some iterations."""
        for columns in batch.signals:
            self._frame(columns)
            for s in self._paths:
                self._write_words(columns, s)
        blocks = batch.blocks
        for frames, images in batch.watched if len(blocks.starts) else ():
            places = blocks.places(frames)
            last = np.flatnonzero(np.diff(places, append=len(blocks.starts)))
            streams = blocks.streams[places[last]]
            for s in self._paths.keys() & set(streams.tolist()):
                rows = last[streams == s]
                at = frames[rows], blocks.iterations[places[rows]]
                self._writer.frames(self._paths[s], at, images[rows], s)

    def _frame(self, columns: SignalColumns) -> None:
        """Put the border around the attended stream, of size 0 if the stream is not visible."""
        turns = changes(columns["stream"], self._framed)
        if not len(turns):
            return
        watched = columns["stream"][turns].tolist()
        self._framed = watched[-1]
        half = np.array(self._size) / 2
        boxes = rr.Boxes2D.columns(
            half_sizes=[half if s in self._corners else (0.0, 0.0) for s in watched],
            centers=[half + self._corners.get(s, (0.0, 0.0)) for s in watched],
            colors=packed_all([colour(s) for s in watched]),
            radii=[self._size[1] / 80] * len(watched),
        )
        at = columns.frames[turns], columns.iterations[turns]
        self._writer.send(f"{GRID}/frame", at, boxes)

    def _write_words(self, columns: SignalColumns, s: int) -> None:
        """Write the label of an image when the state or the module of its stream changes."""
        name, words = drawable(self._writer.spec.streams[s]), self._words[s]
        texts: list[tuple[int, str]] = []
        if self._by_progress:
            codes = columns["state"][:, s]
            for i in changes(codes, codes[0] - 1).tolist():
                state = STATE_WORDS[codes[i]] if codes[i] >= 0 else ""
                texts.append((i, f"{name}: {state}" if state else name))
        else:
            saves = np.flatnonzero(columns["saved"] & (columns["stream"] == s)).tolist()
            texts = [] if words else [(0, name)]
            texts += [(i, f"{name}: module {columns['module'][i]}") for i in saves]
        if texts and texts[0][1] == words:
            texts = texts[1:]
        if not texts:
            return
        turns, labels = zip(*texts, strict=True)
        self._words[s], count = labels[-1], len(texts)
        width, height = self._size
        points = rr.Points2D.columns(
            positions=[(width / 2, (1 + ROOM / 2) * height)] * count,
            labels=labels,
            colors=packed_all([colour(s)] * count),
            radii=[0.0] * count,
            show_labels=[True] * count,
        )
        at = columns.frames[[*turns]], columns.iterations[[*turns]]
        self._writer.send(f"{self._paths[s]}/state", at, points)
