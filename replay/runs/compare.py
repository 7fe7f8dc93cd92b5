"""Comparison of runs: the first difference of two, and a table of many."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.learning import ARITHMETIC
from cdmisfa.core.signals import SIGNALS, STATE_WORDS
from replay.runs.columns import SignalColumns
from replay.runs.folders import read_run_json, run_log
from replay.runs.log import read_columns, read_header
from replay.runs.provenance import comparable, stated_source
from replay.runs.run import Outline, read_outline

# Values of an array that are printed in full; a line of the terminal holds about as many.
MAX_VALUES = 4

# Letters of a setting that are printed.
MAX_LETTERS = 60

IDENTICAL = "identical, bit for bit"

HEAD = ("run", "seed", "iterations", "modules", "compared with the first run")

# Key of the number of iterations among the outcomes of streams.
ITERATIONS = "iterations"


@dataclass(frozen=True, slots=True)
class Difference:
    """The first place where two runs differ.

    Attributes:
        iteration: number of the record, from 0.
        signal: name of its first signal that differs, or "" where one run has ended.
        place: index of the first element that differs; () for a scalar or a shape.
        first: the value in the first run, as text; `second` that in the second run.
        signals: each signal of this iteration with its value in the first and second run.
    """

    iteration: int
    signal: str
    place: tuple[int, ...]
    first: str
    second: str
    signals: Mapping[str, tuple[NDArray[Any], NDArray[Any]]] = field(
        default_factory=dict, compare=False, repr=False
    )

    def __str__(self) -> str:
        return self.text("the first run", "the other one")

    def text(self, first: str, second: str) -> str:
        """Return the place and both values as text.

        Args:
            first: name of the first run, used where one run has ended.
            second: name of the second run.
        """
        if not self.signal:
            return f"iteration {self.iteration}: {first} {self.first}, {second} {self.second}"
        place = f"[{', '.join(map(str, self.place))}]" if self.place else ""
        where = f"iteration {self.iteration}: {self.signal}{place}"
        return f"{where} differs: {self.first} and {self.second}"

    def as_json(self) -> dict[str, Any]:
        """Return the place and both values as JSON values."""
        names = "iteration", "signal", "place", "first", "second"
        return {name: getattr(self, name) for name in names}

    def differing_signals(self) -> tuple[tuple[str, str, str], ...]:
        """Return name, first and second value, as text, of the signals that differ here."""
        return tuple(
            (name, _as_text(x), _as_text(y))
            for name, (x, y) in self.signals.items()
            if x.shape != y.shape or differing(x[None], y[None]).any()
        )


def _as_text(value: NDArray[Any]) -> str:
    if value.size > MAX_VALUES:
        return f"{'x'.join(map(str, value.shape))}, {value.flat[0]!s} ..."
    return " ".join(map(str, value.ravel().tolist())) or "-"


def first_difference(first: Path, second: Path) -> Difference | None:
    """Return the first difference between two runs' signals, None if every bit is the same.

    Raises:
        UsageError: a path is not a run.
        LogDamagedError: the log of a run cannot be read.
    """
    return first_differing(read_columns(first), read_columns(second))


def first_differing(
    first: Iterator[SignalColumns], second: Iterator[SignalColumns], at: int = 0
) -> Difference | None:
    """Return the first difference between two series of records that start at iteration `at`."""
    a, b = next(first, None), next(second, None)
    while a is not None and b is not None:
        n = min(len(a), len(b))
        if (difference := _difference(at, a.rows(0, n), b.rows(0, n))) is not None:
            return difference
        at += n
        a = a.rows(n, len(a)) or next(first, None)
        b = b.rows(n, len(b)) or next(second, None)
    if a is b:
        return None
    ended, more = f"ended after {at} iterations", "continues"
    return Difference(at, "", (), ended if a is None else more, ended if b is None else more)


def _difference(at: int, a: SignalColumns, b: SignalColumns) -> Difference | None:
    """Return the first difference between two runs' records of the same iterations."""
    rows = {name: _first_differing_row(a[name], b[name]) for name in SIGNALS}
    name = min(rows, key=rows.__getitem__)
    row = rows[name]
    if row == len(a):
        return None
    signals = {signal: (a[signal][row], b[signal][row]) for signal in SIGNALS}
    x, y = signals[name]
    if x.shape != y.shape:
        values = f"of shape {x.shape}", f"of shape {y.shape}"
        return Difference(at + row, name, (), *values, signals)
    place = tuple(int(i) for i in np.argwhere(differing(x[None], y[None])[0])[0])
    values = repr(x[place].item()), repr(y[place].item())
    return Difference(at + row, name, place, *values, signals)


def _first_differing_row(x: NDArray[Any], y: NDArray[Any]) -> int:
    """Return the first row in which two columns differ, their length if there is none."""
    if x.shape[1:] != y.shape[1:]:
        return 0
    differ = differing(x, y)
    return int(np.argmax(differ.reshape(len(x), -1).any(axis=1))) if differ.any() else len(x)


def differing(x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.bool_]:
    """Return a mask of the elements of two arrays that differ in a bit; all NaN are equal."""
    width = np.dtype(f"u{x.dtype.itemsize}")
    first, second = (np.ascontiguousarray(value).view(width) for value in (x, y))
    differ: NDArray[np.bool_] = (first != second).reshape(x.shape)
    if differ.any():
        differ &= ~(np.isnan(x) & np.isnan(y))
    return differ


def different_settings(first: Path, second: Path) -> tuple[tuple[str, Any, Any], ...]:
    """Return key and both values of what differs in configuration, seed and source."""
    logs = [run_log(run) for run in (first, second)]
    a, b = ({key: read_header(log).manifest.get(key) for key in ("config", "seed")} for log in logs)
    a["source"], b["source"] = comparable(*map(stated_source, logs))
    return tuple((key.removeprefix("config."), x, y) for key, x, y in differences(a, b))


def different_versions(first: Path, second: Path) -> tuple[str, ...]:
    """Return the differences in arithmetic, package versions and machine, which may explain others.

    Only what both run.json files state is compared. From one machine to another, scenes may be
    rendered differently.
    """
    a, b = (read_run_json(run_log(run).parent) for run in (first, second))
    one, two = read_header(first).arithmetic, read_header(second).arithmetic
    lines = [] if one == two else [f"{ARITHMETIC} {one} -> {two}"]
    for x, y in ((a.get(table), b.get(table)) for table in ("versions", "platform")):
        if isinstance(x, Mapping) and isinstance(y, Mapping):
            shared = sorted(x.keys() & y.keys())
            lines += [f"{k} {x[k]} -> {y[k]}" for k in shared if x[k] != y[k]]
    return tuple(lines)


def differences(before: Any, now: Any, key: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield dotted key, value before and value now where two JSON values differ."""
    if isinstance(before, Mapping) and isinstance(now, Mapping):
        for name in sorted({*before, *now}):
            where = f"{key}.{name}" if key else name
            yield from differences(before.get(name), now.get(name), where)
    elif before != now:
        yield key, before, now


def outcome(outline: Outline, *, timed: bool = False) -> dict[str, str]:
    """Return the outcome of each stream of a run as text, by the stream's name.

    Args:
        outline: outline of the run.
        timed: add the iterations of modules, and the number of all iterations.
    """
    outcomes = {}
    for s, name in enumerate(outline.names()):
        saved = [save for save in outline.saved if save.stream == s]
        modules = [f"module {m.module}{f' at {m.iteration}' if timed else ''}" for m in saved]
        state = outline.states[s]
        without = "no module" if state < 0 else STATE_WORDS[state]
        outcomes[name] = ", ".join(modules) or without
    return {**outcomes, ITERATIONS: str(outline.iterations)} if timed else outcomes


def differing_outcomes(first: Outline, second: Outline) -> tuple[tuple[str, str, str], ...]:
    """Return the streams whose outcome or its iteration differs, with both outcomes as text."""
    a, b = (outcome(outline, timed=True) for outline in (first, second))
    return tuple(
        (name, a.get(name, "-"), b.get(name, "-"))
        for name in sorted({**a, **b}, key=ITERATIONS.__eq__)  # iterations last
        if a.get(name) != b.get(name)
    )


def verdict(first: Outline, second: Outline) -> str:
    """Return a phrase that says whether two runs learned the same."""
    if outcome(first) != outcome(second):
        return "different results"
    if differing_outcomes(first, second):
        return "same results, at other iterations"
    return "same results, at the same iterations"


@dataclass(frozen=True, slots=True)
class ComparedRun:
    """A run in a table of runs, compared with the first one.

    Attributes:
        name: short name of its folder.
        outline: outline of the run.
        difference: first difference from the first run, None where there is none.
        verdict: whether it learned the same, see `verdict`; "" for the first run.
        versions: see `different_versions`.
        settings: see `different_settings`.
    """

    name: str
    outline: Outline
    difference: Difference | None
    verdict: str = ""
    versions: tuple[str, ...] = ()
    settings: tuple[tuple[str, Any, Any], ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Return the row as JSON values."""
        streams = self.outline.names()
        return {
            "run": self.name,
            "seed": self.outline.header.manifest.get("seed"),
            "iterations": self.outline.iterations,
            "modules": [streams[saved.stream] for saved in self.outline.saved],
            "outcome": outcome(self.outline),
            "verdict": self.verdict,
            "first_difference": None if self.difference is None else self.difference.as_json(),
            "different_settings": [
                {"key": k, "first": a, "second": b} for k, a, b in self.settings
            ],
            "different_versions": list(self.versions),
        }

    def cells(self) -> tuple[str, ...]:
        """Return the row as text, in the order of `HEAD`."""
        row = self.as_json()
        result = f"{self.verdict}; {self.difference}" if self.difference else self.verdict
        modules = ", ".join(row["modules"]) or "none"
        return self.name, str(row["seed"]), str(row["iterations"]), modules, result or "-"

    def explanation(self) -> str:
        """Return the settings and versions that may explain the difference, a line each."""
        lines = []
        if self.settings:
            settings = (f"{k} {_short(a)} -> {_short(b)}" for k, a, b in self.settings)
            lines.append(f"settings changed in {self.name}: {'; '.join(settings)}")
        if self.versions:
            versions = "; ".join(self.versions)
            lines.append(f"versions changed in {self.name}, a possible reason: {versions}")
        return "\n".join(lines)


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) <= MAX_LETTERS else f"{text[: MAX_LETTERS - 3]}..."


def side_by_side(runs: Sequence[Path]) -> tuple[ComparedRun, ...]:
    """Return a row for each run, compared with the first one."""
    rows: list[ComparedRun] = []
    for run, name in zip(runs, short_names(runs), strict=True):
        outline = read_outline(run)
        if not rows:
            rows.append(ComparedRun(name, outline, None))
            continue
        difference, settings = first_difference(runs[0], run), different_settings(runs[0], run)
        phrase = verdict(rows[0].outline, outline) if difference else IDENTICAL
        versions = different_versions(runs[0], run) if difference else ()
        if difference is None:  # a source with the same signals may be a copy or a recording
            settings = tuple(s for s in settings if not s[0].startswith("source"))
        rows.append(ComparedRun(name, outline, difference, phrase, versions, settings))
    return tuple(rows)


def short_names(runs: Sequence[Path]) -> list[str]:
    """Return the names of the runs' folders, with as many parents as make them unique."""
    folders = [run_log(run).resolve().parent.parts for run in runs]
    names = []
    for folder in folders:
        other_folders = [other for other in folders if other != folder]
        few = 1
        while any(other[-few:] == folder[-few:] for other in other_folders):
            few += 1
        names.append("/".join(folder[-few:]))
    return names
