"""Panels of the paper's figures: what a learner's signals were over iterations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.studies import pages
from cdmisfa.studies.paper.experiment import Trial

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def figure_of_panels(rows: int, columns: int, *, width: float = 3.4) -> tuple[Any, Any]:
    """A figure of panels, each `width` inches wide, and its (rows, columns) axes."""
    return pages.new_figure(rows, columns, columns * width, rows * 2.4)


def eta_dot(axes: Axes, trials: Sequence[Trial], delta: float, letter: str) -> None:
    """Derivative of slowness over iterations: every trial, their mean dashed, and delta."""
    stacked = pages.stack([np.max(t.arrays["eta_dot"], axis=-1) for t in trials])
    for row in stacked:
        axes.plot(row, color=pages.COLOURS[0], alpha=0.25, linewidth=0.5)
    axes.plot(pages.mean_sd(stacked)[0], color="black", linestyle="--", linewidth=0.9, label="mean")
    axes.axhline(delta, color=pages.COLOURS[1], linewidth=0.8, label=r"$\delta$")
    axes.set_yscale("log")
    axes.legend(fontsize=6)
    pages.letter_panel(axes, letter, "iteration", r"$|\dot\eta|$")


def rewards(axes: Axes, trials: Sequence[Trial], letter: str, y: str) -> None:
    """Every trial's R, and the mean."""
    _per_stream(axes, [t.arrays["R"] for t in trials], letter, y, each=True)


def value_gains(axes: Axes, trials: Sequence[Trial], letter: str) -> None:
    """By how much staying is worth more than switching, mean and SD."""
    gains = [t.arrays["Q"][:, :, 0] - t.arrays["Q"][:, :, 1] for t in trials]
    _per_stream(axes, gains, letter, "Q(s, stay) - Q(s, switch)")


def _per_stream(
    axes: Axes, curves: Sequence[NDArray[Any]], letter: str, y: str, *, each: bool = False
) -> None:
    """One colour a stream: every trial's (N, S) where `each`, else mean and a band of one SD."""
    stacked = pages.stack(curves)
    mean, sd = pages.mean_sd(stacked)
    for s in range(stacked.shape[2]):
        if each:
            for row in stacked[:, :, s]:
                axes.plot(row, color=pages.COLOURS[s], alpha=0.25, linewidth=0.4)
        else:
            pages.draw_band(axes, np.arange(len(mean)), mean[:, s], sd[:, s], pages.COLOURS[s])
        axes.plot(mean[:, s], color=pages.COLOURS[s], linewidth=1.0, label=pages.STREAM_NAMES[s])
    settled = stacked[:, 30:] if stacked.shape[1] > 60 else stacked
    low, high = np.nanquantile(settled, 0.001), np.nanquantile(settled, 0.999)
    if high > low:
        axes.set_ylim(low - 0.1 * (high - low), high + 0.1 * (high - low))
    axes.legend(fontsize=6)
    pages.letter_panel(axes, letter, "iteration", y)


def policies(axes: Axes, trials: Sequence[Trial], letter: str, y: str) -> None:
    """Mean policy over iterations, a line a stream, and a band of one SD within what can be."""
    mean, sd = pages.mean_sd(pages.stack([t.arrays["policy"] for t in trials]))
    k = np.arange(len(mean))
    for s in range(mean.shape[1]):
        pages.draw_band(axes, k, mean[:, s], sd[:, s], pages.COLOURS[s], limits=(0, 1), alpha=0.15)
        axes.plot(
            mean[:, s],
            color=pages.COLOURS[s],
            linewidth=1.4 if s else 1.8,
            linestyle=pages.DASHES[s],
            label=pages.STREAM_NAMES[s],
        )
    axes.legend(fontsize=6)
    pages.letter_panel(axes, letter, "iteration", y)
    pages.stay_to_switch(axes)


def policy_bars(axes: Axes, words: Sequence[str], letter: str, title: str) -> None:
    """Share of trials whose policy, as "011", leaves each stream: 0 all stay, 1 all switch."""
    for s, height in enumerate(np.mean([[*map(int, word)] for word in words], axis=0)):
        axes.bar(s, height, color=pages.COLOURS[s], width=0.7)
        axes.plot([s - 0.35, s + 0.35], [height, height], color=pages.COLOURS[s], linewidth=2)
    axes.set_xticks(range(len(words[0])), pages.STREAM_NAMES)
    pages.stay_to_switch(axes)
    pages.letter_panel(axes, letter, title, "policy, mean over trials")
