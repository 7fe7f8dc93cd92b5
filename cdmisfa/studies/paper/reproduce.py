"""Reproduce the paper: run the missing trials of an experiment, judge, tabulate, draw.

DIR/rows.jsonl holds each finished trial, DIR/results.json and the figures what all of them came
to. A trial is known by its settings and the code that ran it: a stopped reproduction resumes, and a
change of the code starts it again.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from cdmisfa.core.errors import CdmisfaError, NotReproducedError, UsageError, did_you_mean
from cdmisfa.experiments.documents import markdown, plain, versions, write_json
from cdmisfa.experiments.store import StoredTrial, answer, code, read_rows, run_trials, trial_id
from cdmisfa.studies.paper.experiment import Experiment, Findings, Trial
from cdmisfa.studies.paper.icub import Icub, make_recording
from cdmisfa.studies.paper.nonstationary import NonStationary
from cdmisfa.studies.paper.oscillatory import FiveStreams, Oscillatory, Stability

EXPERIMENTS: Mapping[str, Experiment] = {
    "oscillatory": Oscillatory(),
    "five": FiveStreams(),
    "stability": Stability(),
    "nonstationary": NonStationary(),
    "icub": Icub(),
}
"""The experiments, in the paper's order."""

FIRST_SEED = 28_000
"""Seed of an experiment's first trials: no reading was chosen on these, see docs/decisions."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperTrial(StoredTrial):
    """A trial of one of `EXPERIMENTS`; its settings are its point."""

    experiment: str


def reproduce(
    name: str,
    folder: Path,
    *,
    trials: int | None = None,
    quick: bool = False,
    recording: Path | None = None,
    jobs: int = 1,
    progress: Callable[[int, int], None] = lambda done, total: None,
    **where: Any,
) -> dict[str, Any]:
    """Run an experiment's missing trials, and write and return their results.

    Args:
        name: of the experiment.
        folder: of the results.
        trials: per condition; by default the paper's number.
        quick: a few instead, enough to test the claim.
        recording: of the iCub scene; by default one beside the folder, made if it is missing.
        jobs: processes.
        progress: called with the finished trials and all.
        where: scheduler, see `run_trials`.

    Raises:
        UsageError: no such experiment, or matplotlib is missing.
        CdmisfaError: a trial failed; the others are kept.
    """
    if name not in EXPERIMENTS:
        raise UsageError(f"no experiment {name!r}: {did_you_mean(name, (*EXPERIMENTS, 'all'))}")
    if find_spec("matplotlib") is None:
        raise UsageError("reproduce draws figures: pip install 'cdmisfa[paper]'")
    experiment, version = EXPERIMENTS[name], code()
    if experiment.sees and recording is None:
        recording = make_recording(folder.parent / "icub-recording", FIRST_SEED, jobs)
    seeds = range(FIRST_SEED, FIRST_SEED + (trials or experiment.trials[quick]))
    tasks = [
        PaperTrial(
            id=trial_id(name, point, version), point=point, seed=seed, code=version, experiment=name
        )
        for condition in experiment.conditions(quick, recording)
        for seed in seeds
        for point in [{**condition, "seed": seed}]
    ]
    report = run_trials(
        tasks,
        folder,
        compute_trial,
        jobs=jobs,
        retry_failed=True,
        begin=lambda missing: progress(len(tasks) - len(missing), len(tasks)),
        progress=lambda done, failed, total: progress(done, total),
        **where,
    )
    for row in report.failed:
        raise CdmisfaError(f"{name} trial {row['point']}: {row['error']}; the others are kept")
    rows = {row["id"]: row for row in read_rows(folder)}
    finished = [_finished(folder, rows[task.id]) for task in tasks]
    found = Findings()
    experiment.evaluate(finished, found)
    drawn = experiment.draw(finished, folder)
    document: dict[str, Any] = plain(
        {
            "schema": 2,
            "experiment": name,
            "title": experiment.title,
            "quick": quick,
            "trials": len(finished),
            "reproduced": all(claim["holds"] is not False for claim in found.claims),
            "claims": found.claims,
            "table": found.lines,
            "tables": found.tables,
            "notes": found.notes,
            "figures": [figure.name for figure in drawn],
            "code": version,
            "versions": versions(),
        }
    )
    write_json(folder / "results.json", document)
    return document


def compute_trial(trial: PaperTrial) -> Mapping[str, Any]:
    """Compute one trial: its row and arrays, or under "error" why there are none."""

    def compute(trial: PaperTrial) -> dict[str, Any]:
        row, arrays = EXPERIMENTS[trial.experiment].run(trial.point)
        file = io.BytesIO()
        np.savez_compressed(file, **dict[str, Any](arrays))
        return {"row": plain(row), "arrays": base64.b64encode(file.getvalue()).decode()}

    return answer(trial, code(), compute)


def _finished(folder: Path, row: Mapping[str, Any]) -> Trial:
    """Return a trial from its row in the store."""
    try:
        file = io.BytesIO(base64.b64decode(row["result"]["arrays"]))
        with np.load(file, allow_pickle=False) as arrays:
            return Trial(row["point"], row["result"]["row"], dict(arrays))
    except Exception as error:
        raise UsageError(
            f"{folder}: the row of trial {row['id']} is damaged: delete it, and it is run again"
        ) from error


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

VERDICTS = {True: "yes", False: "**no**", None: "*not judged*"}
"""Whether a statement came out, in words."""


def markdown_tables(document: Mapping[str, Any]) -> str:
    """Return the tables, claims and notes of results.json as Markdown."""
    rows = []
    for line in document["table"]:
        values = (line["mean"], line["sd"], *(line["interval"] or ()))
        mean, sd, *bounds = ("-" if v is None else f"{v:.{line['digits']}f}" for v in values)
        interval = " .. ".join(bounds) or "-"
        rows.append([line["quantity"], line["paper"], mean, sd, interval, line["n"]])
    tables = [markdown(HEAD, rows)] if rows else []
    tables += [markdown(table["head"], table["rows"]) for table in document["tables"]]
    claims = [(c["claim"], VERDICTS[c["holds"]], c["detail"]) for c in document["claims"]]
    tables.append(markdown(("statement", "so here", "measured"), claims))
    return "\n\n".join([*tables, *document["notes"]]) + "\n"
