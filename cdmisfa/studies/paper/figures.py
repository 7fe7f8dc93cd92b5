"""Panels of the paper's figures: signals over iterations, drawn without a screen."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's colors, which color-blind readers can tell apart; one for each stream.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")

STREAM_NAMES = ("$s_1$", "$s_2$", "$s_3$")

# A signal over iterations, (N, ...) a trial.
Curves = Sequence[NDArray[Any]]


def new_figure(rows: int, columns: int, **subplots: Any) -> tuple[Figure, Any]:
    """Return a figure, and its (rows, columns) axes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.4 * columns, 2.4 * rows), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **subplots)


def save_figure(figure: Figure, folder: Path, name: str) -> Path:
    """Write NAME.png; the same figure gives the same bytes."""
    path = folder / f"{name}.png"
    figure.savefig(path, dpi=150, metadata={"Software": None})
    return path


def letter_panel(axes: Axes, letter: str, x: str, y: str) -> None:
    """Letter a panel and name its axes."""
    axes.set_title(f"({letter})", loc="left", fontsize=10)
    axes.set_xlabel(x, fontsize=9)
    axes.set_ylabel(y, fontsize=9)
    axes.tick_params(labelsize=8)


def stack(curves: Curves) -> FloatArray:
    """Return curves of different lengths as one array (trials, longest, ...), padded with NaN."""
    longest = max(len(c) for c in curves)
    out = np.full((len(curves), longest, *curves[0].shape[1:]), np.nan)
    for row, curve in zip(out, curves, strict=True):
        row[: len(curve)] = curve
    return out


def mean_sd(stacked: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return mean and standard deviation over the trials that still run, NaN where none does.

    Args:
        stacked: (trials, n, ...), see `stack`.
    """
    values = np.ma.masked_invalid(stacked)
    return values.mean(axis=0).filled(np.nan), values.std(axis=0).filled(np.nan)


def draw_eta_dot(axes: Axes, curves: Curves, delta: float, letter: str) -> None:
    """Draw the change of slowness, (N, J) a trial, the median over trials, and delta."""
    stacked = stack([np.max(curve, axis=-1) for curve in curves])
    axes.plot(stacked.T, color=COLOURS[5], alpha=0.4, linewidth=0.5)
    median: Any = np.ma.median(np.ma.masked_invalid(stacked), axis=0)  # type: ignore[no-untyped-call]
    axes.plot(median.filled(np.nan), color=COLOURS[0], linewidth=1.2, label="median of trials")
    axes.axhline(delta, color=COLOURS[1], linestyle="--", linewidth=0.9, label=r"$\delta$")
    axes.set_yscale("log")
    place_legend_above(axes)
    letter_panel(axes, letter, "iteration", "change of slowness, 1/frame")


def draw_means(axes: Axes, curves: Curves, letter: str, y: str) -> None:
    """Draw a signal of each stream, (N, S) a trial: each trial, and mean and SD over trials."""
    stacked = stack(curves)
    mean, sd = mean_sd(stacked)
    for s, name in enumerate(STREAM_NAMES):
        axes.plot(stacked[:, :, s].T, color=COLOURS[s], alpha=0.25, linewidth=0.4)
        low, high = mean[:, s] - sd[:, s], mean[:, s] + sd[:, s]
        axes.fill_between(np.arange(len(mean)), low, high, color=COLOURS[s], alpha=0.2, linewidth=0)
        axes.plot(mean[:, s], color=COLOURS[s], linewidth=1.0, label=name)
    settled = stacked[:, 30:] if stacked.shape[1] > 60 else stacked
    low, high = np.nanquantile(settled, (0.001, 0.999))
    if high > low:
        axes.set_ylim(low - 0.1 * (high - low), high + 0.1 * (high - low))
    place_legend_above(axes)
    letter_panel(axes, letter, "iteration", y)


def draw_policies(axes: Axes, curves: Curves, letter: str, y: str) -> None:
    """Draw policies, (N, S) of 0 stay and 1 switch: a row a stream, high where most stay."""
    stay = 1.0 - mean_sd(stack(curves))[0]
    for s in range(stay.shape[1]):
        row: dict[str, Any] = {"step": "mid", "color": COLOURS[s], "linewidth": 0}
        axes.fill_between(np.arange(len(stay)), -s, -s + 0.8 * stay[:, s], **row)
        axes.axhline(-s, color="0.7", linewidth=0.5)
    axes.set_yticks([0.4 - s for s in range(stay.shape[1])], STREAM_NAMES)
    axes.tick_params(axis="y", length=0)
    letter_panel(axes, letter, "iteration", y)


def place_legend_above(axes: Axes) -> None:
    """Put a legend above the panel, where it hides no curve."""
    style: dict[str, Any] = {"fontsize": 8, "ncols": 4, "frameon": False, "borderaxespad": 0.2}
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), **style)
