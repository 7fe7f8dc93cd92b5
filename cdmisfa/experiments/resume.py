"""What a run is resumed from: the command that began it, its log, and its checkpoints.

A checkpoint is a learner's state in one file of plain arrays and a JSON text, written whole or
not at all. It holds no signals: those are in the run's log, which is always flushed first. So a
run that was stopped anywhere is resumed from the newest checkpoint that its log covers.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.blocks import Block, FrameSource, SourceSpec
from cdmisfa.core.errors import LogDamagedError, LogWriteError, UsageError, one_line
from cdmisfa.core.learning import Learner, LearnerState, Sink
from cdmisfa.core.modules import Module
from cdmisfa.core.signals import SCHEMA_VERSION, BlockSignals
from cdmisfa.experiments.documents import versions
from recorder.log.begun import Begun, found_path, relative_path
from recorder.log.whole import partial_path, whole
from recorder.world.scenes import SCENES

COMMAND = "command"
"""Key of a manifest: the command that began the run, which may differ when it is resumed."""

OPTIONS = (
    "seed",
    "preset",
    "settings",
    "algorithm",
    "loop",
    "salvage",
    "follow",
    "topics",
    "size",
    "align",
    "rate",
    "max_iterations",
    "max_modules",
)
"""What of a command makes a run what it is, and where it ends, besides its source."""

SET_ASIDE = "run.before.mcap.partial"
"""The log of a run that is being resumed, until the new one has taken over what counts."""

SCHEMA = 2
"""Version of a checkpoint; rises when the state of a learner changes its meaning."""

KEPT = 2
"""Newest checkpoints that a run's folder keeps: one more in case the log of the last was lost."""

SETTLED_SECONDS = 60.0
"""Time after which the operating system has written a file by itself; Linux does within 35."""

_HEAD = "checkpoint"
_MODULES = "modules."
_PLAIN = ("index", "stream", "stream_index", "iteration")


def command_of(source: Sequence[str], options: Mapping[str, Any], run: Path) -> dict[str, Any]:
    """The command that begins a run, as JSON values; paths are kept relative to its folder.

    Of the options of the command those in `OPTIONS` are kept.
    """
    kept = {name: options[name] for name in OPTIONS if name in options}
    preset = kept.get("preset")
    if preset is not None and preset.endswith(".toml"):
        kept["preset"] = relative_path(preset, run)
    return Begun(tuple(source), kept).as_json(run, SCENES)


def read_command(run: Path) -> tuple[tuple[str, ...], dict[str, Any]]:
    """The command that began a run: its source and its options.

    Raises:
        UsageError: there is no run, or it does not say.
        LogDamagedError: its log cannot be read.
    """
    from replay.runs.log import read_header

    begun = Begun.from_json(read_header(log_to_resume(run)).manifest.get(COMMAND), run)
    if begun is None:
        raise UsageError(f"{run} does not say what it learns from: name its source")
    options = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in begun.options.items()
        if name in OPTIONS
    }
    preset = options.get("preset")
    if preset is not None and str(preset).endswith(".toml"):
        options["preset"] = found_path(str(preset), run)
    return begun.source, options


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """Where a run stood after some iteration.

    Attributes:
        iteration: iterations done.
        t: the source's next frame.
        state: of the learner.
        versions: of the packages that computed it.
        taken: the SHA-256 of the frames before it, of a source that says so; see
            `FollowedSource`.
    """

    iteration: int
    t: int
    state: LearnerState
    versions: Mapping[str, str]
    taken: str | None = None


def save_checkpoint(run: Path, checkpoint: Checkpoint, *, sync: bool = False) -> Path:
    """Write a checkpoint into a run's folder.

    The run's log must already hold every iteration before it; with `sync`, on disk.
    """
    path = checkpoint_path(run, checkpoint.iteration)
    head = {
        "schema": SCHEMA,
        "iteration": checkpoint.iteration,
        "t": checkpoint.t,
        "policy_rng": checkpoint.state.policy_rng,
        "versions": checkpoint.versions,
        "taken": checkpoint.taken,
    }
    arrays: dict[str, NDArray[Any]] = {_HEAD: np.frombuffer(json.dumps(head).encode(), np.uint8)}
    for field in dataclasses.fields(Module):
        values = [getattr(module, field.name) for module in checkpoint.state.modules]
        arrays[_MODULES + field.name] = np.array(values)
    arrays.update(checkpoint.state.arrays)
    # One that is not synced and cut by a power cut is passed over as damaged.
    with whole(path, sync=sync) as partial, open(partial, "wb") as file:
        np.savez(file, allow_pickle=False, **arrays)
    return path


def checkpoint_path(run: Path, iteration: int) -> Path:
    """Where a checkpoint lies in a run's folder."""
    return run / f"checkpoint-{iteration:012d}.npz"


def drop(paths: Iterable[Path]) -> None:
    """Remove files of a run that nothing needs any more.

    Raises:
        LogWriteError: one cannot be removed.
    """
    for path in paths:
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            raise LogWriteError(f"{path} cannot be removed: {error.strerror}") from error


def checkpoints(run: Path) -> list[Path]:
    """The checkpoints in a run's folder, newest first."""
    return sorted(run.glob("checkpoint-*.npz"), reverse=True)


def load_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint.

    Raises:
        LogDamagedError: the file is damaged, or not a checkpoint of this version.
    """
    from replay.storage.arrays import read_arrays

    try:
        arrays = read_arrays(path)
        head = json.loads(arrays.pop(_HEAD).tobytes())
        if head["schema"] != SCHEMA:
            raise LogDamagedError(f"{path}: a checkpoint of version {head['schema']}, not {SCHEMA}")
        columns = {
            name.removeprefix(_MODULES): arrays.pop(name)
            for name in list(arrays)
            if name.startswith(_MODULES)
        }
        state = LearnerState(arrays, _modules(columns), head["policy_rng"])
        at, t = int(head["iteration"]), int(head["t"])
        return Checkpoint(at, t, state, head["versions"], head.get("taken"))
    except (OSError, LookupError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise LogDamagedError(
            f"{path}: not a whole checkpoint ({one_line(error)}); remove it"
        ) from error


def _modules(columns: Mapping[str, NDArray[Any]]) -> tuple[Module, ...]:
    values: Any = {
        name: column.tolist() if name in _PLAIN else list(column)
        for name, column in columns.items()
    }
    rows = zip(*values.values(), strict=True)
    return tuple(Module(**dict(zip(values, row, strict=True))) for row in rows)


def newest_covered(run: Path, iterations: int) -> Checkpoint | None:
    """The newest readable checkpoint whose past a log of so many iterations holds.

    None starts from the beginning.
    """
    for path in checkpoints(run):
        with contextlib.suppress(LogDamagedError):
            checkpoint = load_checkpoint(path)
            if checkpoint.iteration <= iterations:
                return checkpoint
    return None


class Checkpoints(Sink):
    """Saves where a run stands, every so many iterations and at its end.

    It comes after the run's log, which must hold every iteration before a checkpoint.

    Args:
        run: the run's folder.
        source: what it learns from.
        learner: what learns.
        every: iterations between two; 0 saves one at the end only.
        flush: hands all of the log to the operating system.
        sync: lets the disk have all of it.
        fsync_every: seconds after which the disk is to have a checkpoint, too.
    """

    def __init__(
        self,
        run: Path,
        source: FrameSource,
        learner: Learner,
        every: int,
        flush: Callable[[], None],
        sync: Callable[[], None],
        fsync_every: float | None = None,
    ) -> None:
        self._run, self._source, self._learner = run, source, learner
        self._every, self._flush, self._sync = every, flush, sync
        self._fsync_every = math.inf if fsync_every is None else fsync_every
        self._synced = time.monotonic()
        self._settled: Path | None = None
        self._settling: tuple[Path, float] | None = None

    def block(self, block: Block, signals: BlockSignals, learner: Learner) -> None:
        """See `Sink`."""
        if self._every and learner.iteration % self._every == 0:
            if time.monotonic() - self._synced >= self._fsync_every:
                self._sync()
                self._save(sync=True)
                self._synced = time.monotonic()
            else:
                self._flush()
                self._save(sync=False)

    def finish(self) -> None:
        """See `Sink`."""
        self._sync()
        self._save(sync=True)

    def _save(self, *, sync: bool) -> None:
        """Save a checkpoint, and drop all but the newest and one that the disk has."""
        if self._settled is None and self._settling is None:
            self._settled = next(iter(checkpoints(self._run)), None)  # from which it was resumed
        learner, now = self._learner, time.monotonic()
        at, t, taken = learner.iteration, self._source.t, getattr(self._source, "taken", None)
        checkpoint = Checkpoint(at, t, learner.state, versions(), taken)
        path = save_checkpoint(self._run, checkpoint, sync=sync)
        if sync:
            self._settled, self._settling = path, None
        elif self._settling is None:
            self._settling = path, now
        elif now - self._settling[1] >= SETTLED_SECONDS:
            self._settled, self._settling = self._settling[0], (path, now)
        kept = {self._settled, self._settling and self._settling[0]}
        drop(p for p in checkpoints(self._run)[KEPT:] if p not in kept)


def restore(learner: Learner, checkpoint: Checkpoint) -> None:
    """Put a learner where a checkpoint of this configuration stands."""
    try:
        learner.restore(checkpoint.state)
    except (KeyError, TypeError, ValueError) as error:
        raise LogDamagedError(
            f"checkpoint at iteration {checkpoint.iteration}: {error}; remove it"
        ) from error


def log_to_resume(run: Path) -> Path:
    """The log of a run that was stopped, wherever it is."""
    from replay.runs.folders import RUN_FILE

    finished = run / RUN_FILE
    for found in (run / SET_ASIDE, partial_path(finished), finished):
        if found.is_file():
            return found
    raise UsageError(f"{run} holds no {RUN_FILE}: there is no run to resume")


def set_aside(run: Path, spec: SourceSpec, manifest: Mapping[str, Any]) -> None:
    """Move the log of a run that is to be resumed out of the way, after checking that it may.

    A log that said nothing before the run was stopped stays.

    Raises:
        UsageError: there is no run, or it was made with another configuration or source.
    """
    from replay.runs.folders import RUN_FILE

    found = log_to_resume(run)
    if found == partial_path(run / RUN_FILE) and not checkpoints(run) and not _has_header(found):
        return
    refuse_difference(run, found, spec, manifest)
    try:
        os.replace(found, run / SET_ASIDE)
    except OSError as error:
        raise LogWriteError(f"{found} cannot be set aside: {error.strerror}") from error


def _has_header(log: Path) -> bool:
    from replay.runs.log import read_header

    try:
        read_header(log)
    except (LogDamagedError, UsageError):
        return False
    return True


def refuse_difference(run: Path, log: Path, spec: SourceSpec, manifest: Mapping[str, Any]) -> None:
    """Refuse to resume with another configuration, seed or source, naming the first difference."""
    from replay.runs.log import read_header

    header = read_header(log)
    before = {
        "signals": header.schema,
        **header.manifest,
        "spec": dataclasses.asdict(header.spec),
        COMMAND: None,
    }
    now = {"signals": SCHEMA_VERSION, **manifest, "spec": dataclasses.asdict(spec), COMMAND: None}
    for key, old, new in differences(_json(before), _json(now)):
        raise UsageError(
            f"{run} was made with {key.removeprefix('config.')} = {old}, not {new}: resume with "
            "what it was made with, or choose another folder"
        )


def differences(before: Any, now: Any, key: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Where two JSON values differ: dotted key, the value before, the value now."""
    if isinstance(before, Mapping) and isinstance(now, Mapping):
        for name in sorted({*before, *now}):
            where = f"{key}.{name}" if key else name
            yield from differences(before.get(name), now.get(name), where)
    elif before != now:
        yield key, before, now


def _json(value: Any) -> Any:
    return json.loads(json.dumps(value))
