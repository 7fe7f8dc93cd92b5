"""The paper's experiments: plan trials, run what is missing, judge, tabulate and draw.

DIR/NAME/rows.jsonl and trials/ hold each finished trial, its row and its curves; rows.parquet,
results.json, table.md and the figures what all of them came to. A trial is known by its settings
and the code that ran it, so a stopped reproduction is resumed where it stopped and a change of
the code starts it anew.
"""

from __future__ import annotations

import contextlib
import importlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np
import pyarrow
from numpy.typing import ArrayLike, NDArray
from pyarrow import parquet

from cdmisfa.core.errors import CdmisfaError, NotReproducedError, UsageError
from cdmisfa.core.modules import Module
from cdmisfa.core.processes import WorkerDied, run_all
from cdmisfa.core.registry import did_you_mean
from cdmisfa.experiments.documents import markdown, plain, versions, write_json
from cdmisfa.experiments.statistics import Summary, summary, wilson
from cdmisfa.experiments.store import DONE, TrialStore, code, identity
from recorder.log.files import atomic_write

NAMES = ("oscillatory", "five", "stability", "costs", "nonstationary", "icub", "difficulty")
"""The experiments, each a module of this package, in the order of their page."""

SETTING = "set_"
"""How the columns of rows.parquet begin that hold a trial's settings."""

Settings = Mapping[str, Any]
Arrays = Mapping[str, NDArray[Any]]
Output = tuple[dict[str, Any], Arrays]
"""A trial's row, in plain values, and its arrays."""


@dataclass(frozen=True, slots=True)
class Request:
    """What is asked of an experiment.

    Attributes:
        trials: trials per condition; None is the paper's number, or a few where `quick` is set.
        recording: folder of a recording, for the experiments that see.
        folder: where the experiment's files go.
        force: results of more or other trials may be replaced.
    """

    trials: int | None
    quick: bool
    recording: Path | None
    folder: Path
    jobs: int = 1
    force: bool = False

    def count(self, paper: int, quick: int) -> int:
        """Trials per condition."""
        return self.trials if self.trials is not None else quick if self.quick else paper


@dataclass(frozen=True, slots=True)
class Trial:
    """A finished trial.

    Attributes:
        settings: what it was computed for.
        row: what it came to, in plain values.
        arrays: curves and the like, for the figures.
    """

    settings: Settings
    row: Mapping[str, Any]
    arrays: Arrays


@dataclass(frozen=True, slots=True)
class Line:
    """One line of an experiment's table.

    Attributes:
        quantity: what was measured.
        paper: the paper's value, as text; "-" where it has none.
        ours: mean over trials, standard deviation and number of trials.
        interval: 95 % confidence interval, where one was computed.
        digits: decimals to print.
        others: means and intervals of other readings, by the headings of their columns.
    """

    quantity: str
    paper: str
    ours: Summary
    interval: tuple[float, float] | None = None
    digits: int = 3
    others: Mapping[str, tuple[float, tuple[float, float]]] = field(default_factory=dict)

    @classmethod
    def measured(
        cls, quantity: str, values: ArrayLike, paper: str = "-", *, digits: int = 3
    ) -> Line:
        """What was measured once or more."""
        return cls(quantity, paper, summary(values), digits=digits)

    @classmethod
    def of_module(
        cls,
        quantity: str,
        trials: Sequence[Trial],
        key: str,
        number: int,
        paper: str = "-",
        *,
        digits: int = 3,
    ) -> Line:
        """What the rows say under a key of a module, counted from 0, where there is one."""
        values = [t.row[key][number] for t in trials if len(t.row[key]) > number]
        return cls.measured(quantity, values, paper, digits=digits)

    @classmethod
    def share(cls, quantity: str, paper: str, good: int, n: int) -> Line:
        """How many of n trials did what is named."""
        return cls(quantity, paper, summary([1.0] * good + [0.0] * (n - good)), wilson(good, n))

    def as_json(self) -> dict[str, Any]:
        """The line as results.json has it."""
        known = {"quantity": self.quantity, "paper": self.paper, **asdict(self.ours)}
        others = {
            name: {"mean": m, "interval": bounds} for name, (m, bounds) in self.others.items()
        }
        return {**known, "interval": self.interval, "digits": self.digits, "others": others}


@dataclass(frozen=True, slots=True)
class Claim:
    """A qualitative statement of the paper, and whether it came out."""

    claim: str
    holds: bool
    detail: str

    @classmethod
    def of_all(cls, claim: str, good: int, n: int) -> Claim:
        """That all of n trials did what is named."""
        return cls(claim, good == n, f"{good} of {n} trials")


@dataclass(frozen=True, slots=True)
class Findings:
    """What an experiment came to."""

    lines: Sequence[Line]
    claims: Sequence[Claim]
    notes: Sequence[str] = field(default=())


def groups(trials: Sequence[Trial], *keys: str) -> dict[tuple[Any, ...], list[Trial]]:
    """The trials whose settings have the same values of some keys, by these, in order."""
    found: dict[tuple[Any, ...], list[Trial]] = {}
    for trial in trials:
        found.setdefault(tuple(trial.settings[key] for key in keys), []).append(trial)
    return found


def learned(modules: Sequence[Module]) -> dict[str, list[Any]]:
    """What a row says of the modules of a trial; a policy as "011", 0 stay and 1 switch."""
    return {
        "streams": [m.stream_index for m in modules],
        "policies": ["".join(map(str, m.policy)) for m in modules],
        "saved_at": [m.iteration for m in modules],
    }


class Experiment(Protocol):
    """What the module of an experiment offers."""

    TITLE: str

    def plan(self, request: Request) -> list[dict[str, Any]]:
        """Settings of every trial, as JSON values."""

    def run(self, settings: Settings) -> Output:
        """One trial: its row and its arrays. Called in another process, maybe elsewhere."""

    def evaluate(self, trials: Sequence[Trial]) -> Findings:
        """Table and claims."""

    def draw(self, trials: Sequence[Trial], folder: Path) -> list[Path]:
        """Figures, as PNG and SVG each."""


def experiment(name: str) -> Experiment:
    """The module of an experiment.

    Raises:
        UsageError: there is none of that name.
    """
    if name not in NAMES:
        raise UsageError(f"no experiment {name!r}: {did_you_mean(name, (*NAMES, 'all'))}")
    return cast(Experiment, importlib.import_module(f"cdmisfa.paper.{name}"))


def reproduce(
    name: str,
    request: Request,
    *,
    engine: str = "local",
    scheduler: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Run an experiment's missing trials, and write what all of them came to: results.json.

    Engine and scheduler are those of `run_all`; `progress` is told finished and all trials.

    Raises:
        UsageError: no such experiment or engine, or the folder holds results of trials that
            are not asked for, and `force` is not set.
        CdmisfaError: a trial killed every process that ran it; the others are kept.
    """
    module = experiment(name)
    planned = module.plan(request)
    if not request.force:
        _keep_results(request.folder, planned)
    version = code()
    names = [identity(name, settings, version) for settings in planned]
    curves = [request.folder / "trials" / f"{n}.npz" for n in names]
    with contextlib.closing(TrialStore(request.folder)) as store:
        missing = [i for i, n in enumerate(names) if store.needs_computing(n, curves[i])]
        tasks = [(name, planned[i]) for i in missing]
        if progress is not None:
            progress(len(planned) - len(missing), len(planned))
        computed = run_all(run_one, tasks, jobs=request.jobs, engine=engine, scheduler=scheduler)
        for done, (k, result) in enumerate(computed, len(planned) - len(missing) + 1):
            i = missing[k]
            if isinstance(result, WorkerDied):
                raise CdmisfaError(f"{name} trial {planned[i]}: {result.what}; the others are kept")
            row, arrays = result
            point = {"id": names[i], "status": DONE, "point": planned[i], "code": version}
            store.add({**point, "result": row})
            with atomic_write(curves[i], sync=False) as partial, open(partial, "wb") as file:
                np.savez_compressed(file, **cast(dict[str, Any], arrays))
            if progress is not None:
                progress(done, len(planned))
        rows = [store.rows[n] for n in names]
    trials = [
        Trial(row["point"], row["result"], read_arrays(path))
        for row, path in zip(rows, curves, strict=True)
    ]
    findings = module.evaluate(trials)
    table = [{**{f"{SETTING}{k}": v for k, v in t.settings.items()}, **t.row} for t in trials]
    with atomic_write(request.folder / "rows.parquet") as partial:
        parquet.write_table(pyarrow.Table.from_pylist(table), partial)
    figures = module.draw(trials, request.folder)
    document: dict[str, Any] = plain(
        {
            "schema": 1,
            "experiment": name,
            "title": module.TITLE,
            "quick": request.quick,
            "trials": len(trials),
            "reproduced": all(claim.holds for claim in findings.claims),
            "claims": [asdict(claim) for claim in findings.claims],
            "table": [line.as_json() for line in findings.lines],
            "notes": list(findings.notes),
            "figures": [figure.name for figure in figures],
            "code": version,
            "versions": versions(),
        }
    )
    write_json(request.folder / "results.json", document)
    with atomic_write(request.folder / "table.md") as partial:
        partial.write_text(markdown_table(document["table"]), encoding="utf-8")
    return document


def run_one(task: tuple[str, Settings]) -> Output:
    """One trial of the named experiment, for any process to call."""
    name, settings = task
    return experiment(name).run(settings)


def check(document: Mapping[str, Any]) -> None:
    """Complain, naming them, when claims of the paper did not come out.

    Raises:
        NotReproducedError: one did not.
    """
    failed = [c for c in document["claims"] if not c["holds"]]
    if failed:
        words = "; ".join(f"{c['claim']} ({c['detail']})" for c in failed)
        raise NotReproducedError(f"{document['experiment']} did not come out: {words}")


def read_arrays(path: Path) -> Arrays:
    """What was kept of a trial for the figures.

    Raises:
        UsageError: the file is damaged.
    """
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as stored:
            return dict(stored)
    except Exception as error:
        raise UsageError(f"{path} is damaged: delete it, and the trial is run again") from error


def _keep_results(folder: Path, planned: Sequence[Settings]) -> None:
    """Refuse to replace results that hold trials which are not planned now."""
    path = folder / "rows.parquet"
    if not path.is_file():
        return
    try:
        rows = parquet.ParquetFile(path).read().to_pylist()
    except (OSError, pyarrow.ArrowException) as error:
        raise UsageError(f"{path} is damaged: write it anew with --force") from error
    known = [_given(settings) for settings in planned]
    there = [
        _given({k.removeprefix(SETTING): v for k, v in row.items() if k.startswith(SETTING)})
        for row in rows
    ]
    lost = sum(settings not in known for settings in there)
    if lost:
        raise UsageError(
            f"{folder} holds results of {len(rows)} trials, {lost} of them not among the "
            f"{len(planned)} asked for now: choose another -o, or replace them with --force"
        )


def _given(settings: Settings) -> Settings:
    """Settings as they come back from a table, where what one trial lacks is None."""
    return {k: v for k, v in json.loads(json.dumps(settings)).items() if v is not None}


HEAD = ("quantity", "paper", "ours", "SD", "95 % interval", "n")


def markdown_table(lines: Sequence[Mapping[str, Any]]) -> str:
    """The table of results.json as Markdown, with a column for every other reading."""
    others = list(dict.fromkeys(name for line in lines for name in line.get("others", ())))
    rows = []
    for line in lines:
        mean, sd, *bounds = _numbers(line, "mean", "sd")
        interval = " .. ".join(bounds) or "-"
        row = [line["quantity"], line["paper"], mean, sd, interval, line["n"]]
        for name in others:
            other = line.get("others", {}).get(name)
            value, *bounds = _numbers({**line, **other}, "mean") if other else ("-",)
            row.append(f"{value} ({' .. '.join(bounds)})" if bounds else value)
        rows.append(row)
    return markdown((*HEAD, *others), rows) + "\n"


def _numbers(line: Mapping[str, Any], *names: str) -> list[str]:
    """Values of a line, then the bounds of its interval, as they are printed."""
    values = (*(line[name] for name in names), *(line["interval"] or ()))
    return ["-" if v is None else f"{v:.{line['digits']}f}" for v in values]
