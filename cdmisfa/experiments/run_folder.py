"""Folder of a run: the command that started it, its log, and the files written at its end."""

from __future__ import annotations

import contextlib
import os
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from cdmisfa.core.blocks import FrameSource, SeekableSource
from cdmisfa.core.config import build
from cdmisfa.core.errors import CdmisfaError, UsageError
from cdmisfa.core.learning import ARITHMETIC
from cdmisfa.core.outcomes import EXHAUSTED
from cdmisfa.core.signals import SCHEMA_VERSION
from cdmisfa.experiments.documents import machine, plain, write_json
from cdmisfa.experiments.sources import PASSES, open_logs
from cdmisfa.modules import Module
from recorder.cameras.words import is_live
from recorder.config import RecordConfig
from recorder.images.framing import Recipe
from recorder.images.options import COMMON_KEYS, InputOptions
from recorder.images.options import OPTIONS as INPUTS
from recorder.log.files import (
    locked_folder,
    logs_in,
    make_folder,
    partial_path,
    refuse_existing,
    refuse_special,
    relative_path,
    resolved_path,
    writing,
)
from recorder.world.scenes import SCENES, open_scene
from replay.runs.folders import MODULES_FILE, REPORT_FILE, RUN_FILE, RUN_JSON, VIEW_FILE
from replay.runs.log import read_header
from replay.runs.modules import save_modules
from replay.runs.provenance import final_record
from replay.runs.writer import RunWriter
from replay.stored_source import StoredSource

# Key of a manifest: the command that started the run. It may differ when the run is resumed.
COMMAND = "command"

# Key of a manifest: the run and iteration that a fork continues, and the settings before it.
FORK = "fork"

# Options of a command that determine how logs are opened.
OPENING = ("loop", "skip_damaged", "episodes")

# Options of a command that are stored with its run.
OPTIONS = (
    *("seed", "preset", "settings", "algorithm"),
    *OPENING,
    "passes",
    *INPUTS,
    *("max_iterations", "max_modules"),
)

# Name of the earlier log while a run is being resumed, until the new log has its iterations.
SET_ASIDE = "run.before.mcap.partial"


def command_of(source: Sequence[str], options: Mapping[str, Any], run: Path) -> dict[str, Any]:
    """Return the command that starts a run as JSON values, with paths relative to its folder.

    Args:
        source: the words of the source.
        options: options of the command; those in `OPTIONS` are stored.
        run: folder of the run.
    """
    stored = {name: options[name] for name in OPTIONS if name in options}
    if str(stored.get("preset")).endswith(".toml"):
        stored["preset"] = relative_path(stored["preset"], run)
    names = [word for word in source if word in SCENES or is_live(word)]
    words = [word if word in names else relative_path(word, run) for word in source]
    return {"source": words, **stored}


def read_command(run: Path) -> tuple[tuple[str, ...], dict[str, Any]]:
    """Return the words of the source, and the options, of the command that started a run.

    Raises:
        UsageError: the run does not exist, or does not state its command.
        LogDamagedError: the log cannot be read.
    """
    command = read_header(log_to_resume(run)).manifest.get(COMMAND)
    if not isinstance(command, Mapping) or not isinstance(command.get("source"), list):
        raise UsageError(f"{run} does not state its source: name the source")
    options = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in command.items()
        if name in OPTIONS
    }
    if str(options.get("preset")).endswith(".toml"):
        options["preset"] = resolved_path(str(options["preset"]), run)
    return tuple(resolved_path(str(word), run) for word in command["source"]), options


def command_again(run: Path) -> str:
    """Return the shell command that starts a run again; "" if the run does not state it."""
    try:
        source, options = read_command(run)
    except CdmisfaError:
        return ""
    return shlex.join(["cdmisfa", "learn", *source, *words_of(options), "-o", "RUN"])


def words_of(options: Mapping[str, Any]) -> list[str]:
    """Return the words of a command line for the options of `command_of` that are not off."""
    words: list[str] = []
    flags = {"settings": "--set", **INPUTS}
    for name, value in options.items():
        flag = flags.get(name, f"--{name.replace('_', '-')}")
        if name == "size" and value:
            value = f"{value[1]}x{value[0]}"
        elif name == "color" and value is True:
            value = "on"
        values = value if isinstance(value, tuple) else (value,)
        for part in filter(None, values):
            text = f"{part:g}" if isinstance(part, float) else str(part)
            words += [flag] if part is True else [flag, text]
    return words


def log_to_resume(run: Path) -> Path:
    """Return the log of a run, finished or not.

    Raises:
        UsageError: the folder has no log.
    """
    finished = run / RUN_FILE
    for log in (run / SET_ASIDE, partial_path(finished), finished):
        if log.is_file():
            return log
    command = f"cdmisfa learn SOURCE -o {run}{' --force' if run.exists() else ''}"
    raise UsageError(f"{run}: there is no run to resume: start one with {command}")


def open_source_of(run: Path, words: Sequence[str] = ()) -> SeekableSource:
    """Open the source that the command of a run states, or the source that words name.

    Raises:
        UsageError: the run does not state its source, or the source does not exist.
    """
    stated, options = tuple[str, ...](), dict[str, Any]()
    try:
        stated, options = read_command(run)
    except UsageError:
        if not words:
            raise
    config = read_header(log_to_resume(run)).manifest.get("config", {})
    first, *_ = words = tuple(words) or stated
    if first in SCENES:
        scene = config.get("scene", {})
        if scene.get("kind") != first:
            scene = {"kind": first, "seed": 0}
        record = build(RecordConfig, "record", config.get("record", {}))
        return open_scene(first, build(SCENES[first].config, "scene", scene), record)
    keys = config.get("input", {})
    chosen = {name: options[name] for name in INPUTS if name in options}
    if words != stated and not options.get("episodes"):
        from replay.integrity.listing import may_be_corpus  # imports pyarrow, which is slow
        from replay.open_sources import is_recording

        # The frames of a recording are made already, so that most input options do not apply.
        if not may_be_corpus(words) and is_recording(words):
            chosen, keys = {}, {name: keys[name] for name in COMMON_KEYS if name in keys}
    inputs = InputOptions(**chosen).configured(keys)
    opening: Any = {name: bool(options.get(name)) for name in OPENING}
    return open_logs(words, inputs=inputs, **opening)


@dataclass(frozen=True, slots=True)
class RunResult:
    """Result of a run; `as_json` is the document that `learn --json` prints.

    Attributes:
        run: folder of the run; None if nothing is stored.
        source: identity of the source, see `FrameSource.describe`.
        seed: seed of the run.
        iterations: number of iterations.
        frames: number of frames learned from.
        signals_sha256: hash of all signals, see `SignalsHash`.
        modules: the saved modules.
        summary: further results of the learner.
        held_out: slowness of the modules on frames that were held out, see `evaluate`.
        ended: reason for the end, a key of `END_REASONS`.
        undecided: streams that were still being learned at the end.
        passes: number of passes over a log that have begun; None for other sources.
    """

    run: str | None
    source: Mapping[str, Any]
    seed: int
    iterations: int
    frames: int
    signals_sha256: str
    modules: tuple[Module, ...]
    summary: Mapping[str, Any]
    held_out: Mapping[str, Any]
    ended: str
    undecided: tuple[str, ...]
    passes: int | None = None

    @property
    def more_passes(self) -> int:
        """Number of passes to continue with, if streams need more; else 0."""
        ended = self.ended == EXHAUSTED and not self.source.get("loop")
        # In a log that ends in an earlier pass, all parts between two gaps are too short.
        last = self.passes is not None and self.passes == self.source.get("passes", 1)
        return max(2 * (self.passes or 0), PASSES) if self.undecided and ended and last else 0

    def as_json(self) -> dict[str, Any]:
        """Return the result as `learn --json` prints it."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        values["modules"] = [module_table(module) for module in self.modules]
        values |= values.pop("summary")
        if not self.held_out:
            del values["held_out"]
        if self.passes is None:
            del values["passes"]
        return {"schema": 1, **values, "undecided": list(self.undecided)}


def module_table(module: Module) -> dict[str, Any]:
    """Return the facts of a module that results contain, as JSON values."""
    return {
        "index": module.index,
        "stream": module.stream,
        "stream_index": module.stream_index,
        "iteration": module.iteration,
        "policy": module.policy.tolist(),
        "eta": module.eta.tolist(),
        "slow": [bool(slow) for slow in module.slow],
        "kinds": list(module.kinds),
        "recipe": None if module.recipe is None else module.recipe.as_json(),
    }


def with_recipes(
    modules: Iterable[Module], source: FrameSource, described: Mapping[str, Any]
) -> tuple[Module, ...]:
    """Return modules with their recipes, which tell how raw images become frames.

    Args:
        modules: the saved modules.
        source: the source that they were learned from; for a recording, the recipe is that of the
            source that was recorded.
        described: identity of the source.
    """
    if isinstance(source, StoredSource) and source.recorded:
        described = source.origin()

    def recipe(stream: int) -> Recipe:
        result = Recipe.of(described, source.spec.kind(stream)[0], stream)
        frames = () if "size" in described else result.size  # else the raw images are frames
        framings = getattr(source, "framings", [None] * len(source.spec.streams))
        result = replace(result, raw=getattr(framings[stream], "first", frames) or ())
        result = replace(result, centre=getattr(source, "centre", "run"))
        pixels = source.pixels(stream) if isinstance(source, StoredSource) else ""
        return replace(result, pixels=pixels) if pixels.startswith("bayer_") else result

    return tuple(replace(module, recipe=recipe(module.stream_index)) for module in modules)


@contextlib.contextmanager
def opened_log(
    folder: Path, source: FrameSource, manifest: Mapping[str, Any], *, force: bool, resumed: bool
) -> Iterator[RunWriter]:
    """Create the log of a run, and lock its folder until the context ends.

    After an error the log is a readable beginning of the run; the message of an interrupt then
    says how to continue.

    Args:
        folder: folder of the run.
        source: source of the run.
        manifest: manifest of the log, see `RunWriter`.
        force: True to replace the contents of the folder.
        resumed: True if the run is resumed; its earlier log is moved to `SET_ASIDE`.

    Raises:
        UsageError: the folder is not empty, in use, or has other logs.
        LogWriteError: the log cannot be written.
    """
    if not resumed:
        resumable = FORK not in manifest and isinstance(source, SeekableSource)
        refuse_existing(folder, force=force, resumable=resumable)
        with writing(folder):
            make_folder(folder)
    with locked_folder(folder):
        finished = folder / RUN_FILE
        logs = [folder / SET_ASIDE, finished, partial_path(finished)]
        if foreign := [path for path in logs_in(folder) if path not in logs]:
            raise UsageError(f"{foreign[0]} does not belong to a run: choose another folder")
        stale = [folder / name for name in (RUN_JSON, MODULES_FILE, VIEW_FILE, REPORT_FILE)]
        with writing(folder):
            if resumed:
                os.replace(log_to_resume(folder), logs[0])
            else:  # delete the logs first, so that a kill leaves nothing that looks like a run
                stale = [*logs, *stale]
            refuse_special(*stale)
            for path in stale:
                path.unlink(missing_ok=True)
        log = RunWriter(finished, source.spec, manifest, force=force or resumed)
        try:
            yield log
        except BaseException as error:
            log.abandon()
            if isinstance(error, KeyboardInterrupt):
                seekable = isinstance(source, SeekableSource)
                hint = "continue with --resume" if seekable else "start another (live source)"
                raise KeyboardInterrupt(f"{folder} is not finished: {hint}") from None
            raise


def write_results(
    log: RunWriter, result: RunResult, manifest: Mapping[str, Any], *, view: bool
) -> None:
    """Write modules and run.json, close the log with its final record, and build the view.

    Args:
        log: log of the run, with all its blocks and events.
        result: result of the run.
        manifest: manifest of the log, and `versions`.
        view: True to build the view.
    """
    folder = log.path.parent
    save_modules(folder / MODULES_FILE, result.modules)
    document = {
        "schema": 1,
        "signals_schema": SCHEMA_VERSION,
        "config": manifest["config"],
        "seed": result.seed,
        "source": dict(result.source),
        "streams": list(log.spec.streams),
        "platform": machine(),
        "result": result.as_json(),
    }
    optional = (COMMAND, FORK, ARITHMETIC, "versions")
    document = plain(document | {key: manifest[key] for key in optional if key in manifest})
    write_json(folder / RUN_JSON, document)
    log.close(final_record(folder, document, result.signals_sha256, view=view))
    if view:
        from replay.view.build import build_view

        build_view(folder, folder / VIEW_FILE)
