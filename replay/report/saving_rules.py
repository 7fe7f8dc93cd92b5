"""The rules by which a learner saves a module, measured in every iteration of a run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.signals import SIGNALS, STATE_WORDS
from replay.runs.run import Outline, Save, rules_of

# The progress learner's constants: replay must not import `cdmisfa/agents/progress/decisions.py`,
# where they are explained; a test compares them.
VARIANCE_BOUNDS = (0.5, 2.0)
(
    IMPROVEMENT_ONGOING,
    IMPROVEMENT_NEGLIGIBLE,
    ROTATING_CHANGE,
    FITTED_RATIO_SLOW,
    SETTLING_WINDOWS,
) = 0.1, 0.03, 4.0, 0.65, 4.5


@dataclass(frozen=True, slots=True)
class Measurement:
    """A measurement that must lie within limits for a module to be saved.

    Attributes:
        name: column head in a table.
        about: description.
        values: (n,) of each iteration; NaN where there is none.
        low, high: the limits; None where there is none.
        log: draw it on a logarithmic axis.
        exact: (n,) where the rule holds, if it depends on more than the limits.
    """

    name: str
    about: str
    values: FloatArray
    low: float | None = None
    high: float | None = None
    log: bool = False
    exact: NDArray[np.bool_] | None = None

    @property
    def holds(self) -> NDArray[np.bool_]:
        """(n,) where the rule holds; false where there is no value."""
        if self.exact is not None:
            return self.exact
        low = -np.inf if self.low is None else self.low
        high = np.inf if self.high is None else self.high
        with np.errstate(invalid="ignore"):
            return (self.values >= low) & (self.values < high) & np.isfinite(self.values)

    @property
    def decides(self) -> bool:
        """Whether the rule has a limit; a measurement without limits is only drawn."""
        return self.low is not None or self.high is not None


def measurements_of(outline: Outline) -> list[Measurement]:
    """Return the rules of a run's learner that its log has values of.

    A fork's rules have its own limits, also in the iterations that it shares with its parent.
    """
    if not outline.iterations:
        return []
    rules = _progress_rules(outline) if outline.header.by_progress else _paper_rules(outline)
    return [rule for rule in rules if np.isfinite(rule.values).any()]


def _paper_rules(outline: Outline) -> list[Measurement]:
    header, lines, rules = outline.header, outline.lines, list[Measurement]()
    for rule in rules_of(header):
        values = np.abs(lines[rule.signal].reshape(outline.iterations, -1))
        below = rule.side == "below"
        worst = values.max(axis=1) if below else values.min(axis=1)
        low, high = (None, rule.threshold) if below else (rule.threshold, None)
        about, log = SIGNALS[rule.signal].about.rstrip("."), rule.signal == "eta_dot"
        rules.append(Measurement(rule.symbol, about, worst, low, high, log))
    if (window := header.number("eta_dot_window")) is not None:
        # A module is saved only at the end of a novel block.
        blocks = np.where(lines["novel"] == 1, lines["novel_blocks"], np.nan)
        about = SIGNALS["novel_blocks"].about.rstrip(".")
        rules.append(Measurement("novel blocks", about, blocks, low=window + 1))
    return rules


def _progress_rules(outline: Outline) -> list[Measurement]:
    header, lines = outline.header, outline.lines
    tested, fitted, typical = lines["tested"], lines["fitted"], lines["typical"]
    change, regret, tests = lines["change"], lines["regret"], lines["novel_blocks"] - 1
    frames, settled = header.number("test_frames"), header.number("settled")
    window = None if frames is None else max(frames / max(outline.tau, 1), 1.0)
    was_tested = np.isfinite(tested)
    exact = {"improvement": was_tested & ~(regret > IMPROVEMENT_ONGOING)}
    with np.errstate(divide="ignore", invalid="ignore"):
        disagreement = np.abs(np.log(tested / fitted))
        gain, flatness = tested / typical, fitted / typical
        if settled is not None and window is not None:
            # As `is_learned` in decisions.py: the threshold grows with the windows of tests.
            windows = tests / window
            firm = change < settled * np.clip(windows / SETTLING_WINDOWS, 0.0, 1.0) ** 2
            turning = (windows >= SETTLING_WINDOWS) & (change < ROTATING_CHANGE * settled)
            turning &= np.abs(regret) < IMPROVEMENT_NEGLIGIBLE
            exact["change"] = was_tested & (firm | turning)
    variance = lines["variance"].reshape(outline.iterations, -1)[:, 0]
    rows: list[tuple[str, str, NDArray[Any], float | None, float | None]] = [
        ("error", "Learning error: change + disagreement", lines["learning_error"], None, None),
        ("change", "Change of the outputs by one block; the limit is lower after few tests, and "
         "higher without recent improvement", change, None, settled),
        ("disagreement", "Disagreement |ln(slowness on new frames / slowness on training frames)|",
         disagreement, None, header.number("agreement")),
        ("variance", "Variance of output 1 on new frames (1 on training frames)",
         variance, *VARIANCE_BOUNDS),
        ("slow on new frames", "Slowness on new frames / typical slowness of the stream",
         gain, None, header.number("slow")),
        ("slow on training frames", "Slowness on training frames / typical slowness of the stream",
         flatness, None, FITTED_RATIO_SLOW),
        ("improvement", "Improvement: ln(slowness of an earlier candidate / slowness now)",
         regret, None, IMPROVEMENT_ONGOING),
        ("tests", "Number of tested blocks", tests, window, None),
    ]  # fmt: skip
    rules = []
    for name, about, values, low, high in rows:
        values, log = np.where(was_tested, values, np.nan), name in ("error", "change")
        rules.append(Measurement(name, about, values, low, high, log, exact.get(name)))
    return rules


@dataclass(frozen=True, slots=True)
class Attempt:
    """Blocks in which a module was learned, or a stream by the progress learner.

    Attributes:
        name: the module or the stream.
        blocks: number of them.
        shares: share of the blocks in which each rule held.
        together: number of blocks in which all rules held.
        save: save of the module, or None.
        state: state of a stream without a module, or "".
    """

    name: str
    blocks: int
    shares: tuple[float, ...]
    together: int
    save: Save | None
    state: str


def attempts(outline: Outline, rules: list[Measurement]) -> list[Attempt]:
    """Return how often the rules that decide held for every module, saved or not."""
    deciding = [rule for rule in rules if rule.decides]
    if not deciding:
        return []
    groups: list[tuple[str, Any, Save | None, int]] = []
    if outline.header.by_progress:
        saves = {save.stream: save for save in outline.saved}
        for s in outline.streams(len(outline.states)):
            blocks = outline.blocks.streams == s
            if s in saves:
                blocks &= outline.blocks.iterations <= saves[s].iteration
            groups.append((outline.names()[s], blocks, saves.get(s), outline.states[s]))
    else:
        saves = {save.module: save for save in outline.saved}
        for module in np.unique(outline.lines["module"]).astype(int).tolist():
            blocks = outline.lines["module"] == module
            groups.append((f"module {module}", blocks, saves.get(module), -1))
    together = np.all([rule.holds for rule in deciding], axis=0)
    made = []
    for name, blocks, save, state in groups:
        if blocks.any():
            shares = tuple(float(rule.holds[blocks].mean()) for rule in deciding)
            count, held = int(blocks.sum()), int(together[blocks].sum())
            words = STATE_WORDS[state] if state > 0 else ""
            made.append(Attempt(name, count, shares, held, save, words))
    return made
