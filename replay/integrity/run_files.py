"""Does a run prove itself: its signals, and the files beside its log."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from cdmisfa.core.errors import CdmisfaError
from cdmisfa.core.signals import SCHEMA_VERSION, SignalsHash
from replay.mcap.reader import LogReader
from replay.mcap.segments import Problem
from replay.runs.final import facts_sha256
from replay.runs.folders import FINAL_METADATA, MODULES_FILE, RUN_JSON, VIEW_FILE, read_run_json
from replay.runs.log import read_header
from replay.runs.modules import load_modules
from replay.runs.stretches import read_columns
from replay.storage.checksum import sha256


def view_again(run: Path) -> str:
    """How the view of a run comes back; it holds nothing that the log does not."""
    command = ("cdmisfa", "view", str(run), "--save", str(run / VIEW_FILE), "--force")
    return f"make it again with {shlex.join(command)}"


def read_final(log: Path) -> Mapping[str, str] | None:
    """The final record of a run's log, None where it holds none."""
    with LogReader(log, salvage=True) as reader:
        return next((r.values for r in reader.metadata if r.name == FINAL_METADATA), None)


def check_run(log: Path, *, beside: bool) -> Iterator[Problem]:
    """Compare what a run states of itself with what is there.

    Args:
        log: of a run, whole.
        beside: also look at the files beside it.
    """
    final = read_final(log)
    folder = log.parent
    document = read_run_json(folder) if beside else {}
    try:
        yield from _check_signals(log, final, document)
    except CdmisfaError as error:
        yield Problem(str(log), str(error).removeprefix(f"{log}: "))
    if final is None or not beside:
        return
    if not document:
        yield Problem(str(folder / RUN_JSON), "is missing or no JSON")
    elif facts_sha256(document) != final.get("facts_sha256"):
        yield Problem(str(folder / RUN_JSON), "states something else than the run's final record")
    yield from _check_modules(folder / MODULES_FILE, final.get("modules_sha256"))
    view = folder / VIEW_FILE
    if final.get("view") == json.dumps(True) and not view.is_file():
        yield Problem(str(view), f"is missing; {view_again(folder)}")


def _check_signals(
    log: Path, final: Mapping[str, str] | None, document: Mapping[str, Any]
) -> Iterator[Problem]:
    result = document.get("result")
    of_result = result.get("signals_sha256") if isinstance(result, Mapping) else None
    stated = of_result if final is None else final.get("signals_sha256")
    header = read_header(log)
    if stated is None or header.schema != SCHEMA_VERSION:
        return
    found, expected = SignalsHash(), 0
    for columns in read_columns(log, header):
        for signals in columns.records():
            if signals.iteration != expected:
                what = f"iterations {expected} to {signals.iteration - 1} are missing"
                yield Problem(str(log), what)
            expected = signals.iteration + 1
            found.add(signals)
    if found.hexdigest() != stated:
        yield Problem(str(log), f"its {found.count} iterations are not those that the run had")


def _check_modules(path: Path, stated: str | None) -> Iterator[Problem]:
    try:
        if not path.is_file():
            yield Problem(str(path), "is missing")
        elif sha256(path) != stated:
            yield Problem(str(path), "holds something else than the run's final record states")
        else:
            load_modules(path)
    except CdmisfaError as error:
        yield Problem(str(path), str(error).removeprefix(f"{path}: "))
