"""Small pictures of runs and recordings, and their views."""

from __future__ import annotations

import html
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.shown import ROW, WIDTH, Shown, png
from recorder.images.options import InputOptions
from replay.palette import colour

HEIGHT = 600
"""Pixels of the height of a view in a notebook."""


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


def view(
    held: Shown,
    paths: Sequence[Path],
    save: str | Path | None,
    *,
    tab: str | None = None,
    inputs: InputOptions | None = None,
) -> None:
    """Show a run or a recording: in the notebook, else in a window, or write its view to a file.

    Args:
        held: what is shown; a notebook shows it where the viewer's frame cannot be.
        paths: the run's folder, or the files of the recording.
        save: the file.
        tab: the name of the tab that is open.
        inputs: which streams of logs, and how they become frames.
    """
    from replay.view.build import build_view

    def build(out: Path) -> None:
        build_view(paths[0], out, beside=paths[1:], tab=tab, inputs=inputs)

    if save is not None:
        build(Path(save))
        return
    from replay.viewer.window import open_window, refuse_without_display, serve_frame

    display = _notebook()
    if display is None:
        refuse_without_display()
    with tempfile.TemporaryDirectory(prefix="cdmisfa-", ignore_cleanup_errors=True) as folder:
        file = Path(folder) / f"{paths[0].resolve().stem}.rrd"
        build(file)
        if display is None:
            open_window(file)
        else:
            display(framed(held, serve_frame(file)), raw=True)


def framed(held: Shown, address: str) -> dict[str, str]:
    """The viewer's page in a frame, by MIME types; the object itself where that cannot be shown.

    Args:
        held: what the page shows.
        address: of the page, on this machine.
    """
    place = address.partition("?")[0]
    instead = (
        f"<p>Here is the viewer as long as the notebook runs on this machine, at {place}: run the "
        "cell again, or write the view to a file, view('run.rrd').</p>"
    )
    bundle = {
        "text/plain": repr(held),
        "text/html": f'<object type="text/html" data="{html.escape(address)}" '
        f'style="width:100%;height:{HEIGHT}px">{held._repr_html_()}{instead}</object>',
    }
    picture = held._picture()
    return bundle if picture is None else {**bundle, "image/png": png(picture)}


def _notebook() -> Callable[..., None] | None:
    """What shows things in the notebook that this is; None elsewhere."""
    ipython: Any = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    return ipython.display.display if hasattr(shell, "kernel") else None
