"""`cdmisfa.sweep`: many runs over settings and seeds, from what `learn` takes, and their table."""

from __future__ import annotations

import contextlib
import hashlib
import json
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cdmisfa.core.blocks import FrameSource
from cdmisfa.core.errors import UsageError
from cdmisfa.core.shown import Shown
from cdmisfa.experiments.results import PointResult, results, varied
from cdmisfa.experiments.sources import is_scene
from cdmisfa.experiments.store import read_rows
from cdmisfa.experiments.sweep import sweep as sweep_folder
from cdmisfa.public.recording import Given, Recording
from recorder.log.files import atomic_write
from replay.camera_logs.options import CameraOptions
from replay.runs.folders import REQUEST, read_request

SOURCE = "source-"
"""How the name of a file of arrays begins, in the folder of a sweep."""

MISSING = "missing"
"""The status of a trial that was not computed yet."""


class Sweep(Shown):
    """Many runs over settings and seeds: a table of a row a trial, and means over seeds.

    Args:
        folder: of the sweep, as `cdmisfa.sweep` or `cdmisfa sweep` wrote it.

    Attributes:
        points: mean and SD over seeds at each point of the grid.

    Raises:
        UsageError: the folder holds no sweep.
        LogDamagedError: its files are damaged.
    """

    def __init__(self, folder: str | Path) -> None:
        self.path = Path(folder)
        self.points: list[PointResult] = results(self.path)

    @property
    def differs(self) -> Mapping[str, Sequence[Any]]:
        """The settings that differ between its points, and their values."""
        return varied(self.points)

    def to_arrow(self) -> Any:
        """A table of pyarrow, a row for each trial that was asked for last, in the grid's order.

        Its columns: each key of the grid with the type of its values; `seed`; `status`, "done",
        "failed" or "missing"; `iterations`, `frames`, `ended`; how many `modules`, and of each the
        `streams`, `saved` iterations and `slowness` as lists; `error` of one that failed; `run`,
        the folder of its log where that was kept. What is missing is null.
        """
        import pyarrow

        rows = {row["id"]: row for row in read_rows(self.path)}
        trials = [(point, rows.get(name, {})) for name, point in read_request(self.path)]
        keys = list(dict.fromkeys(key for point, _ in trials for key in point))
        columns = {key: typed([point.get(key) for point, _ in trials]) for key in keys}
        found = [_row(row) for _, row in trials]
        for name, kind in _KINDS.items():
            kept = getattr(pyarrow, kind.removesuffix("s"))()
            kept = pyarrow.list_(kept) if kind.endswith("s") else kept
            columns[name] = pyarrow.array([row.get(name) for row in found], kept)
        return pyarrow.table(columns)

    def to_pandas(self) -> Any:
        """The same as a DataFrame of pandas."""
        return self.to_arrow().to_pandas()

    def to_polars(self) -> Any:
        """The same as a DataFrame of Polars."""
        import polars

        return polars.from_arrow(self.to_arrow())

    def _facts(self) -> Mapping[str, Any]:
        done = sum(point.done for point in self.points)
        differ = ", ".join(f"{key} {values}" for key, values in self.differs.items())
        return {
            "sweep": self.path,
            "trials": sum(point.trials for point in self.points),
            "done": done,
            "failed": sum(point.failed for point in self.points),
            "differ": differ or "in nothing but seeds",
        }


_KINDS = {
    "seed": "int64",
    "status": "string",
    "iterations": "int64",
    "frames": "int64",
    "ended": "string",
    "modules": "int64",
    "streams": "strings",
    "saved": "int64s",
    "slowness": "float64s",
    "error": "string",
    "run": "string",
}
"""The columns of the table beside those of the grid; those that end in s hold lists."""


def sweep(
    source: Given,
    folder: str | Path,
    *,
    grid: Mapping[str, Sequence[Any]] | None = None,
    seeds: Iterable[int] = range(20),
    jobs: int = 1,
    algorithm: str | None = None,
    max_iterations: int | None = None,
    max_modules: int | None = None,
    preset: str | None = None,
    loop: bool = False,
    keep_logs: bool = False,
    retry_failed: bool = False,
    progress: Callable[[int, int, int], None] = lambda finished, failed, total: None,
    **settings: Any,
) -> Sweep:
    """Learn once for each combination of settings and each seed; what is there is not done again.

        found = cdmisfa.sweep(array, "sweeps/tau", grid={"tau": [20, 40]}, seeds=range(3))
        found.to_pandas()

    Args:
        source: as for `learn`, but what is live or goes forward only; arrays are written into the
            folder once, for the workers.
        folder: of the sweep; made where it does not exist.
        grid: values to try, by keys of the learner as "tau", or of a scene as "scene.seed".
        seeds: every combination is tried with each.
        jobs: processes.
        algorithm: as for `learn`, and so are the next ones.
        max_iterations: end each after so many.
        max_modules: end each after so many modules.
        preset: settings by name or from a .toml file.
        loop: begin logs or arrays again at their end.
        keep_logs: keep each trial's run, under its folder `trials`.
        retry_failed: compute again what failed before.
        progress: called with the trials finished, failed and asked for.
        settings: keys of the learner, for all.

    Raises:
        UsageError: a source, key or value that cannot be, found before anything is computed.
    """
    algorithms = {} if algorithm is None else {"algorithm": algorithm}
    words = [f"learner.{name}={value}" for name, value in (algorithms | settings).items()]
    keys = {key if "." in key else f"learner.{key}": each for key, each in (grid or {}).items()}
    if isinstance(source, FrameSource | Iterator):
        raise UsageError(
            "a sweep opens its source anew for each trial: give arrays, paths or a scene's name"
        )
    options: dict[str, Any] = {"loop": loop}
    named: Sequence[str] = (source,) if isinstance(source, str) and is_scene([source]) else ()
    written: Path | None = None
    if not named:
        recording = Recording.of(source)
        options["loop"] = loop or recording.loop
        options["cameras"] = CameraOptions(**recording.options)
        named = recording.words
        if not named:
            written = _written(recording, Path(folder))
            named = (str(written),)
    try:
        report = sweep_folder(
            named,
            folder,
            grid=keys,
            seeds=seeds,
            jobs=jobs,
            keep_logs=keep_logs,
            retry_failed=retry_failed,
            progress=progress,
            settings=words,
            preset=preset,
            max_iterations=max_iterations,
            max_modules=max_modules,
            **options,
        )
    except UsageError:
        if written is not None and not (Path(folder) / REQUEST).exists():
            written.unlink()
            with contextlib.suppress(OSError):
                Path(folder).rmdir()
        raise
    return Sweep(report.folder)


def _written(recording: Recording, folder: Path) -> Path:
    """The file of a recording's arrays in a folder, named by what is in it, and made if need be.

    Raises:
        UsageError: the folder holds something else than a sweep.
        LogWriteError: the disk does not take it.
    """
    others = [path for path in folder.glob("*") if not path.match(f"{SOURCE}*.npz")]
    if others and not (folder / REQUEST).exists():
        raise UsageError(f"{folder} holds {others[0].name}, and no sweep: choose another folder")
    with recording.source() as source:
        arrays = source.arrays
    digest = hashlib.sha256()
    for name, array in arrays.items():
        digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(np.ascontiguousarray(array).data)
    path = folder / f"{SOURCE}{digest.hexdigest()[:16]}.npz"
    if not path.exists():
        with atomic_write(path) as partial, zipfile.ZipFile(partial, "w") as file:
            for name, array in arrays.items():  # numpy.savez takes not every name
                with file.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member:
                    np.lib.format.write_array(member, array, allow_pickle=False)
    return path


def _row(row: Mapping[str, Any]) -> dict[str, Any]:
    """The columns of a trial's row beside those of the grid."""
    if not row:
        return {"status": MISSING}
    result = row.get("result", {})
    modules = result.get("modules", [])
    return {
        **{name: row.get(name) for name in ("seed", "status", "error", "run")},
        **{name: result.get(name) for name in ("iterations", "frames", "ended")},
        "modules": len(modules) if result else None,
        "streams": [module["stream"] for module in modules] if result else None,
        "saved": [module["iteration"] for module in modules] if result else None,
        "slowness": [module["eta"][0] for module in modules] if result else None,
    }


def typed(values: Sequence[Any]) -> list[Any]:
    """Values of one key: numbers and truths as such where a command line gave words of these."""
    if not all(isinstance(value, str) for value in values):
        return list(values)
    try:
        read = [
            json.loads(value.lower() if value in ("True", "False") else value) for value in values
        ]
    except ValueError:
        return list(values)
    return read if all(isinstance(value, bool | int | float) for value in read) else list(values)
