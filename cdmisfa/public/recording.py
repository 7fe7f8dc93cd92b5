"""`Recording`: recordings, external logs and arrays, to learn from or to view."""

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

# A source for `learn`: arrays, tables, mappings of these by stream name, paths and URLs of logs,
# names of scenes, live streams, or an open source.
SourceLike: TypeAlias = Any


def as_words(source: SourceLike) -> tuple[str, ...]:
    """Return paths, patterns or names as the words of a command; () for arrays."""
    words = source if isinstance(source, list | tuple) else (source,)
    return tuple(map(str, words)) if all(isinstance(w, str | Path) for w in words) else ()


class Recording(Described):
    """Recording, external logs, or arrays.

    Args:
        sources: paths, URLs or patterns: the folder of a recording, MCAP files, ROS bags, videos,
            folders of images, tables, LeRobot datasets, .npy and .npz files; or one array, table,
            or mapping of them by stream name. Arrays hold numbers, (n,) or (n, values), or images,
            (n, height, width) or (n, height, width, 3); row i of all of them has the same time.
        loop: True to start again at the end.
        skip_damaged: True to skip damaged parts of files.
        episodes: True to read the paths one after the other, each as an episode. The logs of an
            indexed folder (see `cdmisfa index`) always are episodes.
        options: which streams, and how they become frames: the input options of `cdmisfa learn`
            (`topics`, `fields`, `size`, `rate`, `start`, `end`, `align`, `color`) and the keys
            `input.*`, such as `fit="pad"` or `centre="episode"`.

    Attributes:
        spec: names of the streams, frame shape, type, rate and number of frames.
        inputs: the options.

    Raises:
        UsageError: a log does not exist, or an array is not numeric.
        LogDamagedError: a log is damaged.
    """

    def __init__(
        self,
        *sources: SourceLike,
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
        self.words = as_words(sources)
        if not self.words and len(sources) != 1:
            raise UsageError(f"{len(sources)} arrays have no names: give {{'left': array, ...}}")
        self._arrays = sources[0]
        with self.source() as source:
            self.spec: SourceSpec = source.spec

    @classmethod
    def of(cls, source: SourceLike) -> Self:
        """Return a recording of a source; a `Recording` itself is returned unchanged."""
        if isinstance(source, cls):
            return source
        several = isinstance(source, list | tuple) and as_words(source)
        return cls(*source) if several else cls(source)

    def source(self, *, loop: bool = False) -> Any:
        """Open the streams as a `SeekableSource`, for a `with` statement.

        Args:
            loop: True to start again at the end, also if the recording does not.
        """
        loop = loop or self.loop
        if self.words:
            how: dict[str, Any] = {"loop": loop, "skip_damaged": self.skip_damaged}
            return open_logs(self.words, inputs=self.inputs, episodes=self.episodes, **how)
        arrays = self._arrays
        streams = arrays if isinstance(arrays, Mapping) else {"stream": arrays}
        source = open_arrays(streams, self.inputs, loop=loop)
        source.centre = self.inputs.centre
        return source

    def frames(
        self, stream: str | int = 0, start: int = 0, stop: int | None = None
    ) -> NDArray[Any]:
        """Return the frames [start, stop) of a stream without its gaps, (n, *frame_shape).

        Args:
            stream: name of the stream, or its index from 0.
            start: number of the first frame, from 0.
            stop: number after the last frame; None: the end. Needed if the recording loops.

        Raises:
            ValueError: the stream or the frames do not exist.
        """
        names, length = self.spec.streams, self.spec.length
        index = names.index(stream) if stream in names else stream
        if not isinstance(index, int) or not 0 <= index < len(names):
            raise ValueError(f"no stream {stream!r}: there are {', '.join(names)}")
        stop = length if stop is None else stop
        if stop is None or not 0 <= start <= stop or (length is not None and stop > length):
            raise ValueError(f"no frames [{start}, {stop}): there are [0, {length or '...'})")
        shape, dtype = self.spec.kind(index)
        parts = [np.empty((0, *shape), dtype)]
        with self.source() as source:
            first = getattr(source, "first_frame", 0)
            spans = source.spans(index, first + start, first + stop) if stop > start else []
            for low, high in spans:
                source.seek(low)
                parts.append(source.take(index, high - low).frames)
        return np.concatenate(parts)

    def view(self, save: str | Path | None = None, *, tab: str | None = None) -> None:
        """Show the recording in the Rerun viewer: below the cell in a notebook, else in a window.

        Args:
            save: file to write the view to (.rrd) instead.
            tab: name of the tab that is open at first.

        Raises:
            UsageError: the recording consists of arrays.
            CdmisfaError: there is no display, or the file cannot be written.
        """
        if not self.words:
            raise UsageError("arrays cannot be shown: learn from them, and view the run")
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
    """Show a run or a recording: below the cell in a notebook, else in a window; or write its view.

    Args:
        paths: the folder of the run, or the files of the recording.
        save: file to write the view to (.rrd); None to show it.
        tab: name of the tab that is open at first.
        inputs: which streams of logs to show, and how they become frames.
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
