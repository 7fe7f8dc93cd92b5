"""What a source on the command line means, and the configuration that goes with it."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cdmisfa.agents.learners import LEARNERS
from cdmisfa.core.blocks import FrameSource, SeekableSource, SourceSpec, description
from cdmisfa.core.config import LearnerConfig, as_table, build, load_preset, parse_settings
from cdmisfa.core.errors import UsageError, are_for
from cdmisfa.core.registry import did_you_mean
from cdmisfa.experiments.documents import versions
from recorder.config import RecordConfig, SceneConfig
from recorder.images.options import ImageOptions
from recorder.world.scenes import SCENES, scene_of
from replay.camera_logs.options import CameraOptions

if TYPE_CHECKING:
    from recorder.cameras.options import LiveOptions

OF_CAMERAS = "progress"
"""The learner of streams that are no scene of ours, nor recorded from one."""

SECTIONS = ("learner", "scene", "record")
"""Configuration tables that a run knows."""

CLOCK = ("fps", "start_ns")
"""Keys of `record` that logs and cameras say themselves."""


@dataclass(frozen=True, slots=True)
class Configuration:
    """Everything a run or a recording was told.

    Attributes:
        learner: keys `learner.*`, of the class that the learner's entry in `LEARNERS` names.
        scene: keys `scene.*`; its seed is never None.
        record: keys `record.*`.
        streams: of what kind the streams are where they are no scene's: "cameras", "gym",
            "foreign"; "" of a scene.
        clock: frames a second, and log time of frame 0 in nanoseconds, where the source says
            them; None where `record` does.
    """

    learner: Any
    scene: SceneConfig
    record: RecordConfig
    streams: str = ""
    clock: tuple[float, int] | None = None

    def open_scene(self) -> SeekableSource:
        """The live scene."""
        from recorder.world.scenes import open_scene

        return open_scene(self.scene.kind, self.scene, self.record)

    def tables(self) -> dict[str, Any]:
        """The world's part as plain tables, for a manifest."""
        scene = {"kind": self.streams} if self.streams else as_table(self.scene)
        clock = {} if self.clock is None else dict(zip(CLOCK, self.clock, strict=True))
        return {"scene": scene, "record": as_table(self.record) | clock}

    def shown_by(self, spec: SourceSpec, streams: str) -> Configuration:
        """The same of a source that is no live scene, whose streams are of a kind."""
        return replace(self, streams=streams, clock=(spec.fps, spec.start_ns))


def configure(
    kind: str,
    preset: str | None = None,
    settings: Sequence[str] = (),
    seed: int = 0,
    *,
    learner: str | None = None,
) -> Configuration:
    """Fill the configuration for a kind of scene.

    Args:
        kind: the scene, which also names the preset where none is given and the learner that
            `settings` choose has none of its own.
        preset: name of a preset or a .toml file.
        settings: `section.key=value` words; they win over the preset.
        seed: becomes `scene.seed` where that is not set.
        learner: the learner where neither `preset` nor `settings` choose one; by default that of
            the scene's preset.

    Raises:
        UsageError: an unknown scene, preset, learner, section or key, or a value that misfits.
    """
    words = parse_settings(settings)
    algorithm = words.get("learner", {}).get("algorithm", learner if preset is None else None)
    own = LEARNERS[algorithm].preset if algorithm is not None else None
    tables = load_preset(preset or own or SCENES[kind].preset)
    for section in (*tables, *words):
        if section not in SECTIONS:
            raise UsageError(f"unknown section {section}: {did_you_mean(section, SECTIONS)}")

    layers: dict[str, tuple[Mapping[str, Any], ...]] = {
        name: (tables.get(name, {}), words.get(name, {})) for name in SECTIONS
    }
    of_preset, of_words = layers["scene"]
    if of_preset.get("kind", kind) != kind:
        raise UsageError(
            f"the preset {preset} is for the scene {of_preset['kind']}, this is {kind}: choose "
            "another preset, or leave it out"
        )
    if of_words.get("kind", kind) != kind:
        raise UsageError(f"scene.kind cannot be set: the source says that it is {kind}")
    known = {name: [f.name for f in fields(entry.config)] for name, entry in SCENES.items()}
    for key in (*of_preset, *of_words):
        name = key.partition(".")[0]
        if name not in known[kind] and any(name in others for others in known.values()):
            raise UsageError(
                f"scene.{key} means nothing to the scene {kind}, which has "
                f"{', '.join(f'scene.{own}' for own in known[kind])}"
            )
    if algorithm is None:
        algorithm = str(tables.get("learner", {}).get("algorithm", LearnerConfig().algorithm))
    layers["learner"] = (*layers["learner"], {"algorithm": algorithm})
    _refuse_keys_of_others(algorithm, words.get("learner", {}))
    _refuse_keys_of_others(algorithm, tables.get("learner", {}), preset)
    scene = build(SCENES[kind].config, "scene", *layers["scene"], {"kind": kind})
    return Configuration(
        learner=build(LEARNERS[algorithm].configuration, "learner", *layers["learner"]),
        scene=scene if scene.seed is not None else replace(scene, seed=seed),
        record=build(RecordConfig, "record", *layers["record"]),
    )


def _refuse_keys_of_others(algorithm: str, keys: Iterable[str], preset: str | None = None) -> None:
    """Say so where a key is not this learner's but another's.

    Args:
        algorithm: name of the learner.
        keys: of its configuration.
        preset: that sets them; None where the user does.
    """
    own = {field.name for field in fields(LEARNERS[algorithm].configuration)}
    for key in sorted(set(keys) - own):
        for name, entry in LEARNERS.items():
            if key in {field.name for field in fields(entry.configuration)}:
                by, it = ("", "it") if preset is None else (f"the preset {preset}: ", "that preset")
                raise UsageError(
                    f"{by}learner.{key} is of the learner {name}, and this is {algorithm}: leave "
                    f"{it} out, or choose the other with --algorithm {name}"
                )


def refuse_keys_of_scenes(settings: Sequence[str], source: str | Path) -> None:
    """Refuse what would be set in vain: what is no live scene has a world and a clock of its own.

    A run that is resumed may have been told so: as a fork, to keep the seed that its parent states.

    Args:
        settings: `section.key=value` words.
        source: the first word that names it.

    Raises:
        UsageError: one of them is about either, and the source is no scene.
    """
    if source in SCENES:
        return
    words = parse_settings(settings)
    vain = [f"scene.{key}" for key in words.get("scene", {})]
    vain += [f"record.{key}" for key in words.get("record", {}) if key in CLOCK]
    if vain:
        raise UsageError(f"{vain[0]} is for live scenes, and {source} is none: leave it out")


def versions_used(
    config: Any, source: FrameSource, described: Mapping[str, Any] | None = None
) -> dict[str, str]:
    """Versions of the packages that a run depends on, those of its plugins, too.

    Args:
        config: of the learner.
        source: what it learns from.
        described: what the source says of itself, where it may be of cameras.
    """
    from recorder.cameras.words import PACKAGES

    scene = scene_of(source)
    return {
        **versions(),
        **LEARNERS.versions(config.algorithm),
        **(SCENES.versions(scene.name) if scene is not None else {}),
        **(described or {}).get(PACKAGES, {}),
    }


def scene_kind_for(
    spec: SourceSpec, described: Mapping[str, Any], preset: str | None = None
) -> str:
    """The kind of scene, and so the preset, for a recording: that of its scene.

    What shows another scene takes the kind of the `preset` chosen, else by what a frame is.
    """
    scene = str(described.get("scene", ""))
    if scene in SCENES:
        return scene
    chosen = load_preset(preset).get("scene", {}).get("kind") if preset is not None else None
    if chosen in SCENES:
        return str(chosen)
    return "icub" if len(spec.frame_shape) == 2 else "oscillatory"


def streams_of(described: Mapping[str, Any]) -> str:
    """Of what kind a source's streams are where they are no scene's; "" of a scene."""
    scene = str(described.get("scene", ""))
    return "" if scene in SCENES else scene or str(described["kind"])


def learner_of(streams: str) -> str | None:
    """The learner of what `streams_of` says where nobody chooses one; None for the preset's."""
    return OF_CAMERAS if streams else None


def open_source(
    words: Sequence[str | Path],
    *,
    preset: str | None = None,
    settings: Sequence[str] = (),
    seed: int = 0,
    loop: bool = False,
    salvage: bool = False,
    cameras: CameraOptions | None = None,
    follow: float | None = None,
) -> tuple[SeekableSource, Configuration]:
    """Open a live scene by its name, a recording, or other people's camera logs.

    Args:
        words: the name of a scene, or paths or URLs: the folder of a recording or its views'
            files, or camera logs of others, or patterns of their names.
        preset: instead of the source's own.
        settings: `section.key=value` words.
        seed: of the scene, where `scene.seed` is not set.
        loop: start a recording again at its end.
        salvage: pass over the damaged parts of a recording.
        cameras: how images of others become frames; given, the paths are taken as such logs.
        follow: wait so many seconds for more frames of a recording that is being written.

    Raises:
        UsageError: neither a scene nor a path that exists, or a wrong configuration.
        CdmisfaError: the scene needs a simulator that is missing, or the log is damaged.
    """
    if follow is None and is_scene(words, cameras):
        kind = str(words[0])
        configuration = configure(kind, preset, settings, seed)
        return configuration.open_scene(), configuration
    source = open_logs(words, loop=loop, salvage=salvage, cameras=cameras, follow=follow)
    try:
        described = description(source, at_once=True)
        kind = scene_kind_for(source.spec, described, preset)
        streams = streams_of(described)
        configuration = configure(kind, preset, settings, seed, learner=learner_of(streams))
        return source, configuration.shown_by(source.spec, streams)
    except BaseException:
        source.close()
        raise


def is_scene(words: Sequence[str | Path], cameras: ImageOptions | None = None) -> bool:
    """Whether words name a live scene, which no options of cameras are for.

    Raises:
        UsageError: they do, and some are given.
    """
    if len(words) != 1 or words[0] not in SCENES:
        return False
    if cameras is not None and (given := cameras.given()):
        clock = "; its rate is --set record.fps=HZ" if "--rate" in given else ""
        raise UsageError(f"{words[0]} is a scene: {are_for(given, 'cameras')}{clock}")
    return True


def open_logs(
    words: Sequence[str | Path],
    *,
    loop: bool = False,
    salvage: bool = False,
    cameras: CameraOptions | None = None,
    follow: float | None = None,
    goal: tuple[str, str] = ("learn", "RUN"),
) -> SeekableSource:
    """Open a recording, or other people's camera logs, as `open_source`, without a configuration.

    Args:
        words: see `open_source`, as are the next ones.
        loop: see there.
        salvage: see there.
        cameras: see there.
        follow: see there.
        goal: see `open_log`.

    Raises:
        UsageError: no path that exists.
        LogDamagedError: the log is damaged.
    """
    cameras = cameras or CameraOptions()
    if follow is not None and (
        len(words) > 1 or words[0] in SCENES or loop or salvage or cameras != CameraOptions()
    ):
        raise UsageError("--follow takes the folder of one recording, and neither loops nor skips")
    scene = next((word for word in words if word in SCENES), None)
    if scene is not None and not Path(scene).exists():
        raise UsageError(f"{scene} is a scene, of which only one can be named, and nothing beside")
    from recorder.cameras.words import is_live
    from replay.inputs import open_log, places
    from replay.storage.location import Url

    if live := [str(word) for word in words if is_live(str(word))]:
        raise UsageError(
            f"{live[0]} is a live stream, which cannot go back: record it first, with cdmisfa "
            f"record {shlex.join(live)} -o REC"
        )
    paths = places(words)
    for path in paths:
        if not isinstance(path, Url) and not path.exists() and follow is None:
            raise UsageError(
                f"{path}: no such file or folder, and no scene either: "
                f"the scenes are {', '.join(SCENES)}"
            )
    if follow is None:
        return open_log(paths, cameras, loop=loop, salvage=salvage, goal=goal)
    from replay.recordings.followed import FollowedSource

    if isinstance(paths[0], Url):
        raise UsageError(f"{paths[0]}: only the folder of a recording can be followed")
    return FollowedSource(paths[0], timeout=follow)


def open_cameras_now(
    words: Sequence[str | Path],
    live: LiveOptions,
    *,
    cameras: ImageOptions,
    preset: str | None = None,
    settings: Sequence[str] = (),
    say: Callable[[str], None] = lambda line: None,
    stop: Callable[[], bool] = lambda: False,
) -> tuple[FrameSource, Configuration]:
    """Open live streams, as `is_live` finds them, on one clock; see `open_live`.

    Args:
        words: a stream each.
        live: how they become frames; its seed is also that of the configuration.
        cameras: how their images become frames; what is of logs alone is refused.
        preset: instead of that of cameras.
        settings: `section.key=value` words.
        say: told in a line when a camera's state changes.
        stop: asked while waiting for the first pictures.

    Raises:
        UsageError: a word names no live stream or one that cannot be opened, or a wrong
            configuration.
    """
    from recorder.cameras.words import is_live, open_live

    stored = [str(word) for word in words if not is_live(str(word))]
    if stored:
        raise UsageError(
            f"{stored[0]} is no live stream, as the others are: record these, and name recordings "
            "and logs apart"
        )
    framing = {field.name: getattr(cameras, field.name) for field in fields(ImageOptions)}
    theirs = ImageOptions(**framing).given()
    if of_logs := [option for option in cameras.given() if option not in theirs]:
        raise UsageError(f"{words[0]} is a live stream: {are_for(of_logs, 'logs')}")
    live = replace(live, **framing)
    source = open_live([str(word) for word in words], live, say=say, stop=stop)
    try:
        described = source.describe()
        kind = scene_kind_for(source.spec, described, preset)
        configuration = configure(kind, preset, settings, live.seed, learner=OF_CAMERAS)
        return source, configuration.shown_by(source.spec, streams_of(described))
    except BaseException:
        source.close()
        raise
