"""Comparison of runs: the first difference of two, and a table of many."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.learning import ARITHMETIC
from cdmisfa.core.signals import SIGNALS, STATES
from replay.runs.columns import SignalColumns
from replay.runs.folders import read_run_json, run_log
from replay.runs.log import read_columns, read_header
from replay.runs.run import Outline, known_to_both, read_outline, stated_source

FEW_VALUES = 4
"""Of a signal that is written out."""

LONGEST = 60
"""Letters of a value that runs were told."""

MOST_ALONE = 5
"""Keys that are named of those which only one of two runs was told, as runs of two learners are."""


@dataclass(frozen=True, slots=True)
class Difference:
    """The first place where two runs differ.

    Attributes:
        iteration: of the record, from 0.
        signal: name of its first signal that differs, or "" where one run has ended.
        place: index of the first element that differs; () for a scalar or a shape.
        first: the value in the first run, as text; `second` that in the second one.
    """

    iteration: int
    signal: str
    place: tuple[int, ...]
    first: str
    second: str

    def __str__(self) -> str:
        if not self.signal:
            return f"iteration {self.iteration}: the first {self.first}, the second {self.second}"
        place = f"[{', '.join(map(str, self.place))}]" if self.place else ""
        where = f"iteration {self.iteration}: {self.signal}{place}"
        return f"{where} is {self.first} against {self.second}"

    def as_json(self) -> dict[str, Any]:
        """The difference as JSON values."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items()}


def first_difference(first: Path, second: Path) -> Difference | None:
    """The first difference between two runs' signals, or None where every bit is the same.

    Raises:
        UsageError: one of them is no run.
        LogDamagedError: one of them cannot be read.
    """
    return first_differing(read_columns(first), read_columns(second))


def first_differing(
    first: Iterator[SignalColumns], second: Iterator[SignalColumns], at: int = 0
) -> Difference | None:
    """The first difference among signals, from an iteration on."""
    a, b = next(first, None), next(second, None)
    while a is not None and b is not None:
        n = min(len(a), len(b))
        found = _difference(at, a.rows(0, n), b.rows(0, n))
        if found is not None:
            return found
        at += n
        a = a.rows(n, len(a)) or next(first, None)
        b = b.rows(n, len(b)) or next(second, None)
    if a is b:
        return None
    ended, more = f"ended after {at} iterations", "goes on"
    return Difference(at, "", (), ended if a is None else more, ended if b is None else more)


def _difference(iteration: int, a: SignalColumns, b: SignalColumns) -> Difference | None:
    """The first difference between as many records of each run, from an iteration on."""
    rows = {name: _row(a[name], b[name]) for name in SIGNALS}
    name = min(rows, key=rows.__getitem__)
    if rows[name] == len(a):
        return None
    at = iteration + rows[name]
    x, y = a[name][rows[name]], b[name][rows[name]]
    if x.shape != y.shape:
        return Difference(at, name, (), f"of shape {x.shape}", f"of shape {y.shape}")
    differ = differing(a[name], b[name])[rows[name]]
    place = tuple(int(i) for i in np.argwhere(differ)[0])
    return Difference(at, name, place, repr(x[place].item()), repr(y[place].item()))


def _row(x: NDArray[Any], y: NDArray[Any]) -> int:
    """The first row in which two columns differ, their length where there is none."""
    if x.shape != y.shape:
        return 0
    differ = differing(x, y)
    return int(np.argmax(differ.reshape(len(x), -1).any(axis=1))) if differ.any() else len(x)


def differing(x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.bool_]:
    """Mask of the elements of two arrays that differ in a bit; all NaN are equal."""
    width = np.dtype(f"u{x.dtype.itemsize}")
    first, second = (np.ascontiguousarray(value).view(width) for value in (x, y))
    differ: NDArray[np.bool_] = (first != second).reshape(x.shape)
    if differ.any():
        differ &= ~(np.isnan(x) & np.isnan(y))
    return differ


def computed_otherwise(first: Path, second: Path) -> tuple[str, ...]:
    """Differences of two runs in arithmetic, versions and machine, which may explain others.

    The version of their arithmetic, of packages, and the machine, as far as both say it in
    run.json: from one machine to another scenes may be rendered differently.
    """
    a, b = (read_run_json(run_log(run).parent) for run in (first, second))
    one, two = read_header(first).arithmetic, read_header(second).arithmetic
    found = [] if one == two else [f"{ARITHMETIC} {one} against {two}"]
    for before, after in ((a.get(table), b.get(table)) for table in ("versions", "platform")):
        if isinstance(before, Mapping) and isinstance(after, Mapping):
            found += [
                f"{key} {before[key]} against {after[key]}"
                for key in sorted(before.keys() & after.keys())
                if before[key] != after[key]
            ]
    return tuple(found)


def told_otherwise(first: Path, second: Path) -> tuple[tuple[str, Any, Any], ...]:
    """Differences of two runs in configuration, seed and source: key and both values."""
    logs = [run_log(run) for run in (first, second)]
    a, b = ({key: read_header(log).manifest.get(key) for key in ("config", "seed")} for log in logs)
    a["source"], b["source"] = known_to_both(*map(stated_source, logs))
    return tuple((key.removeprefix("config."), x, y) for key, x, y in differences(a, b))


def signals_of(run: Path, iteration: int) -> Mapping[str, NDArray[Any]]:
    """The signals of an iteration by name; none where the run holds no such iteration."""
    for columns in read_columns(run):
        place = iteration - int(columns.iterations[0])
        if 0 <= place < len(columns):
            return {name: columns[name][place] for name in SIGNALS}
    return {}


def differing_signals(
    first: Mapping[str, NDArray[Any]], second: Mapping[str, NDArray[Any]]
) -> tuple[tuple[str, str, str], ...]:
    """The signals of an iteration that two runs differ in, as words: name and both values."""
    rows = []
    for name in (name for name in SIGNALS if name in first and name in second):
        x, y = (np.asarray(signals[name])[None] for signals in (first, second))
        if x.shape != y.shape or differing(x, y).any():
            rows.append((name, _words(x[0]), _words(y[0])))
    return tuple(rows)


def _words(value: NDArray[Any]) -> str:
    if value.size > FEW_VALUES:
        return f"{'x'.join(map(str, value.shape))}, {value.flat[0]!s} ..."
    return " ".join(map(str, value.ravel().tolist())) or "-"


ITERATIONS = "iterations"
"""How many there were in all, beside what became of each stream."""


def outcome(outline: Outline, *, timed: bool = False) -> dict[str, str]:
    """What became of each stream of a run, in words, by its name.

    Args:
        outline: the run in short.
        timed: with the iterations of modules, and how many there were in all.
    """
    found = {}
    for s, name in enumerate(outline.names()):
        modules = [
            f"module {save.module}" + (f" at {save.iteration}" if timed else "")
            for save in outline.saved
            if save.stream == s
        ]
        state = outline.states[s]
        without = "no module" if state < 0 else STATES[state].replace("_", " ")
        found[name] = ", ".join(modules) or without
    return {**found, ITERATIONS: str(outline.iterations)} if timed else found


def differing_outcomes(first: Outline, second: Outline) -> tuple[tuple[str, str, str], ...]:
    """Streams of which two runs came to something else, or at another time, and both in words."""
    a, b = (outcome(outline, timed=True) for outline in (first, second))
    return tuple(
        (name, a.get(name, "-"), b.get(name, "-"))
        for name in sorted({**a, **b}, key=ITERATIONS.__eq__)  # iterations last
        if a.get(name) != b.get(name)
    )


def verdict(first: Outline, second: Outline) -> str:
    """Whether two runs came to the same, in a sentence."""
    if outcome(first) != outcome(second):
        return "what was learned differs"
    if differing_outcomes(first, second):
        return "the same was learned, at other iterations"
    return "the same was learned, at the same iterations"


@dataclass(frozen=True, slots=True)
class Row:
    """A run in a table of runs, and where its signals first differ from the first run's.

    Attributes:
        difference: from the first run, None where there is none.
        verdict: whether it came to the same as the first one, see `verdict`; "" of that.
        otherwise: what explains it, see `computed_otherwise`.
        told: what it was told otherwise, see `told_otherwise`.
    """

    name: str
    outline: Outline
    difference: Difference | None
    verdict: str = ""
    otherwise: tuple[str, ...] = ()
    told: tuple[tuple[str, Any, Any], ...] = ()

    def as_json(self) -> dict[str, Any]:
        """The row as JSON values."""
        streams = self.outline.names()
        return {
            "run": self.name,
            "seed": self.outline.header.manifest.get("seed"),
            "iterations": self.outline.iterations,
            "modules": [streams[saved.stream] for saved in self.outline.saved],
            "outcome": outcome(self.outline),
            "verdict": self.verdict,
            "first_difference": None if self.difference is None else self.difference.as_json(),
            "told_otherwise": [{"key": k, "first": a, "second": b} for k, a, b in self.told],
            "computed_otherwise": list(self.otherwise),
        }

    def cells(self) -> tuple[str, ...]:
        """The row as words, in the order of `HEAD`."""
        found = self.as_json()
        found_in = f"{self.verdict}; {self.difference}" if self.difference else self.verdict
        learned = ", ".join(found["modules"]) or "none"
        return self.name, str(found["seed"]), str(found["iterations"]), learned, found_in or "-"

    def explanation(self) -> str:
        """Explanation of its difference in words; "" where nothing known explains it."""
        found = []
        if self.told:
            both = [(key, a, b) for key, a, b in self.told if a is not None and b is not None]
            what = [f"{key} {_short(a)} against {_short(b)}" for key, a, b in both]
            if alone := [key for key, a, b in self.told if a is None or b is None]:
                more = f" and {len(alone) - MOST_ALONE} more" if len(alone) > MOST_ALONE else ""
                named = ", ".join(alone[:MOST_ALONE])
                what.append(f"only one of them says {named}{more}")
            found.append(f"{self.name} was told otherwise: {'; '.join(what)}")
        if self.otherwise:
            why = "; ".join(self.otherwise)
            found.append(f"{self.name} was computed otherwise, which may be why: {why}")
        return "\n".join(found)


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 3]}..."


IDENTICAL = "identical, bit for bit"

HEAD = ("run", "seed", "iterations", "modules", "against the first run")


def side_by_side(runs: Sequence[Path]) -> tuple[Row, ...]:
    """Outline of each run, and its `first_difference` from the first one."""
    rows: list[Row] = []
    for run, name in zip(runs, told_apart(runs), strict=True):
        outline = read_outline(run)
        if not rows:
            rows.append(Row(name, outline, None))
        elif (found := first_difference(runs[0], run)) is None:
            rows.append(Row(name, outline, None, IDENTICAL))
        else:
            same, told = verdict(rows[0].outline, outline), told_otherwise(runs[0], run)
            because = computed_otherwise(runs[0], run)
            rows.append(Row(name, outline, found, same, because, told))
    return tuple(rows)


def told_apart(runs: Sequence[Path]) -> list[str]:
    """Names of runs: those of their folders, with the folders around where others have the same."""
    folders = [run_log(run).resolve().parent.parts for run in runs]
    names = []
    for folder in folders:
        others = [other for other in folders if other != folder]
        few = 1
        while any(other[-few:] == folder[-few:] for other in others):
            few += 1
        names.append("/".join(folder[-few:]))
    return names


def differences(before: Any, now: Any, key: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Where two JSON values differ: dotted key, the value before, the value now."""
    if isinstance(before, Mapping) and isinstance(now, Mapping):
        for name in sorted({*before, *now}):
            where = f"{key}.{name}" if key else name
            yield from differences(before.get(name), now.get(name), where)
    elif before != now:
        yield key, before, now
