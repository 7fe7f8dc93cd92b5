"""The figure of the arena: how soon, how well, and what it cost, for all sets together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from cdmisfa.studies.arena.arena import CONTESTANTS, POINTS
from cdmisfa.studies.arena.trial import SLOW_ENOUGH
from cdmisfa.studies.pages import new_figure, save_figure
from replay.palette import CYCLE

Entry = Mapping[str, Any]

DEFAULT: Final = next(iter(CONTESTANTS))
"""The learner that tables and panels of one learner show."""


def draw_figure(document: Mapping[str, Any], folder: Path) -> list[Path]:
    """Draw all results, as PNG and SVG: six panels.

    Returns:
        The files.
    """
    import matplotlib

    from replay.export.figures import STYLE

    entries = document["entries"]
    mine = [e for e in entries if e["point"]["learner"] == DEFAULT and not conditions(e)]
    compared = sorted(comparisons(entries), key=lambda one: -len(one.learners))
    free = next((one for one in compared if not one.condition), None)
    under = next((one for one in compared if one.condition), None)
    with matplotlib.rc_context(STYLE):
        figure, axes = new_figure(3, 2, 4.4, 3.3)
        curves, costly, slowness, state, told, spent = axes.ravel()
        _draw_curves(curves, free)
        _draw_curves(costly, under)
        _draw_slowness(slowness, mine)
        _draw_state(state, mine)
        _draw_blocks(told, _told(mine), "blocks until noise is told")
        _draw_blocks(spent, _spent(free), "share of blocks on what cannot be learned")
        return save_figure(figure, folder, "arena")


def conditions(entry: Entry) -> str:
    """What else was set, as `budget=20000`; "" where nothing was."""
    more = {k: v for k, v in entry["point"].items() if k not in ("set", "learner")}
    return ", ".join(f"{k}={v}" for k, v in more.items())


@dataclass(frozen=True, slots=True)
class Comparison:
    """Learners that were run on the same sets under the same condition.

    Attributes:
        condition: as `conditions` says it.
        sets: their names.
        learners: results of each, on these sets alone.
    """

    condition: str
    sets: tuple[str, ...]
    learners: Mapping[str, Sequence[Entry]]


def comparisons(entries: Sequence[Entry]) -> list[Comparison]:
    """What can be compared: for all sets that a learner was on, whoever was on all of these.

    A learner alone is one only where something else was set.
    """
    found = []
    for condition in dict.fromkeys(map(conditions, entries)):
        by: dict[str, dict[str, Entry]] = {}
        for entry in entries:
            if conditions(entry) == condition:
                by.setdefault(entry["point"]["learner"], {})[entry["point"]["set"]] = entry
        order = sorted(by, key=lambda learner: (_place(learner), learner))
        for sets in dict.fromkeys(tuple(by[learner]) for learner in order):
            learners = {
                learner: [by[learner][name] for name in sets]
                for learner in order
                if set(sets) <= set(by[learner])
            }
            if condition or len(learners) > 1:
                found.append(Comparison(condition, sets, learners))
    return found


def _place(learner: str) -> int:
    names = list(CONTESTANTS)
    return names.index(learner) if learner in names else len(names)


DASHES: Final = ("-", "--", ":", "-.")
"""Of lines, by how often their colour was there before."""


def _draw_curves(panel: Any, one: Comparison | None) -> None:
    """The share learned by frames seen, a line a learner: mean over sets."""
    if one is None:
        panel.set_axis_off()
        return
    ends = [e["curve"]["frames"][-1] for of in one.learners.values() for e in of if _curved(e)]
    at = np.geomspace(1000, max(ends, default=1e4), POINTS)
    for place, (learner, entries) in enumerate(one.learners.items()):
        curves = [entry["curve"] for entry in entries if _curved(entry)]
        found = [np.interp(at, curve["frames"], curve["mean"]) for curve in curves]
        if found:
            again, which = divmod(place, len(CYCLE))
            rgb = tuple(part / 255 for part in CYCLE[which])
            dash = DASHES[again % len(DASHES)]
            panel.plot(at, np.mean(found, axis=0), dash, color=rgb, label=learner)
    panel.set_xscale("log")
    panel.set_ylim(-0.03, 1.03)
    panel.set_xlabel(", ".join(filter(None, ("frames seen", one.condition))))
    many = len(one.sets) > 1
    panel.set_ylabel("share learned, " + (f"{len(one.sets)} sets" if many else one.sets[0]))
    if panel.get_lines():
        panel.legend(fontsize=6)


def _curved(entry: Entry) -> bool:
    return bool(entry["curve"]["frames"])


def _draw_slowness(panel: Any, entries: Sequence[Entry]) -> None:
    """Slowness of every module over batch SFA's, on frames fitted to and on those that follow."""
    modules = [module for entry in entries for module in entry["modules"]]
    for part, mark in (("fitted", "."), ("following", "x")):
        batch = [m[f"{part}_of_batch"] for m in modules if m[part] is not None]
        times = [m[part] / m[f"{part}_of_batch"] for m in modules if m[part] is not None]
        panel.plot(batch, times, mark, markersize=3, label=f"{part} frames")
    panel.axhline(SLOW_ENOUGH, color="black", linewidth=0.7, linestyle=":")
    if modules:
        panel.set_xscale("log")
    panel.set_xlabel("slowness of batch SFA")
    panel.set_ylabel("that of a module, over it")
    panel.legend(fontsize=6)


def _draw_state(panel: Any, entries: Sequence[Entry]) -> None:
    """What modules tell of the world's state, over what principal components do, by stream."""
    probes = [probe for entry in entries for probe in entry["probes"].values()]
    told = [[probe[key]["mean"] for probe in probes] for key in ("components", "modules")]
    panel.plot(*told, ".", color="0.3", markersize=5)
    panel.plot([0, 1], [0, 1], color="black", linewidth=0.7, linestyle=":")
    panel.set_xlabel("R² of the state by principal components")
    panel.set_ylabel("by as many outputs of modules")


def _told(entries: Sequence[Entry]) -> dict[str, list[float]]:
    """Blocks until each kind of noise was said to be it, of all trials."""
    found: dict[str, list[float]] = {}
    for entry in entries:
        for stream, blocks in entry["told"].items():
            found.setdefault(stream.partition("#")[0], []).extend(blocks)
    return found


def _spent(one: Comparison | None) -> dict[str, list[float]]:
    """The share of blocks in vain, of each learner on every set."""
    found = {}
    for learner, entries in one.learners.items() if one else ():
        means = [entry["measures"]["in_vain"]["mean"] for entry in entries]
        if known := [mean for mean in means if mean is not None]:
            found[learner] = known
    return found


def _draw_blocks(panel: Any, found: Mapping[str, Sequence[float]], about: str) -> None:
    """A row of points for each name, and their mean."""
    for row, values in enumerate(found.values()):
        panel.plot(values, [row] * len(values), ".", color="0.6", markersize=4)
        panel.plot(np.mean(values), row, "|", color="black", markersize=9)
    panel.set_yticks(range(len(found)), list(found), fontsize=7)
    panel.set_xlim(0, 1.05 * max((max(values) for values in found.values()), default=1) or 1)
    panel.set_ylim(max(len(found), 1) - 0.5, -0.5)
    panel.set_xlabel(about)
