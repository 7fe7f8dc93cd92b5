"""Modules applied to each of many logs, in many processes: a file a log, together one data set."""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from cdmisfa.core.errors import LogDamagedError, LogWriteError, UsageError
from cdmisfa.core.names import stream_name
from cdmisfa.core.untrusted import read_json
from cdmisfa.experiments.apply.application import Application
from cdmisfa.experiments.apply.writing import Totals, follow, written_to
from cdmisfa.experiments.documents import plain, write_json
from cdmisfa.experiments.store import (
    FAILED,
    ROWS,
    StoredTrial,
    answer,
    code,
    read_rows,
    run_trials,
    trial_id,
)
from recorder.images.options import InputOptions
from recorder.log.files import (
    found_path,
    held,
    make_folder,
    refuse_existing,
    relative_path,
    to_disk,
)
from replay.corpus.finding import INDEX
from replay.corpus.index import IndexedLog, index_logs, indexed_logs, is_index

STORE: Final = "_applied"
"""Folder of what is known of the logs; programs that read data sets pass over names like it."""

REQUEST: Final = "apply.json"
"""File in it that says which modules were applied, and how."""

COMPUTED: Final = (
    *("cdmisfa/modules", "cdmisfa/experiments/apply/application"),
    "replay/export/applied",
)
"""Modules that decide what is written."""

_TABLES: Final = (".parquet", ".csv")
"""Endings of files that have the log in a column."""

_LONGEST: Final = 48
"""Letters of a log's name in that of its file."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ApplyTrial(StoredTrial):
    """One log that modules are applied to; `log` is the file of the outputs.

    Attributes:
        name: of the log, relative to the folder of all.
        files: of the log.
        application: the modules.
        part: where the file is written until it is whole.
        options: for `Application.open`.
        frames: end after so many.
    """

    name: str
    files: tuple[str, ...]
    application: Application
    part: Path
    options: Mapping[str, Any]
    frames: int | None


@dataclass(frozen=True, slots=True)
class AppliedLogs:
    """What became of logs.

    Attributes:
        out: the folder of the files.
        logs: a row each, by name: `log`, `out`, `frames`, `error`, `warnings`, and `exit_code`.
        computed: how many were tried now.
        skipped: how many were done, or had failed, before.
    """

    out: Path
    logs: Sequence[Mapping[str, Any]]
    computed: int
    skipped: int

    @property
    def failed(self) -> list[Mapping[str, Any]]:
        """The rows of those that were not applied to, or not to their ends."""
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
    salvage: bool = False,
    jobs: int = 1,
    scheduler: str | None = None,
    retry_failed: bool = False,
    force: bool = False,
    indexing: Callable[[float, float | None], None] = lambda done, total: None,
    progress: Callable[[int, int, int], None] = lambda finished, failed, total: None,
) -> AppliedLogs:
    """Apply the modules of a run to each of many logs that has no outputs in a folder yet.

    Files are the same to the byte whatever `jobs`, and on dask. A log that was written again since
    is applied to again, as by its size and time of change.

    Args:
        run: the run's folder.
        words: folders, patterns, files and URLs of logs, or indices of them.
        out: the folder of the files; with workers on other machines a shared one.
        form: of the files: their ending.
        inputs: see `Application.open`, as for `loop` and `salvage`.
        frames: end after so many of each stream.
        loop: start a log again at its end.
        salvage: pass over what is damaged.
        jobs: local processes.
        scheduler: address of a dask scheduler, whose workers compute instead.
        retry_failed: apply to logs again that failed before.
        force: replace outputs of other modules, or with other options.
        indexing: called with the logs that were looked at, and how many are to be.
        progress: called with the logs finished, failed, and asked for.

    Raises:
        UsageError: there is no such run or log, or the folder holds something else.
        LogWriteError: the disk does not take a file; those before are kept.
        WorkersError: a worker died, or no scheduler answers.
    """
    application, out = Application(run), Path(out).resolve()
    inputs = inputs or InputOptions()
    options = {"inputs": inputs, "loop": loop, "salvage": salvage}
    depends = plain(options | {"form": form, "frames": frames, "inputs": asdict(inputs)})
    folder = out / STORE
    if not folder.exists():
        refuse_existing(out, force=force, goes_on=False)
    try:
        make_folder(folder)
    except OSError as error:
        raise LogWriteError(f"{out} cannot be written: {error.strerror}") from error
    with held(out), _parts(folder) as parts:
        asked = {"schema": 1, "modules": application.identity, "options": depends}
        root = _agreed(folder, asked, force=force) or _root(words, out)
        logs = list(_logs(words, folder / INDEX, root, out, jobs, indexing))
        trials = [
            ApplyTrial(
                id=trial_id(name, states, application.identity, depends, code(*COMPUTED)),
                point={"log": name},
                seed=0,
                code=code(*COMPUTED),
                log=out / _file_name(name, form),
                name=name,
                files=files,
                application=application,
                part=parts / _file_name(name, form),
                options=options,
                frames=frames,
            )
            for name, files, states in logs
        ]

        def begin(missing: Sequence[ApplyTrial]) -> None:
            write_json(folder / REQUEST, {**asked, "root": relative_path(root, folder)})
            for trial in missing:
                if trial.log is not None:
                    trial.log.unlink(missing_ok=True)  # of a log or of code that has changed

        report = run_trials(
            trials,
            folder,
            compute,
            jobs=jobs,
            scheduler=scheduler,
            retry_failed=retry_failed,
            begin=begin,
            progress=progress,
        )
        known = {row["id"]: row for row in read_rows(folder)}
    rows = [_row(trial, known[trial.id]) for trial in trials]
    return AppliedLogs(out, rows, report.trials - report.skipped, report.skipped)


def compute(trial: ApplyTrial) -> Mapping[str, Any]:
    """Apply modules to one log: how that went, or under "error" why it did not."""
    return answer(trial, code(*COMPUTED), _compute)


def _compute(trial: ApplyTrial) -> dict[str, Any]:
    application = trial.application
    named = trial.name if trial.part.suffix in _TABLES else None
    with contextlib.ExitStack() as opened:
        source = application.open(trial.files, **trial.options)
        opened.callback(source.close)
        about = source.spec, application.modules
        totals = Totals(*about)
        with written_to(trial.part, *about, force=True, log=named) as sink:
            blocks = opened.enter_context(contextlib.closing(application.to(source, trial.frames)))
            follow(blocks, [sink], totals)
        said = [*getattr(source, "warnings", ()), *getattr(source, "changes", {}).values()]
        said += getattr(source, "salvaged", list)()
    assert trial.log is not None
    try:
        os.replace(trial.part, trial.log)
        to_disk(trial.log.parent)
    except OSError as error:
        raise LogWriteError(f"{trial.log} cannot be written: {error.strerror}") from error
    damaged = None if totals.damaged is None else str(totals.damaged)
    return {"frames": totals.frames, "damaged": damaged, "warnings": said}


@contextlib.contextmanager
def _parts(folder: Path) -> Iterator[Path]:
    """A folder for files that are not whole yet; what is left in it goes, whoever wrote it."""
    parts = folder / "parts"
    try:
        shutil.rmtree(parts, ignore_errors=True)
        make_folder(parts)
        yield parts
    finally:
        shutil.rmtree(parts, ignore_errors=True)


def _agreed(folder: Path, asked: Mapping[str, Any], *, force: bool) -> str:
    """The folder that names are relative to, as when the first outputs were written; "" before.

    Raises:
        UsageError: the outputs there are of other modules, or were made with other options.
        LogDamagedError: what is said of them is damaged.
    """
    path = folder / REQUEST
    if force:
        _clear(folder)
    if not path.exists():
        return ""
    remedy = "replace all of it with --force"
    there = read_json(path, remedy)
    if not isinstance(there, dict) or not isinstance(there.get("root"), str):
        raise LogDamagedError(f"{path} is damaged: {remedy}")
    if other := [name for name in asked if there.get(name) != asked[name]]:
        raise UsageError(
            f"{folder.parent} holds what was made with other {other[0]}: choose another folder, or "
            f"{remedy}"
        )
    return found_path(there["root"], folder)


def _clear(folder: Path) -> None:
    """Remove the outputs, and what is known of them; other files stay."""
    if (folder / REQUEST).exists():
        names = [Path(row["run"]).name for row in read_rows(folder) if row.get("run")]
        outputs = [folder.parent / name for name in names]
        for path in (*outputs, folder / ROWS, folder / REQUEST):
            path.unlink(missing_ok=True)


def _root(words: Sequence[str], out: Path) -> str:
    """The folder that all logs of this machine are in."""
    folders = []
    for word in words:
        if "://" not in word:
            magic = None if os.path.exists(word) else re.search(r"[*?[]", word)
            path = os.path.abspath(word)
            if magic is not None:
                path = os.path.abspath(os.path.dirname(word[: magic.start()]))
            folders.append(path if os.path.isdir(path) else os.path.dirname(path))
    return os.path.commonpath(folders) if folders else str(out)


def _logs(
    words: Sequence[str],
    index: Path,
    root: str,
    out: Path,
    jobs: int,
    told: Callable[[float, float | None], None],
) -> Iterator[tuple[str, tuple[str, ...], list[tuple[int, str]]]]:
    """Name, files, and states of each log, in the order of names.

    Raises:
        UsageError: there is none.
    """
    indices = [Path(word).resolve() for word in words if is_index(Path(word))]
    if others := [word for word in words if not is_index(Path(word))]:
        index_logs(others, index, jobs=jobs, told=told)
        indices.append(index)
    found: dict[str, IndexedLog] = {}
    for each in indices:
        for log in indexed_logs(each):
            name = log.name if "://" in log.name else os.path.normpath(each.parent / log.name)
            if not name.startswith(os.path.join(out, "")):
                found[_name(name, root)] = log
    if not found:
        raise UsageError(f"{' '.join(words)}: there is no log")
    for name, log in sorted(found.items()):
        files = tuple(f if "://" in f else os.path.normpath(f) for f in log.files)
        yield name, files, log.states


def _name(path: str, root: str) -> str:
    if "://" in path:
        return path
    return os.path.relpath(path, root) if path != root else os.path.basename(path)


def _file_name(log: str, form: str) -> str:
    """A name of a file that no other log has, and that every program takes."""
    name = stream_name(log)[:_LONGEST]
    if name != log:
        name += f"-{hashlib.sha256(log.encode()).hexdigest()[:12]}"
    return f"{name}.{form}"


def _row(trial: ApplyTrial, row: Mapping[str, Any]) -> dict[str, Any]:
    """What became of a log, as `apply --json` prints it, and the exit code that it is worth."""
    if row["status"] == FAILED:
        failed = {"error": row["error"], "exit_code": row.get("exit_code", 1)}
        return {"log": trial.name, "out": None, "frames": 0, "warnings": [], **failed}
    result = row["result"]
    code = 0 if result["damaged"] is None else LogDamagedError.exit_code
    return {
        "log": trial.name,
        "out": str(trial.log),
        "frames": result["frames"],
        "warnings": result["warnings"],
        "error": result["damaged"],
        "exit_code": code,
    }
