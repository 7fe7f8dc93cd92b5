"""The modules of a run: weights, output on their own streams, and frames of least to most output.

`/modules/<number>/output` holds a module's outputs wherever its own stream was watched, before its
save, too: on the frames that the log has. Of a run without its modules, as one that was broken off
or is still learning, it holds what the signals tell, from the save on.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import rerun as rr

from cdmisfa.core.arrays import FloatArray, IntArray
from cdmisfa.core.errors import UsageError
from cdmisfa.modules import Module
from replay.outputs import EACH, OwnStream, Sheet
from replay.palette import (
    BRICK,
    DARK,
    GREY,
    MIST,
    Colour,
    Rgb,
    colour,
    faint,
    packed,
    packed_all,
    shade,
)
from replay.runs.columns import SignalColumns
from replay.runs.log import Batch
from replay.runs.run import Outline
from replay.view.columns import Column, Target, tensors
from replay.view.labels import label
from replay.view.world import ROOM, places_of


@cache
def saved_mark() -> rr.SeriesPoints:
    """How the iteration is marked in which a module was saved.

    Made when it is needed: with it pyarrow imports pandas, where that is installed.
    """
    return rr.SeriesPoints(
        colors=[packed(BRICK)], markers="diamond", marker_sizes=[7.0], names=["module saved"]
    )


MOST_BARS = 256
"""Weights that are no picture, and drawn as bars: more are a tensor."""

BETWEEN = 4
"""Pixels between two frames of a row."""


def hang_weights(
    target: Target, path: str, outputs: int, labels: Sequence[str] = (), rgbs: Sequence[Rgb] = ()
) -> None:
    """Say where the weights of several outputs are to hang, each with a frame and words below it.

    Args:
        target: where they go.
        path: the entity of the weights.
        outputs: how many there are.
        labels: of the outputs, by default their numbers.
        rgbs: their colours, by default grey.
    """
    height, width = target.spec.frame_shape if target.spec.images else (0, 0)
    for j, (x, y) in enumerate(places_of(outputs, width, height) if width and outputs > 1 else ()):
        words, rgb = labels[j] if labels else str(j + 1), rgbs[j] if rgbs else GREY
        _hang(target, f"{path}/{j + 1}", (x, y), (width, height), words, rgb)


def write_weights(target: Target, path: str, t: int, iteration: int, phi: FloatArray) -> None:
    """Show (J, I) weights at a frame and iteration: as pictures, bars, or a tensor.

    Each output's picture, at `path` or of several at `path/<number>`, is in full colour at its own
    largest weight.
    """
    shape = target.spec.frame_shape
    if target.spec.images and phi.shape[1] == shape[0] * shape[1]:
        for j, row in enumerate(phi):
            place = path if len(phi) == 1 else f"{path}/{j + 1}"
            target.log_at(place, t, iteration, rr.Image(shade(row.reshape(shape))))
    elif phi.size <= MOST_BARS:
        bars = rr.BarChart(tensors(phi.reshape(1, -1)), color=packed(MIST))
        target.log_at(path, t, iteration, bars)
    else:
        target.log_at(path, t, iteration, rr.Tensor(phi.copy(), dim_names=("output", "input")))


class ModulesView:
    """Writes the modules of a run.

    Args:
        target: where they go.
        modules: of the run, where they are known.

    Attributes:
        notes: which modules say nothing of the run's frames, and why.
    """

    def __init__(self, target: Target, modules: Sequence[Module] = ()) -> None:
        self._target, spec, self.notes = target, target.spec, list[str]()
        known = [m for m in modules if m.stream_index < len(spec.streams)]
        self._own = {module.index: OwnStream(module, spec) for module in known}
        self._stream_of: dict[int, int] = {}
        self._columns: dict[int, Column] = {}
        self._tau = 0

    def take(self, batch: Batch) -> None:
        """Take what a log holds of some iterations."""
        weights = dict(batch.phi)
        for columns in batch.signals:
            self._tau = columns.tau
            self._saved(columns, weights)
            for number, stream in self._stream_of.items():
                own = columns["stream"] == stream
                if number not in self._own and number <= columns["y_frozen"].shape[1] and own.any():
                    frames, iterations = (
                        times[np.repeat(own, columns.tau)]
                        for times in columns.times(per_frame=True)
                    )
                    y = columns["y_frozen"][own, number - 1]
                    self._draw(number, frames, iterations, y.reshape(len(frames), -1))
        for number, module in list(self._own.items()):
            try:
                for t, _, y in module.take(batch):
                    self._draw(number, t, batch.blocks.iteration(t), y)
            except UsageError as error:
                del self._own[number]
                self.notes.append(f"module {number} says nothing of these frames: {error}")

    def finish(self, outline: Outline) -> None:
        """Write what is known at the end, and hand over what waits."""
        saved = {save.module: save.t for save in outline.saved}
        for number, own in self._own.items():
            module, at = own.module, saved.get(number, outline.end)
            slow = module.slow.astype(bool).tolist()
            labels = [
                f"{j + 1} {'slow' if is_slow else 'not slow'}" for j, is_slow in enumerate(slow)
            ]
            rgbs = [colour(module.stream_index) if is_slow else GREY for is_slow in slow]
            place = f"modules/{number}"
            hang_weights(self._target, f"{place}/weights", len(module.phi), labels, rgbs)
            write_weights(self._target, f"{place}/weights", at, module.iteration, module.phi)
            if self._target.spec.images and own.count:
                self._sheet(place, own.sheet())
        self.flush()

    def sheets(self) -> int:
        """How many modules have pictures of least to greatest output."""
        pictures = self._target.spec.images
        return sum(own.count > 0 for own in self._own.values()) if pictures else 0

    def flush(self) -> None:
        """Hand over everything that waits."""
        for column in self._columns.values():
            column.flush()

    def _saved(self, columns: SignalColumns, weights: dict[int, FloatArray]) -> None:
        """Mark where modules were saved; show weights of those that are not known otherwise."""
        for i in np.flatnonzero(columns["saved"]).tolist():
            number, stream = int(columns["module"][i]), int(columns["stream"][i])
            t, iteration = int(columns.frames[i]), int(columns.iterations[i])
            self._stream_of[number], place = stream, f"modules/{number}"
            self._target.log(f"{place}/saved", saved_mark())
            self._target.log_at(f"{place}/saved", t + columns.tau, iteration, rr.Scalars([0.0]))
            if number not in self._own and t in weights:
                hang_weights(self._target, f"{place}/weights", len(weights[t]))
                write_weights(self._target, f"{place}/weights", t, iteration, weights[t])

    def _draw(self, number: int, t: IntArray, iterations: IntArray, y: FloatArray) -> None:
        """Draw the (n, J) outputs of a module at n frames; of those it marks, the slow ones."""
        module = self._own[number].module if number in self._own else None
        stream = self._stream_of[number] if module is None else module.stream_index
        slow = np.zeros(0) if module is None else module.slow
        shown = np.flatnonzero(slow) if slow.any() else np.arange(y.shape[1])
        if number not in self._columns:
            names = [f"output {j + 1}" for j in shown.tolist()]
            rgbs: list[Colour] = [colour(stream), *(faint(colour(stream)) for _ in shown[1:])]
            place = f"modules/{number}/output"
            self._columns[number] = self._target.lines(place, names, rgbs, within=self._tau)
        self._columns[number].add(t, iterations, y[:, shown])

    def _sheet(self, place: str, sheet: Sheet) -> None:
        """Hang frames of least, middle and greatest output below one another."""
        height, width = self._target.spec.frame_shape
        gap = np.full((height, BETWEEN), DARK[0], dtype=np.uint8)
        rows = ("least", sheet.least), ("middle", sheet.middle), ("greatest", sheet.greatest)
        size = sheet_size(height, width)
        corners = places_of(len(rows), *size, columns=1)
        for number, ((name, picks), corner) in enumerate(zip(rows, corners, strict=True), 1):
            if not picks:
                continue
            path = f"{place}/sheet/{number}_{name}"
            row = np.hstack([part for pick in picks for part in (pick.frame, gap)])[:, :-BETWEEN]
            words = f"{name}: {picks[0].y:.2f} to {picks[-1].y:.2f}"
            _hang(self._target, path, corner, row.shape[::-1], words, GREY)
            self._target.log(path, rr.Image(row))


def sheet_size(height: int, width: int) -> tuple[int, int]:
    """Width and height of a row of a contact sheet of frames of a size."""
    return EACH * (width + BETWEEN) - BETWEEN, height


def _hang(
    target: Target,
    path: str,
    corner: tuple[float, float],
    size: Sequence[int],
    words: str,
    rgb: Rgb,
) -> None:
    """Say where a picture of a size (width, height) hangs, with a frame, and words below it."""
    width, height = size
    target.log(path, rr.Transform3D(translation=[*corner, 0.0]))
    rgbs = packed_all([rgb])
    frame = rr.Boxes2D(mins=[[0, 0]], sizes=[size], colors=rgbs, show_labels=False)
    target.log(f"{path}/frame", frame)
    place = [[width / 2, (1 + ROOM / 8) * height]]
    said = rr.Points2D(place, labels=[label(words)], colors=rgbs, radii=[0.0], show_labels=True)
    target.log(f"{path}/words", said)
