"""Sources in a program: recordings, external logs, and arrays."""

from __future__ import annotations

import atexit
import contextlib
import sys
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.blocks import Described, SourceSpec
from cdmisfa.core.errors import UsageError, did_you_mean
from cdmisfa.experiments.sources import open_logs
from recorder.images.options import InputOptions
from replay.open_sources import open_arrays

# A source for `learn`: arrays, tables, mappings of these by names of streams, paths and URLs of
# logs, names of scenes, words of live streams, or an open source.
Given: TypeAlias = Any


def as_words(given: Given) -> tuple[str, ...]:
    """Return the words of paths, patterns or names; () of arrays."""
    several = given if isinstance(given, list | tuple) else (given,)
    return tuple(map(str, several)) if all(isinstance(w, str | Path) for w in several) else ()


class Recording(Described):
    """A recording, external logs, or arrays, to look at and to learn from.

    Args:
        given: paths, URLs or patterns: a recording's folder, MCAP files, ROS bags, videos, folders
            of images, tables, LeRobot datasets, .npy and .npz files; or one array, table, or
            mapping of them by the streams' names. Arrays hold numbers, (n,) or (n, values), or
            images, (n, height, width) or (n, height, width, 3), the i-th of all at once.
        loop: start again at the end.
        skip_damaged: skip damaged parts.
        episodes: each path is an episode, one after the other; the logs of a folder that
            `cdmisfa index` indexed always are.
        options: which streams, and how they become frames: the input options of `cdmisfa learn`,
            `topics`, `fields`, `size`, `rate`, `start`, `end`, `align`, `color`, and the keys
            `input.*`, as `fit="pad"` or `centre="episode"`; see docs/reference/configuration.md.

    Attributes:
        spec: names of the streams, shape, type, rate and number of frames.
        inputs: the options.

    Raises:
        UsageError: there is no such log, or arrays hold no numbers.
        LogDamagedError: a log is damaged.
    """

    def __init__(
        self,
        *given: Given,
        loop: bool = False,
        skip_damaged: bool = False,
        episodes: bool = False,
        **options: Any,
    ) -> None:
        known = [field.name for field in fields(InputOptions)]
        if unknown := [name for name in options if name not in known]:
            raise UsageError(f"no option {unknown[0]}: {did_you_mean(unknown[0], known)}")
        self.inputs = InputOptions(**options)
        self.loop, self.skip_damaged, self.episodes = loop, skip_damaged, episodes
        self.words = as_words(given)
        if not self.words and len(given) != 1:
            raise UsageError("give one array, or several by name: {'left': one, 'right': two}")
        self._given = given[0]
        with self.source() as source:
            self.spec: SourceSpec = source.spec

    @classmethod
    def of(cls, given: Given) -> Self:
        """Return a recording as it is, or one of paths in a list, of one path or of arrays."""
        if isinstance(given, cls):
            return given
        return cls(*given) if isinstance(given, list | tuple) and as_words(given) else cls(given)

    def source(self, *, loop: bool = False) -> Any:
        """Open its streams for a `with` statement: a `SeekableSource`.

        Args:
            loop: start again at the end, also if the recording does not.
        """
        loop = loop or self.loop
        if self.words:
            how: dict[str, Any] = {"loop": loop, "skip_damaged": self.skip_damaged}
            return open_logs(self.words, inputs=self.inputs, episodes=self.episodes, **how)
        given = self._given
        streams = given if isinstance(given, Mapping) else {"stream": given}
        source = open_arrays(streams, self.inputs, loop=loop)
        source.centre = self.inputs.centre
        return source

    def frames(
        self, stream: str | int = 0, start: int = 0, stop: int | None = None
    ) -> NDArray[Any]:
        """Return the frames [start, stop) of a stream without its gaps, (n, *frame_shape).

        Args:
            stream: its name, or its number from 0.
            start: counted from the first frame.
            stop: by default the end; needed if it starts again at its end.

        Raises:
            ValueError: there is no such stream, or no such frames.
        """
        names, length = self.spec.streams, self.spec.length
        index = names.index(stream) if stream in names else stream
        if not isinstance(index, int) or not 0 <= index < len(names):
            raise ValueError(f"no stream {stream!r}: there are {', '.join(names)}")
        stop = length if stop is None else stop
        if stop is None or not 0 <= start <= stop or (length is not None and stop > length):
            raise ValueError(f"no frames [{start}, {stop}): there are [0, {length or '...'})")
        parts = [np.empty((0, *self.spec.frame_shape), self.spec.dtype)]
        with self.source() as source:
            first = getattr(source, "first_frame", 0)
            spans = source.spans(index, first + start, first + stop) if stop > start else []
            for low, high in spans:
                source.seek(low)
                parts.append(source.take(index, high - low).frames)
        return np.concatenate(parts)

    def view(self, save: str | Path | None = None, *, tab: str | None = None) -> None:
        """Show it in the Rerun viewer: in a notebook below the cell, else until a window is closed.

        Args:
            save: write the view to this file, *.rrd, instead.
            tab: the name of the tab that is open.

        Raises:
            UsageError: it is of arrays.
            CdmisfaError: there is no display, or the file cannot be written.
        """
        if not self.words:
            raise UsageError("recordings and logs are shown: of arrays, view the run")
        view([Path(word) for word in self.words], save, tab=tab, inputs=self.inputs)

    def _facts(self) -> Mapping[str, Any]:
        return {"recording": ", ".join(self.words) or "arrays", **self.spec.facts()}


def view(
    paths: Sequence[Path],
    save: str | Path | None,
    *,
    tab: str | None = None,
    inputs: InputOptions | None = None,
) -> None:
    """Show a run or a recording below a notebook's cell, else in a window; or write its view.

    Args:
        paths: the run's folder, or the files of the recording.
        save: the file of the view.
        tab: the name of the tab that is open.
        inputs: the streams of logs, and how they become frames.
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
    ipython.display.display(ipython.display.IFrame(address, "100%", height=600))


_until_exit = contextlib.ExitStack()
atexit.register(_until_exit.close)
