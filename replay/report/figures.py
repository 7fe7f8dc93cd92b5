"""The plots and images of a report."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray, IntArray
from replay.palette import CYCLE, shade
from replay.report.run_data import ModuleData, RunData
from replay.report.saving_rules import Measurement
from replay.report.svg_plot import WIDE, Axis, Plot
from replay.runs.run import Outline
from replay.truth_fits import TruthFit

# Pixels from one row of a timeline to the next, and of its bars; `.names div` of page.css.
ROW, BAR = 22, 16

# Pixels of a plot from top to bottom.
TALL, FLAT, SMALL = 140, 96, 56

# Streams in a timeline, the most watched: more do not fit on a screen.
STREAMS = 60

# Bars of a stream in a timeline, each of as many blocks: 2.5 pixels are still seen.
BARS = 400

# Modules whose numbers a timeline shows; of more modules the words would overlap.
NAMED = 12

# Most pixels across or down of an image: a page must stay below 2 MB.
FRAME, THUMBNAIL, WEIGHTS = 96, 160, 128

# Numbers of a frame that are written out.
NUMBERS = 12


def colour_class(index: int) -> str:
    """Return the CSS class of a stream's color."""
    return f"c{index % len(CYCLE)}"


def value_range(
    values: Any, *, log: bool = False, limits: Sequence[float | None] = ()
) -> tuple[float, float]:
    """Return a range that shows all finite values and the limits, with some room."""
    values = np.concatenate([np.ravel(values), [v for v in limits if v is not None]])
    values = values[np.isfinite(values) & ((values > 0) | (not log))]
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.1, 1.0)
    if log:
        return low / 1.25, high * 1.25
    room = 0.06 * (high - low) or max(abs(high), 1.0) * 0.1
    return low - room, high + room


def _over_run(outline: Outline, about: str, y: Axis, frames: str = "") -> Plot:
    """Return an empty plot over all frames of a run."""
    start = int(outline.blocks.starts[0])
    return Plot(about, Axis(start, max(outline.end, start + 1), WIDE), y, frames=frames)


def timeline(outline: Outline, frames: str = "") -> Plot:
    """Draw which streams were watched when, their states, and the saves, one row a stream."""
    blocks, streams = outline.blocks, outline.streams(STREAMS)
    row_of = {s: k for k, s in enumerate(streams)}
    plot = _over_run(
        outline, "Attended streams and saved modules over the frames of the run",
        Axis(0, ROW * len(streams), ROW * len(streams)), frames,
    )  # fmt: skip
    plot.rows = [(outline.names()[s], colour_class(s)) for s in streams]
    starts = np.append(blocks.starts, outline.end)
    edges = np.unique(np.linspace(0, outline.iterations, BARS + 1).astype(int))
    left, right = blocks.starts[edges[:-1]], blocks.starts[edges[1:] - 1] + outline.tau
    for s, k in row_of.items():
        plot.boxes("lane", starts[0], outline.end, ROW * k, ROW * k + BAR)
        begins, _, codes = outline.changes[outline.changes[:, 1] == s].T
        stops = np.append(begins[1:], outline.iterations)
        for code in np.unique(codes[codes >= 0]).tolist():
            spans = starts[begins[codes == code]], starts[stops[codes == code]]
            plot.boxes(f"state{code}", *spans, ROW * k, ROW * k + BAR)
        watched = np.add.reduceat((blocks.streams == s).astype(int), edges[:-1])
        tall = np.rint(BAR * watched / np.diff(edges))
        foot, drawn = ROW * k + BAR, tall > 0
        plot.boxes(f"fill {colour_class(s)}", left[drawn], right[drawn], foot - tall[drawn], foot)
    for save in outline.saved:
        at = save.t + outline.tau
        plot.marks("saved", [at])
        if save.stream in row_of and len(outline.saved) <= NAMED:
            plot.word(at, ROW * row_of[save.stream] + BAR - 3, f"module {save.module}")
    if (fork := outline.header.forked_at) is not None and fork < outline.iterations:
        plot.marks("fork", starts[[fork]])
        plot.word(starts[fork], plot.y.size - 4, "fork")
    return plot


def rule_plot(outline: Outline, rule: Measurement, frames: str) -> Plot:
    """Draw a measurement over a run, its limits, where they held, and the saves."""
    limits, values = (rule.low, rule.high), rule.values
    if not rule.log and all(v is None or v <= 2 for v in limits):
        values = np.where(values > 3, 3.0, values)  # values far above the limits hide the rest
    low, high = value_range(values, log=rule.log, limits=limits)
    plot = _over_run(outline, rule.about, Axis(low, high, FLAT, rule.log, upward=True), frames)
    blocks = outline.blocks
    if rule.decides:
        edges = np.flatnonzero(np.diff(np.concatenate([[False], rule.holds, [False]]).astype(int)))
        ends = np.append(blocks.starts, outline.end)
        plot.boxes("held", ends[edges[::2]], ends[edges[1::2]])
    plot.grid(4)
    if outline.header.by_progress:  # the measurement is of the watched stream
        visits = np.cumsum(np.diff(blocks.streams, prepend=-1) != 0)
        for s in outline.streams(STREAMS):
            rows = blocks.streams == s
            plot.curve(colour_class(s), blocks.starts[rows], values[rows], visits[rows])
    else:
        plot.curve("plain", blocks.starts, values)
    for value in limits:
        if value is not None:
            plot.limit(value)
    rows = np.searchsorted(blocks.iterations, [save.iteration for save in outline.saved])
    plot.marks("saved", blocks.starts[rows])
    plot.dots("at", blocks.starts[rows], values[rows])
    return plot


def output_plot(run: RunData, module: ModuleData, saved: int, frames: str) -> Plot:
    """Draw a module's first output on its stream over the run, before and after its save."""
    t, y, _ = module.outputs.columns
    plot = _over_run(
        run.outline, f"Output 1 of module {module.frozen.index} over the frames of the run",
        Axis(*value_range(y[:, 0]), TALL, upward=True), frames,
    )  # fmt: skip
    plot.boxes("after", saved, run.outline.end)
    plot.grid(4, "+g")
    plot.dots(colour_class(module.frozen.stream_index), t, y[:, 0])
    plot.marks("saved", [saved])
    plot.word(saved, 12, "saved")
    return plot


def recent_plots(module: ModuleData) -> list[Plot]:
    """Draw each output of a module over the longest recent stretch of frames without a pause."""
    t, y = module.recent
    steps = np.diff(t)
    pauses = np.flatnonzero(steps > steps.min(initial=np.iinfo(np.int64).max)) + 1
    stretch = max(np.split(np.arange(len(t)), pauses), key=len)
    if len(stretch) < 3:
        return []
    t, y, alone = t[stretch], y[stretch], y.shape[1] == 1
    plots = []
    for j in range(y.shape[1]):
        plot = Plot(
            f"Output {j + 1} of module {module.frozen.index}, frames {t[0]} to {t[-1]}",
            Axis(t[0], t[-1], WIDE),
            Axis(*value_range(y[:, j]), FLAT if alone else SMALL, upward=True),
            most=8 if alone else 3,
        )
        plot.grid(2, "+g")
        plot.curve(f"broad {colour_class(module.frozen.stream_index)}", t, y[:, j])
        plots.append(plot)
    return plots


def truth_plot(module: ModuleData, fit: TruthFit) -> Plot:
    """Draw a module's first output over the true quantity that it follows."""
    _, y, truth = module.outputs.columns
    known = np.isfinite(truth[:, fit.column])
    value, output = truth[known, fit.column][-1200:], y[known, 0][-1200:]
    plot = Plot(
        f"Output of module {module.frozen.index} over {fit.function}",
        Axis(*value_range(value), WIDE),
        Axis(*value_range(output), TALL, upward=True),
        most=4,
        x_label="",  # the caption names the quantity
    )
    plot.grid(4, "+g")
    plot.dots(f"faint {colour_class(module.frozen.stream_index)}", value, output)
    line = np.linspace(value.min(), value.max(), 100)
    plot.curve("fit", line, fit(line))
    return plot


def numbers_plot(rows: NDArray[Any], about: str) -> Plot:
    """Draw rows of numbers over time, (n, I), the first seven of them."""
    values = np.asarray(rows, dtype=np.float64).reshape(len(rows), -1)[:, : len(CYCLE)]
    across = Axis(0, max(len(values) - 1, 1), WIDE)
    plot = Plot(about, across, Axis(*value_range(values), 76, upward=True))
    for i, column in enumerate(values.T):
        plot.curve(f"c{i}", np.arange(len(values)), column)
    return plot


def bars(values: FloatArray, about: str) -> Plot:
    """Draw the first 128 of some numbers as bars above and below 0."""
    values = np.ravel(values)[:128]
    most = float(np.abs(values).max(initial=0.0)) or 1.0
    plot = Plot(about, Axis(0, len(values), WIDE), Axis(-most, most, FLAT, upward=True))
    place, y = np.arange(len(values)), plot.y(values)
    for kind, rows in (("positive", values > 0), ("negative", values < 0)):
        plot.boxes(kind, place[rows], place[rows] + 0.8, y[rows], FLAT / 2)
    plot.grid(4, "+.2g")
    return plot


def curves(name: str, outlines: Sequence[Outline], about: str, *, log: bool) -> Plot | None:
    """Draw a signal of several runs over their iterations; None if it does not vary in any."""
    lines = []
    for k, outline in enumerate(outlines):
        if not outline.iterations:
            continue
        values = outline.lines[name].reshape(outline.iterations, -1)[:, 0]
        values = np.abs(values) if name == "eta_dot" else values
        if name == "learning_error":  # without a test it only holds its last value
            values = np.where(np.isfinite(outline.lines["tested"]), values, np.nan)
        if len(np.unique(values[np.isfinite(values)])) > 1:
            lines.append((k, outline.blocks.iterations, values))
    if not lines:
        return None
    low, high = value_range(np.concatenate([values for *_, values in lines]), log=log)
    across = Axis(0, max(int(at[-1]) + 1 for _, at, _ in lines), WIDE)
    plot = Plot(about, across, Axis(low, high, TALL, log, upward=True), x_label="iteration")
    plot.grid(5)
    for k, at, values in lines:
        plot.curve(colour_class(k), at, values)
    return plot


def frames_to_point_at(
    plot: Plot, t: IntArray, frames: NDArray[Any], texts: list[str], *, images: bool
) -> dict[str, Any]:
    """Return the frames that page.js shows where the reader points at a plot, as JSON values."""
    where = {"x": [round(x, 1) for x in plot.x(t).tolist()], "t": t.tolist()}
    if not images:
        texts = [f"{text} · {numbers(row)}" for text, row in zip(texts, frames, strict=True)]
        return {**where, "text": texts, "source": ""}
    small = [reduced(frame, FRAME) for frame in frames]
    columns, (height, width) = max(int(np.sqrt(len(small))), 1), small[0].shape
    size = {"columns": columns, "width": width, "height": height}
    return {**where, "text": texts, "source": data_uri(sheet(small, columns)), **size}


def numbers(row: NDArray[Any]) -> str:
    """Return the first numbers of a frame as text."""
    values = np.asarray(row, dtype=np.float64).ravel()
    return ", ".join(f"{v:.3g}" for v in values[:NUMBERS]) + " …" * (len(values) > NUMBERS)


def data_uri(image: NDArray[np.uint8], *, photo: bool | None = None) -> str:
    """Return an image as a data URI: a photo as JPEG, by default a gray one; others as PNG."""
    from PIL import Image

    data, photo = io.BytesIO(), image.ndim == 2 if photo is None else photo
    how: dict[str, Any] = {"quality": 78} if photo else {"optimize": True}
    Image.fromarray(np.ascontiguousarray(image)).save(data, "JPEG" if photo else "PNG", **how)
    encoded = base64.b64encode(data.getvalue()).decode()
    return f"data:image/{'jpeg' if photo else 'png'};base64,{encoded}"


def reduced(image: NDArray[Any], most: int) -> NDArray[Any]:
    """Return (height, width) values of at most `most` across and down, as means of areas."""
    step = -(-max(image.shape) // most)
    if step <= 1:
        return image
    height, width = (size // step * step for size in image.shape)
    areas = image[:height, :width].reshape(height // step, step, width // step, step)
    return np.asarray(areas.mean(axis=(1, 3), dtype=np.float64), image.dtype)


def sheet(images: Sequence[NDArray[np.uint8]], columns: int, gap: int = 0) -> NDArray[np.uint8]:
    """Return images of one size in rows, white between them."""
    height, width = images[0].shape
    rows = -(-len(images) // columns)
    shape = (rows * (height + gap) - gap, columns * (width + gap) - gap)
    whole = np.full(shape, 255, np.uint8)
    for k, image in enumerate(images):
        y, x = (height + gap) * (k // columns), (width + gap) * (k % columns)
        whole[y : y + height, x : x + width] = image
    return whole


def saliency_image(saliency: FloatArray, mean: FloatArray) -> str:
    """Return saliency in blue and orange over the mean image in gray."""
    values = reduced(saliency, WEIGHTS)
    gray = np.repeat(reduced(mean, WEIGHTS)[..., None], 3, axis=2) * 0.55 + 90
    part = np.abs(values)[..., None] / max(float(np.abs(values).max()), 1e-300)
    mixed = gray * (1 - part) + shade(np.sign(values)) * part
    return data_uri(mixed.clip(0, 255).astype(np.uint8))
