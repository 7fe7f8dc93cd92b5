"""What a run continues from: the keyframes of its own log, or its parent's where it is a fork."""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cdmisfa.agents.learners import LEARNERS, open_learner
from cdmisfa.core.blocks import SourceSpec
from cdmisfa.core.config import build, differences, parse_settings, section_table
from cdmisfa.core.errors import LogDamagedError, UsageError, one_line
from cdmisfa.core.learning import ARITHMETIC, Keyframe, Learner, LearnerState
from cdmisfa.core.signals import SCHEMA_VERSION
from cdmisfa.experiments.command import COMMAND, log_to_resume
from cdmisfa.experiments.sources import CLOCK
from recorder.log.files import partial_path
from recorder.world.scenes import SCENES
from replay.runs.folders import RUN_FILE
from replay.runs.keyframes import read_keyframe
from replay.runs.log import RunHeader, read_columns, read_header
from replay.runs.run import known_to_both, stated_source

if TYPE_CHECKING:
    from cdmisfa.experiments.recompute import Recomputation

FORK = "fork"
"""Key of a manifest: from which run and iteration a fork continues, and its settings before."""

KEPT = ("algorithm", "expansion", "tau")
"""Keys of a learner on which what it learned depends, whatever the shapes of its memory."""


def header_to_resume(run: Path) -> tuple[Path, RunHeader | None]:
    """The log of a run that was stopped, and its header; None where it was killed before that.

    Raises:
        UsageError: there is no run, or it is of a later version of this software.
        LogDamagedError: the log cannot be read.
    """
    log = log_to_resume(run)
    try:
        return log, read_header(log)
    except (LogDamagedError, UsageError):
        if log != partial_path(run / RUN_FILE):
            raise
        return log, None


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


def refuse_difference(
    log: Path, header: RunHeader, spec: SourceSpec, manifest: Mapping[str, Any]
) -> None:
    """Refuse to resume with another configuration, seed or source, naming the first difference.

    Raises:
        UsageError: there is one.
    """
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
            f"{log.parent} was made with {key.removeprefix('config.')} = {old}, not {new}: resume "
            "with what it was made with, or choose another folder"
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


def continued(
    parent: Recomputation, settings: Sequence[str], seed: int | None
) -> tuple[ConfigSpan, LearnerState]:
    """The configuration of a fork, and its learner's state, where its parent was computed again.

    Raises:
        UsageError: a setting cannot change.
    """
    manifest = parent.header.manifest
    before = int(manifest["seed"])
    config = _config_of_fork(manifest["config"]["learner"], settings)
    seed = before if seed is None else seed
    span = ConfigSpan(parent.learner.iteration, config, seed, reseeded=seed != before)
    try:
        return span, reconfigured(parent.learner, span, parent.header.spec).state
    except (ValueError, UsageError) as error:
        raise UsageError(
            f"{' '.join(settings)}: what was learned does not fit it ({error}): fork with keys "
            "that keep its shape"
        ) from error


def changes(manifest: Mapping[str, Any], span: ConfigSpan) -> dict[str, list[Any]]:
    """What a fork changes of the configuration of its parent: values before and now, by key."""
    each = differences(manifest["config"]["learner"], section_table(span.config))
    changed = {f"learner.{key}": [before, now] for key, before, now in each}
    if span.reseeded:
        changed["seed"] = [int(manifest["seed"]), span.seed]
    return changed


def _config_of_fork(before: Mapping[str, Any], settings: Sequence[str]) -> Any:
    """The configuration of a fork's learner."""
    words = parse_settings(settings)
    other = next((section for section in words if section != "learner"), None)
    if other is not None:
        raise UsageError(f"{other}.* is the parent's and stays: a fork changes learner.* alone")
    kind = LEARNERS[before["algorithm"]].configuration
    config = build(kind, "learner", before, words.get("learner", {}))
    for key, old, new in differences(
        section_table(build(kind, "learner", before)), section_table(config)
    ):
        if key in KEPT:
            raise UsageError(
                f"learner.{key} is {old} and stays: what was learned depends on it, so {new} is "
                "for a run of its own"
            )
    return config
