"""The command that began a run, kept with it: to resume the run, and to open its source again."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cdmisfa.core.blocks import SeekableSource
from cdmisfa.core.errors import UsageError
from cdmisfa.experiments.documents import versions
from cdmisfa.experiments.sources import open_logs, open_source
from recorder.cameras.words import is_live
from recorder.log.files import found_path, partial_path, relative_path
from recorder.world.scenes import SCENES
from replay.camera_logs.options import CameraOptions
from replay.recordings.source import RecordedSource
from replay.recordings.view_file import NoRecordingError
from replay.runs.folders import RUN_FILE
from replay.runs.keyframes import read_keyframe
from replay.runs.log import read_header
from replay.storage.location import location

COMMAND = "command"
"""Key of a manifest: the command that began the run, which may differ when it is resumed."""

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
        UsageError: there is no run, it does not say, or its source is of a plugin that is gone.
        LogDamagedError: its log cannot be read.
    """
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


def command_of_fork(
    parent: Path, source: Sequence[str], sections: Mapping[str, Any], settings: Sequence[str]
) -> tuple[tuple[str, ...], dict[str, Any]]:
    """The command of a fork: that of its parent, with the settings of both."""
    try:
        words, options = read_command(parent)
    except UsageError:
        words, options = (), {}
    world = sections.get("scene", {}).get("seed")
    kept = () if world is None else (f"scene.seed={world}",)  # only the learner's changes
    options["settings"] = (*options.get("settings", ()), *kept, *settings)
    return tuple(source) or words, options


def _packages_gone(log: Path) -> str:
    """The packages of plugins that a run used and that are not installed any more."""
    keyframe = read_keyframe(log)
    used = {} if keyframe is None else keyframe.versions
    gone = [f"{name} {used[name]}" for name in sorted(used.keys() - versions().keys())]
    return f"the plugin {' or '.join(gone)}" if gone else "a plugin"


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
    as_begun = not words or words[0] in SCENES
    words = tuple(words) or named
    if is_live(words[0]):
        raise UsageError(f"{words[0]} was live: name what learn --record wrote of it")
    kept = () if not as_begun and _is_recording(words) else CAMERAS
    cameras = CameraOptions(**{name: begun[name] for name in kept if name in begun})
    if words[0] not in SCENES:
        loop, salvage = bool(begun.get("loop")), bool(begun.get("salvage"))
        return open_logs(words, loop=loop, salvage=salvage, cameras=cameras)
    settings = list(begun.get("settings", ()))
    if begun.get("algorithm"):
        settings.append(f"learner.algorithm={begun['algorithm']}")
    preset, seed = begun.get("preset"), begun.get("seed", 0)
    return open_source(words, preset=preset, settings=settings, seed=seed, cameras=cameras)[0]


def _is_recording(words: Sequence[str]) -> bool:
    try:
        RecordedSource([location(word) for word in words]).close()
    except NoRecordingError:
        return False
    return True
