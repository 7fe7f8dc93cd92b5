"""What a run is resumed from: the command that began it, and its log with its keyframes.

A keyframe is a learner's state, which stands in the log after the iterations that led to it. So a
run that was stopped anywhere is resumed from the newest keyframe that can be read.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cdmisfa.core.blocks import Block, FrameSource, SourceSpec
from cdmisfa.core.config import differences
from cdmisfa.core.errors import LogDamagedError, LogWriteError, UsageError, one_line
from cdmisfa.core.learning import ARITHMETIC, Keyframe, Learner, Sink
from cdmisfa.core.signals import SCHEMA_VERSION, BlockSignals, SignalsHash
from cdmisfa.experiments.documents import versions
from cdmisfa.experiments.sources import CLOCK
from recorder.cameras.words import is_live
from recorder.log.files import found_path, partial_path, relative_path
from recorder.world.scenes import SCENES
from replay.camera_logs.options import CameraOptions

if TYPE_CHECKING:
    from replay.runs.writer import RunWriter

COMMAND = "command"
"""Key of a manifest: the command that began the run, which may differ when it is resumed."""

FORK = "fork"
"""Key of a manifest: from which run and iteration a fork went on, and what it was told before."""

CAMERAS = tuple(field.name for field in dataclasses.fields(CameraOptions))
"""Options of a command that say how images of others become frames."""

OPTIONS = (
    "seed",
    "preset",
    "settings",
    "algorithm",
    "loop",
    "salvage",
    "follow",
    *CAMERAS,
    "max_iterations",
    "max_modules",
    "keyframes",
)
"""What of a command makes a run what it is, and where it ends, besides its source."""

SET_ASIDE = "run.before.mcap.partial"
"""The log of a run that is being resumed, until the new one has taken over what counts."""

EVERY = 100
"""Iterations between two keyframes, where nothing else is said and the log has room for them."""

SHARE = 5
"""A keyframe waits until the log has grown by so many times the size of the one before."""


def command_of(source: Sequence[str], options: Mapping[str, Any], run: Path) -> dict[str, Any]:
    """The command that begins a run, as JSON values; paths are kept relative to its folder.

    Of the options of the command those in `OPTIONS` are kept.
    """
    kept = {name: options[name] for name in OPTIONS if name in options}
    preset = kept.get("preset")
    if preset is not None and preset.endswith(".toml"):
        kept["preset"] = relative_path(preset, run)
    names = [word for word in source if word in SCENES or is_live(word)]
    words = [word if word in names else relative_path(word, run) for word in source]
    return {"source": words, **kept}


def read_command(run: Path) -> tuple[tuple[str, ...], dict[str, Any]]:
    """The command that began a run: its source and its options.

    Raises:
        UsageError: there is no run, it does not say, or its source is of a plugin that is gone.
        LogDamagedError: its log cannot be read.
    """
    from replay.runs.log import read_header

    log = log_to_resume(run)
    kept = read_header(log).manifest.get(COMMAND)
    if not isinstance(kept, Mapping) or not isinstance(kept.get("source"), list):
        raise UsageError(f"{run} does not say what it learns from: name its source")
    source = [str(word) for word in kept["source"]]
    for word in source:
        path = word.startswith(os.curdir) or "://" in word
        if not (path or word in SCENES or is_live(word)):
            raise UsageError(
                f"{run} learns from {word}, which {_packages_gone(log)} brought: install it again"
            )
    options = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in kept.items()
        if name in OPTIONS
    }
    preset = options.get("preset")
    if preset is not None and str(preset).endswith(".toml"):
        options["preset"] = found_path(str(preset), run)
    return tuple(found_path(word, run) for word in source), options


def _packages_gone(log: Path) -> str:
    """The packages of plugins that a run used and that are not installed any more."""
    from replay.runs.keyframes import read_keyframe

    keyframe = read_keyframe(log)
    used = {} if keyframe is None else keyframe.versions
    gone = [f"{name} {used[name]}" for name in sorted(used.keys() - versions().keys())]
    return f"the plugin {' or '.join(gone)}" if gone else "a plugin"


@dataclass(frozen=True, slots=True)
class Fork:
    """Where a run goes on from another one.

    Attributes:
        log: of the other run.
        keyframe: where it goes on.
        ancestry: what the manifest keeps of it: `parent`, `at`, `changed`, and as `before` what
            the parent was told.
    """

    log: Path
    keyframe: Keyframe
    ancestry: Mapping[str, Any]


class Keyframes(Sink):
    """Writes where a run stands into its log, every so many iterations and at its end.

    It comes after the log, which then holds every iteration before.

    Args:
        log: of the run.
        source: what it learns from.
        learner: what learns.
        versions: of the packages that compute it.
        every: iterations between two, 0 writes one at the end only; None for as often as
            `EVERY` iterations, where they stay below a part in `SHARE` of the log before them.
    """

    def __init__(
        self,
        log: RunWriter,
        source: FrameSource,
        learner: Learner,
        versions: Mapping[str, str],
        every: int | None = None,
    ) -> None:
        self._log, self._source, self._learner = log, source, learner
        self._versions = versions
        self._every = EVERY if every is None else every
        self._share = SHARE if every is None else 0
        self._due = 0
        self._t: int | None = None

    def block(self, block: Block, signals: BlockSignals, learner: Learner) -> None:
        """See `Sink`."""
        self._t = self._source.t
        if not self._every or learner.iteration % self._every:
            return
        self._log.flush()
        before = self._log.size
        if before < self._due:
            return
        keyframe = self._keyframe()
        if not self._due:  # the first, of which nobody knows yet how small it is compressed
            self._due = self._share * sum(a.nbytes for a in keyframe.state.arrays.values())
            if before < self._due:
                return
        self._log.keyframe(keyframe)
        self._due = self._log.size + self._share * (self._log.size - before)

    def finish(self) -> None:
        """See `Sink`."""
        self._log.keyframe(self._keyframe())
        self._log.sync()

    def _keyframe(self) -> Keyframe:
        learner, taken = self._learner, getattr(self._source, "taken", None)
        # Cameras have moved on, where they ended or were stopped within the next block.
        t = self._source.t if self._t is None else self._t
        return Keyframe(learner.iteration, t, learner.state, self._versions, taken)


def restore(learner: Learner, keyframe: Keyframe) -> None:
    """Put a learner where a keyframe of this configuration stands; of another: LogDamagedError."""
    try:
        learner.restore(keyframe.state)
    except (LookupError, TypeError, ValueError) as error:
        what = f"the keyframe after {keyframe.iteration} iterations is of another learner"
        raise LogDamagedError(f"{what} ({one_line(error)})") from error


def take_over(
    log: RunWriter, learner: Learner, source: Any, digest: SignalsHash, fork: Fork
) -> None:
    """Bring log, learner, source and digest to where a fork goes on."""
    restore(learner, fork.keyframe)
    for signals in log.take_over(fork.log, fork.keyframe.iteration):
        digest.add(signals)
    source.seek(fork.keyframe.t)
    changed = [f"{key} is {new}, was {old}" for key, (old, new) in fork.ancestry["changed"].items()]
    text = f"fork of {fork.ancestry['parent']} after {learner.iteration} iterations"
    log.event(source.t, max(learner.iteration - 1, 0), "; ".join([text, *changed]))
    log.keyframe(fork.keyframe, again=True)
    log.sync()


def go_back(log: Path, learner: Learner, source: Any, forked_at: int | None) -> Keyframe | None:
    """Bring learner and source to where the newest keyframe of a log stands; writes nothing.

    Args:
        log: of the run that is to be resumed.
        learner: of its configuration.
        source: what it learns from; a LogDamagedError where it does not show that any more.
        forked_at: the iteration from which on a fork is itself, None where it is none; a UsageError
            where it was cut before.

    Returns:
        The keyframe; None where the log has none, and all begins anew.
    """
    from replay.runs.keyframes import read_keyframe
    from replay.runs.log import read_columns

    keyframe = read_keyframe(log)
    if forked_at is not None and (keyframe is None or keyframe.iteration < forked_at):
        raise UsageError(f"{log.parent} was cut before its fork: fork again with --force")
    if keyframe is None:
        return None
    restore(learner, keyframe)
    if keyframe.taken is not None:
        records = (signals for columns in read_columns(log) for signals in columns.records())
        for signals in itertools.islice(records, keyframe.iteration):
            source.take(signals.stream, learner.tau)
        if source.taken != keyframe.taken:
            raise LogDamagedError(
                f"{log.parent}: what it learned from is not there any more: begin anew with "
                "--force, or choose another folder"
            )
    source.seek(keyframe.t)
    return keyframe


def bring_back(
    log: RunWriter, keyframe: Keyframe | None, digest: SignalsHash, versions: Mapping[str, str]
) -> None:
    """Write what a run that is resumed keeps: all until the keyframe that it went back to.

    Args:
        log: of the run; a LogWriteError where the disk does not take it.
        keyframe: see `go_back`.
        digest: of its signals, at their beginning.
        versions: of the packages that go on computing it.
    """
    before = log.path.parent / SET_ASIDE
    if not before.exists():
        return
    if keyframe is not None:
        for signals in log.take_over(before, keyframe.iteration):
            digest.add(signals)
        last = max(keyframe.iteration - 1, 0)
        log.event(keyframe.t, last, f"resumed at iteration {keyframe.iteration}")
        changed = [
            f"{name} is {now}, was {keyframe.versions.get(name)}"
            for name, now in versions.items()
            if keyframe.versions.get(name) != now
        ]
        if changed:
            log.event(keyframe.t, last, "; ".join(changed), "WARNING")
    log.sync()
    try:
        before.unlink()
    except OSError as error:
        raise LogWriteError(f"{before} cannot be removed: {error.strerror}") from error


def log_to_resume(run: Path) -> Path:
    """The log of a run that was stopped, wherever it is; a UsageError where there is none."""
    from replay.runs.folders import RUN_FILE

    finished = run / RUN_FILE
    for found in (run / SET_ASIDE, partial_path(finished), finished):
        if found.is_file():
            return found
    raise UsageError(
        f"{run} holds no {RUN_FILE}: there is no run to resume, begin one there with --force"
    )


def set_aside(
    run: Path, spec: SourceSpec, manifest: Mapping[str, Any], going_back: Callable[[Path], None]
) -> None:
    """Move the log of a run that is to be resumed out of the way, after checking that it may.

    A log that said nothing before the run was stopped stays. Where learner or source cannot go
    back to where the log stands, all stays as it is.

    Raises:
        UsageError: there is no run, or it was made with another configuration or source.
    """
    from replay.runs.folders import RUN_FILE

    found = log_to_resume(run)
    if found == partial_path(run / RUN_FILE) and not _has_header(found):
        return
    refuse_difference(run, found, spec, manifest)
    going_back(found)
    try:
        os.replace(found, run / SET_ASIDE)
    except OSError as error:
        raise LogWriteError(f"{found} cannot be set aside: {error.strerror}") from error


def ancestry_of(run: Path | None) -> Mapping[str, Any] | None:
    """Of which run a run that is to be resumed is a fork; None where it is none."""
    from replay.runs.log import read_header

    try:
        ancestry = None if run is None else read_header(log_to_resume(run)).manifest.get(FORK)
    except (LogDamagedError, UsageError):  # told where the run is resumed
        return None
    known = isinstance(ancestry, Mapping) and isinstance(ancestry.get("at"), int)
    return ancestry if known else None


def stated_whole(run: Path | None) -> bool:
    """Whether a run that is to be resumed states the SHA-256 of all of a file."""
    from replay.runs.run import stated_source, states_whole

    try:
        return run is not None and states_whole(stated_source(log_to_resume(run)))
    except (LogDamagedError, UsageError):  # told where the run is resumed
        return False


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
    from replay.runs.run import known_to_both, stated_source

    header = read_header(log)
    source_then, source_now = known_to_both(stated_source(log), _json(manifest["source"]))
    before = {
        "signals": header.schema,
        ARITHMETIC: 1,
        **header.manifest,
        "source": source_then,
        "spec": dataclasses.asdict(header.spec),
        COMMAND: None,
    }
    now = {
        "signals": SCHEMA_VERSION,
        **manifest,
        "source": source_now,
        "spec": dataclasses.asdict(spec),
        COMMAND: None,
    }
    streams = manifest["config"].get("scene", {}).get("kind")
    for key, old, new in differences(_json(before), _json(now)):
        if key == "config.learner.portable":
            continue  # begun when it had an effect
        if key.startswith("config.scene.") and streams is not None and streams not in SCENES:
            continue  # begun when every source was called a scene
        if key.removeprefix("config.record.") in CLOCK and _clock(header.spec) == _clock(spec):
            continue  # begun when a preset's clock was said of every source
        raise UsageError(
            f"{run} was made with {key.removeprefix('config.')} = {old}, not {new}: resume with "
            "what it was made with, or choose another folder"
        )


def _clock(spec: SourceSpec) -> list[Any]:
    return [getattr(spec, name) for name in CLOCK]


def _json(value: Any) -> Any:
    return json.loads(json.dumps(value))
