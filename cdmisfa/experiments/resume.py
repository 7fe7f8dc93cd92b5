"""What a run continues from: the keyframes of its own log, or its parent's where it is a fork."""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cdmisfa.agents.learners import LEARNERS, open_learner
from cdmisfa.core.blocks import SourceSpec
from cdmisfa.core.config import as_table, build, differences, parse_settings
from cdmisfa.core.errors import LogDamagedError, LogWriteError, UsageError, one_line
from cdmisfa.core.learning import ARITHMETIC, Keyframe, Learner, LearnerState
from cdmisfa.core.signals import SCHEMA_VERSION, SignalsHash
from cdmisfa.experiments.command import COMMAND, SET_ASIDE, log_to_resume, read_command
from cdmisfa.experiments.sources import CLOCK
from recorder.world.scenes import SCENES
from replay.runs.keyframes import read_keyframe
from replay.runs.log import read_columns, read_header
from replay.runs.run import known_to_both, stated_source

if TYPE_CHECKING:
    from cdmisfa.experiments.recompute import Recomputation
    from replay.runs.writer import RunWriter

FORK = "fork"
"""Key of a manifest: from which run and iteration a fork continues, and its settings before."""

KEPT = ("algorithm", "expansion", "tau")
"""Keys of a learner on which what it learned depends, whatever the shapes of its memory."""


def has_header(log: Path) -> bool:
    """Whether a log says what its run was begun with; one that was killed at once does not."""
    try:
        read_header(log)
    except (LogDamagedError, UsageError):
        return False
    return True


def restore(learner: Learner, keyframe: Keyframe) -> None:
    """Put a learner into the state of a keyframe.

    Raises:
        LogDamagedError: the keyframe is of another configuration.
    """
    try:
        learner.restore(keyframe.state)
    except (LookupError, TypeError, ValueError) as error:
        what = f"the keyframe after {keyframe.iteration} iterations is of another learner"
        raise LogDamagedError(f"{what} ({one_line(error)})") from error


def restore_from(
    log: Path, learner: Learner, source: Any, forked_at: int | None
) -> Keyframe | None:
    """Put learner and source to the newest keyframe of a log that can be read.

    Args:
        log: of the run that is to be resumed.
        learner: of its configuration.
        source: what it learns from.
        forked_at: the iteration where a fork leaves its parent's log; None where it is no fork.

    Returns:
        The keyframe; None where the log has none, and the run begins anew.

    Raises:
        UsageError: a fork was cut before the iteration where it begins.
        LogDamagedError: the source does not show any more what was learned from.
    """
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


def replay_log(
    log: RunWriter, keyframe: Keyframe | None, digest: SignalsHash, versions: Mapping[str, str]
) -> None:
    """Write what a run that is resumed keeps of its log: all until the keyframe.

    Args:
        log: of the run.
        keyframe: see `restore_from`.
        digest: of its signals, at their beginning.
        versions: of the packages that go on computing it.

    Raises:
        LogWriteError: the disk does not take it.
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


def copy_parent_log(
    log: RunWriter,
    learner: Learner,
    source: Any,
    digest: SignalsHash,
    fork: Fork,
    versions: Mapping[str, str],
) -> None:
    """Write the parent's iterations into the log of a fork; put learner and source behind them.

    Args:
        log: of the fork.
        learner: of its configuration.
        source: what it learns from.
        digest: of its signals, at their beginning.
        fork: what it continues from.
        versions: of the packages that compute it.
    """
    keyframe = Keyframe(fork.at, fork.t, fork.state, versions)
    restore(learner, keyframe)
    for signals in log.take_over(fork.log, fork.at):
        digest.add(signals)
    source.seek(fork.t)
    log.event(fork.t, max(fork.at - 1, 0), fork.text)
    log.keyframe(keyframe, again=True)
    log.sync()


def stated_before(folder: Path) -> tuple[Any, Mapping[str, Any] | None]:
    """The source of a run that is to be resumed, and its fork; None where nothing states them.

    What cannot be read is told where the run is resumed.
    """
    try:
        log = log_to_resume(folder)
        source, fork = stated_source(log), read_header(log).manifest.get(FORK)
    except (LogDamagedError, UsageError):
        return None, None
    known = isinstance(fork, Mapping) and isinstance(fork.get("at"), int)
    return source, fork if known else None


def refuse_difference(run: Path, log: Path, spec: SourceSpec, manifest: Mapping[str, Any]) -> None:
    """Refuse to resume with another configuration, seed or source, naming the first difference.

    Raises:
        UsageError: there is one.
        LogDamagedError: the log cannot be read.
    """
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


@dataclass(frozen=True, slots=True)
class ConfigSpan:
    """The configuration and seed of a run's learner from an iteration on; a fork begins one."""

    start: int
    config: Any
    seed: int
    reseeded: bool


def config_history(log: Path, manifest: Mapping[str, Any]) -> tuple[ConfigSpan, ...]:
    """The configurations of a run, in order.

    Raises:
        LogDamagedError: its manifest does not state them.
    """
    try:
        table, seed, fork = manifest["config"]["learner"], manifest["seed"], manifest.get(FORK)
        config = build(LEARNERS[table["algorithm"]].configuration, "learner", table)
        if fork is None:
            return (ConfigSpan(0, config, seed, reseeded=False),)
        before = config_history(log, fork["before"])
        reseeded = seed != before[-1].seed
        return (*before, ConfigSpan(int(fork["at"]), config, seed, reseeded))
    except (LookupError, TypeError, ValueError, RecursionError) as error:
        raise LogDamagedError(f"{log} does not say how its learner was configured") from error


def reconfigured(learner: Learner, span: ConfigSpan, spec: SourceSpec) -> Learner:
    """A learner in the state of another one, with another configuration.

    Raises:
        ValueError: what was learned does not fit the configuration.
    """
    new, state = open_learner(span.config, spec, span.seed), learner.state
    policy_rng = new.state.policy_rng if span.reseeded else state.policy_rng
    new.restore(LearnerState(state.arrays, state.modules, policy_rng))
    return new


@dataclass(frozen=True, slots=True)
class Fork:
    """Where and how a run continues another one.

    Attributes:
        log: of the parent.
        at: iterations kept of it.
        t: the source's next frame.
        state: of the learner.
        config: of the learner from there on.
        seed: of the random choices from there on.
        sections: the parent's configuration tables besides the learner's.
        words: the source, as the command of the fork names it; empty where nobody knows.
        options: of that command.
        ancestry: what the manifest states: `parent`, `at`, `changed`, and as `before` the
            configuration, seed and ancestry of the parent.
    """

    log: Path
    at: int
    t: int
    state: LearnerState
    config: Any
    seed: int
    sections: Mapping[str, Any]
    words: tuple[str, ...]
    options: Mapping[str, Any]
    ancestry: Mapping[str, Any]

    @property
    def text(self) -> str:
        """The fork in words."""
        changes = self.ancestry["changed"].items()
        changed = [f"{key} is {new}, was {old}" for key, (old, new) in changes]
        return "; ".join(
            [f"fork of {self.ancestry['parent']} after {self.at} iterations", *changed]
        )


def plan_fork(
    parent: Recomputation,
    folder: Path,
    settings: Sequence[str],
    seed: int | None,
    source: Sequence[str],
) -> Fork:
    """What is needed to continue a run where it was computed again; see `Session.fork`.

    Raises:
        UsageError: a setting cannot change.
    """
    log, at, manifest = parent.log, parent.learner.iteration, parent.header.manifest
    seed_before = int(manifest["seed"])
    seed = seed_before if seed is None else seed
    config = _config_of_fork(manifest["config"]["learner"], settings)
    span = ConfigSpan(at, config, seed, reseeded=seed != seed_before)
    try:
        state = reconfigured(parent.learner, span, parent.header.spec).state
    except (ValueError, UsageError) as error:
        raise UsageError(
            f"{' '.join(settings)}: what was learned does not fit it ({error}): fork with keys "
            "that keep its shape"
        ) from error
    changes = differences(manifest["config"]["learner"], as_table(config))
    changed = {f"learner.{key}": [old, new] for key, old, new in changes}
    if span.reseeded:
        changed["seed"] = [seed_before, seed]
    ancestry = {
        "parent": os.path.relpath(log.parent, folder),
        "at": at,
        "changed": changed,
        "before": {key: manifest[key] for key in ("config", "seed", FORK) if key in manifest},
    }
    sections = {name: table for name, table in manifest["config"].items() if name != "learner"}
    try:
        words, options = read_command(log.parent)
    except UsageError:
        words, options = (), {}
    world = sections.get("scene", {}).get("seed")
    kept = () if world is None else (f"scene.seed={world}",)  # only the learner's changes
    options |= {"settings": (*options.get("settings", ()), *kept, *settings), "seed": seed}
    return Fork(
        log, at, parent.t, state, config, seed, sections, tuple(source) or words, options, ancestry
    )


def _config_of_fork(before: Mapping[str, Any], settings: Sequence[str]) -> Any:
    """The configuration of a fork's learner."""
    words = parse_settings(settings)
    other = next((section for section in words if section != "learner"), None)
    if other is not None:
        raise UsageError(f"{other}.* is the parent's and stays: a fork changes learner.* alone")
    kind = LEARNERS[before["algorithm"]].configuration
    config = build(kind, "learner", before, words.get("learner", {}))
    for key, old, new in differences(as_table(build(kind, "learner", before)), as_table(config)):
        if key in KEPT:
            raise UsageError(
                f"learner.{key} is {old} and stays: what was learned depends on it, so {new} is "
                "for a run of its own"
            )
    return config
