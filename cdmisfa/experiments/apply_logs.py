"""`apply_to_logs`: apply modules to each of many logs, in many processes."""

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
from cdmisfa.experiments.documents import plain, warnings_of, write_json
from cdmisfa.experiments.store import (
    FAILED,
    ROWS,
    PlannedTrial,
    make_trial,
    read_trial_rows,
    run_trials,
)
from cdmisfa.modules import Module
from recorder.images.options import InputOptions
from recorder.log.files import (
    locked_folder,
    make_folder,
    refuse_existing,
    relative_path,
    resolved_path,
    to_disk,
    writing,
)
from replay.corpus.index import IndexedLog, index_logs, indexed_logs, is_index
from replay.export.applied import AppliedSink, written
from replay.integrity.listing import INDEX

# Folder of the state of the logs; programs that read data sets skip names with an underscore.
STORE: Final = "_applied"

# File in it with the modules and options of the outputs.
REQUEST: Final = "apply.json"

# Source files of this package on which the bytes of the outputs depend.
COMPUTED: Final = ("cdmisfa/modules", "cdmisfa/experiments/apply", "replay/export/applied")

# Characters of a log's name in the name of its output; longer names get a hash.
_MAX_NAME: Final = 48


@dataclass(frozen=True, slots=True)
class AppliedLogs:
    """Outcome of applying modules to many logs.

    Attributes:
        out: folder of the outputs.
        logs: a row for each log: `log`, `out`, `frames`, `error`, `warnings`, and `exit_code`.
        computed: number of logs to which the modules were applied now.
        skipped: number of logs that had finished, or had failed, before.
    """

    out: Path
    logs: Sequence[Mapping[str, Any]]
    computed: int
    skipped: int

    @property
    def failed(self) -> list[Mapping[str, Any]]:
        """Rows of the logs without outputs, or with outputs that end early."""
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
    **execution: Any,
) -> AppliedLogs:
    """Apply the modules of a run to each of many logs that has no outputs in a folder yet.

    The outputs are the same to the byte for any number of processes, and on dask. A log is
    processed again if its size or time of change differs.

    Args:
        run: folder of the run.
        words: folders, patterns, files and URLs of logs, or indices of logs.
        out: folder of the outputs, which workers on other machines must share.
        form: file name ending of the outputs, such as "parquet".
        inputs: see `Application.open`, as for `loop` and `skip_damaged`.
        frames: largest number of frames of each stream; None: all.
        loop: True to start a log again at its end.
        skip_damaged: True to skip damaged parts.
        force: True to replace outputs of other modules or options.
        indexing: called with the number of indexed logs and the total.
        execution: `jobs`, `scheduler`, `retry_failed` and `progress` of `run_trials`.

    Raises:
        UsageError: the run or a log does not exist, or the folder has other contents.
        LogWriteError: an output cannot be written; those before are kept.
        WorkersError: a worker died.
    """
    application, out = Application(run), Path(out).resolve()
    inputs = inputs or InputOptions()
    options = {"inputs": inputs, "loop": loop, "skip_damaged": skip_damaged}
    chosen = plain(options | {"form": form, "frames": frames, "inputs": asdict(inputs)})
    request = {"schema": 1, "modules": application.identity, "options": chosen}
    folder, parts = out / STORE, out / STORE / "parts"
    if not folder.exists():
        refuse_existing(out, force=force, resumable=False)
    with contextlib.ExitStack() as stack:
        with writing(out):
            make_folder(folder)
        stack.enter_context(locked_folder(out))
        stack.callback(shutil.rmtree, parts, ignore_errors=True)
        shutil.rmtree(parts, ignore_errors=True)  # partial files of a killed process
        make_folder(parts)
        root = _earlier_root(folder, request, force=force) or _common_root(words, out)
        trials = []
        jobs = execution.get("jobs", 1)
        for name, log in _find_logs(words, folder / INDEX, root, out, indexing, jobs):
            file = stream_name(name)[:_MAX_NAME]
            if file != name:  # names of other logs can have the same beginning
                file += f"-{hashlib.sha256(name.encode()).hexdigest()[:12]}"
            file = f"{file}.{form}"
            files = [f if "://" in f else os.path.normpath(f) for f in log.files]
            call = partial(apply_to_log, application, name, files, parts / file, options, frames)
            depends = [name, log.states, application.identity, chosen]
            options_of_trial: Any = {"point": {"log": name}, "modules": COMPUTED, "log": out / file}
            trials.append(make_trial(call, *depends, **options_of_trial))

        def begin(missing: Sequence[PlannedTrial]) -> None:
            write_json(folder / REQUEST, {**request, "root": relative_path(root, folder)})
            for trial in missing:
                if trial.log is not None:
                    trial.log.unlink(missing_ok=True)  # the log or the code has changed

        report = run_trials(trials, folder, begin=begin, **execution)
        rows = {row["id"]: row for row in read_trial_rows(folder)}
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
    """Apply modules to one log, write the file of its outputs, and return the result.

    Args:
        application: the modules.
        name: name of the log, relative to the folder of all logs; a column of tables.
        files: files of the log.
        part: path of the file until it is complete; it then moves two folders up.
        options: arguments of `Application.open`.
        frames: largest number of frames; None: all.

    Returns:
        `frames`, the message of the damage or None, and the warnings.
    """
    column = name if part.suffix in (".parquet", ".csv") else None
    modules, out = application.modules, part.parents[2] / part.name
    with contextlib.closing(application.open(files, **options)) as source:
        totals = Totals(source.spec, modules)
        with (
            written_to(part, source.spec, modules, column) as sink,
            contextlib.closing(application.to(source, frames)) as blocks,
        ):
            follow(blocks, [sink], totals)
        warnings = warnings_of(source)
    with writing(out):
        os.replace(part, out)
        to_disk(out.parent)
    damaged = None if totals.damaged is None else str(totals.damaged)
    return {"frames": totals.frames, "damaged": damaged, "warnings": warnings}


def written_to(
    place: Path, spec: SourceSpec, modules: Sequence[Module], log: str | None = None
) -> AbstractContextManager[AppliedSink]:
    """Open the sink that writes outputs in the format of a file name; see `written`."""
    if place.suffix.lower() == ".rrd":
        from replay.view.applied import written_view  # imports Rerun, which takes 0.5 s

        return written_view(place, spec, modules)
    return written(place, spec, modules, log)


def _earlier_root(folder: Path, request: Mapping[str, Any], *, force: bool) -> str:
    """Return the folder to which the names of existing outputs are relative; "" without outputs.

    With `force`, the outputs are deleted; other files stay.

    Raises:
        UsageError: the outputs belong to other modules or options.
        LogDamagedError: the file that states them is damaged.
    """
    path, remedy = folder / REQUEST, "replace all of it with --force"
    if force and path.exists():
        names = [Path(row["run"]).name for row in read_trial_rows(folder) if row.get("run")]
        for output in (*(folder.parent / name for name in names), folder / ROWS, path):
            output.unlink(missing_ok=True)
    if not path.exists():
        return ""
    earlier = read_json(path, remedy)
    if not isinstance(earlier, dict) or not isinstance(earlier.get("root"), str):
        raise LogDamagedError(f"{path} is damaged: {remedy}")
    if different := [name for name in request if earlier.get(name) != request[name]]:
        raise UsageError(
            f"{folder.parent} holds outputs of other {different[0]}: choose another folder, or "
            f"{remedy}"
        )
    return resolved_path(earlier["root"], folder)


def _common_root(words: Sequence[str], out: Path) -> str:
    """Return the folder on this machine that contains all logs."""
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
    jobs: int,
) -> list[tuple[str, IndexedLog]]:
    """Index the logs that words name; return their names and entries, sorted by name."""
    indices = [Path(word).resolve() for word in words if is_index(Path(word))]
    if logs := [word for word in words if not is_index(Path(word))]:
        index_logs(logs, index, jobs=jobs, progress=indexing)
        indices.append(index)
    by_name: dict[str, IndexedLog] = {}
    for path in indices:
        for log in indexed_logs(path):
            name = log.name
            if "://" not in name:
                # A single view has the name of its file: other views may follow into the folder.
                file = log.files[0] if len(log.files) == 1 else name
                name = os.path.normpath(path.parent / file)
                if name.startswith(os.path.join(out, "")):
                    continue
                name = os.path.relpath(name, root) if name != root else os.path.basename(name)
            by_name[name] = log
    if not by_name:
        raise UsageError(f"{' '.join(words)}: no log is there: name other files or folders")
    return sorted(by_name.items())


def _outcome(row: Mapping[str, Any], out: Path | None) -> dict[str, Any]:
    """Return the result of a log as `apply --json` prints it, and its exit code."""
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
