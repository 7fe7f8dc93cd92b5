"""Modules applied to each of many logs, in many processes: one file per log, one table of all."""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

from cdmisfa.core.blocks import SourceSpec
from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.core.names import stream_name
from cdmisfa.core.untrusted import read_json
from cdmisfa.experiments.apply import Application, Totals, follow
from cdmisfa.experiments.documents import plain, write_json, writing
from cdmisfa.experiments.store import FAILED, ROWS, Trial, make_trial, read_rows, run_trials
from cdmisfa.modules import Module
from recorder.images.options import InputOptions
from recorder.log.files import (
    found_path,
    held,
    make_folder,
    refuse_existing,
    relative_path,
    to_disk,
)
from replay.corpus.index import IndexedLog, index_logs, indexed_logs, is_index
from replay.corpus.listing import INDEX
from replay.export.applied import AppliedSink, written

# Folder of the state of the logs; programs that read data sets skip names with an underscore.
STORE: Final = "_applied"

# File in it that states which modules were applied, and with which options.
REQUEST: Final = "apply.json"

# Modules of this package that decide the bytes of the files.
COMPUTED: Final = ("cdmisfa/modules", "cdmisfa/experiments/apply", "replay/export/applied")

# Most letters of a log's name that become part of a file's name.
_LONGEST: Final = 48


@dataclass(frozen=True, slots=True)
class AppliedLogs:
    """Outcome of applying modules to many logs.

    Attributes:
        out: the folder of the files.
        logs: a row per log: `log`, `out`, `frames`, `error`, `warnings`, and `exit_code`.
        computed: the number of logs that were tried now.
        skipped: the number of logs that were finished, or had failed, before.
    """

    out: Path
    logs: Sequence[Mapping[str, Any]]
    computed: int
    skipped: int

    @property
    def failed(self) -> list[Mapping[str, Any]]:
        """The rows of logs with no outputs, or with outputs that end early."""
        return [row for row in self.logs if row["error"]]

    @property
    def exit_code(self) -> int:
        """Exit code of the command."""
        return max((row["exit_code"] for row in self.failed), default=0)


def apply_to_logs(
    run: str | Path,
    words: Sequence[str],
    out: Path,
    *,
    form: str = "parquet",
    inputs: InputOptions | None = None,
    frames: int | None = None,
    loop: bool = False,
    skip_damaged: bool = False,
    force: bool = False,
    indexing: Callable[[float, float | None], None] = lambda done, total: None,
    **where: Any,
) -> AppliedLogs:
    """Apply the modules of a run to each of many logs that has no outputs in a folder yet.

    The files are the same to the byte for any number of processes, and on dask. A log whose size
    or time of change differs is applied to again.

    Args:
        run: the run's folder.
        words: folders, patterns, files and URLs of logs, or indices of them.
        out: the folder of the files; a shared one if workers run on other machines.
        form: the ending of the files.
        inputs: see `Application.open`, as for `loop` and `skip_damaged`.
        frames: end after this many frames of each stream.
        loop: start a log again at its end.
        skip_damaged: skip damaged parts.
        force: replace outputs of other modules or options.
        indexing: called with the number of logs that were indexed, and of all.
        where: `jobs`, `scheduler`, `retry_failed` and `progress` of `run_trials`.

    Raises:
        UsageError: there is no such run or log, or the folder holds something else.
        LogWriteError: a file cannot be written; those before are kept.
        WorkersError: a worker died, or no scheduler answers.
    """
    application, out = Application(run), Path(out).resolve()
    inputs = inputs or InputOptions()
    options = {"inputs": inputs, "loop": loop, "skip_damaged": skip_damaged}
    chosen = plain(options | {"form": form, "frames": frames, "inputs": asdict(inputs)})
    request = {"schema": 1, "modules": application.identity, "options": chosen}
    folder, parts = out / STORE, out / STORE / "parts"
    if not folder.exists():
        refuse_existing(out, force=force, goes_on=False)
    with contextlib.ExitStack() as stack:
        with writing(out):
            make_folder(folder)
        stack.enter_context(held(out))
        stack.callback(shutil.rmtree, parts, ignore_errors=True)
        shutil.rmtree(parts, ignore_errors=True)  # files that a killed process left
        make_folder(parts)
        root = _earlier_root(folder, request, force=force) or _common_root(words, out)
        trials = []
        for name, log in _find_logs(words, folder / INDEX, root, out, indexing, where):
            file = stream_name(name)[:_LONGEST]
            if file != name:  # other logs may have the same beginning
                file += f"-{hashlib.sha256(name.encode()).hexdigest()[:12]}"
            file = f"{file}.{form}"
            files = [f if "://" in f else os.path.normpath(f) for f in log.files]
            call = partial(apply_to_log, application, name, files, parts / file, options, frames)
            depends = [name, log.states, application.identity, chosen]
            how: Any = {"point": {"log": name}, "modules": COMPUTED, "log": out / file}
            trials.append(make_trial(call, *depends, **how))

        def begin(missing: Sequence[Trial]) -> None:
            write_json(folder / REQUEST, {**request, "root": relative_path(root, folder)})
            for trial in missing:
                if trial.log is not None:
                    trial.log.unlink(missing_ok=True)  # the log or the code has changed

        report = run_trials(trials, folder, begin=begin, **where)
        rows = {row["id"]: row for row in read_rows(folder)}
    outcome = [_outcome(rows[trial.id], trial.log) for trial in trials]
    return AppliedLogs(out, outcome, report.trials - report.skipped, report.skipped)


def apply_to_log(
    application: Application,
    name: str,
    files: Sequence[str],
    part: Path,
    options: Mapping[str, Any],
    frames: int | None,
) -> dict[str, Any]:
    """Apply modules to one log, write the file of its outputs, and return the outcome.

    Args:
        application: the modules.
        name: the log's name, relative to the folder of all logs; a column of a table.
        files: the log's files.
        part: where the file is written until it is complete; it moves two folders up.
        options: arguments of `Application.open`.
        frames: end after this many.
    """
    column = name if part.suffix in (".parquet", ".csv") else None
    modules, out = application.modules, part.parents[2] / part.name
    with contextlib.closing(application.open(files, **options)) as source:
        totals = Totals(source.spec, modules)
        with (
            written_to(part, source.spec, modules, force=True, log=column) as sink,
            contextlib.closing(application.to(source, frames)) as blocks,
        ):
            follow(blocks, [sink], totals)
        warnings = [*getattr(source, "warnings", ()), *getattr(source, "changes", {}).values()]
        warnings += getattr(source, "skipped_damage", list)()
    with writing(out):
        os.replace(part, out)
        to_disk(out.parent)
    damaged = None if totals.damaged is None else str(totals.damaged)
    return {"frames": totals.frames, "damaged": damaged, "warnings": warnings}


def written_to(
    place: Path, spec: SourceSpec, modules: Sequence[Module], *, force: bool, log: str | None = None
) -> AbstractContextManager[AppliedSink]:
    """Open the sink that writes a file of outputs, by the ending of its name; see `written`."""
    if place.suffix.lower() == ".rrd":
        from replay.view.applied import written_view  # takes half a second

        return written_view(place, spec, modules, force=force)
    return written(place, spec, modules, force=force, log=log)


def _earlier_root(folder: Path, request: Mapping[str, Any], *, force: bool) -> str:
    """Return the folder that names are relative to since the first outputs were written, or "".

    With `force`, the outputs are removed; other files stay.

    Raises:
        UsageError: the outputs are of other modules, or were made with other options.
        LogDamagedError: the file that states it is damaged.
    """
    path, remedy = folder / REQUEST, "replace all of it with --force"
    if force and path.exists():
        names = [Path(row["run"]).name for row in read_rows(folder) if row.get("run")]
        for output in (*(folder.parent / name for name in names), folder / ROWS, path):
            output.unlink(missing_ok=True)
    if not path.exists():
        return ""
    earlier = read_json(path, remedy)
    if not isinstance(earlier, dict) or not isinstance(earlier.get("root"), str):
        raise LogDamagedError(f"{path} is damaged: {remedy}")
    if other := [name for name in request if earlier.get(name) != request[name]]:
        raise UsageError(
            f"{folder.parent} holds outputs of other {other[0]}: choose another folder, or {remedy}"
        )
    return found_path(earlier["root"], folder)


def _common_root(words: Sequence[str], out: Path) -> str:
    """Return the folder that holds all logs of this machine."""
    folders = []
    for word in words:
        if "://" not in word:
            if not os.path.exists(word) and (magic := re.search(r"[*?[]", word)):
                word = os.path.dirname(word[: magic.start()])
            path = os.path.abspath(word)
            folders.append(path if os.path.isdir(path) else os.path.dirname(path))
    return os.path.commonpath(folders) if folders else str(out)


def _find_logs(
    words: Sequence[str],
    index: Path,
    root: str,
    out: Path,
    indexing: Callable[[float, float | None], None],
    where: Mapping[str, Any],
) -> list[tuple[str, IndexedLog]]:
    """Index the logs that words name; return their names and entries in the order of names."""
    indices = [Path(word).resolve() for word in words if is_index(Path(word))]
    if others := [word for word in words if not is_index(Path(word))]:
        index_logs(others, index, jobs=where.get("jobs", 1), progress=indexing)
        indices.append(index)
    found: dict[str, IndexedLog] = {}
    for path in indices:
        for log in indexed_logs(path):
            name = log.name
            if "://" not in name:
                name = os.path.normpath(path.parent / name)
                if name.startswith(os.path.join(out, "")):
                    continue
                name = os.path.relpath(name, root) if name != root else os.path.basename(name)
            found[name] = log
    if not found:
        raise UsageError(f"{' '.join(words)}: there is no log")
    return sorted(found.items())


def _outcome(row: Mapping[str, Any], out: Path | None) -> dict[str, Any]:
    """Return the outcome of a log as `apply --json` prints it, and its exit code."""
    name = row["point"]["log"]
    if row["status"] == FAILED:
        failed = {"error": row["error"], "exit_code": row.get("exit_code", 1)}
        return {"log": name, "out": None, "frames": 0, "warnings": [], **failed}
    result = row["result"]
    return {
        "log": name,
        "out": str(out),
        "frames": result["frames"],
        "warnings": result["warnings"],
        "error": result["damaged"],
        "exit_code": 0 if result["damaged"] is None else LogDamagedError.exit_code,
    }
