"""Run the progress learner with each of its constants at half and at twice its value.

constants.toml names the constants and the streams. Rows are stored in build/constants.json as they
finish, so that an interrupted run continues if the commit is the same.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import tomllib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any
from unittest import mock

from benchmarks.arena.judging import judge, run_learner
from benchmarks.arena.streams import SETS, ArenaSource
from benchmarks.report import commit, save
from cdmisfa.agents.learners import open_learner
from cdmisfa.agents.progress.config import ProgressConfig
from cdmisfa.experiments.documents import write_json
from cdmisfa.experiments.sources import Layers, configure

TABLE = tomllib.loads(Path(__file__).with_suffix(".toml").read_text("utf-8"))
PARTIAL = Path(__file__).parents[1] / "build" / "constants.json"

# Frames after which a run that has not decided every stream is stopped: 2,500 blocks, about four
# times what the slowest of these sets takes.
FRAMES = 100_000

# Components of the batch SFA that modules are compared with, the same for every variant.
REFERENCE_COMPONENTS = 16

NOTE = (
    "Each constant at half and at twice its value, all others as they are. A cell has the value, "
    "the learnable streams that were learned (slowness at most 1.25 times that of batch SFA on the "
    "following frames), the modules that were saved of streams without a slow feature, the modules "
    "of a stream that has one already, and the mean number of blocks until every stream is decided "
    "(a run that does not end counts 2,500). If a number is compared with 1, its distance to 1 is "
    "halved and doubled; of two bounds around 1, their logarithms. No decision used these streams "
    "with these seeds."
)

HEADER = ("constant", "value", "about", "origin", "half", "twice")
ROW = ("constant", "value", "set", "seed", "learned", "learnable", "noise", "again", "blocks")

Variant = tuple[str, Any]


def place(name: str) -> tuple[Any, str]:
    """Return the module and the attribute of a constant outside the configuration."""
    module, attribute = name.split(".")
    package = "features" if module == "recursive" else "agents.progress"
    return importlib.import_module(f"cdmisfa.{package}.{module}"), attribute


def current(name: str) -> Any:
    """Return the value of a constant as the code has it."""
    return getattr(*place(name)) if "." in name else getattr(ProgressConfig(), name)


def varied(value: Any, vary: str, factor: float) -> Any:
    """Return a value times a factor, in the way that `vary` names; see constants.toml."""
    ways: Mapping[str, Callable[[Any], Any]] = {
        "value": lambda x: x * factor,
        "distance": lambda x: 1 + (x - 1) * factor,
        "range": lambda x: tuple(bound**factor for bound in x),
    }
    result = ways[vary](value)
    if isinstance(value, int):
        return max(1, round(result))
    digits = [float(f"{x:.3g}") for x in (result if isinstance(result, tuple) else (result,))]
    return tuple(digits) if isinstance(result, tuple) else digits[0]


def variants() -> Iterator[Variant]:
    """Yield the unchanged learner, then each constant at half and at twice its value."""
    yield "", None
    for entry in TABLE["constants"]:
        if "fixed" not in entry:
            for factor in (0.5, 2.0):
                value = current(entry["name"])
                yield entry["name"], varied(value, entry.get("vary", "value"), factor)


@contextlib.contextmanager
def assigned(name: str, value: Any) -> Iterator[list[str]]:
    """Set a constant in the context; yields settings for `configure` where it is a key."""
    if "." in name:
        with mock.patch.object(*place(name), value):
            yield []
    else:
        yield [f"learner.{name}={value}"] if name else []


def run_variant(source: ArenaSource, set_name: str, seed: int, variant: Variant) -> list[Any]:
    """Return the row of one run."""
    name, value = variant
    source.t = 0
    with assigned(name, value) as settings:
        words = ["learner.algorithm=progress", *settings]
        if name == "components":  # outputs must not be more
            words.append(f"learner.outputs={min(8, value)}")
        config = configure("icub", Layers.read(words=words)).learner
        course = run_learner(open_learner(config, source.spec, seed), source, set_name)
    result = judge(course, source, REFERENCE_COMPONENTS, "none")
    learned = [block is not None for block in result["targets"].values()]
    blocks = result["blocks"]
    if blocks is None and not SETS[set_name].get("goes_on"):
        blocks = FRAMES // config.tau
    counts = sum(learned), len(learned), result["noise learned"], result["twice"]
    return [name, as_json(value), set_name, seed, *counts, blocks]


def cell(rows: list[Any]) -> str:
    """Return what the rows of one variant come to: learned, noise, again, blocks."""
    learned, learnable, noise, again = (sum(row[k] for row in rows) for k in (4, 5, 6, 7))
    blocks = [row[8] for row in rows if row[8] is not None]
    return f"{learned} of {learnable}, {noise}, {again}, {sum(blocks) / len(blocks):.0f}"


def summarize(rows: list[Any]) -> list[list[str]]:
    """Return the table: a line for each constant, after one for the unchanged learner."""
    unchanged = cell([row for row in rows if not row[0]])
    table = [["(all unchanged)", "", "", "", unchanged, unchanged]]
    tried = list(variants())
    for entry in TABLE["constants"]:
        name = entry["name"]
        cells = [entry["fixed"], ""] if "fixed" in entry else []
        for value in (value for constant, value in tried if constant == name):
            same = [row for row in rows if row[:2] == [name, as_json(value)]]
            outcome = cell(same)
            cells.append(f"{written(value)}: {outcome if outcome != unchanged else 'no change'}")
        table.append([name, written(current(name)), entry["about"], entry["origin"], *cells])
    return table


def as_json(value: Any) -> Any:
    """Return a value as a row stores it: a list for a tuple."""
    return list(value) if isinstance(value, tuple) else value


def written(value: Any) -> str:
    """Return a value as text."""
    if isinstance(value, tuple):
        return " to ".join(f"{x:g}" for x in value)
    return "2 GiB" if value == 2**31 else f"{value:.3g}" if isinstance(value, float) else str(value)


def stored_rows(code: str) -> list[Any]:
    """Return the rows of an interrupted run, without those that another commit measured."""
    document = json.loads(PARTIAL.read_text("utf-8")) if PARTIAL.exists() else {}
    return list(document["rows"]) if document.get("code") == code else []


def main(quick: bool = False) -> None:
    """Run every variant on every set with every seed; quick: one set, one seed."""
    for name, entry in TABLE["sets"].items():
        SETS[name] = SETS.get(name, {}) | {"frames": FRAMES} | entry
    first = 1 if quick else None
    sets, seeds = list(TABLE["sets"])[:first], TABLE["seeds"][:first]
    code, tried = commit(), list(variants())
    rows = stored_rows(code)
    for seed in seeds:
        for set_name in sets:
            finished = [row[:2] for row in rows if row[2:4] == [set_name, seed]]
            missing = [(name, v) for name, v in tried if [name, as_json(v)] not in finished]
            source = ArenaSource(SETS[set_name]["words"], seed) if missing else None
            for variant in missing:
                rows.append(run_variant(source, set_name, seed, variant))
                print(*rows[-1], flush=True)
                PARTIAL.parent.mkdir(exist_ok=True)
                write_json(PARTIAL, {"code": code, "rows": rows})
    chosen = [row for row in rows if row[2] in sets and row[3] in seeds]
    save("constants", "The learner's constants", NOTE, [(HEADER, summarize(chosen)), (ROW, chosen)])
    if not quick:
        PARTIAL.unlink(missing_ok=True)
