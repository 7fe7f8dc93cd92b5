"""Figures and pages of results, made from the results so that they cannot drift.

Figures are drawn without a screen, as PNG and SVG; the same results give the same bytes.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray
from recorder.log.files import atomic_write

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe and Ito's colours, told apart by every kind of eye; one for each stream."""

STREAM_NAMES = ("$s_1$", "$s_2$", "$s_3$")

DASHES = ("-", (0, (4, 2)), (0, (1, 1.5)))
"""Lines that stay apart where they lie on each other; one for each stream."""

Curves = Sequence[NDArray[Any]]
"""A signal over iterations, (N, ...) a trial."""


class Page:
    """A Markdown page, with a folder of its name beside it for its pictures.

    Args:
        path: of the page.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._folder = path, path.with_suffix("")
        self._lines: list[str] = []

    def add(self, *lines: str) -> None:
        """Add lines."""
        self._lines += lines

    def picture(self, png: Path, about: str) -> None:
        """Add a picture, which is copied, and an empty line."""
        self._folder.mkdir(parents=True, exist_ok=True)
        if png.resolve() != (self._folder / png.name).resolve():
            shutil.copyfile(png, self._folder / png.name)
        self.add(f"![{about}]({self._folder.name}/{png.name})", "")

    def versions(self, versions: Mapping[str, str]) -> None:
        """Add what the results were made with."""
        self.add("", f"Versions: {', '.join(map(' '.join, sorted(versions.items())))}.", "")

    def write(self) -> None:
        """Write the page, whole or not at all."""
        with atomic_write(self._path) as partial:
            partial.write_text("\n".join(self._lines), encoding="utf-8")


def new_figure(
    rows: int, columns: int, width: float = 3.4, height: float = 2.4, **subplots: Any
) -> tuple[Figure, Any]:
    """A figure of panels of so many inches, and its (rows, columns) axes."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(columns * width, rows * height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False, **subplots)


def save_figure(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write NAME.png and NAME.svg."""
    import matplotlib

    paths = [folder / f"{name}.png", folder / f"{name}.svg"]
    with matplotlib.rc_context({"svg.hashsalt": name}):
        for path, unstable in zip(paths, ("Software", "Date"), strict=True):
            with atomic_write(path) as partial:
                kind = path.suffix[1:]
                figure.savefig(partial, format=kind, dpi=150, metadata={unstable: None})
    return paths


def letter_panel(axes: Axes, letter: str, x: str, y: str) -> None:
    """Letter a panel and name its axes."""
    axes.set_title(f"({letter})", loc="left", fontsize=9)
    axes.set_xlabel(x, fontsize=8)
    axes.set_ylabel(y, fontsize=8)
    axes.tick_params(labelsize=7)


def stack(curves: Curves) -> FloatArray:
    """Curves of different lengths as one array (trials, longest, ...), NaN after their ends."""
    longest = max(len(c) for c in curves)
    out = np.full((len(curves), longest, *curves[0].shape[1:]), np.nan)
    for row, curve in zip(out, curves, strict=True):
        row[: len(curve)] = curve
    return out


def mean_sd(stacked: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean and standard deviation over trials, of those that still run.

    Args:
        stacked: (trials, n, ...), NaN where a trial has ended; see `stack`.

    Returns:
        (n, ...) each, NaN where none runs.
    """
    count = np.isfinite(stacked).sum(axis=0)
    safe = np.maximum(count, 1)
    mean = np.where(count > 0, np.nansum(stacked, axis=0) / safe, np.nan)
    square = np.nansum((stacked - mean) ** 2, axis=0) / safe
    return mean, np.where(count > 0, np.sqrt(square), np.nan)


def draw_band(
    axes: Axes,
    x: Sequence[float] | NDArray[Any],
    mean: FloatArray,
    sd: FloatArray,
    colour: Any,
    *,
    limits: tuple[float, float] = (-np.inf, np.inf),
    alpha: float = 0.2,
) -> None:
    """One SD, (n,), around a mean, (n,), cut off at what can be."""
    low, high = np.clip(mean - sd, *limits), np.clip(mean + sd, *limits)
    axes.fill_between(x, low, high, color=colour, alpha=alpha, linewidth=0)


def stay_to_switch(axes: Axes) -> None:
    """Name the two ends of a policy's axis."""
    axes.set_ylim(-0.07, 1.07)
    axes.set_yticks([0, 1], ["stay", "switch"])


def draw_eta_dot(axes: Axes, curves: Curves, delta: float, letter: str) -> None:
    """Derivative of slowness, (N, J) a trial: each, the median of those that learn, and delta."""
    stacked = stack([np.max(curve, axis=-1) for curve in curves])
    for row in stacked:
        axes.plot(row, color=COLOURS[5], alpha=0.4, linewidth=0.5)
    learning = np.isfinite(stacked).any(axis=0)
    median = np.full(stacked.shape[1], np.nan)
    median[learning] = np.nanmedian(stacked[:, learning], axis=0)
    axes.plot(median, color=COLOURS[0], linewidth=1.2, label="median of trials")
    axes.axhline(delta, color=COLOURS[1], linestyle="--", linewidth=0.9, label=r"$\delta$")
    axes.set_yscale("log")
    explain_above(axes)
    letter_panel(axes, letter, "iteration", "change of slowness, 1/frame")


def draw_rewards(axes: Axes, curves: Curves, letter: str, y: str) -> None:
    """R of the stay entries, (N, S) a trial: each, and the mean."""
    stacked = stack(curves)
    mean, _ = mean_sd(stacked)
    for s in range(stacked.shape[2]):
        for row in stacked[:, :, s]:
            axes.plot(row, color=COLOURS[s], alpha=0.25, linewidth=0.4)
        axes.plot(mean[:, s], color=COLOURS[s], linewidth=1.0, label=STREAM_NAMES[s])
    _finish_curves(axes, stacked, letter, y)


def draw_value_gains(axes: Axes, curves: Curves, letter: str) -> None:
    """By how much staying is worth more than switching, of Q (N, S, 2) a trial: mean and SD."""
    stacked = stack([curve[:, :, 0] - curve[:, :, 1] for curve in curves])
    mean, sd = mean_sd(stacked)
    for s in range(stacked.shape[2]):
        draw_band(axes, np.arange(len(mean)), mean[:, s], sd[:, s], COLOURS[s])
        axes.plot(mean[:, s], color=COLOURS[s], linewidth=1.0, label=STREAM_NAMES[s])
    _finish_curves(axes, stacked, letter, "Q(s, stay) - Q(s, switch)")


def _finish_curves(axes: Axes, stacked: FloatArray, letter: str, y: str) -> None:
    settled = stacked[:, 30:] if stacked.shape[1] > 60 else stacked
    low, high = np.nanquantile(settled, 0.001), np.nanquantile(settled, 0.999)
    if high > low:
        axes.set_ylim(low - 0.1 * (high - low), high + 0.1 * (high - low))
    explain_above(axes)
    letter_panel(axes, letter, "iteration", y)


def draw_policies(axes: Axes, curves: Curves, letter: str, y: str) -> None:
    """Policies, (N, S) a trial of 0 stay and 1 switch: a lane a stream, as high as trials stay."""
    stay = 1.0 - mean_sd(stack(curves))[0]
    k, lanes = np.arange(len(stay)), range(stay.shape[1])
    for s in lanes:
        lane: dict[str, Any] = {"step": "mid", "color": COLOURS[s], "linewidth": 0}
        axes.fill_between(k, -s, -s + 0.8 * stay[:, s], **lane)
        axes.axhline(-s, color="0.7", linewidth=0.5)
    axes.set_yticks([0.4 - s for s in lanes], [STREAM_NAMES[s] for s in lanes])
    axes.tick_params(axis="y", length=0)
    letter_panel(axes, letter, "iteration", y)


def explain_above(axes: Axes) -> None:
    """A legend above the panel, where it hides nothing."""
    how: dict[str, Any] = {"fontsize": 6, "ncols": 4, "frameon": False, "borderaxespad": 0.2}
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), **how)
