"""The results of the arena as a table, a figure and a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from cdmisfa.experiments.documents import markdown
from cdmisfa.studies.arena.arena import CONTESTANTS
from cdmisfa.studies.arena.pictures import LEARNED_FROM
from cdmisfa.studies.arena.streams import HELD_OUT, SETS
from cdmisfa.studies.arena.trial import KNOWS, SLOW_ENOUGH, SLOW_ENOUGH_LOOPED, THE_SAME
from cdmisfa.studies.pages import Page, draw_band, new_figure, save_figure
from replay.palette import CYCLE

COLUMNS: Final = 4
"""Panels beside each other."""

HEAD: Final = (
    "learner", "seeds", "learned", "modules", "not learnable", "twice", "ends", "blocks",
    "all learned", "R²",
)  # fmt: skip

HEAD_TOGETHER: Final = (
    "learner", "sets learned whole by every seed", "learned", "not learnable", "twice", "ends",
    "R²", "R² of components",
)  # fmt: skip

HEAD_TOLD: Final = ("learner", "stream", "outputs", "R²", "of components")

HEAD_CHANGED: Final = ("learner", "after the change shows", "learned", "blocks of watching it")

Entry = Mapping[str, Any]
Sets = Mapping[str, Sequence[Entry]]


def arena_table(document: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Head and rows of all results, for a terminal."""
    return ["set", *HEAD], [[_set(e), *_cells(e)] for e in document["entries"]]


def _learner(entry: Entry) -> str:
    return str(entry["point"]["learner"])


def _set(entry: Entry) -> str:
    more = {k: v for k, v in entry["point"].items() if k not in ("set", "learner")}
    return " ".join([entry["point"]["set"], *(f"{k}={v}" for k, v in more.items())])


def _cells(entry: Entry) -> list[str]:
    m = entry["measures"]
    failed = f" ({len(entry['failed'])} failed)" if entry["failed"] else ""
    tells = f"{_number(m['probe'], 2)} ({_number(m['probe_components'], 2)})"
    digits = {"modules": 1, "wrong": 1, "doubles": 1, "ended": 2, "blocks": 0, "blocks_learned": 0}
    return [
        _learner(entry),
        f"{len(entry['seeds'])}{failed}",
        _interval(m["learned"], 2, highest=1.0),
        *(_interval(m[name], n) for name, n in digits.items()),
        tells if m["probe"]["n"] else "-",
    ]


def _number(measure: Mapping[str, Any], digits: int) -> str:
    return "-" if measure["mean"] is None else f"{measure['mean']:.{digits}f}"


def _interval(measure: Mapping[str, Any], digits: int, highest: float = np.inf) -> str:
    """A mean with its interval, as far as that is within what can be."""
    low, high = measure["low"], measure["high"]
    if not measure["n"] or low is None or high is None or low == high:
        return _number(measure, digits)
    low, high = max(low, 0.0), min(high, highest)
    return f"{_number(measure, digits)} [{low:.{digits}f}, {high:.{digits}f}]"


def draw_curves(document: Mapping[str, Any], folder: Path) -> list[Path]:
    """The figure, as PNG and SVG: share learned by frames seen, a panel for each set."""
    import matplotlib

    from replay.export.figures import STYLE

    sets = _by_set(document)
    rows, columns = -(-len(sets) // COLUMNS), min(COLUMNS, len(sets))
    with matplotlib.rc_context(STYLE):
        size = 2.4 + 0.6 / columns, 1.8 + 0.8 / rows
        figure, axes = new_figure(rows, columns, *size, sharey=True)
        for panel in axes.ravel()[len(sets) :]:
            panel.set_visible(False)
        for panel, (name, entries) in zip(axes.ravel(), sets.items(), strict=False):
            _draw_set(panel, name, entries)
        figure.supxlabel("frames seen")
        figure.supylabel("share of learnable streams learned")
        lines = {line.get_label(): line for panel in axes.ravel() for line in panel.get_lines()}
        shown = [name for name in _learners(document) if name in lines]
        handles = [lines[name] for name in shown]
        figure.legend(handles, shown, loc="outside upper center", ncols=9)
        return save_figure(figure, folder, "arena")


def _draw_set(panel: Any, name: str, entries: Sequence[Entry]) -> None:
    entries = [entry for entry in entries if entry["curve"]["frames"]]
    last = max((entry["curve"]["frames"][-1] for entry in entries), default=1)
    for entry in entries:
        curve, learner = entry["curve"], _learner(entry)
        place = list(CONTESTANTS).index(learner)
        rgb = tuple(part / 255 for part in CYCLE[(place - 1) % len(CYCLE)]) if place else "black"
        at = [*curve["frames"], last]
        mean, sd = (np.array([*curve[key], curve[key][-1]]) for key in ("mean", "sd"))
        draw_band(panel, at, mean, sd, rgb, limits=(0, 1), alpha=0.12)
        dash = "-" if place <= len(CYCLE) else "--"
        panel.plot(at, mean, dash, color=rgb, label=learner, linewidth=1.0 if place else 1.6)
    panel.set_xscale("log")
    panel.set_ylim(-0.03, 1.03)
    panel.minorticks_off()
    panel.set_title(name.replace(" ", "\n"), loc="left")


def _learners(document: Mapping[str, Any]) -> list[str]:
    """All that have results, in the order of the registry."""
    found = {_learner(entry) for entry in document["entries"]}
    return [name for name in CONTESTANTS if name in found]


def _by_set(document: Mapping[str, Any]) -> dict[str, list[Entry]]:
    sets: dict[str, list[Entry]] = {}
    for entry in document["entries"]:
        sets.setdefault(_set(entry), []).append(entry)
    return sets


def write_arena_page(document: Mapping[str, Any], figure: Path, path: Path) -> None:
    """Write a Markdown page of all results, with their figure."""
    sets = _by_set(document)
    page = Page(path)
    introduction = Path(__file__).with_name("introduction.md").read_text("utf-8")
    page.add(
        introduction.format(
            learned_from=LEARNED_FROM,
            held_out=HELD_OUT,
            slow_enough=SLOW_ENOUGH,
            slow_enough_looped=SLOW_ENOUGH_LOOPED,
            knows=KNOWS,
            the_same=THE_SAME,
        )
    )
    page.picture(figure, "Share of the learnable streams that each learner has learned, by frames")
    page.add("*Mean and standard deviation over seeds.*", "")
    if rows := _together(_learners(document), sets):
        page.add("## All sets together", "", markdown(HEAD_TOGETHER, rows), "")
    page.add("## What did not work", "")
    page.add("With how many of the seeds a stream was not learned, and modules over all seeds.", "")
    failures = [line for entry in document["entries"] for line in _failures(entry)]
    page.add(*(failures or ["Nothing."]))
    for name, entries in sets.items():
        page.add("", f"## {name}", "")
        if (entry := SETS.get(entries[0]["point"]["set"])) is not None:
            words = ", ".join(f"`{word}`" for word in _shortened(entry.words))
            page.add(f"{entry.about[0].upper()}{entry.about[1:]}: {words}.", "")
        page.add(markdown(HEAD, [_cells(e) for e in entries]))
        if told := [row for e in entries for row in _told(e)]:
            page.add("", markdown(HEAD_TOLD, told))
        if changes := [row for e in entries for row in _changes(e)]:
            page.add("", markdown(HEAD_CHANGED, changes))
    page.versions(document["versions"])
    if document["outdated"]:
        page.add(f"{document['outdated']} trials are of an earlier version of the code.", "")
    page.write()


def _together(learners: Sequence[str], sets: Sets) -> list[list[str]]:
    """Rows of the learners that were on every set: means over sets of the means over seeds."""
    rows = []
    for learner in learners:
        entries = [e for of_set in sets.values() for e in of_set if _learner(e) == learner]
        if len(entries) < len(sets) or len(sets) < 2:
            continue
        whole = sum(entry["measures"]["learned"]["mean"] == 1 for entry in entries)
        row = [learner, f"{whole} of {len(sets)}"]
        for key in ("learned", "wrong", "doubles", "ended", "probe", "probe_components"):
            means = [entry["measures"][key]["mean"] for entry in entries]
            known = [mean for mean in means if mean is not None]
            row.append(f"{sum(known) / len(known):.2f}" if known else "-")
        rows.append(row)
    return rows


def _shortened(words: Sequence[str]) -> list[str]:
    """Words, where there are many without those that are others begun elsewhere."""
    if len(words) <= 20:
        return list(words)
    first = [word for word in words if "#" not in word]
    others = list(dict.fromkeys(word.partition("#")[0] for word in words if "#" in word))
    return [*first, *(f"{word}#k" for word in others)]


def _told(entry: Entry) -> list[list[str]]:
    """Rows on what the modules of the first learner tell of the world, stream by stream."""
    if _learner(entry) != next(iter(CONTESTANTS)):
        return []
    rows = []
    for signal, tells in entry["probes"].items():
        measured = (_interval(tells[key], 2, highest=1.0) for key in ("modules", "components"))
        rows.append([_learner(entry), f"`{signal}`", _number(tells["outputs"], 1), *measured])
    return rows


def _changes(entry: Entry) -> list[list[str]]:
    """Rows on what streams show that changed."""
    rows = []
    for target in entry["targets"]:
        if target["stream"].endswith(f">{target['signal']}"):
            share = f"{target['learned']}/{target['trials']}"
            watched = _interval(target["watched"], 0)
            rows.append([_learner(entry), f"`{target['signal']}`", share, watched])
    return rows


def _failures(entry: Entry) -> list[str]:
    """A line for a learner on a set that fell short."""
    missed = [
        f"`{t['stream']}`"
        + (f" as `{t['signal']}`" if ">" in t["stream"] else "")
        + f" {t['trials'] - t['learned']}/{t['trials']}"
        for t in entry["targets"]
        if t["learned"] < t["trials"]
    ]
    said = [f"not learned {', '.join(missed)}"] if missed else []
    for name, count in entry["wrong"].items():
        said.append(f"{count} module{'s' if count > 1 else ''} of `{name}`")
    doubles, ended = entry["measures"]["doubles"], entry["measures"]["ended"]
    if doubles["mean"]:
        said.append(f"{round(doubles['mean'] * doubles['n'])} too many of what it had")
    if still := round((1 - ended["mean"]) * ended["n"]) if ended["n"] else 0:
        said.append(f"{still} of {ended['n']} runs did not end")
    said += [f"broke: {error}" for error in dict.fromkeys(entry["failed"])]
    return [f"- **{_learner(entry)}**, {_set(entry)}: {'; '.join(said)}."] if said else []
