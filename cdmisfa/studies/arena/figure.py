"""The figure of the arena: how soon, how well, and what it cost, for all sets together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
    """Draw all results, as PNG and SVG: four panels.

    Returns:
        The files.
    """
    import matplotlib

    from replay.export.figures import STYLE

    entries = document["entries"]
    plain = [entry for entry in entries if not conditions(entry)] or entries
    mine = [entry for entry in plain if entry["point"]["learner"] == DEFAULT]
    with matplotlib.rc_context(STYLE):
        figure, axes = new_figure(2, 2, 4.4, 3.3)
        curves, slowness, told, order = axes.ravel()
        shared = _shared(plain)
        _draw_curves(curves, shared)
        _draw_slowness(slowness, mine)
        _draw_blocks(told, _told(mine), "blocks until noise is told")
        _draw_blocks(order, _spent(shared), "share of blocks on what cannot be learned")
        return save_figure(figure, folder, "arena")


def _shared(entries: Sequence[Entry]) -> list[Entry]:
    """Results on the sets that every learner was on, or all where there is no such set."""
    sets: dict[str, set[str]] = {}
    for entry in entries:
        sets.setdefault(entry["point"]["learner"], set()).add(entry["point"]["set"])
    common = set.intersection(*sets.values())
    return [entry for entry in entries if entry["point"]["set"] in common] or list(entries)


def conditions(entry: Entry) -> str:
    """What else was set, as `budget=20000`; "" where nothing was."""
    more = {k: v for k, v in entry["point"].items() if k not in ("set", "learner")}
    return ", ".join(f"{k}={v}" for k, v in more.items())


DASHES: Final = ("-", "--", ":", "-.")
"""Of lines, by how often their colour was there before."""


def _draw_curves(panel: Any, entries: Sequence[Entry]) -> None:
    """The share learned by frames seen, a line a learner: mean over the sets it was run on."""
    last = max((e["curve"]["frames"][-1] for e in entries if e["curve"]["frames"]), default=1e4)
    at = np.geomspace(1000, last, POINTS)
    learners = dict.fromkeys(entry["point"]["learner"] for entry in entries)
    for place, learner in enumerate(learners):
        curves = [e["curve"] for e in entries if e["point"]["learner"] == learner]
        found = [np.interp(at, c["frames"], c["mean"]) for c in curves if c["frames"]]
        if found:
            again, which = divmod(place, len(CYCLE))
            rgb = tuple(part / 255 for part in CYCLE[which])
            dash = DASHES[again % len(DASHES)]
            panel.plot(at, np.mean(found, axis=0), dash, color=rgb, label=learner)
    panel.set_xscale("log")
    panel.set_ylim(-0.03, 1.03)
    panel.set_xlabel("frames seen")
    panel.set_ylabel(f"share learned, {len({e['point']['set'] for e in entries})} sets")
    if panel.get_lines():
        panel.legend(fontsize=6)


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


def _told(entries: Sequence[Entry]) -> dict[str, list[float]]:
    """Blocks until each kind of noise was said to be it, of all trials."""
    found: dict[str, list[float]] = {}
    for entry in entries:
        for stream, blocks in entry["told"].items():
            found.setdefault(stream.partition("#")[0], []).extend(blocks)
    return found


def _spent(entries: Sequence[Entry]) -> dict[str, list[float]]:
    """The share of blocks in vain, of each learner on every set."""
    found: dict[str, list[float]] = {}
    for entry in entries:
        if (mean := entry["measures"]["in_vain"]["mean"]) is not None:
            found.setdefault(entry["point"]["learner"], []).append(mean)
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
