"""Reproduce the paper: run what is missing of an experiment, judge, tabulate, draw.

DIR/NAME/rows.jsonl holds each finished trial; rows.parquet, results.json, table.md and the
figures what all of them came to. A trial is known by its settings and the code that ran it, so a
stopped reproduction is resumed where it stopped and a change of the code starts it anew.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
from pyarrow import parquet

from cdmisfa.core.errors import CdmisfaError, NotReproducedError, UsageError
from cdmisfa.core.registry import did_you_mean
from cdmisfa.core.untrusted import MAX_LIST, read_json
from cdmisfa.experiments.documents import markdown, plain, versions, write_json
from cdmisfa.experiments.store import StoredTrial, answer, code, read_rows, run_trials, trial_id
from cdmisfa.studies.pages import Page
from cdmisfa.studies.paper.ablation import Ablation
from cdmisfa.studies.paper.difficulty import Difficulty
from cdmisfa.studies.paper.experiment import Experiment, Findings, Request, Settings, Trial
from cdmisfa.studies.paper.icub import Icub
from cdmisfa.studies.paper.nonstationary import NonStationary
from cdmisfa.studies.paper.oscillatory import Costs, FiveStreams, Oscillatory, Stability
from cdmisfa.studies.paper.scenes import Scenes
from recorder.log.files import atomic_write

EXPERIMENTS: Mapping[str, Experiment] = {
    "oscillatory": Oscillatory(),
    "five": FiveStreams(),
    "stability": Stability(),
    "costs": Costs(),
    "nonstationary": NonStationary(),
    "icub": Icub(),
    "ablation": Ablation(),
    "scenes": Scenes(),
    "difficulty": Difficulty(),
}
"""The experiments, in the order of their page."""

SETTING = "set_"
"""How the columns of rows.parquet begin that hold a trial's settings."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperTrial(StoredTrial):
    """A trial of one of `EXPERIMENTS`; its settings are its point."""

    experiment: str


def reproduce(
    name: str,
    request: Request,
    *,
    engine: str = "local",
    scheduler: str | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, Any]:
    """Run an experiment's missing trials, and write what all of them came to: results.json.

    Engine and scheduler are those of `run_all`; `progress` is told finished and all trials.

    Raises:
        UsageError: no such experiment or engine, or the folder holds results of trials that
            are not asked for, and `force` is not set.
        CdmisfaError: a trial failed; the others are kept.
    """
    if name not in EXPERIMENTS:
        raise UsageError(f"no experiment {name!r}: {did_you_mean(name, (*EXPERIMENTS, 'all'))}")
    experiment = EXPERIMENTS[name]
    planned = experiment.plan(request)
    if not request.force:
        _keep_results(request.folder, planned)
    version = code()
    tasks = [
        PaperTrial(
            id=trial_id(name, settings, version),
            point=settings,
            seed=int(settings["seed"]),
            code=version,
            experiment=name,
        )
        for settings in planned
    ]
    report = run_trials(
        tasks,
        request.folder,
        compute_trial,
        jobs=request.jobs,
        engine=engine,
        scheduler=scheduler,
        retry_failed=True,
        begin=lambda missing: progress(len(tasks) - len(missing), len(tasks)),
        progress=lambda done, failed, total: progress(done, total),
    )
    for row in report.failed:
        raise CdmisfaError(f"{name} trial {row['point']}: {row['error']}; the others are kept")
    rows = {row["id"]: row for row in read_rows(request.folder)}
    trials = [_finished(request.folder, rows[task.id]) for task in tasks]
    found = Findings()
    experiment.evaluate(trials, found)
    cells = [{**{f"{SETTING}{k}": v for k, v in t.settings.items()}, **t.row} for t in trials]
    columns = list(dict.fromkeys(name for row in cells for name in row))
    table = [{name: row.get(name) for name in columns} for row in cells]
    with atomic_write(request.folder / "rows.parquet") as partial:
        parquet.write_table(pyarrow.Table.from_pylist(table), partial)
    figures = experiment.draw(trials, request.folder)
    return _write_results(name, request, found, len(trials), figures)


def compute_trial(trial: PaperTrial) -> Mapping[str, Any]:
    """Compute one trial: its row and arrays, or under "error" why there are none."""

    def compute(trial: PaperTrial) -> dict[str, Any]:
        row, arrays = EXPERIMENTS[trial.experiment].run(trial.point)
        file = io.BytesIO()
        np.savez_compressed(file, **dict[str, Any](arrays))
        return {"row": plain(row), "arrays": base64.b64encode(file.getvalue()).decode()}

    return answer(trial, code(), compute)


def _finished(folder: Path, row: Mapping[str, Any]) -> Trial:
    """A trial from its row in the store."""
    try:
        file = io.BytesIO(base64.b64decode(row["result"]["arrays"]))
        with np.load(file, allow_pickle=False) as arrays:
            return Trial(row["point"], row["result"]["row"], dict(arrays))
    except Exception as error:
        raise UsageError(
            f"{folder}: the row of trial {row['id']} is damaged: delete it, and it is run again"
        ) from error


def _write_results(
    name: str, request: Request, found: Findings, trials: int, figures: Sequence[Path]
) -> dict[str, Any]:
    chosen = " --quick" if request.quick else ""
    chosen += f" --trials {request.trials}" if request.trials is not None else ""
    document: dict[str, Any] = plain(
        {
            "schema": 1,
            "experiment": name,
            "command": f"cdmisfa reproduce {name}{chosen}",
            "title": EXPERIMENTS[name].title,
            "quick": request.quick,
            "trials": trials,
            "reproduced": all(claim["holds"] is not False for claim in found.claims),
            "short": found.short,
            "claims": found.claims,
            "table": found.lines,
            "tables": found.tables,
            "notes": found.notes,
            "figures": [figure.name for figure in figures],
            "code": code(),
            "versions": versions(),
        }
    )
    write_json(request.folder / "results.json", document)
    with atomic_write(request.folder / "table.md") as partial:
        partial.write_text(markdown_tables(document), encoding="utf-8")
    return document


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
    there = ({k[len(SETTING) :]: row[k] for k in row if k.startswith(SETTING)} for row in rows)
    if lost := sum(_given(settings) not in known for settings in there):
        raise UsageError(
            f"{folder} holds results of {len(rows)} trials, {lost} of them not among the "
            f"{len(planned)} asked for now: choose another -o, or replace them with --force"
        )


def _given(settings: Any) -> Any:
    """Settings as they come back from a table, where what one trial lacks is None."""
    if isinstance(settings, Mapping):
        return {k: _given(v) for k, v in settings.items() if v is not None}
    return [_given(v) for v in settings] if isinstance(settings, list | tuple) else settings


def check_claims(document: Mapping[str, Any]) -> None:
    """Complain, naming them, when claims of the paper did not come out.

    Raises:
        NotReproducedError: one did not.
    """
    failed = [c for c in document["claims"] if c["holds"] is False]
    if failed:
        words = "; ".join(f"{c['claim']} ({c['detail']})" for c in failed)
        raise NotReproducedError(f"{document['experiment']} did not come out: {words}")


HEAD = ("quantity", "paper", "ours", "SD", "95 % interval", "n")


def markdown_tables(document: Mapping[str, Any]) -> str:
    """The tables of results.json as Markdown."""
    rows = []
    for line in document["table"]:
        values = (line["mean"], line["sd"], *(line["interval"] or ()))
        mean, sd, *bounds = ("-" if v is None else f"{v:.{line['digits']}f}" for v in values)
        interval = " .. ".join(bounds) or "-"
        rows.append([line["quantity"], line["paper"], mean, sd, interval, line["n"]])
    tables = [markdown(HEAD, rows)] if rows else []
    tables += [markdown(table["head"], table["rows"]) for table in document["tables"]]
    return "\n\n".join(tables) + "\n"


VERDICTS = {True: "yes", False: "**no**", None: "*not judged*"}
"""Whether a statement came out, in words."""


def write_paper_page(root: Path, path: Path) -> None:
    """Write a Markdown page of every experiment below a folder.

    Raises:
        UsageError: there is no result below the folder, or one cannot be read.
    """
    there = [name for name in EXPERIMENTS if (root / name / "results.json").exists()]
    documents = [read_results(root / name) for name in there]
    if not documents:
        raise UsageError(f"{root} has no results: run cdmisfa reproduce all -o {root} first")
    page = Page(path)
    page.add("# The paper, reproduced", "")
    page.add(*(f"- {d['short']}" for d in documents if d["short"]), "")
    page.add(Path(__file__).with_name("introduction.md").read_text("utf-8"))
    page.add("## What the paper says, judged", "")
    claims = [
        (c["claim"], VERDICTS[c["holds"]], c["detail"], f"`{d['experiment']}`")
        for d in documents
        for c in d["claims"]
    ]
    page.add(markdown(("statement", "so here", "measured", "by"), claims), "")
    for document in documents:
        name = document["experiment"]
        made = f"`{document['command']}`, {document['trials']} trials."
        page.add(f"## {document['title']}", "", made, "")
        page.add(markdown_tables(document))
        page.add(*(f"{note}\n" for note in document["notes"]))
        for figure in document["figures"]:
            if figure.endswith(".png"):
                page.picture(root / name / figure, document["title"])
    page.versions(documents[0]["versions"])
    page.write()


def read_results(folder: Path) -> dict[str, Any]:
    """The results.json of an experiment.

    Raises:
        UsageError: it cannot be read.
    """
    path = folder / "results.json"
    try:
        document = read_json(path, "run it again", most=MAX_LIST)
        if document["schema"] != 1:
            raise ValueError(document["schema"])
    except (CdmisfaError, ValueError, KeyError, TypeError) as error:
        raise UsageError(
            f"{path} cannot be read: run cdmisfa reproduce {folder.name} again"
        ) from error
    return dict(document)
