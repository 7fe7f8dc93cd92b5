"""The results of the arena as tables and a page."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from cdmisfa.experiments.documents import markdown
from cdmisfa.studies.arena.figure import DEFAULT, Comparison, Entry, comparisons, conditions
from cdmisfa.studies.arena.pictures import FOLLOW
from cdmisfa.studies.arena.streams import REPORTED, SETS, chosen_sets
from cdmisfa.studies.arena.trial import KNOWS, SLOW_ENOUGH, SLOW_ENOUGH_LOOPED, THE_SAME
from cdmisfa.studies.pages import Page

COLUMNS: Final[Mapping[str, tuple[str, int]]] = {
    "learned": ("learned", 2),
    "fitted": ("fitted", 2),
    "wrong": ("noise learned", 1),
    "doubles": ("twice", 1),
    "one": ("one world", 2),
    "merged": ("merged", 3),
    "told": ("noise told", 0),
    "in_vain": ("in vain", 2),
    "ended": ("ends", 2),
    "blocks": ("blocks", 0),
    "blocks_learned": ("all learned", 0),
    "frames_learned": ("frames", 0),
}
"""Of the measures that a table shows, in their order: the head and digits."""

R2: Final = "R²"

OF_ALL: Final = ("seeds", *(head for head, _ in COLUMNS.values()), R2)
"""What a terminal shows of every entry; the page has two choices of it, and all of it as data."""

OF_SETS: Final = (
    "seeds", "learned", "fitted", "noise learned", "twice", "one world", "merged", "noise told",
    "blocks", R2,
)  # fmt: skip
OF_LEARNERS: Final = (
    "seeds", "learned", "noise learned", "in vain", "ends", "blocks", "all learned", "frames"
)  # fmt: skip

HEAD_CHANGED: Final = ("set", "after the change shows", "known", "learned", "blocks of watching it")


def arena_table(document: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Head and rows of all results, for a terminal."""
    rows = []
    for entry in document["entries"]:
        cells = _cells(entry)
        rows.append([_set(entry), entry["point"]["learner"], *(cells[head] for head in OF_ALL)])
    return ["set", "learner", *OF_ALL], rows


def _set(entry: Entry) -> str:
    return ", ".join(filter(None, (entry["point"]["set"], conditions(entry))))


def _cells(entry: Entry) -> dict[str, str]:
    """What a result came to, by the heads of columns."""
    m = entry["measures"]
    failed = f" ({len(entry['failed'])} failed)" if entry["failed"] else ""
    tells = f"{_number(m['probe'], 2)} ({_number(m['probe_components'], 2)})"
    found = {
        head: _interval(m[name], digits, _HIGHEST.get(name))
        for name, (head, digits) in COLUMNS.items()
    }
    seeds = f"{len(entry['seeds'])}{failed}"
    return {"seeds": seeds, **found, R2: tells if m["probe"]["n"] else "-"}


_HIGHEST: Final = dict.fromkeys(("learned", "fitted", "one", "merged", "in_vain"), 1.0)


def _number(measure: Mapping[str, Any], digits: int) -> str:
    return "-" if measure["mean"] is None else f"{measure['mean']:.{digits}f}"


def _interval(measure: Mapping[str, Any], digits: int, highest: float | None = None) -> str:
    """A mean with its interval, as far as that is within what can be."""
    low, high = measure["low"], measure["high"]
    if not measure["n"] or low is None or high is None or low == high:
        return _number(measure, digits)
    low, high = max(low, 0.0), min(high, np.inf if highest is None else highest)
    return f"{_number(measure, digits)} [{low:.{digits}f}, {high:.{digits}f}]"


def write_arena_page(document: Mapping[str, Any], figure: Path, path: Path) -> None:
    """Write a Markdown page of all results, with their figure and their data beside it."""
    page = Page(path)
    introduction = Path(__file__).with_name("introduction.md").read_text("utf-8")
    page.add(
        introduction.format(
            follow=FOLLOW,
            slow_enough=SLOW_ENOUGH,
            slow_enough_looped=SLOW_ENOUGH_LOOPED,
            knows=KNOWS,
            the_same=THE_SAME,
        )
    )
    mine = [e for e in document["entries"] if e["point"]["learner"] == DEFAULT]
    mine = [entry for entry in mine if not conditions(entry)]
    mine.sort(key=lambda entry: not entry["point"]["set"].startswith(REPORTED))
    page.add(f"## The learner `{DEFAULT}`", "")
    cells = {entry["point"]["set"]: _cells(entry) for entry in mine}
    cells |= {f"**{name}**": _means(group) for name, group in _groups(mine).items()}
    rows = [[name, *(of[head] for head in OF_SETS)] for name, of in cells.items()]
    page.add(markdown(["set", *OF_SETS], rows), "")
    if changes := [row for entry in mine for row in _changes(entry)]:
        page.add(markdown(HEAD_CHANGED, changes), "")
    page.picture(figure, "Learning by frames, slowness, state and noise told, blocks in vain")
    if compared := comparisons(document["entries"]):
        page.add("## Other learners, and other rules of attention", "")
    for one in compared:
        page.add(*_compared(one), "")
    page.add(f"## What `{DEFAULT}` did not do", "")
    page.add("With how many of the seeds a stream was not learned, and modules over all seeds.", "")
    failures = [line for entry in mine for line in _failures(entry)]
    page.add(*(failures or ["Nothing."]), "", "## The sets", "")
    for name in dict.fromkeys(entry["point"]["set"] for entry in document["entries"]):
        if (entry := SETS.get(name)) is not None:
            words = ", ".join(f"`{word}`" for word in _shortened(entry.words))
            page.add(f"- **{name}**: {entry.about}: {words}.")
    _add_data(page, figure.with_name("results.json"), path)
    page.versions(document["versions"])
    if document["outdated"]:
        page.add(f"{document['outdated']} trials are of an earlier version of the code.", "")
    page.write()


def _add_data(page: Page, results: Path, path: Path) -> None:
    """Copy the results beside a page, and name them there."""
    beside = path.with_suffix("") / results.name
    if beside.resolve() != results.resolve():
        shutil.copyfile(results, beside)
    link = f"[{results.name}]({beside.parent.name}/{results.name})"
    page.add("", f"All figures, of every learner and stream: {link}.")


def _groups(entries: Sequence[Entry]) -> dict[str, list[Entry]]:
    """Results on sets that nothing was tuned on, and on all others; those of several sets."""
    found: dict[str, list[Entry]] = {}
    for entry in entries:
        reported = entry["point"]["set"].startswith(REPORTED)
        found.setdefault("all reported" if reported else "all others", []).append(entry)
    return {name: group for name, group in found.items() if len(group) > 1}


def _means(entries: Sequence[Entry]) -> dict[str, str]:
    """Cells of several sets together: means over sets of the means over seeds."""
    seeds = sorted({len(entry["seeds"]) for entry in entries})
    found = {"seeds": str(seeds[0]) if len(seeds) == 1 else f"{seeds[0]} to {seeds[-1]}"}
    for name, (head, digits) in COLUMNS.items():
        found[head] = _mean(entries, name, digits)
    tells = f"{_mean(entries, 'probe', 2)} ({_mean(entries, 'probe_components', 2)})"
    return {**found, R2: tells}


def _mean(entries: Sequence[Entry], name: str, digits: int) -> str:
    means = [entry["measures"][name]["mean"] for entry in entries]
    known = [mean for mean in means if mean is not None]
    return f"{sum(known) / len(known):.{digits}f}" if known else "-"


def _compared(one: Comparison) -> list[str]:
    """Lines on learners that were run on the same sets."""
    sets = ", ".join(f"`{name}`" for name in one.sets)
    if set(one.sets) == set(chosen_sets(["reported"])):
        sets = "all reported sets"
    about = f"{'Means over' if len(one.sets) > 1 else 'On'} {sets}"
    rows = []
    for learner, entries in one.learners.items():
        cells = _cells(entries[0]) if len(entries) == 1 else _means(entries)
        rows.append([learner, *(cells[head] for head in OF_LEARNERS)])
    condition = f", with {one.condition}" if one.condition else ""
    return [f"{about}{condition}:", "", markdown(["learner", *OF_LEARNERS], rows)]


def _shortened(words: Sequence[str]) -> list[str]:
    """Words, where there are many without those that are others begun elsewhere."""
    if len(words) <= 20:
        return list(words)
    first = [word for word in words if "#" not in word]
    others = list(dict.fromkeys(word.partition("#")[0] for word in words if "#" in word))
    return [*first, *(f"{word}#k" for word in others)]


def _changes(entry: Entry) -> list[list[str]]:
    """Rows on what streams show that changed."""
    rows = []
    for target in entry["targets"]:
        if target["stream"].endswith(f">{target['signal']}"):
            known, of = target["known"], target["trials"]
            shares = f"{known}/{of}", f"{target['learned'] - known}/{of}"
            watched = _interval(target["watched"], 0)
            rows.append([entry["point"]["set"], f"`{target['signal']}`", *shares, watched])
    return rows


def _failures(entry: Entry) -> list[str]:
    """A line for a set on which it fell short."""
    missed = [
        f"`{t['stream']}`"
        + (f" as `{t['signal']}`" if ">" in t["stream"] else "")
        + f" {t['trials'] - t['learned']}/{t['trials']}"
        + (f" ({t['too_fast']} with a module that is too fast)" if t["too_fast"] else "")
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
    return [f"- **{_set(entry)}**: {'; '.join(said)}."] if said else []
