"""What a source on the command line means, and the configuration that goes with it."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cdmisfa.blocks import FrameSource, SourceSpec
from cdmisfa.config import LearnerConfig, as_table, build, load_preset, parse_settings
from cdmisfa.errors import UsageError
from recorder.config import RecordConfig, SceneConfig

SECTIONS = ("learner", "scene", "record")
"""Configuration tables that a run knows."""


@dataclass(frozen=True, slots=True)
class Configuration:
    """Everything a run or a recording was told.

    Attributes:
        learner: keys `learner.*`.
        scene: keys `scene.*`; its seed is never None.
        record: keys `record.*`.
    """

    learner: LearnerConfig
    scene: SceneConfig
    record: RecordConfig

    def tables(self) -> dict[str, Any]:
        """The world's part as plain tables, for a manifest."""
        return {"scene": as_table(self.scene), "record": as_table(self.record)}


def configure(
    kind: str, preset: str | None = None, settings: Sequence[str] = (), seed: int = 0
) -> Configuration:
    """Fill the configuration for a kind of scene.

    Args:
        kind: the scene, which also names the preset where none is given.
        preset: name of a preset or a .toml file.
        settings: `section.key=value` words; they win over the preset.
        seed: becomes `scene.seed` where that is not set.

    Raises:
        UsageError: an unknown preset, section or key, or a value that does not fit.
    """
    tables = load_preset(preset or kind)
    words = parse_settings(settings)
    for section in (*tables, *words):
        if section not in SECTIONS:
            close = difflib.get_close_matches(section, SECTIONS, n=1, cutoff=0.4)
            hint = f"did you mean {close[0]}?" if close else f"there are {', '.join(SECTIONS)}"
            raise UsageError(f"unknown section {section}: {hint}")

    def layers(section: str) -> tuple[Mapping[str, Any], ...]:
        return tables.get(section, {}), words.get(section, {})

    if words.get("scene", {}).get("kind", kind) != kind:
        raise UsageError(f"scene.kind cannot be set: the source says that it is {kind}")
    scene = build(SceneConfig, "scene", *layers("scene"), {"kind": kind})
    return Configuration(
        learner=build(LearnerConfig, "learner", *layers("learner")),
        scene=scene if scene.seed is not None else replace(scene, seed=seed),
        record=build(RecordConfig, "record", *layers("record")),
    )


def configure_scene(
    name: str, preset: str | None = None, settings: Sequence[str] = (), seed: int = 0
) -> Configuration:
    """`configure` for the name of a scene as a user wrote it.

    Raises:
        UsageError: no such scene, or as for `configure`.
    """
    from recorder.scenes import SCENES

    if name not in SCENES:
        close = difflib.get_close_matches(name, SCENES, n=1)
        hint = f"did you mean {close[0]}?" if close else f"there are {', '.join(SCENES)}"
        raise UsageError(f"no scene {name!r}: {hint}")
    return configure(name, preset, settings, seed)


def preset_for(spec: SourceSpec, described: Mapping[str, Any]) -> str:
    """The preset for a recording: that of its scene, else by what a frame is."""
    from recorder.scenes import SCENES

    scene = str(described.get("scene", ""))
    if scene in SCENES:
        return scene
    return "icub" if len(spec.frame_shape) == 2 else "oscillatory"


def open_source(
    words: Sequence[str | Path],
    *,
    preset: str | None = None,
    settings: Sequence[str] = (),
    seed: int = 0,
    loop: bool = False,
    salvage: bool = False,
) -> tuple[FrameSource, Configuration]:
    """Open a live scene by its name, or a recording by its folder or its views' files.

    Args:
        words: the name of a scene, or paths.
        preset: instead of the source's own.
        settings: `section.key=value` words.
        seed: of the scene, where `scene.seed` is not set.
        loop: start a recording again at its end.
        salvage: go on over the damaged parts of a recording.

    Raises:
        UsageError: neither a scene nor a path that exists, or a wrong configuration.
        CdmisfaError: the scene needs a simulator that is missing, or the log is damaged.
    """
    from recorder.scenes import SCENES, open_scene

    if len(words) == 1 and words[0] in SCENES:
        kind = str(words[0])
        configuration = configure(kind, preset, settings, seed)
        return open_scene(kind, configuration.scene, configuration.record), configuration
    from replay.recorded import RecordedSource

    paths = [Path(word) for word in words]
    for path in paths:
        if not path.exists():
            raise UsageError(
                f"{path}: no such file or folder, and no scene either: "
                f"the scenes are {', '.join(SCENES)}"
            )
    source = RecordedSource(paths[0] if len(paths) == 1 else paths, loop=loop, salvage=salvage)
    try:
        kind = preset_for(source.spec, source.describe())
        return source, configure(kind, preset, settings, seed)
    except BaseException:
        source.close()
        raise
