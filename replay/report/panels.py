"""The plots and pictures of a run's report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.signals import STATES
from replay.following import Fit
from replay.outputs import Pick
from replay.palette import shade
from replay.report.conditions import Condition, saved_rows
from replay.report.drawing import (
    BINS,
    WIDE,
    Axis,
    Label,
    Plot,
    colour_class,
    data_uri,
    number,
    padded,
    reduced,
    sheet,
)
from replay.report.told import ModuleTold, RunTold

LANE, ROOM = 22, 6
"""Pixels of a stream's lane, and those between two."""

TALL, FLAT, NEAR = 140, 96, 56
"""Pixels of a plot."""

LANES = 60
"""Streams of the timeline: the most watched."""

NAMED = 12
"""Modules whose numbers are written where they were saved; of more each has a line in its lane."""

PIXELS = 96
"""Most pixels across or down of a frame that is shown where one points."""

FEW = 12
"""Numbers of a frame that are written out."""


@dataclass(frozen=True, slots=True)
class Frames:
    """Frames that are shown where one points at a plot: JSON values.

    Attributes:
        source: pictures side by side in one, as a data URI; "" of numbers.
        x: place of each, of `WIDE`.
        text: what is said of each.
    """

    source: str
    columns: int
    width: int
    height: int
    x: list[float]
    text: list[str]
    t: list[int]


def timeline(told: RunTold, frames: str) -> Plot:
    """What was watched when, a lane a stream, what had become of each, and what was saved."""
    outline, names = told.outline, told.streams
    shown = outline.streams(LANES)
    row = {s: k for k, s in enumerate(shown)}
    height = LANE * len(shown)
    plot = Plot(
        Axis(told.start, max(outline.end, told.start + 1), WIDE),
        Axis(0, height, height),
        f"Which of {len(names)} streams was watched when, and when modules were saved",
        frames=frames,
        names=[(names[s], colour_class(s)) for s in shown],
    )
    _lanes_of_states(plot, told, row)
    for s in shown:
        plot.path(f"fill {colour_class(s)}", _attention(plot, told, s, row[s]))
    few = len(outline.saved) <= NAMED
    for save in outline.saved:
        at, lane = save.t + outline.tau, LANE * row.get(save.stream, 0)
        if few:
            plot.marks([at])
        if save.stream in row and few:
            plot.word(at, lane + LANE - ROOM - 3, f"module {save.module}", "back strong")
        elif save.stream in row:
            plot.path("saved", f"M{number(float(plot.x(at)))} {lane}v{LANE - ROOM}")
    if (fork := told.header.forked_at) is not None and fork < outline.iterations:
        t = int(outline.blocks.starts[fork])
        plot.marks([t], "fork")
        plot.word(t, height - 4, "the fork begins")
    return plot


def _lanes_of_states(plot: Plot, told: RunTold, row: dict[int, int]) -> None:
    starts, end = told.outline.blocks.starts, told.outline.end
    first = int(told.outline.blocks.iterations[0]) if len(starts) else 0
    for s, k in row.items():
        changes = [(i, code) for i, stream, code in told.states if stream == s]
        if not told.header.by_progress:
            changes = [(first, -1)]
        stops = [*(i for i, _ in changes[1:]), None]
        for (i, code), stop in zip(changes, stops, strict=True):
            t = float(starts[min(i - first, len(starts) - 1)])
            until = float(end if stop is None else starts[min(stop - first, len(starts) - 1)])
            x = float(plot.x(t))
            plot.add(
                "rect", f"state{code}" if code >= 0 else "lane", x=number(x), y=LANE * k,
                width=number(float(plot.x(until)) - x), height=LANE - ROOM,
            )  # fmt: skip


def _attention(plot: Plot, told: RunTold, stream: int, row: int) -> str:
    """The share of a stream among the blocks at each place, as bars from the foot of its lane."""
    blocks, tau = told.outline.blocks, told.outline.tau
    foot, high = LANE * row + LANE - ROOM, LANE - ROOM
    own = blocks.streams == stream
    if len(own) <= BINS:
        edges = np.flatnonzero(np.diff(np.concatenate([[False], own, [False]]).astype(int)))
        last = blocks.starts[edges[1::2] - 1] + tau
        pairs = zip(plot.x(blocks.starts[edges[::2]]), plot.x(last), strict=True)
        return "".join(
            f"M{number(a)} {foot - high}h{number(max(b - a, 1.5))}v{high}H{number(a)}z"
            for a, b in pairs
        )
    count = BINS if len(told.streams) <= 12 else BINS // 2
    step = WIDE / count
    place = np.minimum((plot.x(blocks.starts) / step).astype(np.int64), count - 1)
    every, mine = (np.bincount(p, minlength=count) for p in (place, place[own]))
    share = np.where(every > 0, mine / np.maximum(every, 1), 0.0)
    tall = np.rint(high * share).astype(int)
    edges = np.flatnonzero(np.diff(tall, prepend=-1, append=-1))
    return "".join(
        f"M{number(a * step)} {foot}v-{tall[a]}H{number(b * step)}v{tall[a]}z"
        for a, b in pairwise(edges.tolist())
        if tall[a]
    )


def rule_plot(told: RunTold, rule: Condition, frames: str, *, by_stream: bool) -> Plot:
    """A quantity that decides over the run, its limits, and where they held."""
    outline = told.outline
    limits = (rule.low, rule.high)
    values = rule.values
    if not rule.log and all(v is None or v <= 2 for v in limits):
        values = np.where(values > 3, 3.0, values)  # what is far out of the limits hides the rest
    low, high = padded(values, log=rule.log, also=limits)
    if rule.short == "share":
        low, high = 0.0, 1.08
    plot = Plot(
        Axis(told.start, max(outline.end, told.start + 1), WIDE),
        Axis(low, high, FLAT, rule.log, turned=True),
        f"{rule.text}; {rule.limit}",
        frames=frames,
    )
    t = outline.blocks.starts.astype(np.float64)
    _held(plot, t, rule.holds, float(outline.end))
    plot.grid(4)
    streams = outline.blocks.streams
    if by_stream:
        unbroken = np.cumsum(np.diff(streams, prepend=-1) != 0)
        for s in outline.streams(LANES):
            own = streams == s
            if own.any():
                plot.line(colour_class(s), t[own], values[own], unbroken[own])
    else:
        plot.line("plain", t, values)
    for value in limits:
        if value is not None:
            plot.limit(value, f"{rule.symbol}{value:g}")
    plot.marks(save.t for save in outline.saved)
    rows = saved_rows(outline)
    rows = rows[rows < len(values)]
    plot.dots("at", t[rows], values[rows])
    return plot


def _held(plot: Plot, t: FloatArray, holds: NDArray[np.bool_], end: float) -> None:
    """Shade where a rule held."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], holds, [False]]).astype(int)))
    ends = np.append(t, end)
    x = plot.x(ends)
    spans = [(float(x[a]), float(x[b])) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    merged: list[list[float]] = []
    for a, b in spans:
        if merged and a - merged[-1][1] < WIDE / BINS:
            merged[-1][1] = b
        else:
            merged.append([a, b])
    down = f"V{plot.height}"
    held = (f"M{number(a)} 0H{number(max(b, a + 1))}{down}H{number(a)}z" for a, b in merged)
    plot.path("held", "".join(held))


def output_plot(told: RunTold, module: ModuleTold, frames: str) -> Plot:
    """A module's first output over the logged frames of its stream, with the save."""
    outline = told.outline
    t, y, _ = module.heard.columns
    low, high = padded(y[:, 0], log=False)
    plot = Plot(
        Axis(told.start, max(outline.end, told.start + 1), WIDE),
        Axis(low, high, TALL, turned=True),
        f"Output of module {module.module.index} on its own stream, before and after its save",
        frames=frames,
    )
    saved = saved_frame(told, module)
    x = float(plot.x(saved))
    plot.add("rect", "after", x=number(x), y=0, width=number(max(WIDE - x, 0)), height=TALL)
    plot.grid(4, "+g")
    plot.dots(colour_class(module.module.stream_index), t.astype(float), y[:, 0])
    plot.marks([saved])
    plot.word(saved, 12, "saved", "back strong", avoid=92)
    return plot


def near_plots(module: ModuleTold) -> list[Plot]:
    """Each of its outputs over the last stretch that was watched without a pause."""
    if not module.near:
        return []
    t, y = (np.concatenate(part) for part in zip(*module.near, strict=True))
    steps = np.diff(t)
    if not len(steps):
        return []
    pauses = np.flatnonzero(steps > steps.min()) + 1
    piece = max(np.split(np.arange(len(t)), pauses), key=len)
    if len(piece) < 3:
        return []
    t, y = t[piece], y[piece]
    kind, found = colour_class(module.module.stream_index), []
    for j in range(y.shape[1]):
        low, high = padded(y[:, j], log=False)
        axis = Axis(low, high, FLAT if y.shape[1] == 1 else NEAR, turned=True)
        about = f"Output {j + 1} of module {module.module.index}, frames {t[0]} to {t[-1]}"
        across = Axis(float(t[0]), float(t[-1]), WIDE)
        plot = Plot(across, axis, about, most=8 if y.shape[1] == 1 else 3)
        plot.grid(2, "+g")
        plot.line(f"broad {kind}", t.astype(float), y[:, j])
        found.append(plot)
    return found


def world_plot(told: RunTold, module: ModuleTold, fit: Fit) -> Plot:
    """The first output over what it follows in the world."""
    _, y, truth = module.heard.columns
    value = truth[:, fit.column]
    known = np.isfinite(value)
    value, output = value[known][-1200:], y[known, 0][-1200:]
    low, high = padded(output, log=False)
    plot = Plot(
        Axis(*padded(value, log=False), WIDE),
        Axis(low, high, TALL, turned=True),
        f"Output of module {module.module.index} over {fit.function}",
        most=4,
    )
    plot.grid(4, "+g")
    plot.dots(f"faint {colour_class(module.module.stream_index)}", value, output)
    line = np.linspace(value.min(), value.max(), 100)
    plot.line("fit", line, fit(line))
    return plot


def numbers_plot(rows: NDArray[Any], about: str) -> Plot:
    """Draw rows of numbers over time, (n, I), the first seven of them."""
    values = np.asarray(rows, dtype=np.float64).reshape(len(rows), -1)[:, :7]
    low, high = padded(values, log=False)
    at = np.arange(len(values), dtype=np.float64)
    across = Axis(0.0, max(len(values) - 1.0, 1.0), WIDE)
    plot = Plot(across, Axis(low, high, 76, turned=True), about)
    for i in range(values.shape[1]):
        plot.line(f"c{i}", at, values[:, i])
    return plot


def bars(values: FloatArray, about: str) -> Plot:
    """Weights as bars, above and below 0."""
    values = np.asarray(values).ravel()[:128]
    most = float(np.abs(values).max(initial=0.0)) or 1.0
    plot = Plot(Axis(0, len(values), WIDE), Axis(-most, most, FLAT, turned=True), about)
    zero, step = float(plot.y(0.0)), WIDE / max(len(values), 1)
    for kind, sign in (("positive", 1), ("negative", -1)):
        places = np.flatnonzero(sign * values > 0)
        found = (
            f"M{number(i * step)} {number(zero)}V{number(float(plot.y(values[i])))}"
            f"h{number(0.8 * step)}V{number(zero)}z"
            for i in places.tolist()
        )
        plot.path(kind, "".join(found))
    plot.path("grid", f"M0 {number(zero)}h{WIDE}")
    plot.labels.append(Label("100%", "12", f"±{most:.3g}", "end", "back"))
    return plot


def saved_frame(told: RunTold, module: ModuleTold) -> int:
    """The first frame after a module was saved."""
    outline, index = told.outline, module.module.index
    found = [save.t + outline.tau for save in outline.saved if save.module == index]
    return found[0] if found else outline.end


def frames_of_run(told: RunTold, rules: Sequence[Condition], plot: Plot) -> Frames | None:
    """What was watched, to be shown where one points at the timeline, and which rules held."""
    if not told.seen.columns:
        return None
    t, frames = told.seen.columns
    blocks = told.outline.blocks
    held = [(rule.short, rule.holds) for rule in rules]
    said = []
    for frame, row in zip(t.tolist(), blocks.places(t).tolist(), strict=True):
        text = f"frame {frame:,}, iteration {blocks.iterations[row]:,}: "
        text += told.streams[blocks.streams[row]]
        for word, kept in (("held", True), ("not", False)):
            if names := [name for name, holds in held if holds[row] == kept]:
                text += f"; {word}: {', '.join(names)}"
        said.append(text)
    return frames_at(plot, t, frames, said, images=told.header.spec.images)


def frames_of_module(told: RunTold, module: ModuleTold, plot: Plot) -> Frames | None:
    """What its stream showed, with its output, to be shown where one points."""
    t, frames, y = module.pictures.columns
    said = [f"frame {k:,}: output {v:+.2f}" for k, v in zip(t.tolist(), y, strict=True)]
    return frames_at(plot, t, frames, said, images=told.header.spec.images)


def frames_at(
    plot: Plot, t: NDArray[Any], frames: NDArray[Any], said: list[str], *, images: bool
) -> Frames:
    """Frames (n, ...) at places t of a plot, with what is said of each."""
    x = [round(float(v), 1) for v in plot.x(t)]
    if not images:
        text = [f"{words} · {values_text(row)}" for words, row in zip(said, frames, strict=True)]
        return Frames("", 1, 0, 0, x, text, t.tolist())
    small = [reduced(frame, PIXELS) for frame in frames]
    columns = max(int(np.sqrt(len(small))), 1)
    source = data_uri(sheet(small, columns), photo=True)
    height, width = small[0].shape
    return Frames(source, columns, width, height, x, said, t.tolist())


def values_text(row: NDArray[Any]) -> str:
    """A frame of numbers in words."""
    values = np.asarray(row, dtype=np.float64).ravel()
    more = " …" if len(values) > FEW else ""
    return ", ".join(f"{value:.3g}" for value in values[:FEW]) + more


def thumbnail(frame: NDArray[Any], most: int = 160) -> str:
    """A picture of a stream, small."""
    return data_uri(reduced(frame, most), photo=True)


def strip(picks: Sequence[Pick]) -> str:
    """Frames side by side in one picture."""
    small = [reduced(pick.frame, PIXELS) for pick in picks]
    return data_uri(sheet(small, len(small), 2), photo=True)


def weights_picture(weights: FloatArray) -> str:
    """Weights: blue below 0, white at 0, orange above."""
    return data_uri(shade(reduced(weights, 128)), photo=False)


def saliency_picture(saliency: FloatArray, mean: FloatArray) -> str:
    """What moves an output, in blue and orange over the mean picture in gray."""
    values = reduced(saliency, 128)
    base = np.repeat(reduced(mean, 128)[..., None], 3, axis=2) * 0.55 + 90
    part = np.abs(values) / max(float(np.abs(values).max()), 1e-300)
    colours = shade(np.sign(values)).astype(np.float64)
    mixed = base * (1 - part[..., None]) + colours * part[..., None]
    return data_uri(mixed.clip(0, 255).astype(np.uint8), photo=False)


def state_words(code: int) -> str:
    """What has become of a stream, in words."""
    return STATES[code].replace("_", " ")
