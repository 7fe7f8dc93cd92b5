"""What a run continues from: its command and its keyframes, or its parent where it is a fork."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cdmisfa.agents.learners import learner_entry, open_learner
from cdmisfa.core.blocks import SeekableSource, SourceSpec
from cdmisfa.core.config import build, parse_settings, section_table
from cdmisfa.core.errors import LogDamagedError, UsageError, one_line
from cdmisfa.core.learning import Keyframe, Learner, LearnerState
from cdmisfa.experiments.sources import configure, open_logs
from recorder.cameras.words import is_live
from recorder.config import RecordConfig
from recorder.images.options import OF_EVERY_SOURCE, InputOptions
from recorder.images.options import OPTIONS as INPUTS
from recorder.log.files import found_path, partial_path, relative_path
from recorder.world.scenes import SCENES, open_scene
from replay.runs.compare import differences
from replay.runs.folders import RUN_FILE
from replay.runs.keyframes import read_keyframe
from replay.runs.log import RunHeader, read_header
from replay.runs.provenance import comparable, stated_source

COMMAND = "command"
"""Key of a manifest: the command that began the run, which may differ when it is resumed."""

OPTIONS = (
    "seed",
    "preset",
    "settings",
    "algorithm",
    *("loop", "salvage", "episodes"),
    *INPUTS,
    "max_iterations",
    "max_modules",
)
"""Options of a command that are kept with its run."""

SET_ASIDE = "run.before.mcap.partial"
"""The log of a run that is being resumed, until the new one holds what is kept of it."""


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
        UsageError: there is no run, or it does not say.
        LogDamagedError: its log cannot be read.
    """
    log = log_to_resume(run)
    kept = read_header(log).manifest.get(COMMAND)
    if not isinstance(kept, Mapping) or not isinstance(kept.get("source"), list):
        raise UsageError(f"{run} does not say what it learns from: name its source")
    source = [str(word) for word in kept["source"]]
    options = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in kept.items()
        if name in OPTIONS
    }
    preset = options.get("preset")
    if preset is not None and str(preset).endswith(".toml"):
        options["preset"] = found_path(str(preset), run)
    return tuple(found_path(word, run) for word in source), options


def command_of_fork(
    parent: Path, source: Sequence[str], sections: Mapping[str, Any], settings: Sequence[str]
) -> tuple[tuple[str, ...], dict[str, Any]]:
    """The command of a fork: that of its parent, with the settings of both."""
    try:
        words, options = read_command(parent)
    except UsageError:
        words, options = (), {}
    world = sections.get("scene", {}).get("seed")
    kept = () if world is None else (f"scene.seed={world}",)  # the world keeps the parent's seed
    options["settings"] = (*options.get("settings", ()), *kept, *settings)
    return tuple(source) or words, options


def log_to_resume(run: Path) -> Path:
    """The log of a run that was stopped, wherever it is.

    Raises:
        UsageError: there is none.
    """
    finished = run / RUN_FILE
    for found in (run / SET_ASIDE, partial_path(finished), finished):
        if found.is_file():
            return found
    raise UsageError(
        f"{run} holds no {RUN_FILE}: there is no run to resume, begin one there with --force"
    )


def source_of(run: Path, words: Sequence[str] = ()) -> SeekableSource:
    """Open what a run learned from: as it says, or what other words name.

    Raises:
        UsageError: it does not say, or there is no such source.
    """
    named, begun = tuple[str, ...](), dict[str, Any]()
    try:
        named, begun = read_command(run)
    except UsageError:
        if not words:
            raise
    as_begun = not words or words[0] in SCENES or bool(begun.get("episodes"))
    words = tuple(words) or named
    if is_live(words[0]):
        raise UsageError(f"{words[0]} was live: name what learn --record wrote of it")
    recorded = False
    if not as_begun:
        from replay.corpus.finding import may_be_corpus  # not needed to begin a run
        from replay.inputs import is_recording

        recorded = not may_be_corpus(words) and is_recording(words)
    told = read_header(log_to_resume(run)).manifest.get("config", {})
    if words[0] not in SCENES:
        keys = told.get("input", {})
        kept = {name: begun[name] for name in INPUTS if name in begun}
        if recorded:
            kept, keys = {}, {name: keys[name] for name in OF_EVERY_SOURCE if name in keys}
        how: dict[str, Any] = {n: bool(begun.get(n)) for n in ("loop", "salvage", "episodes")}
        return open_logs(words, inputs=InputOptions(**kept).configured(keys), **how)
    if told.get("scene", {}).get("kind") != words[0]:
        return configure(words[0], seed=begun.get("seed", 0)).open_scene()
    scene = build(SCENES[words[0]].config, "scene", told["scene"])
    return open_scene(words[0], scene, build(RecordConfig, "record", told.get("record", {})))


FORK = "fork"
"""Key of a manifest: from which run and iteration a fork continues, and its settings before."""

KEPT = ("algorithm", "expansion", "tau")
"""Keys of a learner on which what it learned depends, whatever the shapes of its memory."""


def header_to_resume(run: Path) -> tuple[Path, RunHeader | None]:
    """The log of a run that was stopped, and its header; None where it was killed before that.

    Raises:
        UsageError: there is no run, or it is of another version of the signals.
        LogDamagedError: the log cannot be read.
    """
    log = log_to_resume(run)
    try:
        return log, read_header(log)
    except (LogDamagedError, UsageError):
        if log != partial_path(run / RUN_FILE):
            raise
        return log, None


def restore(learner: Learner, keyframe: Keyframe, spec: SourceSpec) -> None:
    """Put a learner into the state of a keyframe, for a source of this spec.

    Raises:
        LogDamagedError: the keyframe is of another configuration.
    """
    try:
        modules = (replace(m, frame_shape=spec.frame_shape) for m in keyframe.state.modules)
        learner.restore(replace(keyframe.state, modules=tuple(modules)))
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
    """
    keyframe = read_keyframe(log)
    if forked_at is not None and (keyframe is None or keyframe.iteration < forked_at):
        raise UsageError(f"{log.parent} was cut before its fork: fork again with --force")
    if keyframe is None:
        return None
    restore(learner, keyframe, source.spec)
    source.seek(keyframe.t)
    return keyframe


def refuse_difference(
    log: Path, header: RunHeader, spec: SourceSpec, manifest: Mapping[str, Any]
) -> None:
    """Refuse to resume with another configuration, seed or source, naming the first difference.

    Raises:
        UsageError: there is one.
    """
    source_then, source_now = comparable(stated_source(log), _json(manifest["source"]))
    before = {
        **header.manifest,
        "source": source_then,
        "spec": dataclasses.asdict(header.spec),
        COMMAND: None,
    }
    now = {
        **manifest,
        "source": source_now,
        "spec": dataclasses.asdict(spec),
        COMMAND: None,
    }
    found = differences(_json(before), _json(now))
    # another learner first: other keys and another arithmetic come of it
    for key, old, new in sorted(found, key=lambda one: one[0] != "config.learner.algorithm"):
        raise UsageError(
            f"{log.parent} was made with {key.removeprefix('config.')} = {old}, not {new}: resume "
            "with what it was made with, or choose another folder"
        )


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
        config = build(learner_entry(table["algorithm"]).configuration, "learner", table)
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
    parent: RunHeader, learner: Learner, settings: Sequence[str], seed: int | None
) -> tuple[ConfigSpan, LearnerState]:
    """The configuration of a fork, and its learner's state where it begins.

    Args:
        parent: the header of the run that it goes on from.
        learner: that run's, where it goes on.
        settings: what is set anew, as of --set.
        seed: of the random choices from there on; None the parent's.

    Raises:
        UsageError: a setting cannot change.
    """
    manifest = parent.manifest
    before = int(manifest["seed"])
    config = _config_of_fork(manifest["config"]["learner"], settings)
    seed = before if seed is None else seed
    span = ConfigSpan(learner.iteration, config, seed, reseeded=seed != before)
    try:
        return span, reconfigured(learner, span, parent.spec).state
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
    kind = learner_entry(before["algorithm"]).configuration
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
