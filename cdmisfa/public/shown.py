"""Small pictures of runs and recordings, and their views."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.shown import ROW, WIDTH
from replay.palette import colour


def watched(streams: NDArray[Any], count: int) -> NDArray[np.uint8]:
    """Which stream was watched when: a row a stream, time to the right.

    Args:
        streams: (n,) the stream of each iteration.
        count: how many there are.
    """
    width = min(WIDTH, len(streams))
    columns = np.arange(len(streams)) * width // max(len(streams), 1)
    share = np.zeros((count, width))
    np.add.at(share, (streams, columns), 1)
    share /= np.maximum(share.sum(axis=0), 1)
    colours = np.array([colour(s) for s in range(count)], float)
    picture = 255 - share[:, :, None] * (255 - colours[:, None, :])
    wide = np.repeat(picture, max(WIDTH // max(width, 1), 1), axis=1)
    height = max(min(ROW, 10 * ROW // max(count, 1)), 1)
    return np.repeat(wide, height, axis=0).astype(np.uint8)


def beside(frames: list[NDArray[Any]]) -> NDArray[np.uint8]:
    """Frames of images side by side, no wider than `WIDTH` together; one at least."""
    wide = np.hstack(frames)
    step = -(-wide.shape[1] // WIDTH)
    return np.ascontiguousarray(wide[::step, ::step])


def curves(values: NDArray[Any]) -> NDArray[np.uint8]:
    """Numbers (n, I) over time, each with a colour, from the least to the most of all."""
    picture = np.full((4 * ROW, WIDTH, 3), 255, np.uint8)
    low, high = float(values.min()), float(values.max())
    places = np.linspace(0, WIDTH - 1, len(values)).astype(int)
    scale = (len(picture) - 1) / (high - low) if high > low else 0.0
    for i, line in enumerate(values.T):
        heights = np.rint((high - line) * scale).astype(int)
        picture[np.interp(np.arange(WIDTH), places, heights).astype(int), np.arange(WIDTH)] = (
            colour(i)
        )
    return picture


def view(path: Path, save: str | Path | None, *, tab: str | None = None) -> None:
    """Show a run or a recording in the viewer until it is closed, or write its view to a file."""
    if save is not None:
        from replay.view.build import build_view

        build_view(path, Path(save), tab=tab)
        return
    from replay.viewer.window import open_window

    open_window(path, tab=tab)
