"""Panels of the paper's figures, drawn without a screen; every figure as PNG and SVG."""

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

    from cdmisfa.paper.reproduce import Trial


COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe and Ito's colours, told apart by every kind of eye; one for each stream."""

STREAM_NAMES = ("$s_1$", "$s_2$", "$s_3$")

DASHES = ("-", (0, (4, 2)), (0, (1, 1.5)))
"""Lines that stay apart where they lie on each other; one for each stream."""

MARKERS = (("o", 7), ("s", 5), ("^", 3))
"""Marks and their sizes that stay apart where they lie on each other; one for each stream."""


def figure(rows: int, columns: int, *, width: float = 3.4) -> tuple[Any, Any]:
    """A figure of panels, each `width` inches wide, and its (rows, columns) axes."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(columns * width, rows * 2.4), layout="constrained")
    FigureCanvasAgg(drawn)
    return drawn, drawn.subplots(rows, columns, squeeze=False)


def save(drawn: Figure, folder: Path, name: str) -> list[Path]:
    """Write NAME.png and NAME.svg; the same figure gives the same bytes."""
    import matplotlib

    paths = [folder / f"{name}.png", folder / f"{name}.svg"]
    with matplotlib.rc_context({"svg.hashsalt": name}):
        drawn.savefig(paths[0], dpi=150, metadata={"Software": None})
        drawn.savefig(paths[1], metadata={"Date": None})
    return paths


def label(axes: Axes, letter: str, x: str, y: str) -> None:
    """Letter a panel and name its axes."""
    axes.set_title(f"({letter})", loc="left", fontsize=9)
    axes.set_xlabel(x, fontsize=8)
    axes.set_ylabel(y, fontsize=8)
    axes.tick_params(labelsize=7)


def stack(curves: Sequence[NDArray[Any]]) -> FloatArray:
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


def eta_dot(axes: Axes, trials: Sequence[Trial], delta: float, letter: str) -> None:
    """Derivative of slowness over iterations: every trial, their mean dashed, and delta."""
    stacked = stack([np.max(t.arrays["eta_dot"], axis=-1) for t in trials])
    for row in stacked:
        axes.plot(row, color=COLOURS[0], alpha=0.25, linewidth=0.5)
    axes.plot(mean_sd(stacked)[0], color="black", linestyle="--", linewidth=0.9, label="mean")
    axes.axhline(delta, color=COLOURS[1], linewidth=0.8, label=r"$\delta$")
    axes.set_yscale("log")
    axes.legend(fontsize=6)
    label(axes, letter, "iteration", r"$|\dot\eta|$")


def band(
    axes: Axes,
    mean: FloatArray,
    sd: FloatArray,
    stream: int,
    *,
    x: NDArray[Any] | None = None,
    within: tuple[float, float] = (-np.inf, np.inf),
    alpha: float = 0.2,
) -> None:
    """One SD, (n,), around a stream's mean, (n,), as far as it is `within` what can be."""
    low, high = np.clip(mean - sd, *within), np.clip(mean + sd, *within)
    at = np.arange(len(mean)) if x is None else x
    axes.fill_between(at, low, high, color=COLOURS[stream], alpha=alpha, linewidth=0)


def rewards(axes: Axes, trials: Sequence[Trial], letter: str, y: str) -> None:
    """Every trial's R, and the mean."""
    _per_stream(axes, [t.arrays["R"] for t in trials], letter, y, each=True)


def values(axes: Axes, trials: Sequence[Trial], letter: str) -> None:
    """By how much staying is worth more than switching, mean and SD."""
    gains = [t.arrays["Q"][:, :, 0] - t.arrays["Q"][:, :, 1] for t in trials]
    _per_stream(axes, gains, letter, "Q(s, stay) - Q(s, switch)")


def _per_stream(
    axes: Axes, curves: Sequence[NDArray[Any]], letter: str, y: str, *, each: bool = False
) -> None:
    """One colour a stream: every trial's (N, S) where `each`, else mean and a band of one SD."""
    stacked = stack(curves)
    mean, sd = mean_sd(stacked)
    for s in range(stacked.shape[2]):
        if each:
            for row in stacked[:, :, s]:
                axes.plot(row, color=COLOURS[s], alpha=0.25, linewidth=0.4)
        else:
            band(axes, mean[:, s], sd[:, s], s)
        axes.plot(mean[:, s], color=COLOURS[s], linewidth=1.0, label=STREAM_NAMES[s])
    settled = stacked[:, 30:] if stacked.shape[1] > 60 else stacked
    low, high = np.nanquantile(settled, 0.001), np.nanquantile(settled, 0.999)
    if high > low:
        axes.set_ylim(low - 0.1 * (high - low), high + 0.1 * (high - low))
    axes.legend(fontsize=6)
    label(axes, letter, "iteration", y)


def policies(axes: Axes, trials: Sequence[Trial], letter: str, y: str) -> None:
    """Mean policy over iterations, a line a stream, and a band of one SD within what can be."""
    mean, sd = mean_sd(stack([t.arrays["policy"] for t in trials]))
    for s in range(mean.shape[1]):
        band(axes, mean[:, s], sd[:, s], s, within=(0, 1), alpha=0.15)
        axes.plot(
            mean[:, s],
            color=COLOURS[s],
            linewidth=1.4 if s else 1.8,
            linestyle=DASHES[s],
            label=STREAM_NAMES[s],
        )
    axes.legend(fontsize=6)
    label(axes, letter, "iteration", y)
    stay_to_switch(axes)


def stay_to_switch(axes: Axes) -> None:
    """Name the two ends of a policy's axis."""
    axes.set_ylim(-0.07, 1.07)
    axes.set_yticks([0, 1], ["stay", "switch"])


def policy_bars(axes: Axes, policies: Sequence[NDArray[Any]], letter: str, title: str) -> None:
    """Share of trials whose policy leaves each stream: 0 all stay, 1 all switch."""
    mean = np.mean(policies, axis=0)
    for s, height in enumerate(mean):
        axes.bar(s, height, color=COLOURS[s], width=0.7)
        axes.plot([s - 0.35, s + 0.35], [height, height], color=COLOURS[s], linewidth=2)
    axes.set_xticks(range(len(mean)), STREAM_NAMES[: len(mean)])
    stay_to_switch(axes)
    label(axes, letter, title, "policy, mean over trials")
