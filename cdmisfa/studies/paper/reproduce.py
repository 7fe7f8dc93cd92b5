"""Reproduce the paper: run missing trials of an experiment, evaluate, tabulate, draw.

DIR/rows.jsonl holds each finished trial, DIR/results.json and the figures the results of all. A
trial is identified by its settings and the code that ran it: a stopped reproduction resumes, and a
change of the code starts it again.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Mapping
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from cdmisfa.core.errors import (
    CdmisfaError,
    LogDamagedError,
    NotReproducedError,
    UsageError,
    did_you_mean,
)
from cdmisfa.experiments.documents import markdown, plain, versions, write_json
from cdmisfa.experiments.store import code, make_trial, read_trial_rows, run_trials
from cdmisfa.studies.paper.experiment import Experiment, Findings, Settings, Trial
from cdmisfa.studies.paper.icub import Icub, make_recording
from cdmisfa.studies.paper.nonstationary import NonStationary
from cdmisfa.studies.paper.oscillatory import FiveStreams, Oscillatory, Stability

# The experiments, in the paper's order.
EXPERIMENTS: Mapping[str, Experiment] = {
    "oscillatory": Oscillatory(),
    "five": FiveStreams(),
    "stability": Stability(),
    "nonstationary": NonStationary(),
    "icub": Icub(),
}

# Seed of the first trial of an experiment. No choice of docs/project/decisions.md was made on these
# seeds.
FIRST_SEED = 28_000


def load(name: str) -> Experiment:
    """Return an experiment by its name.

    Raises:
        UsageError: no experiment has this name.
    """
    if name not in EXPERIMENTS:
        raise UsageError(f"no experiment {name!r}: {did_you_mean(name, (*EXPERIMENTS, 'all'))}")
    return EXPERIMENTS[name]


def reproduce(
    name: str,
    folder: Path,
    *,
    trials: int | None = None,
    quick: bool = False,
    recording: Path | None = None,
    jobs: int = 1,
    scheduler: str | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, Any]:
    """Run an experiment's missing trials, and write and return their results.

    Args:
        name: name of the experiment.
        folder: folder of the results.
        trials: number of trials per condition; None: the paper's number.
        quick: True to run only enough trials to test the claim.
        recording: recording of the iCub scene; None: one beside the folder, made if it is missing.
        jobs: number of processes.
        scheduler: see `run_trials`.
        progress: called with the number of finished trials and the total.

    Raises:
        UsageError: the experiment does not exist, or matplotlib is missing.
        CdmisfaError: a trial failed; the others are kept.
    """
    experiment = load(name)
    if find_spec("matplotlib") is None:
        raise UsageError("reproduce draws figures: pip install 'cdmisfa[paper]'")
    if experiment.needs_recording and recording is None:
        recording = make_recording(folder.parent / "icub-recording", FIRST_SEED, jobs)
    tasks = []
    for condition in experiment.conditions(quick, recording):
        for seed in range(FIRST_SEED, FIRST_SEED + (trials or experiment.trials[quick])):
            point = {**condition, "seed": seed}
            call = partial(run_trial, name, point)
            tasks.append(make_trial(call, name, point, point=point, seed=seed))
    report = run_trials(
        tasks,
        folder,
        jobs=jobs,
        scheduler=scheduler,
        retry_failed=True,
        begin=lambda missing: progress(len(tasks) - len(missing), len(tasks)),
        progress=lambda done, failed, total: progress(done, total),
    )
    for row in report.failed:
        raise CdmisfaError(f"{name} trial {row['point']}: {row['error']}; the others are stored")
    rows = {row["id"]: row for row in read_trial_rows(folder)}
    finished = [_finished(folder, rows[task.id]) for task in tasks]
    findings = Findings()
    experiment.evaluate(finished, findings)
    values = {
        "schema": 2,
        "experiment": name,
        "title": experiment.title,
        "quick": quick,
        "trials": len(finished),
        **findings.as_json(),
        "figures": [figure.name for figure in experiment.draw(finished, folder)],
        "code": code(),
        "versions": versions(),
    }
    document: dict[str, Any] = plain(values)
    write_json(folder / "results.json", document)
    return document


def run_trial(name: str, settings: Settings) -> dict[str, Any]:
    """Run one trial of an experiment; return its row and arrays as JSON values."""
    row, arrays = load(name).run(settings)
    file = io.BytesIO()
    np.savez_compressed(file, **dict[str, Any](arrays))
    return {"row": plain(row), "arrays": base64.b64encode(file.getvalue()).decode()}


def _finished(folder: Path, row: Mapping[str, Any]) -> Trial:
    """Return a trial from its row in the store."""
    try:
        file = io.BytesIO(base64.b64decode(row["result"]["arrays"]))
        with np.load(file, allow_pickle=False) as arrays:
            return Trial(row["point"], row["result"]["row"], dict(arrays))
    except Exception as error:  # NumPy and zipfile raise many kinds
        raise LogDamagedError(
            f"{folder}: the row of trial {row['id']} is damaged: remove it to run the trial again"
        ) from error


def check_claims(document: Mapping[str, Any]) -> None:
    """Check that the claims of the paper hold in the results.

    Raises:
        NotReproducedError: a claim does not hold; the message names all such claims.
    """
    failed = [c for c in document["claims"] if c["holds"] is False]
    if failed:
        words = "; ".join(f"{c['claim']} ({c['detail']})" for c in failed)
        raise NotReproducedError(f"{document['experiment']} is not reproduced: {words}")


# Header of the table that compares quantities with the paper.
HEAD = ("quantity", "paper", "ours", "SD", "95 % interval", "n")

# Words that state whether a claim holds; None: the trials do not decide it.
VERDICTS = {True: "yes", False: "**no**", None: "*not judged*"}


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
    tables.append(markdown(("statement", "reproduced", "measured"), claims))
    return "\n\n".join([*tables, *document["notes"]]) + "\n"
