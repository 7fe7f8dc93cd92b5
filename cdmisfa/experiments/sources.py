"""Sources that a command names, and the configuration for each."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cdmisfa.agents.learners import LEARNERS, learner_class
from cdmisfa.core.blocks import FrameSource, SeekableSource, SourceSpec, description
from cdmisfa.core.config import LearnerConfig, build, load_preset, parse_settings, section_table
from cdmisfa.core.errors import UsageError, are_for, did_you_mean
from recorder.cameras.words import CAMERAS, is_live, open_live
from recorder.config import RecordConfig, SceneConfig
from recorder.images.options import InputConfig, InputOptions
from recorder.world.scenes import SCENES, open_scene

if TYPE_CHECKING:
    from replay.corpus.episode_source import Progress
    from replay.stored_source import StoredSource

# Learner of all streams that are not of a scene, nor recorded from one.
CAMERA_LEARNER = "progress"

# Default number of passes of the progress learner over a log. Set by hand: it repeats a log of
# 1,500 frames for 750 blocks, and most streams are decided within 200.
PASSES = 20

# Sections of the configuration of a run.
SECTIONS = ("learner", "scene", "record", "input")

# Keys of `record` that logs and cameras state themselves.
CLOCK = ("fps", "start_ns")


@dataclass(frozen=True, slots=True)
class Configuration:
    """Configuration of a run or a recording.

    Attributes:
        learner: keys `learner.*`, in the learner's own dataclass.
        scene: keys `scene.*`.
        record: keys `record.*`.
        streams: kind of streams that are not of a scene: "cameras", "gym", "foreign"; else "".
        clock: frames a second, and log time of frame 0 (ns), if the source states them; None if
            `record` does.
        inputs: how an external log or a live stream is read; None for a live scene.
    """

    learner: Any
    scene: SceneConfig
    record: RecordConfig
    streams: str = ""
    clock: tuple[float, int] | None = None
    inputs: InputOptions | None = None

    def seeded(self, seed: int | None) -> Configuration:
        """Return the configuration with a seed for the scene, if it has none yet."""
        if self.scene.seed is not None or seed is None:
            return self
        return replace(self, scene=replace(self.scene, seed=seed))

    def open_scene(self) -> SeekableSource:
        """Open the live scene."""
        return open_scene(self.scene.kind, self.scene, self.record)

    def tables(self) -> dict[str, Any]:
        """Return all sections but the learner's as plain tables, for a manifest."""
        scene = {"kind": self.streams} if self.streams else section_table(self.scene)
        clock = {} if self.clock is None else dict(zip(CLOCK, self.clock, strict=True))
        tables = {"scene": scene, "record": section_table(self.record) | clock}
        if self.inputs is not None and (self.streams or self.inputs.config != InputConfig()):
            tables["input"] = section_table(self.inputs.config)
        return tables


@dataclass(frozen=True, slots=True)
class Layers:
    """Values of a preset and of `--set` words, by section and key.

    Attributes:
        preset: sections of the preset; None if no preset was named.
        words: sections of the words, which override the preset.
    """

    preset: Mapping[str, Mapping[str, Any]] | None = None
    words: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @classmethod
    def read(cls, preset: str | None = None, words: Sequence[str] = ()) -> Layers:
        """Read a preset, by name or from a .toml file, and `section.key=value` words.

        Raises:
            UsageError: see `load_preset` and `parse_settings`.
        """
        return cls(None if preset is None else load_preset(preset), parse_settings(words))

    def section(self, name: str) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
        """Return the values of a section for `build`: those of the preset, then the words."""
        return (self.preset or {}).get(name, {}), self.words.get(name, {})


NO_LAYERS = Layers()


def is_scene(words: Sequence[str | Path]) -> bool:
    """Return whether words name a live scene."""
    return len(words) == 1 and words[0] in SCENES


def configure(
    kind: str,
    settings: Layers = NO_LAYERS,
    seed: int | None = 0,
    inputs: InputOptions | None = None,
) -> Configuration:
    """Fill the configuration for a live scene.

    Args:
        kind: name of the scene. Its preset is used if none is named and the learner has none.
        settings: preset and words.
        seed: value of `scene.seed` if that is not set; None leaves it to `seeded`.
        inputs: options of the command line; a scene takes only `--color`.

    Raises:
        UsageError: a scene, preset, learner, section or key is unknown, or a value does not fit.
    """
    misplaced = [f"input.{key}" for key in settings.words.get("input", {})]
    if inputs is not None:
        misplaced += replace(inputs, color=inputs.color == "auto").named()
        if inputs.color:
            scene = {**settings.words.get("scene", {}), "color": "true"}
            settings = replace(settings, words={**settings.words, "scene": scene})
    if misplaced:
        clock = "; set its rate with --set record.fps=HZ" if "--rate" in misplaced else ""
        raise UsageError(f"{kind} is a scene: {are_for(misplaced, 'logs and cameras')}{clock}")
    return _filled(kind, settings, None).seeded(seed)


def configure_for(
    spec: SourceSpec,
    described: Mapping[str, Any],
    settings: Layers = NO_LAYERS,
    seed: int | None = 0,
    inputs: InputOptions | None = None,
    *,
    resumed: bool = False,
) -> Configuration:
    """Fill the configuration for a source that is not a live scene.

    The source states its own streams and clock. The preset is that of the scene from which the
    source was recorded, or else of the kind of its frames. If neither preset nor settings choose a
    learner, streams of no scene get `CAMERA_LEARNER`.

    Args:
        spec: properties of the source.
        described: identity of the source, see `FrameSource.describe`.
        settings: see `configure`.
        seed: see `configure`.
        inputs: how the source is read.
        resumed: True to accept keys of live scenes, which the command of a resumed run can have.

    Raises:
        UsageError: as for `configure`, or a key of live scenes is set.
    """
    misplaced = [f"scene.{key}" for key in settings.words.get("scene", {})]
    misplaced += [f"record.{key}" for key in settings.words.get("record", {}) if key in CLOCK]
    if misplaced and not resumed:
        raise UsageError(f"{are_for(misplaced, 'live scenes')}, and this source is not one")
    if inputs is not None and inputs.fields and spec.images:
        raise UsageError(f"{', '.join(spec.streams)} has no numbers: leave out --field")
    if inputs is not None and inputs.range and any(len(shape) > 1 for shape, _ in spec.kinds):
        raise UsageError("input.range is for images or for numbers, not for both: leave it out")
    scene = str(described.get("scene", ""))
    kind = scene if scene in SCENES else str(settings.section("scene")[0].get("kind"))
    if kind not in SCENES:
        kind = "icub" if len(spec.frame_shape) == 2 else "oscillatory"
    streams = "" if scene in SCENES else scene or str(described["kind"])
    filled = _filled(kind, settings, CAMERA_LEARNER if streams else None)
    clock = spec.fps, spec.start_ns
    filled = replace(filled, streams=streams, clock=clock, inputs=inputs or InputOptions())
    return filled.seeded(seed)


def _filled(kind: str, settings: Layers, default: str | None) -> Configuration:
    """Fill all sections from the preset (named, or of the learner or the scene) and the words."""
    algorithm = settings.words.get("learner", {}).get("algorithm")
    tables = settings.preset
    if tables is None:
        algorithm = algorithm or default
        own = getattr(learner_class(algorithm), "preset", None) if algorithm else None
        tables = load_preset(own or kind)
        if algorithm and algorithm not in LEARNERS:
            tables["learner"] = {}  # a user's learner has other keys than the preset
        settings = replace(settings, preset=tables)
    for section in (*tables, *settings.words):
        if section not in SECTIONS:
            raise UsageError(f"unknown section {section}: {did_you_mean(section, SECTIONS)}")
    algorithm = algorithm or tables.get("learner", {}).get("algorithm") or LearnerConfig().algorithm
    keys = learner_class(algorithm).configuration
    return Configuration(
        learner=build(keys, "learner", *settings.section("learner"), {"algorithm": algorithm}),
        scene=build(SCENES[kind].config, "scene", *settings.section("scene")),
        record=build(RecordConfig, "record", *settings.section("record")),
    )


def read_inputs(inputs: InputOptions | None, settings: Layers) -> InputOptions:
    """Return input options with the keys `input.*` of settings.

    Raises:
        UsageError: a key does not exist, or a value does not fit.
    """
    return (inputs or InputOptions()).configured(*settings.section("input"))


def open_source(
    words: Sequence[str | Path],
    *,
    preset: str | None = None,
    settings: Sequence[str] = (),
    seed: int = 0,
    inputs: InputOptions | None = None,
    resumed: bool = False,
    say: Callable[[str], None] = lambda line: None,
    **log_options: Any,
) -> tuple[Any, Configuration]:
    """Open a live scene by its name, live streams, a recording, or external logs.

    Args:
        words: name of a scene, live streams as `is_live` recognises them, or those of `open_logs`.
        preset: preset to use instead of the source's own.
        settings: `section.key=value` words.
        seed: seed of the scene, if `scene.seed` is not set, and of simulated tasks.
        inputs: see `open_logs`; the keys `input.*` of preset and settings are added.
        resumed: True if the settings are those of a resumed run; see `configure_for`.
        say: called with a line when the state of a camera changes.
        log_options: further arguments of `open_logs`.

    Returns:
        The source, which can go back unless it is live, and the configuration.

    Raises:
        CdmisfaError: the source or a setting does not exist, or a log is damaged.
    """
    layers = Layers.read(preset, settings)
    live = all(is_live(str(word)) for word in words)
    if is_scene(words):
        scene = configure(str(words[0]), layers, seed, inputs)
        return scene.open_scene(), scene
    inputs = read_inputs(inputs, layers)
    source: FrameSource
    if live:
        source = open_live(list(map(str, words)), inputs, seed=seed, say=say)
    else:
        source = open_logs(words, inputs=inputs, **log_options)
    try:
        described = description(source, at_once=True)
        chosen = layers, seed, inputs
        return source, configure_for(source.spec, described, *chosen, resumed=resumed)
    except BaseException:
        source.close()
        raise


def open_logs(
    words: Sequence[str | Path],
    *,
    loop: bool = False,
    skip_damaged: bool = False,
    inputs: InputOptions | None = None,
    episodes: bool = False,
    progress: Progress = lambda done, total: None,
) -> SeekableSource:
    """Open a recording, external logs, or many of both as episodes.

    Args:
        words: paths, URLs or patterns of a recording, of external logs, or of an index of logs.
        loop: True to start again at the end.
        skip_damaged: True to skip damaged parts.
        inputs: how images become frames; if set, the paths are read as external logs.
        episodes: True if each path is an episode; logs of an index always are.
        progress: called with the number of opened episodes and the total.

    Raises:
        UsageError: a path does not exist.
        LogDamagedError: a log is damaged.
    """
    from replay.integrity.listing import may_be_corpus
    from replay.open_sources import locations, open_log
    from replay.storage.paths import no_such

    inputs = inputs or InputOptions()
    if live := [str(word) for word in words if is_live(str(word))]:
        raise UsageError(
            f"{live[0]} is a live stream, which cannot go back: record it first with cdmisfa "
            f"record {shlex.join(live)} -o REC"
        )
    for path in (paths := locations(words)):
        if not path.exists():
            _, colon, address = str(path).partition(":")
            known = [*SCENES, *(f"{kind}:{address}" for kind in CAMERAS if colon)]
            if str(path) in SCENES:
                raise no_such(path, [], "a scene must be the only source")
            raise no_such(path, known, f"scenes are {' and '.join(SCENES)}")
    options: Any = {"loop": loop, "skip_damaged": skip_damaged}
    source: StoredSource | None = None
    if episodes or may_be_corpus(words):
        from replay.corpus.episode_source import EpisodeSource
        from replay.corpus.index import logs_of_corpus

        if logs := logs_of_corpus(words) or ([[path] for path in paths] if episodes else None):
            source = EpisodeSource(logs, inputs, progress=progress, **options)
    source = source or open_log(paths, inputs, **options)
    source.centre = inputs.centre
    return source
