"""Compute iterations of a run again: put its learner at a keyframe and learn on from there."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

import replay.runs.run
from cdmisfa.agents.learners import open_learner
from cdmisfa.core.blocks import SeekableSource, description, turn_to
from cdmisfa.core.errors import (
    LogDamagedError,
    LogExhaustedError,
    NotReproducedError,
    UsageError,
)
from cdmisfa.core.learning import Keyframe, Learner, arithmetic_of
from cdmisfa.core.signals import BlockSignals
from cdmisfa.experiments.resume import (
    config_history,
    reconfigured,
    restore,
    source_of,
)
from replay.runs.columns import SignalColumns, columns_of_records
from replay.runs.compare import Difference, differing, first_differing
from replay.runs.folders import run_log
from replay.runs.keyframes import arrays_of, read_keyframe, read_keyframes
from replay.runs.log import RunHeader, read_columns, read_header
from replay.runs.provenance import changed_files, stated_source
from replay.stored import StoredSource

SAME = ("streams", "frame_shape", "dtype", "fps", "start_ns")
"""What a source must have in common with the one that a run learned from."""

Words = Sequence[str]
"""What names a source on the command line."""


@dataclass(frozen=True, slots=True)
class Checked:
    """What came of computing the iterations [start, stop) of a run again.

    Attributes:
        difference: the first one, of the log from what was computed again.
        other_files: names of files that are not those the run learned from.
    """

    start: int
    stop: int
    difference: Difference | None
    other_files: tuple[str, ...] = ()

    @property
    def holds(self) -> bool:
        """Whether there are the same signals, of the same files."""
        return self.difference is None and not self.other_files

    def as_json(self) -> dict[str, Any]:
        """The same as JSON values."""
        found = self.difference
        return {
            "from": self.start,
            "to": self.stop,
            "identical": found is None,
            "first_difference": None if found is None else found.as_json(),
            "other_files": list(self.other_files),
        }

    def __str__(self) -> str:
        files = ", ".join(self.other_files)
        other = f"{files}: no longer what the run learned from" if files else ""
        if self.difference is None:
            what = f"iterations {self.start} to {self.stop - 1}"
            same = f"{what}: learned again, they are identical, bit for bit"
            return f"{same}; but {other}" if other else same
        return f"{self.difference} when learned again{other and f': {other}'}"


class Recomputation:
    """A run's learner at the newest keyframe at or before an iteration, to learn on from there.

    Args:
        run: the run's folder, or its log.
        iteration: iterations done.
        source: words that name its source, where it is not what the run says, or it, open.

    Attributes:
        log: of the run.
        header: of the log.
        learner: in its state after `learner.iteration` iterations.
        t: the source's next frame.

    Raises:
        UsageError: there is no such run, or it was learned with another arithmetic.
        LogDamagedError: it cannot be read.
    """

    def __init__(self, run: Path, iteration: int, source: Words | SeekableSource = ()) -> None:
        self.log = run_log(Path(run))
        self.header: RunHeader = read_header(self.log)
        self._given = source if isinstance(source, SeekableSource) else None
        self._words = tuple(source) if not isinstance(source, SeekableSource) else ()
        self._source: SeekableSource | None = None
        spans = config_history(self.log, self.header.manifest)
        keyframe = read_keyframe(self.log, iteration)
        at = keyframe.iteration if keyframe else 0
        span = [span for span in spans if span.start <= at][-1]
        self._later = [span for span in spans if span.start > at]
        self.learner: Learner = open_learner(span.config, self.header.spec, span.seed)
        then, now = self.header.arithmetic, arithmetic_of(self.learner)
        if then != now:
            raise UsageError(
                f"{self.log} was learned with arithmetic {then}, and this cdmisfa computes with "
                f"{now}: learn it again"
            )
        self.t = 0
        if keyframe is not None:
            restore(self.learner, keyframe, self.header.spec)
            self.t = keyframe.t

    @classmethod
    def after(cls, run: Path, iterations: int, source: Words | SeekableSource = ()) -> Self:
        """A run's learner after so many iterations, bit for bit; to be closed.

        What is computed again to get there is compared with the log.

        Args:
            run: its folder, or its log.
            iterations: done before; 0 is the beginning.
            source: words that name its source, where it is not what the run says.

        Raises:
            UsageError: there is no such run or iteration, or the source that is needed.
            LogDamagedError: the log cannot be read.
            NotReproducedError: computing again gives other signals than the log holds.
        """
        if iterations < 0:
            raise UsageError(f"{iterations} iterations: a run begins after 0")
        again = cls(Path(run), iterations, source)
        with contextlib.ExitStack() as failing:
            failing.callback(again.close)
            at, found = again.compare(iterations)
            if found is not None:
                raise NotReproducedError(
                    f"{again.log}: learned again, {found}: name its own source with --source"
                )
            if at < iterations:
                raise UsageError(f"{again.log} holds {at} iterations: name one of 0 to {at}")
            failing.pop_all()
        return again

    @property
    def source(self) -> SeekableSource:
        """What the run learned from, at frame `t`; opened when it is first needed.

        Raises:
            UsageError: it is not there.
        """
        if self._source is None:
            self._source = self._open()
            self._source.seek(self.t)
        return self._source

    def steps(self, count: int) -> Iterator[BlockSignals]:
        """Learn so many blocks again.

        Raises:
            UsageError: the run's source is not there.
            LogExhaustedError: it ended.
        """
        for _ in range(count):
            block = self.source.take(self.learner.stream, self.learner.tau)
            signals = self.learner.step(block)
            turn_to(self.source, block.stream, self.learner.stream)
            self.t = self.source.t
            if self._later and self._later[0].start == self.learner.iteration:
                try:
                    span = self._later.pop(0)
                    self.learner = reconfigured(self.learner, span, self.header.spec)
                except ValueError as error:
                    raise LogDamagedError(f"{self.log}: its fork cannot be ({error})") from error
            yield signals

    def compare(
        self, stop: int | None, keyframes: Iterable[Keyframe] = ()
    ) -> tuple[int, Difference | None]:
        """Learn up to an iteration, or to the log's end: how far, and the log's first difference.

        Args:
            stop: the iteration.
            keyframes: that are compared, too.
        """
        left = iter(keyframes)
        at, kept = self.learner.iteration, next(left, None)
        for logged in self._logged(stop):
            records: list[BlockSignals] = []
            other: Difference | None = None
            with contextlib.suppress(LogExhaustedError):
                for signals in self.steps(len(logged)):
                    records.append(signals)
                    if kept is not None and kept.iteration == self.learner.iteration:
                        other = other or self._difference_from(kept)
                        kept = next(left, None)
            learned = columns_of_records(records)
            found = first_differing(iter([logged]), learned, at)
            at += len(logged)
            both = [one for one in (found, other) if one is not None]
            if both:
                return at, min(both, key=lambda one: one.iteration)
        return at, None

    def other_files(self) -> list[str]:
        """Names of the source's files that are not those it learned from.

        None are named of a source of other words, and of one that was not needed.
        """
        if self._source is None or self._words:
            return []
        return changed_files(stated_source(self.log), description(self._source, at_once=True))

    def close(self) -> None:
        """Let go of the source."""
        if self._source is not None:
            self._source.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _logged(self, stop: int | None) -> Iterator[SignalColumns]:
        """The records of the log from the learner's iteration on, up to another one."""
        at = self.learner.iteration
        if at == stop:
            return
        for columns in read_columns(self.log, self.header, start=self.t):
            kept = len(columns) if stop is None else min(len(columns), stop - at)
            if kept <= 0:
                return
            if int(columns.iterations[0]) != at:
                raise LogDamagedError(f"{self.log}: iteration {at} is missing, see cdmisfa verify")
            yield columns.rows(0, kept)
            at += kept

    def _difference_from(self, keyframe: Keyframe) -> Difference | None:
        """Where a keyframe differs from the learner after as many iterations."""
        last, state = keyframe.iteration - 1, self.learner.state
        kept = arrays_of(keyframe.state)
        own = arrays_of(state)
        if kept.keys() != own.keys():
            return Difference(last, "keyframe", (), ", ".join(kept), ", ".join(own))
        for name, array in kept.items():
            if (found := _first_element(array, own[name])) is not None:
                return Difference(last, f"keyframe {name}", *found)
        plain = {
            "t": (keyframe.t, self.t),
            "policy_rng": (dict(keyframe.state.policy_rng), dict(state.policy_rng)),
        }
        for name, (one, two) in plain.items():
            if one != two:
                return Difference(last, f"keyframe {name}", (), repr(one), repr(two))
        return None

    def _open(self) -> SeekableSource:
        try:
            source = self._given or source_of(self.log.parent, self._words)
        except UsageError as error:
            raise UsageError(
                f"{error} (what it learned from is needed after {self.learner.iteration} "
                "iterations, where it stands in its log: name it with --source)"
            ) from error
        now, then = source.spec, self.header.spec
        if any(getattr(now, name) != getattr(then, name) for name in SAME):
            source.close()
            raise UsageError(
                f"{' '.join(self._words) or 'its source'} shows other streams than {self.log} was "
                "learned from: name its source with --source"
            )
        held_out = self.header.manifest["source"].get("held_out", 0)
        if held_out and isinstance(source, StoredSource):
            source.hold_out(held_out)
        return source


class Run(replay.runs.run.Run):
    """What a run left behind, read where it is needed and only then.

    Args:
        path: the run's folder, or its log.

    Raises:
        UsageError: there is no such run, or it is of another version of the signals.
        LogDamagedError: its log cannot be read, here or in any later access.
    """

    def at(self, iterations: int, source: Words | SeekableSource = ()) -> Learner:
        """Its learner as it was after so many iterations, bit for bit.

        Args:
            iterations: done before; 0 is the beginning.
            source: words that name what it learned from, where it is not what the run says, or
                it, open.

        Raises:
            UsageError: it has not so many, or its source is not there; what stands in its log, a
                keyframe every some hundred iterations, needs none.
            NotReproducedError: learning again gives other signals than its log holds.
        """
        with Recomputation.after(self.log, iterations, source) as again:
            return again.learner


def check_run(
    run: Path, source: Sequence[str] = (), start: int = 0, stop: int | None = None
) -> Checked:
    """Compute the iterations [start, stop) of a run again, and compare signals and keyframes.

    Args:
        run: its folder, or its log.
        source: words that name its source, where it is not what the run says.
        start: the newest keyframe at or before it is where learning begins.
        stop: by default where its log ends.

    Raises:
        UsageError: there is no such run, source or part.
        LogDamagedError: the log cannot be read.
    """
    if stop is not None and 0 < start >= stop:
        raise UsageError(f"from {start} to {stop} there is nothing to check: write FIRST:END")
    with Recomputation(run, start, source) as again:
        first = again.learner.iteration
        at, found = again.compare(stop, read_keyframes(again.log, first))
        others = tuple(again.other_files())
    if found is None:
        if at <= start and (at or stop):
            raise UsageError(f"{again.log} holds {at} iterations: choose a part of these")
        if stop is not None and at < stop:
            raise UsageError(f"{again.log} holds {at} iterations: end at one of these")
    return Checked(first, at, found, others)


def _first_element(a: NDArray[Any], b: NDArray[Any]) -> tuple[tuple[int, ...], str, str] | None:
    """Place and values of the first element in which two arrays differ."""
    if (a.dtype, a.shape) != (b.dtype, b.shape):
        return (), f"{a.dtype} of shape {a.shape}", f"{b.dtype} of shape {b.shape}"
    if a.tobytes() == b.tobytes():
        return None
    if a.dtype.names:
        fields = (_first_element(a[name], b[name]) for name in a.dtype.names)
        return next((found for found in fields if found is not None), None)
    differ = np.argwhere(differing(a, b))
    if not len(differ):
        return None
    place = tuple(differ[0].tolist())
    return place, repr(a[place].item()), repr(b[place].item())
