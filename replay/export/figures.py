"""Figures of one run, without a viewer: PNG and SVG in one style, safe for every colour vision."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from string import ascii_lowercase
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, NullFormatter

from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.signals import STATES
from recorder.log.files import atomic_write, refuse_taken
from replay.export.history import History, read_history
from replay.palette import CYCLE, GREY, VERMILLION, Rgb, colour
from replay.palette import STATES as STATE_COLOURS
from replay.runs.folders import run_log

INCHES = 7.0
"""Width of a figure."""

MOST_POINTS = 4000
"""Points of a scatter plot."""

FEW = 6
"""Modules that are called so above the line where they were saved; of more there is the number."""

FOLLOWS = 0.5
"""Correlation from which on a fit says something."""

Axes = Any

STYLE: dict[Any, Any] = {
    "font.size": 8.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "grid.linewidth": 0.5,
    "lines.linewidth": 1.0,
    "legend.frameon": False,
    "svg.hashsalt": "cdmisfa",
}


def draw_figures(path: Path, out: Path | None = None, *, force: bool = False) -> list[Path]:
    """Draw every figure of a run, as PNG and as SVG, and return their paths.

    They go to the folder `out`, by default to `figures` in the run's folder.

    Raises:
        UsageError: there is no such run, or a figure exists and `force` is not set.
        LogDamagedError: the run cannot be read.
        LogWriteError: a figure cannot be written.
    """
    log = run_log(path)
    folder = log.parent / "figures" if out is None else Path(out)
    history = read_history(log)
    files: list[Path] = []
    for name, draw in FIGURES.items():
        targets = [folder / f"{name}{ending}" for ending in (".png", ".svg")]
        for target in targets:
            refuse_taken(target, force=force)
        with matplotlib.rc_context(STYLE):
            if (figure := draw(history)) is not None:
                for target in targets:
                    _write(figure, target)
                files += targets
    return files


def convergence(history: History) -> Figure | None:
    """Slowness, its change on a logarithmic axis against delta, and where modules were saved."""
    outline, delta = history.outline, history.outline.header.delta
    if not outline.told & {"eta_dot"}:
        return None
    figure, (top, bottom) = _panels(1.0, 1.4)
    k = np.arange(outline.iterations)
    for j in range(history.eta.shape[1]):
        label = f" of output {j + 1}" if history.eta.shape[1] > 1 else ""
        top.plot(k, history.eta[:, j], color=_css(colour(j)), label=f"η{label}")
        bottom.plot(k, history.eta_dot[:, j], color=_css(colour(j)), label=f"η̇{label}")
    if delta is not None:
        bottom.axhline(delta, color=_css(GREY), linestyle="--", label="δ")
    for save in outline.saved:
        bottom.plot(save.iteration, save.eta_dot[0], "D", color=_css(VERMILLION), markersize=5)
    if (history.eta_dot > 0).any():
        _logarithmic(bottom)
    top.set_ylabel("slowness η\n[1/frame]")
    bottom.set_ylabel("change η̇\n[1/frame]")
    _mark_saves((top, bottom), history)
    _finish((top, bottom), bottom)
    return figure


def decision(history: History) -> Figure | None:
    """What was watched, what staying was worth, the policy, and exploration."""
    outline, names, shown = history.outline, history.outline.names(), history.shown
    if not outline.iterations or outline.header.by_progress:
        return None
    figure, (watched, reward, policy, epsilon) = _panels(1.0, 1.2, 0.4 + 0.2 * len(shown), 0.6)
    k = np.arange(outline.iterations)
    _share(watched, history)
    for row, s in enumerate(shown):
        reward.plot(k, history.stay_reward[:, row], color=_shade(history, s), label=names[s])
        stays = history.policy[:, row] == 0
        lane = {"where": stays, "step": "mid", "linewidth": 0, "color": _shade(history, s)}
        policy.fill_between(k, row - 0.4, row + 0.4, **lane)
    finite = history.stay_reward[np.isfinite(history.stay_reward)]
    if finite.size:
        low, high = np.percentile(finite, (0.5, 99.0))
        reward.set_ylim(low - 0.1 * (high - low) - 1e-12, high + 0.2 * (high - low) + 1e-12)
    epsilon.plot(k, np.minimum(outline.lines["epsilon"], 1.0), color=_css(GREY))
    epsilon.set_ylim(0, 1.05)
    reward.set_ylabel("R for staying")
    policy.set_yticks(range(len(shown)), [names[s] for s in shown])
    policy.set_ylim(len(shown) - 0.5, -0.5)
    policy.set_ylabel("policy: stay")
    policy.grid(False)
    epsilon.set_ylabel("random ε")
    _mark_saves((watched, reward, policy, epsilon), history)
    _finish((watched, reward, policy, epsilon), reward)
    return figure


def streams(history: History) -> Figure | None:
    """What became of each stream of the progress learner, and how that was learned."""
    outline, shown = history.outline, history.shown
    if not outline.iterations or not outline.header.by_progress:
        return None
    figure, panels = _panels(0.5 + 0.12 * len(history.lanes), 1.3, 1.1, 0.9)
    lanes, error, slowness, watched = panels
    _state_lanes(lanes, history)
    others = [s for s in history.lanes if s not in shown]
    for s in (*others, *shown):
        style = {"color": _shade(history, s), "alpha": 1.0 if s in shown else 0.4}
        _plot_watched(error, history, s, history.error, "-", **style)
        _plot_watched(slowness, history, s, history.tested, "-", **style)
        _plot_watched(slowness, history, s, history.fitted, ":", **style)
    if outline.header.settled is not None:
        threshold = {"color": _css(GREY), "linestyle": "--", "linewidth": 0.8}
        error.axhline(outline.header.settled[1], label="settled + agreement", **threshold)
        error.legend(loc="lower left", fontsize=7)
    for axes in (error, slowness):
        _logarithmic(axes)
    _share(watched, history)
    error.set_ylabel("learning error e")
    slowness.set_ylabel("slowness, tested\n(dotted: fitted)\n[1/frame]")
    _mark_saves((error, slowness, watched), history)
    _finish(panels, watched)
    return figure


def _plot_watched(
    axes: Axes, history: History, stream: int, values: FloatArray, line: str, **style: Any
) -> None:
    """Values, (n,), of the iterations in which a stream was watched; no line crosses the others."""
    own = values[: len(history.stream)].copy()
    own[history.stream != stream] = np.nan
    known = np.isfinite(own)
    alone = known & ~np.roll(known, 1) & ~np.roll(known, -1)
    k = np.arange(len(own))
    axes.plot(k, own, line, **style)
    axes.plot(k[alone], own[alone], ".", markersize=2, **style)


def _logarithmic(axes: Axes) -> None:
    """A logarithmic axis whose numbers are written out."""
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(lambda value, place: f"{value:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())


def _state_lanes(axes: Axes, history: History) -> None:
    """A bar for each stream in the colours of its states, with marks where it was watched."""
    names, n = history.outline.names(), history.outline.iterations
    for row, s in enumerate(history.lanes):
        state = history.state[:, row]
        edges = [0, *(np.flatnonzero(np.diff(state)) + 1).tolist(), n]
        for start, stop in pairwise(edges):
            face = _css(STATE_COLOURS[int(state[start])])
            bar = {"left": start, "height": 0.55, "color": face, "edgecolor": "grey"}
            axes.barh(row - 0.12, stop - start, linewidth=0.4, **bar)
        watched = np.flatnonzero(history.stream == s)
        axes.vlines(watched + 0.5, row + 0.19, row + 0.42, color=_shade(history, s), linewidth=0.6)
    rows = range(len(history.lanes))
    axes.set_yticks(rows, [names[s] for s in history.lanes])
    became = axes.secondary_yaxis("right")
    became.set_yticks(rows, [_became(history, row) for row in rows])
    for side in (axes, became):
        side.tick_params(axis="y", length=0)
    axes.set_ylim(len(history.lanes) - 0.4, -0.6)
    axes.set_xlim(0, n)
    axes.grid(False)
    found = np.unique(history.state).tolist()
    patches = [Patch(facecolor=_css(STATE_COLOURS[code]), edgecolor="grey") for code in found]
    words = [STATES[code].replace("_", " ") for code in found]
    where = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0), "ncols": 4}
    axes.legend(patches, words, title="what became of each stream; marks: it was watched", **where)


def _became(history: History, row: int) -> str:
    """What became of a stream, with the module that gives what it shows."""
    state, stream = int(history.state[-1, row]), history.lanes[row]
    text = STATES[state].replace("_", " ")
    modules = history.known_by[(history.stream == stream) & (history.known_by > 0)]
    return f"{text} by {modules[-1]}" if text in ("learned", "known") and len(modules) else text


def _share(axes: Axes, history: History) -> None:
    """How much of the iterations around each, as far as there are some, went to each stream."""
    n, names = history.outline.iterations, history.outline.names()
    window = max(min(50, n // 4), 1)
    around = np.convolve(np.ones(n), np.ones(window), mode="same")
    for s in history.shown:
        watched = np.convolve(history.stream == s, np.ones(window), mode="same")
        axes.plot(np.arange(n), watched / around, color=_shade(history, s), label=names[s])
    axes.set_ylim(0, 1.05)
    axes.set_ylabel(f"share of time\n({window} iterations)")


def _shade(history: History, stream: int) -> tuple[float, float, float]:
    """Colour of a stream; of many streams those shown have the colours to themselves."""
    if len(history.outline.names()) <= len(CYCLE):
        return _css(colour(stream))
    return _css(colour(history.shown.index(stream)) if stream in history.shown else GREY)


def _mark_saves(panels: Sequence[Axes], history: History) -> None:
    """A line through the panels where each module was saved, with its number above the first."""
    for save in history.outline.saved:
        for axes in panels:
            axes.axvline(save.iteration, color=_css(VERMILLION), linewidth=0.8)
        where = {"xy": (save.iteration, 1.0), "xycoords": panels[0].get_xaxis_transform()}
        style = {"ha": "center", "va": "bottom", "fontsize": 7, "color": _css(VERMILLION)}
        name = f"module {save.module}" if len(history.outline.saved) <= FEW else f"{save.module}"
        panels[0].annotate(name, **where, **style)


def modules(history: History) -> Figure | None:
    """Each module's output over time, and against what the world knows about its stream.

    All outputs are on one scale.
    """
    if not history.outputs:
        return None
    spec = history.outline.header.spec
    best = [output.best_fit(spec.truth) for output in history.outputs]
    ratios = (2, 1) if any(best) else (1,)  # one column where the world tells nothing
    figure = Figure(figsize=(INCHES, 1.7 * len(history.outputs)), layout="constrained")
    grid = figure.subplots(len(best), len(ratios), squeeze=False, sharey=True, width_ratios=ratios)
    for row, output, found in zip(grid, history.outputs, best, strict=True):
        shade = _shade(history, output.stream)
        shown = slice(-1000, None)
        row[0].plot(output.t[shown], output.y[shown], ".", color=shade, markersize=2)
        row[0].set_ylabel(f"module {output.module}\n{spec.streams[output.stream]}")
        if found is None:
            for against in row[1:]:
                against.set_axis_off()
            continue
        against, truth = row[1], output.truth[:, found.column]
        step = max(len(truth) // MOST_POINTS, 1)
        against.plot(truth[::step], output.y[::step], ".", color=shade, markersize=2, alpha=0.4)
        if found.r >= FOLLOWS:
            line = np.linspace(truth.min(), truth.max(), 300)
            against.plot(line, found(line), color="black")
        against.set_xlabel(spec.truth[found.column])
        said = f"|r| = {found.r:.2f} with {found.function}"
        against.set_title(said, loc="right", fontsize=8)
    grid[-1][0].set_xlabel("frame t, where its stream was watched")
    grid[0][0].set_title("output y", fontsize=8)
    _letter(grid.flat)
    return figure


def contact_sheet(history: History) -> Figure | None:
    """Frames that were watched, with the output of the module of their stream under them."""
    if not history.pictures:
        return None
    figure = Figure(figsize=(INCHES, 1.6 * len(history.pictures)), layout="constrained")
    heights = (3, 4) * len(history.pictures)
    grid = figure.subplots(2 * len(history.pictures), 1, squeeze=False, height_ratios=heights)
    for row, strip in enumerate(history.pictures):
        above, below = grid[2 * row][0], grid[2 * row + 1][0]
        images = [frame for _, frame, _ in strip.frames]
        height, width = images[0].shape
        gap = np.full((height, max(width // 16, 1)), 255, dtype=np.uint8)
        row_of_images = np.hstack([part for image in images for part in (image, gap)])
        above.imshow(row_of_images, cmap="gray", vmin=0, vmax=255)
        above.set_axis_off()
        step = width + gap.shape[1]
        centres = width / 2 + step * np.arange(len(images))
        heard = [y for *_, y in strip.frames]
        below.bar(centres, heard, width / 2, color=_shade(history, strip.stream))
        below.axhline(0, color="black", linewidth=0.5)
        below.set_xlim(0, step * len(images))
        below.set_xticks(centres, [f"t = {t}" for t, *_ in strip.frames], fontsize=6)
        below.set_ylabel(f"module {strip.module}\non {history.outline.names()[strip.stream]}")
    return figure


FIGURES: dict[str, Callable[[History], Figure | None]] = {
    "convergence": convergence,
    "decision": decision,
    "streams": streams,
    "modules": modules,
    "contact_sheet": contact_sheet,
}
"""Name of each figure's files and what draws it."""


def _panels(*heights: float) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(INCHES, 1.5 * sum(heights)), layout="constrained")
    return figure, list(figure.subplots(len(heights), 1, sharex=True, height_ratios=heights))


def _finish(panels: Sequence[Axes], explained: Axes) -> None:
    panels[-1].set_xlabel("iteration")
    above = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.2}
    explained.legend(ncols=4, fontsize=7, **above)
    _letter(panels)


def _letter(panels: Iterable[Axes]) -> None:
    """Letter the panels that show something."""
    shown = [axes for axes in panels if axes.axison]
    for letter, axes in zip(itertools.cycle(ascii_lowercase), shown, strict=False):
        axes.set_title(f"({letter})", loc="left", fontsize=8)


def _css(rgb: Rgb) -> tuple[float, float, float]:
    red, green, blue = rgb
    return red / 255, green / 255, blue / 255


def _write(figure: Figure, target: Path) -> None:
    """Write one file, the same bytes every time."""
    is_svg = target.suffix == ".svg"
    canvas: Any = FigureCanvasSVG(figure) if is_svg else FigureCanvasAgg(figure)
    with atomic_write(target) as partial:
        if is_svg:
            canvas.print_svg(partial, metadata={"Date": None})
        else:
            figure.set_dpi(150)
            canvas.print_png(partial)
