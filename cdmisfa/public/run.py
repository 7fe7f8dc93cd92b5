"""`cdmisfa.Run`: a run on disk, its signals as arrays and tables, its modules and its learner."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

import replay.runs.run
from cdmisfa.core.blocks import Described
from cdmisfa.core.errors import UsageError, did_you_mean
from cdmisfa.core.learning import Learner
from cdmisfa.core.signals import SIGNALS
from cdmisfa.experiments.resume import Recomputation
from cdmisfa.public.recording import Recording, as_words, view
from replay.runs.columns import whole_signals
from replay.runs.log import EVENT_TOPIC, WATCHED_TOPIC, Event, RunHeader, read_batches, read_columns
from replay.runs.run import read_outline

# Signals that are one number in each iteration.
SCALARS = tuple(signal.name for signal in SIGNALS.values() if not signal.dims)


class UnknownSignalError(UsageError, KeyError):
    """A signal name that does not exist."""

    __str__ = Exception.__str__  # KeyError would print the message in quotes


class TemporaryFolder:
    """Mark of a run in a temporary folder, which is removed with the last object that holds it."""

    def __deepcopy__(self, memo: Any) -> Self:
        return self


class Signals(Described, Mapping[str, "NDArray[Any]"]):
    """The signals of a run: arrays by name, and tables with one row for each iteration.

    `signals["reward"]` is an array (iterations, ...) with NaN for missing values; in tables missing
    values are null. `cdmisfa.SIGNALS` describes each signal.
    """

    def __init__(self, log: Path, header: RunHeader) -> None:
        self._log, self._header = log, header
        self._arrays: dict[str, NDArray[Any]] = {}
        self._folder: TemporaryFolder | None = None

    def __getitem__(self, name: str) -> NDArray[Any]:
        _refuse_unknown(name)
        if name not in self._arrays:
            self._arrays |= whole_signals(read_columns(self._log, self._header), [name])
        return self._arrays[name]

    def __iter__(self) -> Iterator[str]:
        return iter(SIGNALS)

    def __len__(self) -> int:
        return len(SIGNALS)

    def _facts(self) -> Mapping[str, Any]:
        return {"run": self._log.parent, "signals": ", ".join(self)}

    def to_arrow(self, *names: str) -> Any:
        """Return a pyarrow table with one row for each iteration; missing values are null.

        Args:
            names: names of signals; none: all that are one number in each iteration. Arrays become
                lists.

        Raises:
            UsageError: a signal does not exist; the error is also a KeyError.
            LogDamagedError: the log cannot be read.
        """
        from replay.export.tables import signals_table

        for name in names:
            _refuse_unknown(name)
        return signals_table(self._log, names or SCALARS)

    def to_pandas(self, *names: str) -> Any:
        """Return the table of `to_arrow` as a pandas DataFrame."""
        return self.to_arrow(*names).to_pandas()

    def to_polars(self, *names: str) -> Any:
        """Return the table as a Polars DataFrame."""
        import polars

        return polars.from_arrow(self.to_arrow(*names))


def _refuse_unknown(name: str) -> None:
    if name not in SIGNALS:
        raise UnknownSignalError(f"no signal {name!r}: {did_you_mean(str(name), SIGNALS)}")


class Run(Described, replay.runs.run.StoredRun):
    """A run on disk; each part is read when it is first used.

    Args:
        path: folder of the run, or its run.mcap.

    Attributes:
        signals: mapping of arrays by name; `signals.to_pandas()` is a table.
        modules: the saved modules; `module.transform(frames)` returns the outputs of one.
        streams: names of the streams.
        result: the document of `cdmisfa learn --json`; None if the run was interrupted.
        log: path of run.mcap.

    Raises:
        UsageError: the run does not exist, or has another version of the signals.
        LogDamagedError: the log cannot be read, now or at a later access.
    """

    def __init__(self, path: str | Path) -> None:
        super().__init__(path)
        self.signals = Signals(self.log, self.header)
        self._source: Any = ()

    @property
    def path(self) -> Path:
        """Folder of the run."""
        return self.log.parent

    @property
    def config(self) -> Mapping[str, Any]:
        """Configuration of the run by section: `run.config["learner"]["tau"]`."""
        return dict(self.header.manifest.get("config", {}))

    @cached_property
    def events(self) -> tuple[Event, ...]:
        """Events of the run; each has `t`, `iteration`, `text` and `level`."""
        batches = read_batches(self.log, self.header, topics=(EVENT_TOPIC,))
        return tuple(event for batch in batches for event in batch.events)

    def frames(self, start: int = 0, stop: int | None = None) -> NDArray[Any]:
        """Return the frames of the attended streams in the iterations [start, stop).

        The log has every frame of vectors, and every tenth image; `Recording.frames` has all.

        Returns:
            (n, *frame_shape).

        Raises:
            ValueError: the iterations do not exist, or the streams' frames differ in shape.
        """
        if self.header.spec.kinds:
            raise ValueError("the streams have frames of several shapes: use Recording.frames")
        count = len(self.signals["iteration"])
        stop = count if stop is None else stop
        if not 0 <= start < stop <= count:
            raise ValueError(f"no iterations [{start}, {stop}): {self.path} has [0, {count})")
        starts, tau = self.signals["t"], self.signals["y"].shape[1]
        first, last = int(starts[start]), int(starts[stop - 1]) + tau
        parts = [np.empty((0, *self.header.spec.frame_shape), self.header.spec.dtype)]
        for batch in read_batches(self.log, self.header, topics=(WATCHED_TOPIC,), start=first):
            for t, frames in batch.watched:
                parts.append(frames[(t >= first) & (t < last)])
                if t[-1] >= last:
                    return np.concatenate(parts)
        return np.concatenate(parts)

    def at(self, iterations: int, source: Any = ()) -> Learner:
        """Return the learner as it was after some iterations, bit for bit.

        Args:
            iterations: number of iterations; 0 is the beginning.
            source: the source, as `cdmisfa.learn` takes it, if the run does not name it or it has
                moved.

        Raises:
            UsageError: the run has fewer iterations, or the source is missing. No source is needed
                right after a keyframe of the log, one in some hundred iterations.
            NotReproducedError: learning again gives signals that differ from the log.
        """
        if isinstance(source, tuple) and not source:
            source = self._source
        words = as_words(source)
        with contextlib.ExitStack() as stack:
            if not words and not isinstance(source, tuple):
                source = stack.enter_context(Recording.of(source).source())
            with Recomputation.after(self.log, iterations, words or source) as recomputation:
                return recomputation.learner

    def summary(self) -> str:
        """Return the results as Markdown, the first page of the view."""
        from replay.view.summary import summary_text

        return summary_text(read_outline(self.log), self.path.name, [e.text for e in self.events])

    def report(self, out: str | Path | None = None) -> Path:
        """Write the results as one HTML page that needs no network and no other file.

        Args:
            out: the file (.html); None: report.html in the run's folder, replaced; it is removed
                with a temporary run.

        Raises:
            UsageError: the file exists.
            LogWriteError: the file cannot be written.
        """
        from cdmisfa.experiments.reports import write_report

        return write_report([self.path], None if out is None else Path(out))

    def view(self, save: str | Path | None = None, *, tab: str | None = None) -> None:
        """Show the run in the Rerun viewer: below the cell in a notebook, else in a window.

        Args:
            save: file to write the view to (.rrd) instead.
            tab: name of the tab that is open at first.

        Raises:
            CdmisfaError: there is no display, or the file cannot be written.
        """
        view([self.path], save, tab=tab)

    def _facts(self) -> Mapping[str, Any]:
        modules = [f"{m.index}: {m.stream}, η {m.eta[0]:.3g}" for m in self.modules]
        return {
            "run": self.path,
            "streams": ", ".join(self.streams),
            "iterations": len(self.signals["iteration"]),
            "modules": "; ".join(modules) or "none",
            "ended": (self.result or {}).get("ended", "broken off"),
        }
