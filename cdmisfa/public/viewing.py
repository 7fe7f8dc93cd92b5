"""Views of runs and recordings in a notebook, a window or a file."""

from __future__ import annotations

import atexit
import contextlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from recorder.images.options import InputOptions

# Pixels of the height of a view in a notebook.
HEIGHT = 600


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
