"""A run on disk: its signals as arrays and tables, what it learned, its learner at any moment."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import replay.runs.run
from cdmisfa.core.errors import UsageError, did_you_mean
from cdmisfa.core.learning import Learner
from cdmisfa.core.shown import Shown
from cdmisfa.core.signals import SIGNALS
from cdmisfa.experiments.resume import Recomputation
from cdmisfa.public.recording import Recording, as_words
from cdmisfa.public.shown import attended_image, view
from replay.runs.log import EVENT_TOPIC, WATCHED_TOPIC, Event, read_batches
from replay.runs.modules import SlowFeatures
from replay.runs.run import read_outline

SCALARS = tuple(signal.name for signal in SIGNALS.values() if not signal.dims)
"""Signals of one number an iteration."""


class UnknownSignalError(UsageError, KeyError):
    """There is no signal of that name."""

    __str__ = Exception.__str__  # a KeyError's is quoted


class Signals(Shown, Mapping[str, "NDArray[Any]"]):
    """The signals of a run: arrays by name, and one table of a row an iteration.

    `signals["reward"]` is an array (iterations, ...), NaN where a value is missing. In tables what
    is missing is null. `cdmisfa.SIGNALS` says what each signal is.
    """

    def __init__(self, log: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
        self._log, self._arrays = log, arrays

    def __getitem__(self, name: str) -> NDArray[Any]:
        _refuse_unknown(name, self._arrays)
        return self._arrays[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._arrays)

    def __len__(self) -> int:
        return len(self._arrays)

    def _facts(self) -> Mapping[str, Any]:
        return {"run": self._log.parent, "signals": ", ".join(self)}

    def to_arrow(self, *names: str) -> Any:
        """A table of pyarrow, a row an iteration; what is missing is null.

        Args:
            names: of signals; by default all of one number an iteration. Others are lists.

        Raises:
            UsageError: there is no such signal; it is a KeyError, too.
            LogDamagedError: the log cannot be read.
        """
        from replay.export.tables import signals_table

        for name in names:
            _refuse_unknown(name, SIGNALS)
        return signals_table(self._log, names or SCALARS)

    def to_pandas(self, *names: str) -> Any:
        """The same as a DataFrame of pandas, by iterations where these are among the columns."""
        table = self.to_arrow(*names).to_pandas()
        return table.set_index("iteration") if "iteration" in table else table

    def to_polars(self, *names: str) -> Any:
        """The same as a DataFrame of Polars."""
        import polars

        return polars.from_arrow(self.to_arrow(*names))


def _refuse_unknown(name: str, known: Collection[str]) -> None:
    if name not in known:
        raise UnknownSignalError(f"no signal {name!r}: {did_you_mean(str(name), known)}")


class Run(Shown, replay.runs.run.Run):
    """A run on disk, of which is read what is asked for.

    Args:
        path: the run's folder, or its log.

    Attributes:
        signals: a mapping of arrays by name; `signals.to_pandas()` is a table.
        modules: what was learned, in order; `module.transform(frames)` gives its outputs.
        streams: names of what it learned from.
        result: the document of `cdmisfa learn --json`; None where it was broken off.
        log: its run.mcap.

    Raises:
        UsageError: there is no such run, or it is of another version of the signals.
        LogDamagedError: its log cannot be read, here or in any later access.
    """

    def __init__(self, path: str | Path) -> None:
        super().__init__(path)
        self.signals: Signals = Signals(self.log, self.signals)
        self._learned_from: Any = ()

    @property
    def path(self) -> Path:
        """Its folder."""
        return self.log.parent

    @property
    def features(self) -> tuple[SlowFeatures, ...]:
        """Its modules as fitted transformers of scikit-learn, in order."""
        return tuple(map(SlowFeatures, self.modules))

    @property
    def config(self) -> Mapping[str, Any]:
        """What it was told, by sections: `run.config["learner"]["tau"]`."""
        found: Mapping[str, Any] = self.header.manifest.get("config", {})
        return found

    @cached_property
    def events(self) -> tuple[Event, ...]:
        """What happened, in words: each has `t`, `iteration`, `text` and `level`."""
        batches = read_batches(self.log, self.header, topics=(EVENT_TOPIC,))
        return tuple(event for batch in batches for event in batch.events)

    def frames(self, start: int = 0, stop: int | None = None) -> NDArray[Any]:
        """The frames that were watched in the iterations [start, stop), (n, *frame_shape).

        Of numbers all of them, of images every tenth, as the log has them; `Recording.frames` has
        all.

        Raises:
            ValueError: there are no such iterations.
        """
        count = len(self.signals["iteration"])
        stop = count if stop is None else stop
        if not 0 <= start < stop <= count:
            raise ValueError(
                f"{self.path} has no iterations [{start}, {stop}): it has [0, {count})"
            )
        starts, tau = self.signals["t"], self.signals["y"].shape[1]
        first, last = int(starts[start]), int(starts[stop - 1]) + tau
        found = [np.empty((0, *self.header.spec.frame_shape), self.header.spec.dtype)]
        for batch in read_batches(self.log, self.header, topics=(WATCHED_TOPIC,), start=first):
            for t, frames in batch.watched:
                found.append(frames[(t >= first) & (t < last)])
                if t[-1] >= last:
                    return np.concatenate(found)
        return np.concatenate(found)

    def at(self, iterations: int, source: Any = ()) -> Learner:
        """Its learner as it was after so many iterations, bit for bit.

        Args:
            iterations: done before; 0 is the beginning.
            source: what it learned from, as `cdmisfa.learn` takes it, where the run cannot say or
                finds it no more.

        Raises:
            UsageError: it has not so many, or its source is not there; what stands in its log, a
                keyframe every some hundred iterations, needs none.
            NotReproducedError: learning again gives other signals than its log holds.
        """
        if isinstance(source, tuple) and not source:
            source = self._learned_from
        words = as_words(source)
        with contextlib.ExitStack() as opened:
            if not words and not isinstance(source, tuple):
                source = opened.enter_context(Recording.of(source).source())
            with Recomputation.after(self.log, iterations, words or source) as again:
                return again.learner

    def summary(self) -> str:
        """What came of it, in words, as Markdown: what the first page of its view says."""
        from replay.view.summary import summary_text

        return summary_text(read_outline(self.log), self.path.name, [e.text for e in self.events])

    def report(self, out: str | Path | None = None) -> Path:
        """Write what came of it as one HTML page that needs no network and no other file.

        Args:
            out: the file, *.html; by default report.html in its folder, replaced.

        Raises:
            UsageError: the file exists.
            LogWriteError: it cannot be written.
        """
        from cdmisfa.experiments.reports import write_report

        return write_report([self.path], None if out is None else Path(out))

    def view(self, save: str | Path | None = None, *, tab: str | None = None) -> None:
        """Show it in the Rerun viewer: in a notebook below the cell, else until a window is closed.

        Args:
            save: write the view to this file, *.rrd, instead.
            tab: the name of the tab that is open.

        Raises:
            CdmisfaError: there is no display, or the file cannot be written.
        """
        view([self.path], save, tab=tab)

    def _facts(self) -> Mapping[str, Any]:
        learned = (f"{m.index}: {m.stream}, η {m.eta[0]:.3g}" for m in self.modules)
        ended = (self.result or {}).get("ended", "broken off")
        return {
            "run": self.path,
            "streams": ", ".join(self.streams),
            "iterations": len(self.signals["iteration"]),
            "modules": "; ".join(learned) or "none",
            "ended": ended,
        }

    def _picture(self) -> NDArray[np.uint8] | None:
        streams = self.signals["stream"]
        return attended_image(streams, len(self.streams)) if len(streams) else None
