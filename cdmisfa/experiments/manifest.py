"""How a run was begun: kept with it, so that it is resumed without being told again."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import platform
from collections.abc import Iterator, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from cdmisfa.core.blocks import SourceSpec
from cdmisfa.core.errors import UsageError
from cdmisfa.core.signals import SCHEMA_VERSION
from recorder.log.manifest import Manifest, found_path, kept_path
from recorder.log.whole import partial_path, whole
from recorder.world.scenes import SCENES

COMMAND = "command"
"""Key of a manifest: the command that began the run, which may differ when it is resumed."""

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

PACKAGES = ("cdmisfa", "numpy", "numba", "mcap", "protobuf", "rerun-sdk", "pybullet", "icub-models")

SET_ASIDE = "run.before.mcap.partial"
"""The log of a run that is being resumed, until the new one has taken over what counts."""


def command_of(source: Sequence[str], options: Mapping[str, Any], run: Path) -> dict[str, Any]:
    """The command that begins a run, as JSON values; paths are kept relative to its folder.

    Args:
        source: as on the command line.
        options: of the command; of them those in `OPTIONS` are kept.
        run: the folder.
    """
    kept = {name: options[name] for name in OPTIONS if name in options}
    preset = kept.get("preset")
    if preset is not None and preset.endswith(".toml"):
        kept["preset"] = kept_path(preset, run)
    return Manifest(tuple(source), kept).as_json(run, SCENES)


def read_command(run: Path) -> tuple[tuple[str, ...], dict[str, Any]]:
    """The command that began a run: its source and its options.

    Raises:
        UsageError: there is no run, or it does not say.
        LogDamagedError: its log cannot be read.
    """
    from replay.runs.log import read_header

    begun = Manifest.from_json(read_header(log_to_resume(run)).manifest.get(COMMAND), run)
    if begun is None:
        raise UsageError(f"{run} does not say what it learns from: name its source")
    options = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in begun.options.items()
        if name in OPTIONS
    }
    preset = options.get("preset")
    if preset is not None and str(preset).endswith(".toml"):
        options["preset"] = found_path(str(preset), run)
    return begun.source, options


def log_to_resume(run: Path) -> Path:
    """The log of a run that was stopped, wherever it is.

    Raises:
        UsageError: there is no run.
    """
    from replay.runs.folders import RUN_FILE

    finished = run / RUN_FILE
    for found in (run / SET_ASIDE, partial_path(finished), finished):
        if found.is_file():
            return found
    raise UsageError(f"{run} holds no {RUN_FILE}: there is no run to resume")


def refuse_difference(run: Path, log: Path, spec: SourceSpec, manifest: Mapping[str, Any]) -> None:
    """Refuse to resume with another configuration, seed or source, naming the first difference.

    Raises:
        UsageError: something differs.
    """
    from replay.runs.log import read_header

    header = read_header(log)
    before = {
        "signals": header.schema,
        **header.manifest,
        "spec": dataclasses.asdict(header.spec),
        COMMAND: None,
    }
    now = {"signals": SCHEMA_VERSION, **manifest, "spec": dataclasses.asdict(spec), COMMAND: None}
    for key, old, new in differences(_json(before), _json(now)):
        raise UsageError(
            f"{run} was made with {key.removeprefix('config.')} = {old}, not {new}: resume with "
            "what it was made with, or choose another folder"
        )


def differences(before: Any, now: Any, key: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Where two JSON values differ: dotted key, the value before, the value now."""
    if isinstance(before, Mapping) and isinstance(now, Mapping):
        for name in sorted({*before, *now}):
            where = f"{key}.{name}" if key else name
            yield from differences(before.get(name), now.get(name), where)
    elif before != now:
        yield key, before, now


@functools.cache
def versions() -> dict[str, str]:
    """Versions of Python and of the packages a result may depend on."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write a JSON document, whole or not at all.

    Raises:
        LogWriteError: the file cannot be written.
    """
    text = json.dumps(document, indent=2) + "\n"
    with whole(path) as partial:
        partial.write_text(text, encoding="utf-8")


def _json(value: Any) -> Any:
    return json.loads(json.dumps(value))
