"""The rules by which a module is saved, as quantities with their limits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray, IntArray
from cdmisfa.core.signals import NO_STATE, STATES
from replay.runs.run import Outline, rules_of

LIVELY = (0.5, 2.0)
"""Variance of an output that the progress learner counts as alive."""

SLOW_AGAIN, STILL_GAINING, PASSED_ON, TURNING, FULL = 0.65, 0.1, 0.03, 4.0, 4.5
"""Its further constants, `cdmisfa/agents/progress/judging.py`."""


@dataclass(frozen=True, slots=True)
class Condition:
    """A quantity that must be within limits for a module to be saved.

    Attributes:
        short: its name in a table.
        text: what it is, in words.
        limit: the condition, in words.
        values: (n,) of each iteration; NaN where there is none.
        low, high: the limits; None where there is none.
        log: it is drawn on a logarithmic axis.
        drawn: it has a plot of its own.
        symbol: what stands before the limit where that is drawn.
        counts: it decides by itself; else it only follows from the others.
        held: (n,) where it held, where that is more than its limits tell.
    """

    short: str
    text: str
    limit: str
    values: FloatArray
    low: float | None = None
    high: float | None = None
    log: bool = False
    drawn: bool = True
    symbol: str = ""
    counts: bool = True
    held: NDArray[np.bool_] | None = None

    @property
    def holds(self) -> NDArray[np.bool_]:
        """(n,) where it holds; nowhere where there is no value."""
        if self.held is not None:
            return self.held
        found = np.isfinite(self.values)
        with np.errstate(invalid="ignore"):
            if self.low is not None:
                found &= self.values >= self.low
            if self.high is not None:
                found &= self.values < self.high
        return found


def conditions_of(outline: Outline, signals: Mapping[str, NDArray[Any]]) -> tuple[Condition, ...]:
    """The rules for saving of a run's learner, as far as its log tells them.

    Of a fork they are its own, also before it parts from its parent.
    """
    header = outline.header
    if not outline.iterations:
        return ()
    rules = _of_progress(outline, signals) if header.by_progress else _of_paper(outline, signals)
    return tuple(rules)


TOLD = {
    "eta_dot": (
        "η̇",
        "how much its slowness still changes, |η̇| per frame, the largest of its outputs",
        "saved only below δ = {:g}",
    ),
    "roc_error": ("error", "clustering error of its outputs", "saved only below {:g}"),
    "share": (
        "share",
        "share of recent blocks that are new to it and of the same stream as before",
        "saved only from {:g} on: while the learner stays",
    ),
    "variance": (
        "variance",
        "recent variance of its output, the smallest of its outputs",
        "saved only from {:g} on: below, it is dead",
    ),
}
"""Of the signals by which the paper's learners save: name in a table, what it is, the rule."""


def _of_paper(outline: Outline, signals: Mapping[str, NDArray[Any]]) -> list[Condition]:
    header, found = outline.header, list[Condition]()
    for rule in rules_of(header):
        short, text, limit = TOLD[rule.signal]
        values = signals.get(rule.signal, outline.lines.get(rule.signal, np.empty(0)))
        values = np.abs(values.reshape(outline.iterations, -1)).max(axis=1)
        change, below = rule.signal == "eta_dot", rule.side == "below"
        found.append(
            Condition(
                short,
                text,
                limit.format(rule.threshold),
                values,
                low=None if below else rule.threshold,
                high=rule.threshold if below else None,
                log=change,
                symbol="δ = " if change else "",
            )
        )
    if (window := header.number("eta_dot_window")) is not None:
        # Where the block itself is novel: only then is a module saved.
        blocks = np.where(signals["novel"].astype(bool), signals["novel_blocks"], np.nan)
        text, limit = (
            "new blocks that it has learned from",
            f"saved only after more than {window:g}",
        )
        found.append(Condition("novel blocks", text, limit, blocks, low=window + 1, drawn=False))
    return found


def _of_progress(outline: Outline, signals: Mapping[str, NDArray[Any]]) -> list[Condition]:
    header, lines = outline.header, outline.lines
    change, _ = header.settled or (None, None)
    agreement, frames = header.number("agreement"), header.number("test_frames")
    slow = header.number("slow")
    with np.errstate(divide="ignore", invalid="ignore"):
        apart = np.abs(np.log(lines["tested"] / lines["fitted"]))
        gain, flatness = (lines[name] / lines["typical"] for name in ("tested", "fitted"))
    untested = ~np.isfinite(lines["tested"])
    window = None if frames is None else max(frames / max(outline.tau, 1), 1.0)
    tests, regret, settled = signals["novel_blocks"] - 1.0, lines["regret"], None
    if change is not None and window is not None:
        windows = tests / window
        with np.errstate(invalid="ignore"):
            firm = lines["change"] < change * np.clip(windows / FULL, 0.0, 1.0) ** 2
            idle = (np.abs(regret) < PASSED_ON) & (lines["change"] < TURNING * change)
        settled = ~untested & (firm | (idle & (windows >= FULL)))
    return [
        Condition(
            "error", "learning error e of the stream that is watched: change plus disagreement",
            "" if header.settled is None else f"learned below {header.settled[1]:g}, or sooner",
            np.where(untested, np.nan, lines["learning_error"]),
            high=None if header.settled is None else header.settled[1], log=True, counts=False,
        ),
        Condition(
            "change", "change c of its slowest output with a block",
            "" if change is None else f"learned below {change:g}, after few tests below less, and "
            f"below {TURNING * change:g} where nothing is gained",
            np.where(untested, np.nan, lines["change"]), high=change, log=True, held=settled,
        ),
        Condition(
            "agreement", "disagreement |ln(tested / fitted)|: slowness on new frames against old",
            "" if agreement is None else f"learned below {agreement:g}: else it fits accidents",
            np.where(untested, np.nan, apart), high=agreement,
        ),
        Condition(
            "variance", "variance of its slowest output on new frames",
            f"learned between {LIVELY[0]:g} and {LIVELY[1]:g}: it is alive, and as it was",
            signals["variance"], low=LIVELY[0], high=LIVELY[1],
        ),
        Condition(
            "slow", "slowness on new frames over that of the stream's typical direction",
            "" if slow is None else f"learned below {slow:g}: else nothing stands out",
            gain, high=slow,
        ),
        Condition(
            "slow before", "slowness on the frames it learned from over the typical one",
            f"learned below {SLOW_AGAIN:g}", np.where(untested, np.nan, flatness), high=SLOW_AGAIN,
            drawn=False,
        ),
        Condition(
            "regret", "regret: what it has gained of late, as log of its slowness some time ago",
            f"learned up to {STILL_GAINING:g}, or before there is any: else it still gains",
            regret, high=STILL_GAINING, held=~(regret > STILL_GAINING),
        ),
        Condition(
            "tests", "blocks that it was tested on since it was begun",
            "" if window is None else f"learned from {window:g} on: a whole window of tests",
            tests, low=window, drawn=False,
        ),
    ]  # fmt: skip


@dataclass(frozen=True, slots=True)
class Attempt:
    """Blocks in which one thing was learned, and how the rules stood in them.

    Attributes:
        name: the module, or of the progress learner the stream.
        blocks: how many.
        shares: of the blocks, in which each rule held.
        together: blocks in which all held.
        came: what came of it, in words.
        saved: it became a module.
    """

    name: str
    blocks: int
    shares: tuple[float, ...]
    together: int
    came: str
    saved: bool


def deciding(rules: tuple[Condition, ...]) -> tuple[Condition, ...]:
    """Those that decide, as far as there are values of them."""
    return tuple(r for r in rules if r.counts and np.isfinite(r.values).any())


def attempts(
    outline: Outline, signals: Mapping[str, NDArray[Any]], rules: tuple[Condition, ...]
) -> list[Attempt]:
    """What was learned, saved or not, and how the rules stood while it was."""
    rules = deciding(rules)
    if not rules:
        return []
    streams, names = outline.blocks.streams, outline.names()
    groups: list[tuple[str, NDArray[np.bool_], Any, int]] = []
    if outline.header.by_progress:
        of_stream = {save.stream: save for save in outline.saved}
        for s in outline.streams(len(names)):
            save = of_stream.get(s)
            own = streams == s
            if save is not None:
                own &= outline.blocks.iterations <= save.iteration
            groups.append((names[s], own, save, outline.states[s]))
    else:
        of_module = {save.module: save for save in outline.saved}
        for number in np.unique(signals["module"]).tolist():
            save = of_module.get(number)
            groups.append((f"module {number}", signals["module"] == number, save, NO_STATE))
    every = np.all([rule.holds for rule in rules], axis=0)
    return [
        Attempt(
            name,
            int(own.sum()),
            tuple(float(rule.holds[own].mean()) for rule in rules),
            int(every[own].sum()),
            _came(save, names, state),
            save is not None,
        )
        for name, own, save, state in groups
        if own.any()
    ]


def _came(save: Any, names: tuple[str, ...], state: int) -> str:
    if save is None:
        word = STATES[state].replace("_", " ") if state > 0 else ""
        return f"no module: {word}" if word else "no module"
    return f"module {save.module} on {names[save.stream]}, iteration {save.iteration:,}"


def saved_rows(outline: Outline) -> IntArray:
    """Rows of the iterations at whose end a module was saved."""
    iterations = [save.iteration for save in outline.saved]
    return np.searchsorted(outline.blocks.iterations, iterations)
