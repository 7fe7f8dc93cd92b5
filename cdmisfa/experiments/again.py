"""How a run was begun, kept with it, so that it goes on without being told again."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cdmisfa.core.errors import UsageError
from cdmisfa.experiments.checkpoint import COMMAND, log_to_go_on_with

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
)
"""What of a command makes a run what it is, besides its source."""


def remember(source: Sequence[str], options: Mapping[str, Any], run: Path) -> dict[str, Any]:
    """How a run is begun, as JSON values; paths are kept relative to its folder.

    Args:
        source: as on the command line.
        options: of the command; of them those in `OPTIONS` are kept.
        run: the folder.
    """
    kept = {name: options[name] for name in OPTIONS if name in options}
    preset = kept.get("preset")
    if preset is not None and preset.endswith(".toml"):
        kept["preset"] = _relative(preset, run)
    return {"source": [_relative(word, run) for word in source], **kept}


def recall(run: Path) -> tuple[tuple[str, ...], dict[str, Any]]:
    """How a run was begun: its source and the options of its command.

    Raises:
        UsageError: there is no run, or it does not say.
        LogDamagedError: its log cannot be read.
    """
    from replay.runs.log import read_header

    command = read_header(log_to_go_on_with(run)).manifest.get(COMMAND)
    if not isinstance(command, dict) or not isinstance(command.get("source"), list):
        raise UsageError(f"{run} does not say what it learns from: name its source")
    options = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in command.items()
        if name in OPTIONS
    }
    preset = options.get("preset")
    if preset is not None and str(preset).endswith(".toml"):
        options["preset"] = _absolute(str(preset), run)
    return tuple(_absolute(str(word), run) for word in command["source"]), options


def _relative(word: str, run: Path) -> str:
    """A path seen from a run's folder; names of scenes and URLs stay."""
    from recorder.world.scenes import SCENES

    if word in SCENES or "://" in word:
        return word
    return os.path.join(os.curdir, os.path.relpath(word, run))


def _absolute(word: str, run: Path) -> str:
    return os.path.normpath(run / word) if word.startswith(os.curdir) else word
