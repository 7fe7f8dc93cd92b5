"""The page of what curation found, made of results/curation.json."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.curation.choosing import APART, BUDGET, COMPONENTS, MEANS
from benchmarks.curation.planting import FPS, LASTS, RECORDINGS, SECONDS
from benchmarks.curation.worlds import NOISES, WORLDS
from benchmarks.report import RESULTS
from cdmisfa.experiments.documents import markdown
from cdmisfa.experiments.results import mean_interval
from cdmisfa.studies.pages import COLOURS, Page, new_figure, save_figure

PAGE: Final = Path(__file__).parents[2] / "docs" / "results" / "curation.md"

NAMES: Final = {
    "curate": "`curate`",
    "random": "random choice",
    "differences": "frame differences",
    "components": "principal components",
}

KNOWN: Final = ", known"

LITTLE: Final = 0.05
"""Share of noise in what is chosen that is not told of."""

ENOUGH: Final = 0.9
"""Share of events that was to be found."""


def write_page() -> Path:
    """Write docs/results/curation.md and its figure."""
    document = json.loads((RESULTS / "curation.json").read_text("utf-8"))
    page = Page(PAGE)
    page.add(*text(document))
    with tempfile.TemporaryDirectory() as folder:
        figure = draw(document, Path(folder))
        page.picture(figure, "What was found, precision, and what was found of each kind of event")
    page.add(*rest(document))
    page.write()
    return PAGE


def text(document: Mapping[str, Any]) -> Iterator[str]:
    """The page up to its figure."""
    introduction = Path(__file__).with_name("introduction.md").read_text("utf-8")
    yield introduction.format(
        recordings=RECORDINGS,
        seconds=SECONDS,
        fps=FPS,
        low=LASTS[0] / FPS,
        high=LASTS[1] / FPS,
        budget=BUDGET,
        components=COMPONENTS,
    )
    trials = of_group(document, "reported")
    yield "## Worlds that nothing was tuned on"
    yield ""
    yield markdown(HEAD, rows(trials))
    yield ""
    found = [mean_of(trials, f"curate{known}", "found") for known in ("", KNOWN)]
    verdict = ["reached" if share >= ENOUGH else "missed" for share in found]
    yield (
        f"The aim, {ENOUGH:.0%} of the events in {BUDGET:.0%} of the time, is {verdict[0]} without "
        f"a run ({found[0]:.0%}) and {verdict[1]} with one ({found[1]:.0%}). "
        f"At most {np.mean([t['possible'] for t in trials]):.2f} of the chosen time could be "
        "events. " + compared(trials)
    )
    yield ""
    clean = [trial for trial in trials if wasted(trial) <= LITTLE]
    shares = [
        f"{label(mean)} {np.mean([value(t['means'][mean], 'found') for t in clean]):.0%}"
        for mean in ("curate", *(mean + APART for mean in MEANS), "curate" + KNOWN)
    ]
    yield (
        f"In {len(clean)} of {len(trials)} sets no noise is chosen by `curate`; of the events of "
        f"these is found: {'; '.join(shares)}."
    )
    yield ""


def rest(document: Mapping[str, Any]) -> Iterator[str]:
    """The page from its figure on."""
    for group in ("reported", "tuned"):
        trials = of_group(document, group)
        yield f"## Kinds of events, {'not tuned on' if group == 'reported' else 'tuned on'}"
        yield ""
        shown = ["curate", "components" + APART, "curate" + KNOWN, "components" + APART + KNOWN]
        yield markdown(["world", "event", *map(label, shown)], list(kinds(group, trials, shown)))
        yield ""
        if group == "tuned":
            yield markdown(HEAD, rows(trials))
            yield ""
        for name, world in WORLDS[group].items():
            yield f"- **{name}**: {world.about}. Noise: any two of {', '.join(NOISES[group])}."
        yield ""
    yield "## What is missed"
    yield ""
    yield from missed(document)
    yield ""
    yield "## Many recordings"
    yield ""
    yield (
        "`curate --budget 10min --jobs 1` of recordings of three streams of two numbers, 1,000 "
        "frames and more each, as a process of its own:"
    )
    yield ""
    cells = [[n, blocks, f"{busy:.0f}", peak] for n, blocks, busy, peak in document["memory"]]
    yield markdown(["recordings", "blocks", "CPU, s", "peak, MB"], cells)
    yield ""
    yield (
        "Of pictures a block is described by 576 numbers of four bytes, where it is 6 here: 2.3 kB "
        "more a block, and as much again while they are compared, which was not measured."
    )
    yield ""
    facts = ", ".join(f"{key} {value}" for key, value in document["platform"].items())
    yield f"Measured {document.get('code', '')} on: {facts}.".replace("  ", " ")
    yield ""


def compared(trials: Sequence[Any]) -> str:
    """What finds most, beside `curate`, without a run and with one."""
    said = []
    for known, how in (("", "Without a run"), (KNOWN, "with one")):
        others = {m for t in trials for m in t["means"] if m.endswith(KNOWN) == bool(known)}
        others = others - {f"curate{known}"}
        best = max(sorted(others), key=lambda mean: mean_of(trials, mean, "found"))
        share = mean_of(trials, best, "found")
        said.append(f"{how} the best other is {label(best)}, with {share:.0%}")
    return ", ".join(said) + "."


HEAD: Final = ("chosen by", "found", "precision", "noise", "twice")


def of_group(document: Mapping[str, Any], group: str) -> list[Any]:
    """Trials of worlds that were tuned on, or not."""
    return [trial for trial in document["trials"] if trial["group"] == group]


def label(mean: str) -> str:
    """A mean in words."""
    name, *how = mean.split(", ")
    return ", ".join([NAMES[name], *how])


def value(found: Mapping[str, Any], what: str) -> float:
    """A measure of a trial."""
    if what == "found":
        return float(np.mean([hit for _, hit in found["found"]]))
    return float(found[what])


def by_seed(trials: Sequence[Any], mean: str, what: str) -> list[float]:
    """Of each seed, the mean over worlds."""
    seeds: dict[int, list[float]] = {}
    for trial in trials:
        if mean in trial["means"]:
            seeds.setdefault(trial["seed"], []).append(value(trial["means"][mean], what))
    return [float(np.mean(values)) for values in seeds.values()]


def mean_of(trials: Sequence[Any], mean: str, what: str) -> float:
    """Over seeds of the means over worlds."""
    return float(np.mean(by_seed(trials, mean, what)))


def rows(trials: Sequence[Any]) -> list[list[str]]:
    """A row for each way to choose."""
    found = []
    for known in ("", KNOWN):
        for mean in ("curate", *(m + end for end in (APART, "") for m in MEANS)):
            if not any(mean + known in trial["means"] for trial in trials):
                continue
            cells = [label(mean + known)]
            for what in ("found", "precision", "noise", "twice"):
                values = by_seed(trials, mean + known, what)
                cell = f"{np.mean(values):.2f}"
                if what in ("found", "precision") and len(values) > 1 and np.ptp(values) > 0:
                    low, high = mean_interval(values)
                    cell += f" [{max(low, 0):.2f}, {min(high, 1):.2f}]"
                cells.append(cell)
            found.append(cells)
    return found


def kinds(group: str, trials: Sequence[Any], means: Sequence[str]) -> Iterator[list[str]]:
    """How many of each kind of event were found."""
    for name, world in WORLDS[group].items():
        for kind, (about, _) in world.events.items():
            cells = [f"{sum(hits)}/{len(hits)}" if (hits := found_of(trials, name, kind, mean))
                     else "-" for mean in means]  # fmt: skip
            yield [name, f"{kind}: {about}", *cells]


def found_of(trials: Sequence[Any], world: str, kind: str, mean: str) -> list[bool]:
    """Whether each event of a kind was found."""
    own = [t["means"][mean] for t in trials if t["world"] == world and mean in t["means"]]
    return [hit for one in own for name, hit in one["found"] if name == kind]


def missed(document: Mapping[str, Any]) -> Iterator[str]:
    """Kinds of events of which less than was aimed at is found, and noise that is chosen."""
    for group, worlds in WORLDS.items():
        trials = of_group(document, group)
        for name, world in worlds.items():
            for kind, (about, _) in world.events.items():
                hits = [found_of(trials, name, kind, f"curate{k}") for k in ("", KNOWN)]
                shares = [float(np.mean(each)) for each in hits if each]
                if min(shares) < ENOUGH:
                    said = " and ".join(
                        f"{sum(each)} of {len(each)} {how} a run"
                        for each, how in zip(hits, ("without", "with"), strict=True)
                        if each
                    )
                    yield f"- {name}, {about}: {said} are found."
    left = document["trials"]
    while left := [trial for trial in left if wasted(trial) > LITTLE]:
        shares: dict[str, list[float]] = {}
        for trial in left:
            for noise in trial["noise"]:
                shares.setdefault(noise, []).append(wasted(trial))
        worst = max(shares, key=lambda noise: (len(shares[noise]), sum(shares[noise])))
        yield (
            f"- Noise of kind `{worst}`: in {len(shares[worst])} sets that have it "
            f"{np.mean(shares[worst]):.0%} of the chosen time is noise."
        )
        left = [trial for trial in left if worst not in trial["noise"]]
    for trial in document["trials"]:
        if not trial["learned"]:
            yield (
                f"- {trial['world']}, seed {trial['seed']}: the learner learned nothing of the "
                "usual recording, so there is no run that could be known."
            )


def wasted(trial: Mapping[str, Any]) -> float:
    """The share of the time that `curate` chooses that is noise."""
    return float(trial["means"]["curate"]["noise"])


def draw(document: Mapping[str, Any], folder: Path) -> Path:
    """The figure."""
    trials = of_group(document, "reported")
    means = ["curate", *(m + APART for m in MEANS), *MEANS]
    means += ["curate" + KNOWN, "components" + APART + KNOWN, "components" + KNOWN]
    figure, ((left, right),) = new_figure(1, 2, width=4.6, height=3.6)
    for panel, what in ((left, "found"), (right, "precision")):
        for row, mean in enumerate(means):
            colour = COLOURS[list(NAMES).index(mean.split(",")[0])]
            values = by_seed(trials, mean, what)
            panel.barh(row, np.mean(values), color=colour, alpha=0.45)
            panel.plot(values, [row] * len(values), ".", color="black", markersize=3)
        panel.set_ylim(len(means) - 0.5, -0.5)
        panel.set_xlim(0, 1)
        panel.set_yticks(range(len(means)), [label(m).replace("`", "") for m in means], fontsize=7)
    right.set_yticks([])
    left.axvline(ENOUGH, color="black", linewidth=0.7, linestyle=":")
    possible = float(np.mean([trial["possible"] for trial in trials]))
    right.axvline(possible, color="black", linewidth=0.7, linestyle=":")
    left.set_xlabel("events found (dotted: the aim)", fontsize=8)
    right.set_xlabel("of the chosen time in events (dotted: possible)", fontsize=8)
    return save_figure(figure, folder, "curation")[0]
