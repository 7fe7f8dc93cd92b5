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
    rows: int, columns: int, width: float, height: float, **subplots: Any
) -> tuple[Figure, Any]:
    """A figure of so many inches, and its (rows, columns) axes."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
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
