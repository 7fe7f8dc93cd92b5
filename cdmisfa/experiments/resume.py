"""Compute a run again from a keyframe, to resume, fork, inspect or verify it."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from cdmisfa.agents.learners import learner_class, open_learner
from cdmisfa.core.blocks import SeekableSource, SourceSpec, description, turn_to
from cdmisfa.core.config import build, parse_settings, section_table
from cdmisfa.core.errors import (
    LogDamagedError,
    LogExhaustedError,
    NotReproducedError,
    UsageError,
    one_line,
)
from cdmisfa.core.learning import Keyframe, Learner, LearnerState, arithmetic_of
from cdmisfa.core.signals import BlockSignals
from cdmisfa.experiments.run_folder import FORK, open_source_of
from replay.runs.columns import SignalColumns, columns_of_records
from replay.runs.compare import Difference, differences, differing, first_differing
from replay.runs.folders import run_log
from replay.runs.keyframes import arrays_of, read_keyframe, read_keyframes
from replay.runs.log import RunHeader, read_columns, read_header
from replay.runs.provenance import changed_files, stated_source
from replay.stored_source import StoredSource

# Properties of a source that must equal those of the source that the run learned from.
SPEC_FIELDS = ("streams", "frame_shape", "dtype", "kinds", "fps", "start_ns")

# Keys that a fork must not change, because the meaning of the learner's arrays depends on them.
FIXED = ("learner.algorithm", "learner.expansion", "learner.tau")


@dataclass(frozen=True, slots=True)
class ConfigSpan:
    """Configuration and seed of a run's learner from iteration `start` on; each fork adds one.

    `changed` has the [old, new] values of the keys that differ from the previous span.
    """

    start: int
    config: Any
    seed: int
    changed: Mapping[str, Sequence[Any]]


def config_history(log: Path, manifest: Mapping[str, Any]) -> tuple[ConfigSpan, ...]:
    """Return the configurations of a run in the order of their iterations."""
    try:
        table, seed, fork = manifest["config"]["learner"], manifest["seed"], manifest.get(FORK)
        config = build(learner_class(table["algorithm"]).configuration, "learner", table)
        if fork is None:
            return (ConfigSpan(0, config, seed, {}),)
        span = ConfigSpan(int(fork["at"]), config, seed, dict(fork["changed"]))
        return (*config_history(log, fork["before"]), span)
    except (LookupError, TypeError, ValueError, RecursionError) as error:
        raise LogDamagedError(f"{log} lacks its learner's configuration: learn it again") from error


def fork_span(
    learner: Learner, manifest: Mapping[str, Any], settings: Sequence[str], seed: int | None
) -> ConfigSpan:
    """Return the configuration of a fork.

    Args:
        learner: the parent's learner at the iteration of the fork.
        manifest: manifest of the parent's log.
        settings: `learner.key=value` words, except for the keys in `FIXED`.
        seed: seed of the random choices from there on; None: the parent's.

    Raises:
        UsageError: a setting cannot change.
    """
    table, words = manifest["config"]["learner"], parse_settings(settings)
    kind = learner_class(table["algorithm"]).configuration
    config = build(kind, "learner", table, words.get("learner", {}))
    before = section_table(build(kind, "learner", table))
    changed = {
        f"learner.{key}": [old, new] for key, old, new in differences(before, section_table(config))
    }
    fixed = [f"{section}.*" for section in words if section != "learner"]
    if fixed := [*fixed, *(key for key in FIXED if key in changed)]:
        raise UsageError(f"{fixed[0]} cannot change in a fork: set other keys learner.*")
    if seed is not None and seed != manifest["seed"]:
        changed["seed"] = [manifest["seed"], seed]
    seed = int(manifest["seed"] if seed is None else seed)
    return ConfigSpan(learner.iteration, config, seed, changed)


def restore(learner: Learner, keyframe: Keyframe, spec: SourceSpec) -> None:
    """Set a learner to the state of a keyframe; its modules get the frame shapes of `spec`."""
    try:
        modules = (
            replace(m, frame_shape=spec.kind(m.stream_index)[0]) for m in keyframe.state.modules
        )
        learner.restore(replace(keyframe.state, modules=tuple(modules)))
    except (LookupError, TypeError, ValueError) as error:
        raise LogDamagedError(
            f"the keyframe after {keyframe.iteration} iterations is of another learner "
            f"({one_line(error)}): learn again"
        ) from error


def reconfigured(learner: Learner, span: ConfigSpan, spec: SourceSpec) -> Learner:
    """Return a learner with another configuration, in the state of `learner`."""
    new, state = open_learner(span.config, spec, span.seed), learner.state
    policy_rng = new.state.policy_rng if "seed" in span.changed else state.policy_rng
    try:
        new.restore(LearnerState(state.arrays, state.modules, policy_rng))
    except ValueError as error:
        raise UsageError(
            f"the settings do not fit the learned state ({error}): set keys that keep its shape"
        ) from error
    return new


class Recomputation:
    """A run's learner at the newest keyframe at or before an iteration, to continue from there.

    Args:
        run: the run's folder, or its log.
        iteration: number of iterations done.
        source: words that name the source, if the run does not, or the open source.

    Attributes:
        log: the log of the run.
        header: the header of the log.
        learner: the learner after `learner.iteration` iterations.
        t: number of the source's next frame.

    Raises:
        UsageError: the run does not exist, or it was learned with another arithmetic.
        LogDamagedError: the log cannot be read.
    """

    def __init__(
        self, run: Path, iteration: int, source: Sequence[str] | SeekableSource = ()
    ) -> None:
        self.log = run_log(Path(run))
        self.header: RunHeader = read_header(self.log)
        self._source_words = source
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
                f"{self.log} was learned with arithmetic {then}, but this version of cdmisfa has "
                f"arithmetic {now}: learn it again"
            )
        self.t = 0
        if keyframe is not None:
            restore(self.learner, keyframe, self.header.spec)
            self.t = keyframe.t

    @classmethod
    def after(cls, run: Path, iterations: int, source: Sequence[str] | SeekableSource = ()) -> Self:
        """Compute a run again up to an iteration; the learner is the same bit for bit.

        The computed signals are compared with the log. The caller closes the result. For the
        arguments see the class; 0 iterations are the beginning.

        Raises:
            UsageError: the run or the iteration does not exist, or a source is needed and missing.
            LogDamagedError: the log cannot be read.
            NotReproducedError: the signals differ from the log.
        """
        recomputation = cls(Path(run), iterations, source)
        with contextlib.ExitStack() as on_error:
            on_error.enter_context(recomputation)
            _, difference = recomputation.compare(iterations)
            if difference is not None:
                raise NotReproducedError(
                    f"{recomputation.log}: learned again, {difference}: name the run's own source "
                    "with --source"
                )
            on_error.pop_all()
        return recomputation

    @property
    def source(self) -> SeekableSource:
        """The source that the run learned from, at frame `t`; opened at the first access."""
        if self._source is not None:
            return self._source
        source = self._source_words
        if not isinstance(source, SeekableSource):
            try:
                source = open_source_of(self.log.parent, source)
            except UsageError as error:
                raise UsageError(
                    f"{error} (the log has a keyframe after {self.learner.iteration} iterations; "
                    "to continue from it, name the source with --source)"
                ) from error
        actual, expected = source.spec, self.header.spec
        if any(getattr(actual, name) != getattr(expected, name) for name in SPEC_FIELDS):
            source.close()
            raise UsageError(
                f"the source has other streams than {self.log} was learned from: name the run's "
                "own source with --source"
            )
        stated = self.header.manifest["source"]
        if isinstance(source, StoredSource):
            if stated.get("held_out"):
                source.hold_out(stated["held_out"])
            source.repeat(stated.get("passes", 1))
        self._source = source
        source.seek(self.t)
        return source

    def steps(self, count: int) -> Iterator[BlockSignals]:
        """Learn from the next blocks again, and yield their signals."""
        for _ in range(count):
            block = self.source.take(self.learner.stream, self.learner.tau)
            signals = self.learner.step(block)
            turn_to(self.source, block.stream, self.learner.stream)
            self.t = self.source.t
            if self._later and self._later[0].start == self.learner.iteration:
                self.learner = reconfigured(self.learner, self._later.pop(0), self.header.spec)
            yield signals

    def compare(
        self, stop: int | None, keyframes: Iterable[Keyframe] = ()
    ) -> tuple[int, Difference | None]:
        """Learn up to an iteration, and compare with the log.

        Args:
            stop: the iteration; None: the end of the log.
            keyframes: keyframes of the log to compare too.

        Returns:
            The iteration that was reached, and the first difference.
        """
        remaining = iter(keyframes)
        at, keyframe = self.learner.iteration, next(remaining, None)
        for logged in self._logged(stop):
            records: list[BlockSignals] = []
            in_keyframe: Difference | None = None
            with contextlib.suppress(LogExhaustedError):
                for signals in self.steps(len(logged)):
                    records.append(signals)
                    if keyframe is not None and keyframe.iteration == self.learner.iteration:
                        in_keyframe = in_keyframe or self._difference_from(keyframe)
                        keyframe = next(remaining, None)
            in_signals = first_differing(iter([logged]), columns_of_records(records), at)
            at += len(logged)
            if both := [d for d in (in_signals, in_keyframe) if d is not None]:
                return at, min(both, key=lambda difference: difference.iteration)
        if stop is not None and at != stop:
            raise UsageError(f"{self.log} has {at} iterations: choose a number from 0 to {at}")
        return at, None

    def _logged(self, stop: int | None) -> Iterator[SignalColumns]:
        """Yield the records of the log from the learner's iteration up to `stop`."""
        at = self.learner.iteration
        if at == stop:
            return
        for columns in read_columns(self.log, self.header, start=self.t):
            count = len(columns) if stop is None else min(len(columns), stop - at)
            if count <= 0:
                return
            if int(columns.iterations[0]) != at:
                raise LogDamagedError(f"{self.log}: iteration {at} is missing: see cdmisfa verify")
            yield columns.rows(0, count)
            at += count

    def _difference_from(self, keyframe: Keyframe) -> Difference | None:
        """Return the first difference of a keyframe from the learner after as many iterations."""
        stored = _memory(keyframe.state, keyframe.t)
        computed = _memory(self.learner.state, self.t)
        for name in sorted({*stored, *computed}):
            element = _first_element(stored.get(name, _NO_ARRAY), computed.get(name, _NO_ARRAY))
            if element is not None:
                return Difference(keyframe.iteration - 1, f"keyframe {name}", *element)
        return None

    def other_files(self) -> list[str]:
        """Return the names of files of the run's own source that changed since it learned."""
        if self._source is None or self._source_words:
            return []
        return changed_files(stated_source(self.log), description(self._source, at_once=True))

    def close(self) -> None:
        """Close the source."""
        if self._source is not None:
            self._source.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


_NO_ARRAY = np.zeros(0, np.uint8)


def _memory(state: LearnerState, t: int) -> dict[str, NDArray[Any]]:
    """Return the content of a keyframe as arrays, by name."""
    rng = json.dumps(dict(state.policy_rng), sort_keys=True).encode()
    return {**arrays_of(state), "t": np.array([t]), "policy_rng": np.frombuffer(rng, np.uint8)}


def _first_element(a: NDArray[Any], b: NDArray[Any]) -> tuple[tuple[int, ...], str, str] | None:
    """Return index and both values of the first element in which two arrays differ."""
    if (a.dtype, a.shape) != (b.dtype, b.shape):
        return (), f"{a.dtype} of shape {a.shape}", f"{b.dtype} of shape {b.shape}"
    if a.tobytes() == b.tobytes():
        return None
    if a.dtype.names:
        fields = (_first_element(a[name], b[name]) for name in a.dtype.names)
        return next((element for element in fields if element is not None), None)
    differ = np.argwhere(differing(a, b))
    if not len(differ):
        return None
    place = tuple(differ[0].tolist())
    return place, repr(a[place].item()), repr(b[place].item())


@dataclass(frozen=True, slots=True)
class Checked:
    """Result of computing the iterations [start, stop) of a run again.

    `difference` is the first difference from the log, `other_files` are files of the source that
    changed since the run learned from them, `asked` is the first iteration of interest.
    """

    start: int
    stop: int
    difference: Difference | None
    other_files: tuple[str, ...]
    asked: int

    @property
    def holds(self) -> bool:
        """Whether the signals are identical and the files unchanged."""
        return self.difference is None and not self.other_files

    def as_json(self) -> dict[str, Any]:
        """Return the result as JSON values."""
        difference = self.difference
        return {
            "from": self.start,
            "to": self.stop,
            "identical": difference is None,
            "first_difference": None if difference is None else difference.as_json(),
            "other_files": list(self.other_files),
        }

    def __str__(self) -> str:
        files = ", ".join(self.other_files)
        other = f"{files}: no longer what the run learned from" if files else ""
        if self.difference is None:
            span = f"iterations {self.asked} to {self.stop - 1}: learned again"
            begin = f" from iteration {self.start}" if self.start < self.asked else ""
            identical = f"{span}{begin}, they are identical, bit for bit"
            return f"{identical}; but {other}" if other else identical
        return f"{self.difference} when learned again{other and f': {other}'}"


def check_run(
    run: Path, source: Sequence[str] = (), start: int = 0, stop: int | None = None
) -> Checked:
    """Compute the iterations [start, stop) of a run again, and compare signals and keyframes.

    Learning begins at the newest keyframe at or before `start`, and ends at the end of the log if
    `stop` is None. For `run` and `source` see `Recomputation`.

    Raises:
        UsageError: the run, its source or an iteration does not exist.
        LogDamagedError: the log cannot be read.
    """
    with Recomputation(run, start, source) as recomputation:
        first = recomputation.learner.iteration
        at, difference = recomputation.compare(stop, read_keyframes(recomputation.log, first))
        changed = tuple(recomputation.other_files())
        if difference is None and 0 < at <= start:
            raise UsageError(f"{recomputation.log} has {at} iterations: FIRST must be below {at}")
    return Checked(first, at, difference, changed, start)
