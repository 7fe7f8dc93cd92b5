"""The modules of a run: weights, outputs, and frames with the least to the greatest output.

`/modules/<number>/output` has a module's outputs on the logged frames of its stream, also before
its save. If modules.npz is missing, as in an interrupted run or one that is still learning, it has
the outputs in the signals, from the save on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache

import numpy as np
import rerun as rr

from cdmisfa.core.arrays import FloatArray, IntArray
from cdmisfa.core.errors import UsageError
from cdmisfa.modules import Module
from replay.module_outputs import ModuleOutputs, SampledFrame
from replay.palette import BRICK, DARK, GREY, MIST, Rgb, RgbOrRgba, colour, faint, packed, shade
from replay.runs.columns import SignalColumns
from replay.runs.log import Batch, Frames
from replay.runs.run import Outline
from replay.truth_fits import truth_fits
from replay.view.image_grid import BETWEEN, grid_positions, place_image, sheet_size
from replay.view.layouts import Panel
from replay.view.writer import Writer, drawable

PHI = "abstraction/phi"

# Modules whose output is drawn over the quantity that it follows: as many as fit below the scene.
FOLLOWED = 6

# Last frames of a run for which it is drawn.
FOLLOWED_FRAMES = 1_000_000

# Blocks before the save whose output is drawn: in earlier ones the weights still changed.
LAST_BLOCKS = 40

# Width of the line of the followed quantity, behind the output, in points.
BROAD = 4.0


@cache
def saved_mark() -> rr.SeriesPoints:
    """Return how the iteration is marked in which a module was saved.

    Made when it is needed: with it pyarrow imports pandas, where that is installed.
    """
    return rr.SeriesPoints(
        colors=[packed(BRICK)], markers="diamond", marker_sizes=[7.0], names=["module saved"]
    )


def hang_weights(
    writer: Writer, path: str, stream: int, labels: Sequence[str], rgbs: Sequence[Rgb] = ()
) -> None:
    """Place the weights of several outputs in a grid, with gray borders by default."""
    spec = writer.spec.of(stream)
    if not spec.images or len(labels) == 1:
        return
    height, width = spec.frame_shape
    corners = grid_positions(len(labels), width, height)
    for j, (words, corner) in enumerate(zip(labels, corners, strict=True)):
        rgb = rgbs[j] if rgbs else GREY
        place_image(writer, f"{path}/{j + 1}", corner, (width, height), words, rgb)


def write_weights(
    writer: Writer, path: str, stream: int, t: int, iteration: int, phi: FloatArray
) -> None:
    """Show (J, I) weights for frames of a stream at a frame and iteration: as images, or bars.

    Each output's image, at `path` or of several at `path/<number>`, is in full color at its own
    largest weight.
    """
    spec = writer.spec.of(stream)
    shape = spec.frame_shape
    if not spec.images or phi.shape[1] != shape[0] * shape[1]:
        writer.log_at(path, t, iteration, rr.BarChart(phi.reshape(-1).copy(), color=packed(MIST)))
        return
    for j, weights in enumerate(phi):
        place = path if len(phi) == 1 else f"{path}/{j + 1}"
        writer.log_at(place, t, iteration, rr.Image(shade(weights.reshape(shape))))


def _numbers(phi: FloatArray) -> list[str]:
    return [str(j + 1) for j in range(len(phi))]


class Weights:
    """Writes the weights of the candidate of the attended stream, as far as they are logged.

    In a run of the progress learner each stream has a candidate, and the log has the weights of
    the candidate whose stream is next. They are shown once that stream is attended; until then
    its previous weights are shown, or none (white). None are if streams have frames of several
    kinds.

    Args:
        writer: writer of the Rerun recording.
        by_progress: the run is one of the progress learner.
    """

    def __init__(self, writer: Writer, *, by_progress: bool) -> None:
        self._writer, self._by_progress, self._stream = writer, by_progress, -1
        self._phi: dict[int, FloatArray] = {}

    def take(self, batch: Batch) -> None:
        """Write the weights of some iterations."""
        logged = dict(batch.phi)
        for columns in () if self._writer.spec.kinds else batch.signals:
            watched = columns["stream"]
            owners = np.where(columns["saved"], watched, columns["next_stream"])
            owners = owners if self._by_progress else watched
            signals = (columns.frames, columns.iterations, watched, owners)
            for t, iteration, s, owner in zip(*(v.tolist() for v in signals), strict=True):
                phi, visible = logged.get(t), None
                if self._by_progress and s != self._stream and self._phi:
                    visible = self._phi.get(s, 0 * next(iter(self._phi.values())))
                self._stream = s
                if phi is not None:
                    if not self._phi:
                        hang_weights(self._writer, PHI, 0, _numbers(phi))
                    self._phi[owner] = phi
                    visible = phi if owner == s else visible
                if visible is not None:
                    write_weights(self._writer, PHI, 0, t, iteration, visible)


class ModulesView:
    """Writes the modules of a run.

    Args:
        writer: writer of the Rerun recording.
        modules: modules of the run; empty if they are unknown.
        by_progress: the run is one of the progress learner.

    Attributes:
        sheets: modules with images of least to greatest output.
    """

    def __init__(self, writer: Writer, modules: Sequence[Module], *, by_progress: bool) -> None:
        self._by_progress = by_progress
        self._writer, self._notes, self.sheets = writer, list[str](), set[int]()
        known = [m for m in modules if m.stream_index < len(writer.spec.streams)]
        self._known = {module.index: ModuleOutputs(module, writer.spec) for module in known}
        self._stream_of: dict[int, int] = {}
        self._tau = 0
        self._truth: list[Frames] = []
        numbers = sorted(self._known)[:FOLLOWED] if writer.spec.truth else []
        self._first: dict[int, list[tuple[int, FloatArray]]] = {n: [] for n in numbers}

    def take(self, batch: Batch) -> None:
        """Write the messages of some iterations."""
        weights = dict(batch.phi)
        if self._first:
            self._truth += batch.truth
        for columns in batch.signals:
            self._tau = columns.tau
            self._saved(columns, weights)
            self._keep_first(columns)
            frozen = columns["y_frozen"]
            for number, stream in self._stream_of.items():
                watched = columns["stream"] == stream
                is_unknown = number not in self._known and number <= frozen.shape[1]
                if is_unknown and watched.any():
                    of = np.repeat(watched, columns.tau)
                    frames, iterations = (times[of] for times in columns.times(per_frame=True))
                    y = frozen[watched, number - 1].reshape(len(frames), -1)
                    self._output(number, frames, iterations, y)
        for number, module in list(self._known.items()):
            try:
                for t, _, y in module.take(batch):
                    self._output(number, t, batch.blocks.iteration(t), y)
            except UsageError as error:
                del self._known[number]
                self._first.pop(number, None)
                self._notes.append(
                    f"module {number} cannot be applied to the logged frames: {error}"
                )

    def finish(self, outline: Outline) -> list[str]:
        """Write weights and frames of the modules that are known.

        Returns:
            Which modules have no output on the run's frames, and why.
        """
        saved = {save.module: save.t for save in outline.saved}
        for number, stream in self._known.items():
            module, place = stream.module, f"modules/{number}"
            rgbs = [colour(module.stream_index) if is_slow else GREY for is_slow in module.slow]
            of = f"{place}/weights", module.stream_index
            hang_weights(self._writer, *of, module.labels, rgbs)
            at = saved.get(number, outline.end), module.iteration
            write_weights(self._writer, *of, *at, module.phi)
            spec = self._writer.spec.of(module.stream_index)
            if spec.images and stream.count:
                self.sheets.add(number)
                self._write_sheet(place, stream.sheet(), *spec.frame_shape)
        return self._notes

    def _saved(self, columns: SignalColumns, weights: dict[int, FloatArray]) -> None:
        """Mark the frames of saves, and show the weights of modules that are not in modules.npz."""
        for i in np.flatnonzero(columns["saved"]).tolist():
            number, stream = int(columns["module"][i]), int(columns["stream"][i])
            t, iteration = int(columns.frames[i]), int(columns.iterations[i])
            self._stream_of[number], place = stream, f"modules/{number}"
            self._writer.log(f"{place}/saved", saved_mark())
            self._writer.log_at(f"{place}/saved", t + columns.tau, iteration, rr.Scalars([0.0]))
            if number not in self._known and t in weights:
                of = f"{place}/weights", stream
                hang_weights(self._writer, *of, _numbers(weights[t]))
                write_weights(self._writer, *of, t, iteration, weights[t])

    def _output(self, number: int, t: IntArray, iterations: IntArray, y: FloatArray) -> None:
        """Draw the (n, J) outputs of a module at n frames; only slow ones where any is slow."""
        module = self._known[number].module if number in self._known else None
        stream = self._stream_of[number] if module is None else module.stream_index
        slow = np.zeros(0) if module is None else module.slow
        visible = np.flatnonzero(slow) if slow.any() else np.arange(y.shape[1])
        names = [f"output {j + 1}" for j in visible.tolist()]
        rgbs: list[RgbOrRgba] = [colour(stream), *(faint(colour(stream)) for _ in visible[1:])]
        path = f"modules/{number}/output"
        self._writer.lines(path, names, (t, iterations), y[:, visible], rgbs, gap=self._tau)

    def _keep_first(self, columns: SignalColumns) -> None:
        """Keep first outputs in blocks of their own streams, of learning ones the last blocks."""
        frozen = columns["y_frozen"]
        for number, blocks in self._first.items():
            is_saved = number <= frozen.shape[1]
            y = frozen[:, number - 1] if is_saved else columns["y"]
            watched = columns["stream"] == self._known[number].module.stream_index
            watched &= is_saved | self._by_progress | (columns["module"] == number)
            watched &= np.isfinite(y).all(axis=(1, 2))
            blocks += zip(columns.frames[watched].tolist(), y[watched, :, 0], strict=True)
            del blocks[: -(FOLLOWED_FRAMES // columns.tau if is_saved else LAST_BLOCKS)]

    def followed(self, outline: Outline) -> list[Panel]:
        """Write what the first output of each known module follows best.

        Returns:
            A panel for each module that follows any true quantity.
        """
        spec, panels = self._writer.spec, list[Panel]()
        if not self._truth:
            return panels
        parts = zip(*self._truth, strict=True)
        frames, values = (np.concatenate(column)[-FOLLOWED_FRAMES:] for column in parts)
        at = frames, outline.blocks.iteration(frames)
        for number, blocks in self._first.items():
            t = np.ravel([start + np.arange(len(y)) for start, y in blocks]).astype(np.int64)
            known = np.isin(t, frames)
            t, y = t[known], np.ravel([y for _, y in blocks])[known]
            best = next(iter(truth_fits(spec.truth, values[np.searchsorted(frames, t)], y)), None)
            if best is None:
                continue
            s, root = self._known[number].module.stream_index, f"learned/{number}"
            stream, line = spec.streams[s], best(values[:, best.column])[:, None]
            name, where = f"{best.function}, fitted", outline.blocks.iteration(t)
            self._writer.lines(f"{root}/followed", [name], at, line, [GREY], width=BROAD, gap=1)
            name, rgbs = f"module {number} on {stream}", [colour(s)]
            self._writer.lines(f"{root}/output", [name], (t, where), y[:, None], rgbs, gap=1)
            function, r = drawable(best.function), f"|r| = {best.r:.2f}"
            title = f"Module {number} ({drawable(stream)}) follows {function} (gray), {r}"
            entities = f"/{root}/followed", f"/{root}/output"
            panels.append(Panel(title, entities, "recent", fit=True, legend=False))
        self._writer.flush()
        return panels

    def _write_sheet(
        self, place: str, sheet: Mapping[str, Sequence[SampledFrame]], height: int, width: int
    ) -> None:
        """Hang frames of least, middle and greatest output below one another."""
        gap = np.full((height, BETWEEN), DARK[0], dtype=np.uint8)
        corners = grid_positions(len(sheet), *sheet_size(height, width), columns=1)
        hung = zip(sheet.items(), corners, strict=True)
        for number, ((name, picks), corner) in enumerate(hung, 1):
            if picks:
                path = f"{place}/sheet/{number}_{name}"
                strip = np.hstack([part for pick in picks for part in (pick.frame, gap)])
                strip = strip[:, :-BETWEEN]
                words = f"{name}: {picks[0].y:.2f} to {picks[-1].y:.2f}"
                place_image(self._writer, path, corner, strip.shape[::-1], words, GREY)
                self._writer.log(path, rr.Image(strip))
