"""Small pictures of runs and recordings, and their views."""

from __future__ import annotations

import atexit
import contextlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.shown import ROW, WIDTH
from recorder.images.options import InputOptions
from replay.palette import colour

HEIGHT = 600
"""Pixels of the height of a view in a notebook."""


def attended_image(streams: NDArray[Any], count: int) -> NDArray[np.uint8]:
    """Return an image of the attended stream over time: a row a stream, time to the right.

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


def view(
    paths: Sequence[Path],
    save: str | Path | None,
    *,
    tab: str | None = None,
    inputs: InputOptions | None = None,
) -> None:
    """Show a run or a recording: below a notebook's cell, else in a window; or write its view.

    Args:
        paths: the run's folder, or the files of the recording.
        save: the file of the view.
        tab: the name of the tab that is open.
        inputs: which streams of logs, and how they become frames.
    """
    from replay.view.build import build_view, view_of

    how: dict[str, Any] = {"beside": paths[1:], "tab": tab, "inputs": inputs}
    if save is not None:
        build_view(paths[0], Path(save), **how)
        return
    from replay.viewer import open_window, served

    ipython: Any = sys.modules.get("IPython")
    if ipython is None or not hasattr(ipython.get_ipython(), "kernel"):
        with view_of(paths[0], **how) as file:
            open_window(file)
        return
    file = _until_exit.enter_context(view_of(paths[0], **how))
    _, address = _until_exit.enter_context(served(file))
    ipython.display.display(ipython.display.IFrame(address, "100%", HEIGHT))


_until_exit = contextlib.ExitStack()
atexit.register(_until_exit.close)
