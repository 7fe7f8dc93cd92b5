"""Whether a run is what it says: learned again from its source, and compared bit for bit.

A run of a version that computed with another arithmetic is compared up to rounding.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.errors import LogDamagedError, LogExhaustedError, NotReproducedError, UsageError
from cdmisfa.core.learning import Keyframe, Learner, arithmetic_of
from cdmisfa.core.signals import BlockSignals
from cdmisfa.experiments.recompute.again import Again
from replay.runs.columns import SignalColumns, columns_of_records
from replay.runs.compare import Difference, differing, first_differing
from replay.runs.keyframes import arrays_of, read_keyframes
from replay.runs.log import read_columns

ROUNDING = 1e-6
"""Share of a signal's largest number up to which another arithmetic explains a difference."""


@dataclass(frozen=True, slots=True)
class Checked:
    """What came of learning the iterations [start, stop) of a run again.

    Attributes:
        difference: the first one, of the log from what was learned again.
        arithmetic: version of the log's, and of what was learned again; where they differ, all is
            compared up to rounding.
        other_files: names of files that are not those the run learned from.
    """

    start: int
    stop: int
    difference: Difference | None
    arithmetic: tuple[int, int] = (1, 1)
    other_files: tuple[str, ...] = ()

    @property
    def same_arithmetic(self) -> bool:
        """Whether bits can be compared."""
        then, now = self.arithmetic
        return then == now

    @property
    def holds(self) -> bool:
        """Whether the run is what it says: the same signals, of the same files."""
        return self.difference is None and not self.other_files

    def as_json(self) -> dict[str, Any]:
        """The same as JSON values."""
        found = self.difference
        return {
            "from": self.start,
            "to": self.stop,
            "identical": found is None and self.same_arithmetic,
            "same_up_to_rounding": found is None,
            "first_difference": None if found is None else found.as_json(),
            "arithmetic": list(self.arithmetic),
            "other_files": list(self.other_files),
        }

    def __str__(self) -> str:
        """What came of it, in words."""
        files = ", ".join(self.other_files)
        other = f"{files}: no longer what the run learned from" if files else ""
        if self.difference is None:
            what = f"iterations {self.start} to {self.stop - 1}"
            how = "identical, bit for bit" if self.same_arithmetic else "the same up to rounding"
            same = f"{what}: learned again, they are {how}"
            if not self.same_arithmetic:
                same += f" ({_otherwise(*self.arithmetic)})"
            return f"{same}; but {other}" if other else same
        why = other or ("" if self.same_arithmetic else _otherwise(*self.arithmetic))
        return f"{self.difference} when learned again{why and f': {why}'}"


def _otherwise(then: int, now: int) -> str:
    return f"the run was learned with arithmetic {then}, this version computes with {now}"


def check_run(
    run: Path, source: Sequence[str] = (), start: int = 0, stop: int | None = None
) -> Checked:
    """Learn the iterations [start, stop) of a run again, and compare every signal and keyframe.

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
        raise UsageError(
            f"from {start} to {stop} there is nothing to check: --from comes before --to"
        )
    with Again(Path(run), start, source) as again:
        first = again.learner.iteration
        versions = again.header.arithmetic, arithmetic_of(again.learner)
        rounding = 0.0 if versions[0] == versions[1] else ROUNDING
        at, found = _learned_again(again, stop, read_keyframes(again.log, first), rounding)
        others = tuple(again.other_files())
    if found is not None:
        return Checked(first, at, found, versions, others)
    if at <= start and (at or stop):
        raise UsageError(f"{again.log} holds {at} iterations: choose a part of these")
    if stop is not None and at < stop:
        raise UsageError(f"{again.log} holds {at} iterations: end at one of these")
    return Checked(first, at, None, versions, others)


def learner_after(run: Path, iterations: int, source: Sequence[str] = ()) -> tuple[Learner, int]:
    """A run's learner as it was after so many iterations, and the next frame of its source.

    What it learns again to get there is compared with the log.

    Raises:
        UsageError: there is no such run or iteration, or the source that is needed.
        LogDamagedError: the log cannot be read.
        NotReproducedError: learning again gives other signals than the log holds.
    """
    if iterations < 0:
        raise UsageError(f"{iterations} iterations: a run begins after 0")
    with Again(Path(run), iterations, source) as again:
        at, found = _learned_again(again, iterations)
        if found is not None:
            then, now = again.header.arithmetic, arithmetic_of(again.learner)
            why = "name its own source with --source"
            if then != now:
                why = f"{_otherwise(then, now)}: only states at its keyframes are exact"
            raise NotReproducedError(f"{again.log}: learned again, {found}: {why}")
        if at < iterations:
            raise UsageError(f"{again.log} holds {at} iterations: name one of 0 to {at}")
        return again.learner, again.t


def _learned_again(
    again: Again,
    stop: int | None,
    keyframes: Iterable[Keyframe] = (),
    rounding: float = 0.0,
) -> tuple[int, Difference | None]:
    """Learn up to an iteration, or to the log's end: how far, and the log's first difference.

    Args:
        again: learns.
        stop: the iteration.
        keyframes: that are compared, too.
        rounding: see `first_differing`.
    """
    left = iter(keyframes)
    at, kept = again.learner.iteration, next(left, None)
    for logged in _logged(again, stop):
        records: list[BlockSignals] = []
        other: Difference | None = None
        with contextlib.suppress(LogExhaustedError):
            for signals in again.steps(len(logged)):
                records.append(signals)
                if kept is not None and kept.iteration == again.learner.iteration:
                    other = other or _moved(kept, again, rounding)
                    kept = next(left, None)
        learned = columns_of_records(records)
        found = first_differing(iter([logged]), learned, again.header.schema, at, rounding)
        at += len(logged)
        both = [one for one in (found, other) if one is not None]
        if both:
            return at, min(both, key=lambda one: one.iteration)
    return at, None


def _moved(keyframe: Keyframe, again: Again, rounding: float) -> Difference | None:
    """Where a keyframe differs from the learner that stands there."""
    last, state = keyframe.iteration - 1, again.learner.state
    kept, own = arrays_of(keyframe.state), arrays_of(state)
    if kept.keys() != own.keys():
        return Difference(last, "keyframe", (), ", ".join(kept), ", ".join(own))
    for name, array in kept.items():
        if (found := _first(array, own[name], rounding)) is not None:
            return Difference(last, f"keyframe {name}", *found)
    plain = {
        "t": (keyframe.t, again.t),
        "policy_rng": (dict(keyframe.state.policy_rng), dict(state.policy_rng)),
    }
    for name, (one, two) in plain.items():
        if one != two:
            return Difference(last, f"keyframe {name}", (), repr(one), repr(two))
    return None


def _first(
    a: NDArray[Any], b: NDArray[Any], rounding: float
) -> tuple[tuple[int, ...], str, str] | None:
    """Place and values of the first element in which two arrays differ."""
    if (a.dtype, a.shape) != (b.dtype, b.shape):
        return (), f"{a.dtype} of shape {a.shape}", f"{b.dtype} of shape {b.shape}"
    if a.tobytes() == b.tobytes():
        return None
    if rounding and a.dtype.names:
        fields = (_first(a[name], b[name], rounding) for name in a.dtype.names)
        return next((found for found in fields if found is not None), None)
    if rounding and a.dtype.kind == "f":
        differ = differing(a, b, rounding).reshape(-1).tolist()
    else:
        pairs = zip(a.reshape(-1), b.reshape(-1), strict=True)
        differ = [x.tobytes() != y.tobytes() for x, y in pairs]
    if True not in differ:
        return None
    i = differ.index(True)
    place = tuple(int(n) for n in np.unravel_index(i, a.shape))
    return place, repr(a.reshape(-1)[i].item()), repr(b.reshape(-1)[i].item())


def _logged(again: Again, stop: int | None) -> Iterator[SignalColumns]:
    """The records of a run from where its learner stands, up to an iteration."""
    at = again.learner.iteration
    if at == stop:
        return
    for columns in read_columns(again.log, again.header, start=again.t):
        kept = len(columns) if stop is None else min(len(columns), stop - at)
        if kept <= 0:
            return
        if int(columns.iterations[0]) != at:
            raise LogDamagedError(f"{again.log}: iteration {at} is missing, see cdmisfa verify")
        yield columns.rows(0, kept)
        at += kept
