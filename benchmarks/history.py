"""What the benchmarks said of each commit, and a figure of it."""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks import report

CODE = ("cdmisfa", "recorder", "replay", "benchmarks/*.py", "pyproject.toml")
"""What a result depends on: where this was changed, no commit is what was measured."""


@dataclass(frozen=True, slots=True)
class Kept:
    """A ratio that is kept of every commit.

    Attributes:
        name: of it, below the name of its panel.
        benchmark: whose result it is in.
        row: what cells of its row are, by their column.
        column: where in the row it stands, as "1.50x" or as "+50 %", which is 1.5.
    """

    name: str
    benchmark: str
    row: Mapping[str, Any]
    column: str


def _kernel(components: int, column: str) -> Kept:
    row = {"inputs": 6144, "K": components, "J": 5, "tau": 40}
    return Kept(f"K = {components}, {column}", "kernels", row, column)


def _logs(column: str, logs: str) -> Kept:
    return Kept(logs, "learn", {f"{column}: CPU of": "all threads", "logs": logs}, "more than")


PANELS: Mapping[str, Sequence[Kept]] = {
    "Gram kernel, times faster": (
        *(_kernel(K, "vs plain numpy") for K in (16, 32, 64)),
        Kept("still pixels, K = 32", "kernels", {"K": 32, "J": 5}, "gain"),
    ),
    "Iteration, preset icub, times that without a log": (
        _logs("preset icub", "run.mcap"),
        _logs("preset icub", "run.mcap and run.rrd"),
    ),
    "Reading, times faster": (
        Kept("sample log, vs mcap", "reader", {"file": "sample log"}, "vs mcap"),
        Kept("noise, vs mcap", "reader", {"file": "noisy pictures"}, "vs mcap"),
    ),
    "Projecting on modules, times faster": (
        Kept("10, vs a matrix product", "modules", {"modules": 10}, "vs a matrix product"),
        Kept("100, vs a matrix product", "modules", {"modules": 100}, "vs a matrix product"),
    ),
    "Recursive SFA, times faster": (
        Kept("256 inputs, vs numpy", "recursive", {"inputs": 256}, "vs plain numpy"),
        Kept("6144 inputs, vs numpy", "recursive", {"inputs": 6144}, "vs plain numpy"),
    ),
    "Starting, times the import of numpy": (
        *(
            Kept(words, "startup", {"process": words}, "times the import of numpy")
            for words in ("learn oscillatory", "learn oscillatory --no-rerun")
        ),
    ),
}


def ratio_of(document: Mapping[str, Any], kept: Kept) -> float | None:
    """A kept ratio in a benchmark's result; None where it is not in it."""
    for table in document["tables"]:
        header = table["header"]
        column = next((i for i, name in enumerate(header) if name.startswith(kept.column)), None)
        if column is None or not set(kept.row) <= set(header):
            continue
        for cells in table["rows"]:
            if all(cells[header.index(name)] == value for name, value in kept.row.items()):
                return _number(str(cells[column]))
    return None


def _number(text: str) -> float | None:
    if found := re.fullmatch(r"([+-][\d.]+) %", text):
        return round(1 + float(found[1]) / 100, 4)
    found = re.fullmatch(r"([\d.]+)x", text)
    return float(found[1]) if found else None


def ratios(document: Mapping[str, Any]) -> dict[str, float]:
    """The kept ratios of one benchmark's result, by panel and name."""
    wanted = ((panel, kept) for panel, all_kept in PANELS.items() for kept in all_kept)
    found = {
        f"{panel}: {kept.name}": ratio_of(document, kept)
        for panel, kept in wanted
        if kept.benchmark == document["benchmark"]
    }
    return {name: value for name, value in found.items() if value is not None}


def keep(name: str, root: Path = report.RESULTS.parent.parent) -> Path | None:
    """Add a benchmark's result to results/history/COMMIT.json; None where no commit holds the code.

    The result itself is told the commit, too, which the page shows.

    Args:
        name: of the benchmark, measured before.
        root: of the repository.
    """
    path = report.RESULTS / f"{name}.json"
    document = json.loads(path.read_text(encoding="utf-8"))
    if _git(root, "status", "--porcelain", "--", *CODE) != "":
        return None
    commit, date = _git(root, "show", "-s", "--format=%H %cI", "HEAD").split()
    document["code"] = f"at {commit[:7]}"
    path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    return add(commit, date, ratios(document))


def add(commit: str, date: str, measured: Mapping[str, float]) -> Path:
    """Add ratios to those of a commit."""
    path = report.RESULTS / "history" / f"{commit[:12]}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    known = json.loads(path.read_text(encoding="utf-8"))["ratios"] if path.exists() else {}
    told = {"commit": commit, "date": date, "ratios": known | dict(measured)}
    path.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
    return path


LINE = 4
"""Points that make a line."""


def curves(commits: Sequence[Mapping[str, Any]], panel: str) -> dict[str, list[tuple[int, float]]]:
    """What a panel shows: by name the places of commits and their ratios, if they make a line.

    Those that are no longer measured come after those that are.
    """
    names = [f"{panel}: {kept.name}" for kept in PANELS[panel]]
    names += sorted({n for told in commits for n in told["ratios"] if n.startswith(f"{panel}: ")})
    found = {
        name.removeprefix(f"{panel}: "): [
            (place, told["ratios"][name])
            for place, told in enumerate(commits)
            if name in told["ratios"]
        ]
        for name in names
    }
    return {name: measured for name, measured in found.items() if len(measured) >= LINE}


def _git(root: Path, *words: str) -> str:
    done = subprocess.run(
        ["git", "-C", str(root), *words], capture_output=True, text=True, check=False
    )
    return done.stdout.strip() if done.returncode == 0 else "no repository"


def draw(picture: Path) -> bool:
    """Draw the kept ratios over the commits they are of; False where none makes a line.

    Args:
        picture: PNG to write.
    """
    paths = (report.RESULTS / "history").glob("*.json")
    commits = [json.loads(path.read_text(encoding="utf-8")) for path in paths]
    commits.sort(key=lambda told: (told["date"], told["commit"]))
    shown = {panel: lines for panel in PANELS if (lines := curves(commits, panel))}
    if not shown:
        return False
    figure = Figure(figsize=(8.0, 2.1 * len(shown)), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(shown), 1, squeeze=False, sharex=True)
    for axes, (panel, lines) in zip(grid.flat, shown.items(), strict=True):
        for name, measured in lines.items():
            axes.plot(*zip(*measured, strict=True), "o-", ms=3, lw=1, label=name)
        axes.set_title(panel, fontsize=9)
        axes.set_xlim(-0.5, len(commits) - 0.5)
        axes.set_ylim(0, 1.15 * axes.get_ylim()[1])
        axes.tick_params(labelsize=7)
        axes.set_xticks(*_days([told["date"][:10] for told in commits]))
        # inside it would hide points
        axes.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    figure.savefig(picture, dpi=100, metadata={"Software": None})
    return True


def _days(days: Sequence[str]) -> tuple[list[int], list[str]]:
    """Where each day begins in a row of commits, and the days; few enough to be read."""
    first = [0, *(i for i, (one, other) in enumerate(pairwise(days), 1) if one != other)]
    few = first[:: 1 + len(first) // 6]
    return few, [days[i][5:] for i in few]
