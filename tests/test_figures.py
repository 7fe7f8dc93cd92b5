"""Figures in README and "Results at a glance" are those of the stored results."""

from __future__ import annotations

import json
import re
import statistics
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from benchmarks.estimators import WHITENED
from benchmarks.report import RESULTS as BENCHMARKS

ROOT = Path(__file__).parents[1]
EVIDENCE = ROOT / "docs" / "evidence"
DATA = EVIDENCE / "data"


def load(name: str) -> Any:
    return json.loads((DATA / f"{name}.json").read_text("utf-8"))


def benchmark(name: str) -> Any:
    return json.loads((BENCHMARKS / f"{name}.json").read_text("utf-8"))


def arena(learner: str, *sets: str) -> list[Any]:
    """Return the results of a learner on sets of streams, by default all that are reported."""
    return [
        entry
        for entry in load("learners")["entries"]
        if entry["point"].keys() == {"set", "learner"}
        and entry["point"]["learner"] == learner
        and (
            entry["point"]["set"] in sets or (not sets and entry["point"]["set"][:9] == "reported-")
        )
    ]


def learned(learner: str, *sets: str) -> tuple[int, int]:
    """Return how many streams were learned, and how many could be, over all seeds."""
    streams = [stream for entry in arena(learner, *sets) for stream in entry["targets"]]
    return sum(s["learned"] for s in streams), sum(s["trials"] for s in streams)


def missed(*names: str) -> tuple[int, int]:
    """Return in how many of how many trials streams of the reported sets were not learned.

    Args:
        names: SET/STREAM each.
    """
    streams = [
        stream
        for entry in arena("progress")
        for stream in entry["targets"]
        if f"{entry['point']['set'][9:]}/{stream['stream']}" in names
    ]
    trials = sum(s["trials"] for s in streams)
    return trials - sum(s["learned"] for s in streams), trials


def mean(measure: str, learner: str, *sets: str) -> float:
    """Return the mean of a measure over sets of streams."""
    result = [entry["measures"][measure]["mean"] for entry in arena(learner, *sets)]
    return statistics.fmean(value for value in result if value is not None)


def noise_modules(learner: str, *sets: str) -> int:
    """Return how many modules were saved on streams of noise, over all seeds."""
    result = [entry["measures"]["wrong"] for entry in arena(learner, *sets)]
    return round(sum(each["mean"] * each["n"] for each in result))


def claims(experiment: str) -> list[Any]:
    return [claim["holds"] for claim in load(experiment)["claims"]]


def detail(experiment: str, claim: int) -> tuple[int, ...]:
    """Return the numbers of what was measured about a claim of the paper."""
    return tuple(map(int, re.findall(r"\d+", load(experiment)["claims"][claim]["detail"])))


def scenes(column: int) -> tuple[int, int]:
    """Return in how many of how many trials both objects of the iCub's scenes were learned."""
    cells = [row[column].split(" of ") for row in load("scenes")["tables"][0][1]]
    return sum(int(cell[0]) for cell in cells), sum(int(cell[1]) for cell in cells)


def estimator(values: int, name: str) -> list[Any]:
    """Return the row of an estimator on 20,000 samples of so many values."""
    table = benchmark("estimators")["tables"][0]["rows"]
    [row] = [row for row in table if row[:2] == [f"20,000 x {values}", name]]
    return list(row)


def slowest(values: int, name: str) -> str:
    return str(estimator(values, name)[5])


def time(values: int, name: str) -> float:
    """Return how much more CPU time an estimator takes than RecursiveSFA."""
    return float(estimator(values, name)[3].rstrip("x"))


def same_slowness() -> list[str]:
    """Return the slowness that RecursiveSFA and TICA find among 20 values, if it is the same."""
    return [" and ".join({slowest(20, name) for name in ("RecursiveSFA", "TICA")})]


def read(labels: str, features: str) -> str:
    """Return the mean R² of the true state from features."""
    table = benchmark("features")["tables"][0]
    [row] = [row for row in table["rows"] if row[0] == labels]
    return f"{float(row[table['header'].index(features)].split()[0]):.2f}"


def microseconds() -> float:
    """Return the CPU time of a frame that the preset `icub` learns without a log."""
    table = benchmark("learn")["tables"][0]["rows"]
    [row] = [row for row in table if row[:2] == ["all threads", "no log"]]
    return float(row[2] / 40)


def decoding() -> float:
    """Return the microseconds of a frame of a video."""
    rows = benchmark("applying")["tables"][0]["rows"]
    return float(next(row[2] for row in rows if row[0].startswith("video")))


OTHERS = ("games", "light", "oscillatory-noise")
RULES = ("progress", "robin", "random")
CHOICE = ("reported-photographs", "reported-grids", "reported-many")

Figures = list[tuple[str, Callable[[], Any]]]

RESULTS: dict[str, Figures] = {
    "Does it learn the slow feature of a stream?": [
        ("{} of {} streams", lambda: learned("progress")),
        ("({:.1%})", lambda: [learned("progress")[0] / learned("progress")[1]]),
        ("in {} sets of streams", lambda: [len(arena("progress"))]),
        ("{} module was saved", lambda: [noise_modules("progress") or "No"]),
        ("drifting light ({} of {})", lambda: missed("light/drift")),
        ("pauses ({} of {})", lambda: missed("pauses/bowling", "pauses/pausing:acrobot")),
        ("20 streams ({} of {})", lambda: missed("many/boxing")),
    ],
    "Do the features carry the state of the world?": [
        ("R² {} (mean of 16", lambda: [read("all labels", "module")]),
        ("16 principal components with {}", lambda: [read("all labels", "16 PC")]),
        ("from 64 with {}", lambda: [read("all labels", "64 PC")]),
        (
            "50 labels: {}, {} and {}",
            lambda: [read("50 labels", each) for each in ("module", "16 PC", "64 PC")],
        ),
        ("SFA reaches {}", lambda: [read("50 labels", "SFA, 16 of 32")]),
    ],
    "Is it better than the paper's CD-MISFA 2.0?": [
        (
            "{} of {} streams learned against {} of {}",
            lambda: (*learned("progress", *OTHERS), *learned("2.0", *OTHERS)),
        ),
        (
            "{} against {}, in {} runs",
            lambda: (
                *(noise_modules(learner, *OTHERS) for learner in ("progress", "2.0")),
                sum(len(entry["seeds"]) for entry in arena("2.0", *OTHERS)),
            ),
        ),
    ],
    "Does it work on other scenes than the paper's?": [
        ("both objects in {} of {} trials", lambda: scenes(3)),
        ("2.0 in {} of {}", lambda: scenes(1)),
    ],
    "Does it choose streams well?": [
        (
            "{:,.0f} frames (rotation {:,.0f}, random choice {:,.0f};",
            lambda: [round(mean("frames_learned", each, *CHOICE), -2) for each in RULES],
        ),
        (
            "noise: {:.0%} ({:.0%}, {:.0%})",
            lambda: [mean("in_vain", each, *CHOICE) for each in RULES],
        ),
    ],
    "Is its estimator better than other libraries?": [
        ("With 20 values it finds the same slowness as TICA of deeptime ({})", same_slowness),
        ("{} times as fast", lambda: [round(time(20, "RecursiveSFA") / time(20, "TICA"))]),
        ("With 300 values it finds {}", lambda: [slowest(300, "RecursiveSFA")]),
        ("instead of {}", lambda: [slowest(300, "TICA")]),
        ("or {} without", lambda: [slowest(300, "RecursiveSFA, all")]),
        ("reduction to {} components", lambda: [WHITENED]),
        ("{} times the time", lambda: [round(time(300, "RecursiveSFA, all"))]),
    ],
    "How fast is it?": [
        ("less than {} µs for a frame of 48x128", lambda: [20 if microseconds() < 20 else "?"]),
        ("about {:.0f} ms for a frame of a 640x480 video", lambda: [decoding() / 1000]),
    ],
    "Is the paper reproduced?": [
        ("{} of {} trials", lambda: detail("oscillatory", 0)),
        ("{} of {} on the iCub", lambda: detail("icub", 0)),
        (
            "{} of {} claims",
            lambda: (claims("nonstationary").count(False), len(claims("nonstationary"))),
        ),
    ],
}
"""What stands in the result of each question: texts with their figures."""

NAMES = ("2.0", "1.0")
"""Numbers that are names, and come from no measurement."""


def rows(page: Path) -> Iterator[list[str]]:
    """Yield the cells of the tables of a page."""
    for line in page.read_text("utf-8").splitlines():
        if line.startswith("|") and not line.startswith("|-"):
            yield [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]


def percent(text: str) -> str:
    """Write a space before the sign, as the pages do."""
    return re.sub(r"(\d)%", r"\1 %", text)


@pytest.mark.parametrize("question", RESULTS)
def test_results_have_the_figures_of_the_stored_results(question: str) -> None:
    [cell] = [row[1] for row in rows(EVIDENCE / "results.md") if row[0] == question]
    for text, figures in RESULTS[question]:
        expected = percent(text.format(*figures()))
        assert expected in cell
        cell = cell.replace(expected, "")
    rest = re.findall(r"\d[\d.]*\d|\d", cell)
    assert [number for number in rest if number not in NAMES] == []


def test_every_question_of_the_results_is_compared() -> None:
    assert {row[0] for row in rows(EVIDENCE / "results.md")} - {"Question"} == RESULTS.keys()


def test_readme_repeats_figures_of_the_results() -> None:
    results = {row[0]: row[1] for row in rows(EVIDENCE / "results.md")}
    tables = [*rows(ROOT / "README.md")]
    [head] = [number for number, row in enumerate(tables) if row[0] == "Question"]
    repeated = [row for row in tables[head + 1 :] if len(row) == 2 and row[0].endswith("?")]
    assert len(repeated) >= 4
    for question, result in repeated:
        for number in re.findall(r"\d[\d.,]*(?: %)?", re.sub(r"\]\([^)]*\)", "]", result)):
            assert number.rstrip(".,") in results[question], (question, number)


def test_results_name_the_commit_of_their_data() -> None:
    for *_, source in list(rows(EVIDENCE / "results.md"))[1:]:
        for file in re.findall(r"\]\(([^)]*\.json)\)", source):
            document = json.loads((EVIDENCE / file).read_text("utf-8"))
            commit = document["commit"] if "commit" in document else document["code"]
            assert commit.removesuffix("-dirty") == source.rsplit(" ", 1)[-1]


def numbers(value: Any) -> Iterator[float]:
    """Yield all numbers of a document, also of its texts."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        for each in value:
            yield from numbers(each)
    elif isinstance(value, str):
        yield from map(float, re.findall(r"[-+]?\d+(?:\.\d+)?", value))
    elif isinstance(value, int | float):
        yield value


def test_claims_of_the_paper_have_figures_of_their_data() -> None:
    checked = []
    for row in rows(EVIDENCE / "paper.md"):
        if len(row) == 4 and (link := re.search(r"\]\(data/(\w+)\.json\)", row[3])):
            stored = list(numbers(load(link[1])))
            text = re.sub(r"(\d),(\d{3})\b", r"\1\2", row[2])
            for number in re.findall(r"-?\d+(?:\.\d+)?", text):
                digits = len(number.partition(".")[2])
                assert any(round(x, digits) == float(number) for x in stored), (row[0], number)
                checked.append(number)
    assert len(checked) > 50
    # A whole number of one or two digits agrees with some stored number nearly always.
    assert sum("." in number or abs(float(number)) >= 100 for number in checked) > 35


def test_tables_of_the_learners_are_those_of_their_data() -> None:
    page = (EVIDENCE / "learners.md").read_text("utf-8")
    for entry in arena("progress"):
        result, of = entry["measures"], learned("progress", entry["point"]["set"])
        state = [f"{result[name]['mean']:.2f}" for name in ("probe", "probe_components")]
        blocks = (
            "{mean:.0f} [{low:.0f}, {high:.0f}]".format(**result["blocks"])
            if result["blocks"]["n"]
            else "-"
        )
        assert f"| {of[0]} of {of[1]} | 0 | {blocks} | {' | '.join(state)} |" in page
    for name in OTHERS:
        shares = [learned(learner, name) for learner in ("progress", "2.0")]
        noise = [noise_modules(learner, name) for learner in ("progress", "2.0")]
        cells = [*(f"{x} of {n}" for x, n in shares), *map(str, noise)]
        assert f"| {' | '.join(cells)} |" in page
    for rule in (
        "progress",
        "robin",
        "alp",
        "prediction",
        "rnd",
        "lpm",
        "learning-progress",
        "random",
    ):
        share, frames, noise = (
            mean(m, rule, *CHOICE) for m in ("learned", "frames_learned", "in_vain")
        )
        assert percent(f"| {share:.0%} | {round(frames, -2):,.0f} | {noise:.0%} |") in page
