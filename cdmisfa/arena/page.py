"""The results of the arena as a table, a figure and a page, which is made and not written."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from cdmisfa.arena.contestants import CONTESTANTS
from cdmisfa.arena.measures import (
    KNOWS,
    SLOW_ENOUGH,
    SLOW_ENOUGH_LOOPED,
    THE_SAME,
)
from cdmisfa.arena.results import write_results
from cdmisfa.arena.sets import SETS
from cdmisfa.arena.streams import HELD_OUT, LEARNED_FROM
from cdmisfa.experiments.documents import markdown
from recorder.log.files import atomic_write
from replay.export.figures import STYLE
from replay.palette import CYCLE

FIGURE: Final = "arena"

COLUMNS: Final = 4
"""Panels beside each other."""

HEAD: Final = (
    "learner", "seeds", "learned", "modules", "not learnable", "twice", "ends", "blocks",
    "all learned", "R²",
)  # fmt: skip

TOLD: Final = ("learner", "stream", "outputs", "R²", "of components")

CHANGED: Final = ("learner", "after the change shows", "learned", "blocks of watching it")

Entry = Mapping[str, Any]

DEFINITIONS: Final = f"""\
- *Learned*: the share of the learnable streams of a set of which a module was saved whose slowest
  output is, on held-out frames, at most {SLOW_ENOUGH} times as fast as that of batch SFA with as
  many components, fitted on all {LEARNED_FROM:,} frames that the stream consists of
  ({SLOW_ENOUGH_LOOPED} times for clips and recordings that loop, which are judged on themselves;
  their cut is shown to batch SFA, too). The {HELD_OUT:,} frames that follow are held out. Where no
  module was learned on a stream, one that was learned on another, and slow enough there, counts
  if it is so here and its output is that of batch SFA (correlation above {KNOWS:g}).
- *Modules*: how many a run saved; *not learnable*: how many of them on streams that have nothing
  slow. There should be none.
- *Twice*: modules a run saved on a stream that had one already and still shows the same, or on
  the same stream shown once more, if the outputs are the same (correlation above {THE_SAME:g}).
- *Ends*: the share of runs that ended by themselves; *blocks*: after how many, of those that did.
  Others are stopped when their frames are over, the same number for every learner.
- *All learned*: blocks until the last learnable stream was learned, of the runs that learned all.
- *R²*: of the world's true state (positions, angles, bytes of a game's memory), told by ridge
  regression from the modules' outputs, and in brackets from as many principal components, on the
  last quarter of the frames; only streams that a module was saved on.

Numbers are means over seeds with 95 % intervals (Student; Wilson for *ends*). Figures are of seeds
below 100; constants may be tuned on seeds from 100 on only. Seed s makes the learner's choices and
the streams."""


def table(document: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Head and rows of all results, for a terminal."""
    return ["set", *HEAD], [[_set(e), *_cells(e)] for e in document["entries"]]


def _set(entry: Entry) -> str:
    more = {k: v for k, v in entry["point"].items() if k not in ("set", "learner")}
    return " ".join([entry["point"]["set"], *(f"{k}={v}" for k, v in more.items())])


def _cells(entry: Entry) -> list[str]:
    m, trials = entry["measures"], len(entry["seeds"])
    failed = f" ({len(entry['failed'])} failed)" if entry["failed"] else ""
    tells = f"{_number(m['probe'], 2)} ({_number(m['probe_components'], 2)})"
    return [
        entry["point"]["learner"],
        f"{trials}{failed}",
        _within(m["learned"], 2, highest=1.0),
        _within(m["modules"], 1),
        _within(m["wrong"], 1),
        _within(m["doubles"], 1),
        _within(m["ended"], 2),
        _within(m["blocks"], 0),
        _within(m["blocks_learned"], 0),
        tells if m["probe"]["n"] else "-",
    ]


def _number(measure: Mapping[str, Any], digits: int) -> str:
    return "-" if measure["mean"] is None else f"{measure['mean']:.{digits}f}"


def _within(measure: Mapping[str, Any], digits: int, highest: float | None = None) -> str:
    """A mean with its interval, as far as that is within what can be."""
    low, high = measure["low"], measure["high"]
    if not measure["n"] or low is None or high is None or low == high:
        return _number(measure, digits)
    low, high = max(low, 0.0), high if highest is None else min(high, highest)
    return f"{_number(measure, digits)} [{low:.{digits}f}, {high:.{digits}f}]"


def draw(document: Mapping[str, Any], folder: Path) -> list[Path]:
    """The figure, as PNG and SVG: share learned by frames seen, a panel for each set."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    sets = _by_set(document)
    learners = _learners(document)
    rows = -(-len(sets) // COLUMNS)
    columns = min(COLUMNS, len(sets))
    paths = [folder / f"{FIGURE}{ending}" for ending in (".png", ".svg")]
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(2.4 * columns + 0.6, 1.8 * rows + 0.8), layout="constrained")
        FigureCanvasAgg(figure)
        panels = figure.subplots(rows, columns, squeeze=False, sharey=True).ravel()
        for panel, (name, entries) in zip(panels, sets.items(), strict=False):
            _panel(panel, name, entries)
        for panel in panels[len(sets) :]:
            panel.set_visible(False)
        figure.supxlabel("frames seen")
        figure.supylabel("share of learnable streams learned")
        lines = {line.get_label(): line for panel in panels for line in panel.get_lines()}
        shown = [lines[name] for name in learners if name in lines]
        figure.legend(shown, [x.get_label() for x in shown], loc="outside upper center", ncols=9)
        for path, metadata in zip(paths, ({"Software": None}, {"Date": None}), strict=True):
            with atomic_write(path) as partial:
                figure.savefig(partial, format=path.suffix[1:], dpi=130, metadata=metadata)
    return paths


def _panel(panel: Any, name: str, entries: Sequence[Entry]) -> None:
    last = max((e["curve"]["frames"][-1] for e in entries if e["curve"]["frames"]), default=1)
    for entry in entries:
        curve, learner = entry["curve"], entry["point"]["learner"]
        if not curve["frames"]:
            continue
        place = list(CONTESTANTS).index(learner)
        rgb = tuple(part / 255 for part in CYCLE[(place - 1) % len(CYCLE)]) if place else "black"
        at = [*curve["frames"], last]
        mean, sd = ([*curve[key], curve[key][-1]] for key in ("mean", "sd"))
        low = [max(m - s, 0.0) for m, s in zip(mean, sd, strict=True)]
        high = [min(m + s, 1.0) for m, s in zip(mean, sd, strict=True)]
        panel.fill_between(at, low, high, color=rgb, alpha=0.12, linewidth=0)
        dash = "-" if place <= len(CYCLE) else "--"
        panel.plot(at, mean, dash, color=rgb, label=learner, linewidth=1.6 if not place else 1.0)
    panel.set_xscale("log")
    panel.set_ylim(-0.03, 1.03)
    panel.minorticks_off()
    panel.set_title(name.replace(" ", "\n"), loc="left")


def _learners(document: Mapping[str, Any]) -> list[str]:
    """All that have results, in the order of the registry."""
    found = {entry["point"]["learner"] for entry in document["entries"]}
    return [name for name in CONTESTANTS if name in found]


def _by_set(document: Mapping[str, Any]) -> dict[str, list[Entry]]:
    sets: dict[str, list[Entry]] = {}
    for entry in document["entries"]:
        sets.setdefault(_set(entry), []).append(entry)
    return sets


def write_page(folder: Path, page: Path) -> dict[str, Any]:
    """Write a Markdown page of all results in a folder, its figure beside it; hand them back."""
    document = write_results(folder)
    png, _ = draw(document, folder)
    figures = page.with_suffix("")
    figures.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(png, figures / png.name)
    with atomic_write(page) as partial:
        partial.write_text(_text(document, f"{figures.name}/{png.name}"), encoding="utf-8")
    return document


def _text(document: Mapping[str, Any], figure: str) -> str:
    sets = _by_set(document)
    parts = [
        "# The arena",
        "",
        "Learners compared on sets of streams. Made by `cdmisfa arena --page`; do not edit.",
        "",
        "```",
        "pip install 'cdmisfa[arena]'",
        "cdmisfa arena all -o arena --page docs/arena.md",
        "```",
        "",
        DEFINITIONS,
        "",
        f"![Share of the learnable streams that each learner has learned, by frames]({figure})",
        "",
        "*Mean and standard deviation over seeds.*",
        "",
        *_together(document, sets),
        "## What did not work",
        "",
        "With how many of the seeds a stream was not learned, and modules over all seeds.",
        "",
        *_failures(document),
    ]
    for name, entries in sets.items():
        entry = SETS.get(entries[0]["point"]["set"])
        parts += ["", f"## {name}", ""]
        if entry is not None:
            words = ", ".join(f"`{word}`" for word in _shortened(entry.words))
            parts += [f"{entry.about[0].upper()}{entry.about[1:]}: {words}.", ""]
        parts.append(markdown(HEAD, [_cells(e) for e in entries]))
        if told := [row for e in entries for row in _told(e)]:
            parts += ["", markdown(TOLD, told)]
        if changes := [row for e in entries for row in _changes(e)]:
            parts += ["", markdown(CHANGED, changes)]
    versions = sorted(document["versions"].items())
    parts += ["", f"Versions: {', '.join(map(' '.join, versions))}.", ""]
    if document["outdated"]:
        parts += [f"{document['outdated']} trials are of an earlier version of the code.", ""]
    return "\n".join(parts)


def _together(document: Mapping[str, Any], sets: Mapping[str, Sequence[Entry]]) -> list[str]:
    """A table of the learners that were on every set: means over sets of the means over seeds."""
    rows = []
    for learner in _learners(document):
        entries = [e for of in sets.values() for e in of if e["point"]["learner"] == learner]
        if len(entries) < len(sets) or len(sets) < 2:
            continue
        measures = [entry["measures"] for entry in entries]
        everything = sum(m["learned"]["mean"] == 1 for m in measures)
        cells = [
            f"{sum(values) / len(values):.2f}" if (values := _means(measures, key)) else "-"
            for key in ("learned", "wrong", "doubles", "ended", "probe", "probe_components")
        ]
        rows.append((learner, f"{everything} of {len(sets)}", *cells))
    head = (
        "learner", "sets learned whole by every seed", "learned", "not learnable", "twice", "ends",
        "R²", "R² of components",
    )  # fmt: skip
    return ["## All sets together", "", markdown(head, rows), ""] if rows else []


def _means(measures: Sequence[Mapping[str, Any]], key: str) -> list[float]:
    return [m[key]["mean"] for m in measures if m[key]["mean"] is not None]


def _shortened(words: Sequence[str]) -> list[str]:
    """Words, where there are many without those that are others begun elsewhere."""
    if len(words) <= 20:
        return list(words)
    first = [word for word in words if "#" not in word]
    others = list(dict.fromkeys(word.partition("#")[0] for word in words if "#" in word))
    return [*first, *(f"{word}#k" for word in others)]


def _told(entry: Entry) -> list[tuple[str, ...]]:
    """Rows on what the modules of the first learner tell of the world, stream by stream."""
    if entry["point"]["learner"] != next(iter(CONTESTANTS)):
        return []
    return [
        (
            entry["point"]["learner"],
            f"`{signal}`",
            _number(tells["outputs"], 1),
            _within(tells["modules"], 2, highest=1.0),
            _within(tells["components"], 2, highest=1.0),
        )
        for signal, tells in entry["probes"].items()
    ]


def _changes(entry: Entry) -> list[tuple[str, ...]]:
    """Rows on what streams show that changed."""
    rows: list[tuple[str, ...]] = []
    for target in entry["targets"]:
        if not target["stream"].endswith(f">{target['signal']}"):
            continue
        share = f"{target['learned']}/{target['trials']}"
        watched = _within(target["watched"], 0)
        rows.append((entry["point"]["learner"], f"`{target['signal']}`", share, watched))
    return rows


def _failures(document: Mapping[str, Any]) -> list[str]:
    """A line for each learner and set that fell short."""
    lines = []
    for entry in document["entries"]:
        missed = [
            f"`{t['stream']}`"
            + (f" as `{t['signal']}`" if ">" in t["stream"] else "")
            + f" {t['trials'] - t['learned']}/{t['trials']}"
            for t in entry["targets"]
            if t["learned"] < t["trials"]
        ]
        said = [f"not learned {', '.join(missed)}"] if missed else []
        said += [
            f"{count} module{'s' if count > 1 else ''} of `{name}`"
            for name, count in entry["wrong"].items()
        ]
        doubles = entry["measures"]["doubles"]
        if doubles["mean"]:
            said.append(f"{round(doubles['mean'] * doubles['n'])} too many of what it had")
        ended = entry["measures"]["ended"]
        if still := round((1 - ended["mean"]) * ended["n"]) if ended["n"] else 0:
            said.append(f"{still} of {ended['n']} runs did not end")
        said += [f"broke: {error}" for error in dict.fromkeys(entry["failed"])]
        if said:
            lines.append(f"- **{entry['point']['learner']}**, {_set(entry)}: {'; '.join(said)}.")
    return lines or ["Nothing."]
