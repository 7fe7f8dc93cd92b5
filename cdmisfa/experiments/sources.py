"""What a source on the command line means, and the configuration that goes with it."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cdmisfa.agents.learners import LEARNERS, learner_entry
from cdmisfa.core.blocks import FrameSource, SeekableSource, SourceSpec, description
from cdmisfa.core.config import LearnerConfig, build, load_preset, parse_settings, section_table
from cdmisfa.core.errors import UsageError, are_for, did_you_mean
from recorder.cameras.words import CAMERAS, is_live, open_live, refuse_stored
from recorder.config import RecordConfig, SceneConfig
from recorder.images.options import InputConfig, InputOptions
from recorder.world.scenes import SCENES, open_scene

if TYPE_CHECKING:
    from replay.corpus.logs import Told
    from replay.stored import StoredSource

OF_CAMERAS = "progress"
"""The learner of streams that are no scene of ours, nor recorded from one."""

SECTIONS = ("learner", "scene", "record", "input")
"""Configuration tables that a run knows."""

CLOCK = ("fps", "start_ns")
"""Keys of `record` that logs and cameras say themselves."""


@dataclass(frozen=True, slots=True)
class Configuration:
    """Everything a run or a recording was told.

    Attributes:
        learner: keys `learner.*`, of the class that the learner's entry names.
        scene: keys `scene.*`.
        record: keys `record.*`.
        streams: of what kind the streams are where they are no scene's: "cameras", "gym",
            "foreign"; "" of a scene.
        clock: frames a second, and log time of frame 0 in nanoseconds, where the source says
            them; None where `record` does.
        inputs: how an external log or a live stream is read; None of a live scene.
    """

    learner: Any
    scene: SceneConfig
    record: RecordConfig
    streams: str = ""
    clock: tuple[float, int] | None = None
    inputs: InputOptions | None = None

    def seeded(self, seed: int) -> Configuration:
        """The same with a seed of the scene, where it has none of its own."""
        if self.scene.seed is not None:
            return self
        return replace(self, scene=replace(self.scene, seed=seed))

    def open_scene(self) -> SeekableSource:
        """The live scene."""
        return open_scene(self.scene.kind, self.scene, self.record)

    def tables(self) -> dict[str, Any]:
        """All but the learner's part as plain tables, for a manifest."""
        scene = {"kind": self.streams} if self.streams else section_table(self.scene)
        clock = {} if self.clock is None else dict(zip(CLOCK, self.clock, strict=True))
        tables = {"scene": scene, "record": section_table(self.record) | clock}
        if self.inputs is not None and (self.streams or self.inputs.config != InputConfig()):
            tables["input"] = section_table(self.inputs.config)
        return tables


def configure(
    kind: str, preset: str | None = None, settings: Sequence[str] = (), seed: int | None = 0
) -> Configuration:
    """Fill the configuration for a live scene.

    Args:
        kind: the scene, which also names the preset where none is given and the learner that
            `settings` choose has none of its own.
        preset: name of a preset or a .toml file.
        settings: `section.key=value` words; they win over the preset.
        seed: becomes `scene.seed` where that is not set; None leaves it to `seeded`.

    Raises:
        UsageError: an unknown scene, preset, learner, section or key, or a value that misfits.
    """
    chosen = {} if preset is None else load_preset(preset)
    words = parse_settings(settings)
    if vain := [f"input.{key}" for key in words.get("input", {})]:
        raise UsageError(f"{kind} is a scene: {are_for(vain, 'logs and cameras')}")
    filled = _configure(kind, preset, chosen, words)
    return filled if seed is None else filled.seeded(seed)


def log_settings(
    settings: Sequence[str], name: str | Path | None
) -> Mapping[str, Mapping[str, str]]:
    """Settings by section, for a source that is no live scene: its world and clock are its own.

    Args:
        settings: `section.key=value` words.
        name: of the source; None lets settings of scenes pass, as the command of a fork keeps the
            seed that its parent states.

    Raises:
        UsageError: a setting is for live scenes alone.
    """
    words = parse_settings(settings)
    vain = [f"scene.{key}" for key in words.get("scene", {})]
    vain += [f"record.{key}" for key in words.get("record", {}) if key in CLOCK]
    if vain and name is not None:
        raise UsageError(f"{vain[0]} is for live scenes, and {name} is none: leave it out")
    return words


def configure_for(
    spec: SourceSpec,
    described: Mapping[str, Any],
    preset: str | None = None,
    words: Mapping[str, Mapping[str, str]] | None = None,
    seed: int | None = 0,
    inputs: InputOptions | None = None,
) -> Configuration:
    """Fill the configuration for a source that is no live scene.

    Its streams and its clock are its own. The preset is that of the scene it was recorded from,
    else of the kind of its frames; the learner of other streams is `OF_CAMERAS` where neither
    preset nor settings choose one.

    Args:
        spec: of the source.
        described: what it says of itself.
        preset: see `configure`.
        words: see `log_settings`.
        seed: see `configure`.
        inputs: how it is read.

    Raises:
        UsageError: as for `configure`.
    """
    chosen = {} if preset is None else load_preset(preset)
    kind = str(described.get("scene", ""))
    if kind not in SCENES:
        kind = str(chosen.get("scene", {}).get("kind"))
    if kind not in SCENES:
        kind = "icub" if len(spec.frame_shape) == 2 else "oscillatory"
    scene = str(described.get("scene", ""))
    streams = "" if scene in SCENES else scene or str(described["kind"])
    filled = _configure(kind, preset, chosen, words or {}, OF_CAMERAS if streams else None)
    clock = spec.fps, spec.start_ns
    filled = replace(filled, streams=streams, clock=clock, inputs=inputs or InputOptions())
    return filled if seed is None else filled.seeded(seed)


def _configure(
    kind: str,
    preset: str | None,
    chosen: Mapping[str, Mapping[str, Any]],
    words: Mapping[str, Mapping[str, str]],
    learner: str | None = None,
) -> Configuration:
    """Fill a configuration from the sections of a chosen preset and of settings."""
    algorithm = words.get("learner", {}).get("algorithm", learner if preset is None else None)
    default = learner_entry(algorithm).preset if algorithm is not None else None
    tables = chosen if preset is not None else load_preset(default or SCENES[kind].preset)
    if preset is None and algorithm is not None and algorithm not in LEARNERS:
        tables = {**tables, "learner": {}}  # a class of the user has keys of its own
    for section in (*tables, *words):
        if section not in SECTIONS:
            raise UsageError(f"unknown section {section}: {did_you_mean(section, SECTIONS)}")
    layers = {name: (tables.get(name, {}), words.get(name, {})) for name in SECTIONS}
    _refuse_other_scene(kind, preset, *layers["scene"])
    if algorithm is None:
        algorithm = str(tables.get("learner", {}).get("algorithm", LearnerConfig().algorithm))
    _refuse_keys_of_others(algorithm, words.get("learner", {}))
    _refuse_keys_of_others(algorithm, tables.get("learner", {}), preset)
    own, named = learner_entry(algorithm).configuration, {"algorithm": algorithm}
    return Configuration(
        learner=build(own, "learner", *layers["learner"], named),
        scene=build(SCENES[kind].config, "scene", *layers["scene"], {"kind": kind}),
        record=build(RecordConfig, "record", *layers["record"]),
    )


def _refuse_other_scene(
    kind: str, preset: str | None, of_preset: Mapping[str, Any], of_words: Mapping[str, Any]
) -> None:
    """Refuse a preset or a setting that names another scene."""
    if of_preset.get("kind", kind) != kind:
        raise UsageError(
            f"the preset {preset} is for the scene {of_preset['kind']}, this is {kind}: choose "
            "another preset, or leave it out"
        )
    if of_words.get("kind", kind) != kind:
        raise UsageError(f"scene.kind cannot be set: the source says that it is {kind}")


def _refuse_keys_of_others(algorithm: str, keys: Iterable[str], preset: str | None = None) -> None:
    """Refuse a key that is another learner's; `preset` sets it, or None where the user does."""
    own = {field.name for field in fields(learner_entry(algorithm).configuration)}
    for key in sorted(set(keys) - own):
        for name, entry in LEARNERS.items():
            if key in {field.name for field in fields(entry.configuration)}:
                by, it = ("", "it") if preset is None else (f"the preset {preset}: ", "that preset")
                raise UsageError(
                    f"{by}learner.{key} is of the learner {name}, and this is {algorithm}: leave "
                    f"{it} out, or choose the other with --algorithm {name}"
                )


def open_source(
    words: Sequence[str | Path],
    *,
    preset: str | None = None,
    settings: Sequence[str] = (),
    seed: int = 0,
    inputs: InputOptions | None = None,
    resumed: bool = False,
    **how: Any,
) -> tuple[SeekableSource, Configuration]:
    """Open a live scene by its name, a recording, or other people's camera logs.

    Args:
        words: the name of a scene, or those of `open_logs`.
        preset: instead of the source's own.
        settings: `section.key=value` words.
        seed: of the scene, where `scene.seed` is not set.
        inputs: see `open_logs`; keys `input.*` of the preset and of settings are added.
        resumed: the settings are those of a run that is resumed; see `log_settings`.
        how: further arguments of `open_logs`.

    Raises:
        CdmisfaError: there is no such scene, log or setting, or a log is damaged.
    """
    if is_scene(words, inputs):
        if how.get("episodes"):
            raise UsageError(f"{words[0]} is a scene: episodes are of logs, as of recordings of it")
        scene = configure(str(words[0]), preset, of_scene(settings, inputs), seed)
        return scene.open_scene(), scene
    told = log_settings(settings, None if resumed else words[0])
    inputs = read_inputs(inputs, preset, told)
    source = open_logs(words, inputs=inputs, **how)
    try:
        described = description(source, at_once=True)
        configuration = configure_for(source.spec, described, preset, told, seed, inputs)
    except BaseException:
        source.close()
        raise
    return source, configuration


def read_inputs(
    inputs: InputOptions | None, preset: str | None, words: Mapping[str, Mapping[str, str]]
) -> InputOptions:
    """Add the keys `input.*` of a preset and of settings by section to options.

    Raises:
        UsageError: there is no such preset or key, or a value does not fit.
    """
    chosen = {} if preset is None else load_preset(preset)
    inputs = inputs or InputOptions()
    return inputs.configured(chosen.get("input", {}), words.get("input", {}))


def is_scene(words: Sequence[str | Path], inputs: InputOptions | None = None) -> bool:
    """Whether words name a live scene, which no options of cameras are for but `--color`.

    Raises:
        UsageError: they do, and some are given.
    """
    if len(words) != 1 or words[0] not in SCENES:
        return False
    if inputs is not None and (given := replace(inputs, color=inputs.color == "auto").named()):
        clock = "; its rate is --set record.fps=HZ" if "--rate" in given else ""
        raise UsageError(f"{words[0]} is a scene: {are_for(given, 'cameras')}{clock}")
    return True


def of_scene(settings: Sequence[str], inputs: InputOptions | None) -> Sequence[str]:
    """The settings of a scene with what options of cameras say of it: whether it has colours."""
    return (*settings, "scene.color=true") if inputs is not None and inputs.color else settings


def open_logs(
    words: Sequence[str | Path],
    *,
    loop: bool = False,
    salvage: bool = False,
    inputs: InputOptions | None = None,
    episodes: bool = False,
    told: Told = lambda done, total: None,
    goal: tuple[str, str] = ("learn", "RUN"),
) -> SeekableSource:
    """Open a recording, other people's camera logs, or many of both as episodes.

    Args:
        words: paths, URLs or patterns: of a recording, logs of others, or an index of many.
        loop: start again at the end.
        salvage: pass over damaged parts.
        inputs: how images of others become frames; given, paths are taken as such logs.
        episodes: each path is an episode of its own; those of an index always are.
        told: how many of the episodes were opened.
        goal: see `open_log`.

    Raises:
        UsageError: no path that exists.
        LogDamagedError: the log is damaged.
    """
    inputs = inputs or InputOptions()
    if scene := next((word for word in words if word in SCENES and not Path(word).exists()), None):
        raise UsageError(f"{scene} is a scene, of which only one can be named, and nothing beside")
    from replay.corpus.finding import may_be_corpus
    from replay.inputs import locations, open_log
    from replay.storage.opening import no_such

    if live := [str(word) for word in words if is_live(str(word))]:
        raise UsageError(
            f"{live[0]} is a live stream, which cannot go back: record it first, with cdmisfa "
            f"record {shlex.join(live)} -o REC"
        )
    for path in (paths := locations(words)):
        if not path.exists():
            _, colon, address = str(path).partition(":")
            kinds = [f"{kind}:{address}" for kind in CAMERAS if colon]
            raise no_such(path, [*SCENES, *kinds], f"the scenes are {', '.join(SCENES)}")
    how: Any = {"loop": loop, "salvage": salvage}
    source: StoredSource | None = None
    if episodes or may_be_corpus(words):
        from replay.corpus.episodes import open_episodes

        source = open_episodes(words, episodes and paths, inputs, told=told, **how)
    source = source or open_log(paths, inputs, goal=goal, **how)
    source.centre_by(inputs.centre)
    return source


def open_cameras_now(
    words: Sequence[str],
    inputs: InputOptions | None = None,
    *,
    preset: str | None = None,
    settings: Sequence[str] = (),
    seed: int = 0,
    say: Callable[[str], None] = lambda line: None,
) -> tuple[FrameSource, Configuration]:
    """Open live streams, as `is_live` finds them, on one clock; see `open_live`.

    Args:
        words: a stream each.
        inputs: how their images become frames; what is of logs alone is refused.
        preset: instead of that of cameras.
        settings: `section.key=value` words.
        seed: of simulated tasks, and of the configuration.
        say: told in a line when a camera's state changes.

    Raises:
        UsageError: a word names no live stream that can be opened, or a wrong configuration.
    """
    told = log_settings(settings, words[0])
    inputs = read_inputs(inputs, preset, told)
    refuse_stored(words, inputs)
    source = open_live(words, inputs, seed=seed, say=say)
    try:
        configuration = configure_for(source.spec, source.describe(), preset, told, seed, inputs)
    except BaseException:
        source.close()
        raise
    return source, configuration
