"""The folder of a run: its log, opened and held, and what is written when it ends."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cdmisfa.core.blocks import Block, FrameSource, SeekableSource
from cdmisfa.core.errors import LogWriteError, UsageError
from cdmisfa.core.learning import ARITHMETIC, Learner, Sink
from cdmisfa.core.signals import SCHEMA_VERSION, BlockSignals
from cdmisfa.experiments.documents import machine, write_json
from cdmisfa.experiments.resume import COMMAND, FORK, SET_ASIDE
from cdmisfa.modules import Module
from recorder.images.framing import Recipe
from recorder.log.files import (
    held,
    logs_in,
    make_folder,
    partial_path,
    refuse_existing,
    refuse_special,
)
from replay.recordings.source import RecordedSource
from replay.runs.folders import MODULES_FILE, REPORT_FILE, RUN_FILE, RUN_JSON, VIEW_FILE
from replay.runs.modules import save_modules
from replay.runs.provenance import final_record
from replay.runs.writer import RunWriter
from replay.storage.identity import LoggedSource


@dataclass(frozen=True, slots=True)
class RunResult:
    """What a run came to; `as_json` is the command line's contract.

    Attributes:
        run: its folder, if it has one.
        source: what it learned from, described.
        modules: what was learned, in order.
        summary: what else the learner says of itself.
        held_out: how slow it is on frames that were held out; see `judged`.
        ended: why, a key of `ENDINGS`.
        undecided: streams of which the learner had not come to a result when it ended.
    """

    run: str | None
    source: Mapping[str, Any]
    streams: tuple[str, ...]
    seed: int
    iterations: int
    frames: int
    signals_sha256: str
    modules: tuple[Module, ...]
    summary: Mapping[str, Any]
    held_out: Mapping[str, Any] | None
    ended: str
    undecided: tuple[str, ...]

    def as_json(self) -> dict[str, Any]:
        """The result as `learn --json` prints it."""
        return {
            "schema": 1,
            "run": self.run,
            "source": dict(self.source),
            "seed": self.seed,
            "iterations": self.iterations,
            "frames": self.frames,
            "signals_sha256": self.signals_sha256,
            "modules": [module_table(module) for module in self.modules],
            **self.summary,
            **({"held_out": dict(self.held_out)} if self.held_out else {}),
            "ended": self.ended,
            "undecided": list(self.undecided),
        }


def undecided(learner: Learner, source: FrameSource, summary: Mapping[str, Any]) -> tuple[str, ...]:
    """The streams that are still being learned, or, where a learner says none, without a module."""
    if "streams" in summary:
        return tuple(one["stream"] for one in summary["streams"] if one["state"] == "learning")
    learned = {module.stream_index for module in learner.modules}
    return tuple(name for s, name in enumerate(source.spec.streams) if s not in learned)


def module_table(module: Module) -> dict[str, Any]:
    """What a result says about a module, as JSON values."""
    return {
        "index": module.index,
        "stream": module.stream,
        "stream_index": module.stream_index,
        "iteration": module.iteration,
        "policy": module.policy.tolist(),
        "eta": module.eta.tolist(),
        "slow": [bool(slow) for slow in module.slow],
        "recipe": None if module.recipe is None else module.recipe.as_json(),
    }


def in_words(changed: Mapping[str, Sequence[Any]]) -> list[str]:
    """Values before and now, by name, in words."""
    return [f"{name} is {now}, was {before}" for name, (before, now) in changed.items()]


def with_recipes(
    modules: Iterable[Module], source: FrameSource, described: Mapping[str, Any]
) -> tuple[Module, ...]:
    """Modules with what becomes of a raw picture of their streams.

    Args:
        modules: what was learned.
        source: from what; of a recording that is what was recorded.
        described: what it says of itself.
    """
    if isinstance(source, RecordedSource):
        described = source.origin()

    def recipe(stream: int) -> Recipe:
        own = Recipe.of(described, source.spec.frame_shape, stream)
        frames = () if "size" in described else own.size  # else they are the pictures
        framings = getattr(source, "framings", [None] * len(source.spec.streams))
        own = replace(own, raw=getattr(framings[stream], "first", frames) or ())
        own = replace(own, centre=getattr(source, "centre", "run"))
        stated = source.pixels(stream) if isinstance(source, LoggedSource) else ""
        return replace(own, pixels=stated) if stated.startswith("bayer_") else own

    return tuple(replace(module, recipe=recipe(module.stream_index)) for module in modules)


class OpenLog(Sink):
    """A run's log that stays open when learning ends, for what is written after it."""

    def __init__(self, log: RunWriter, learner: Learner) -> None:
        self._log, self._learner = log, learner

    def block(self, block: Block, signals: BlockSignals, learner: Learner) -> None:
        """See `Sink`."""
        self._log.block(block, signals, learner)

    def event(self, t: int, iteration: int, text: str, level: str = "INFO") -> None:
        """See `Sink`."""
        self._log.event(t, iteration, text, level)

    def finish(self) -> None:
        """Write the last weights, and hand over what was written."""
        self._log.weights(self._learner)
        self._log.flush()


@contextlib.contextmanager
def opened_log(
    folder: Path,
    source: FrameSource,
    manifest: Mapping[str, Any],
    *,
    force: bool,
    resumed: bool,
    aside: Path | None,
    view: bool,
) -> Iterator[RunWriter]:
    """The log of a run, to be finished inside, while its folder is held.

    On failure it is left as a readable prefix; an interrupt then says what is missing.

    Args:
        folder: of the run.
        source: what it learns from.
        manifest: see `RunWriter`.
        force: replace what is in the folder.
        resumed: whether the run is resumed.
        aside: its log of before, where it holds anything; set aside under `SET_ASIDE`.
        view: whether the run will have a view.

    Raises:
        UsageError: the folder is not empty, in use or of no run.
        LogWriteError: the log cannot be written.
    """
    if not resumed:
        goes_on = FORK not in manifest and isinstance(source, SeekableSource)
        refuse_existing(folder, force=force, goes_on=goes_on)
        with _telling(folder):
            make_folder(folder)
    with held(folder):
        finished = folder / RUN_FILE
        logs = [folder / SET_ASIDE, finished, partial_path(finished)]
        if others := [path for path in logs_in(folder) if path not in logs]:
            raise UsageError(f"{others[0]} is of no run: choose another folder")
        stale = [folder / name for name in (RUN_JSON, MODULES_FILE, VIEW_FILE, REPORT_FILE)]
        if aside is not None:
            try:
                os.replace(aside, logs[0])
            except OSError as error:
                raise LogWriteError(f"{aside} cannot be set aside: {error.strerror}") from error
        elif not resumed:  # the log first: of what is left by a kill nothing then looks like a run
            stale = [*logs, *stale]
        with _telling(folder):
            refuse_special(*stale)
            for path in stale:
                path.unlink(missing_ok=True)
        force = force or resumed
        log = RunWriter(finished, source.spec, manifest, force=force)
        try:
            yield log
        except BaseException as error:
            left = _left_undone(folder, source, view=view)
            log.abandon()
            if isinstance(error, KeyboardInterrupt):
                raise KeyboardInterrupt(left) from None
            raise


def _left_undone(run: Path, source: FrameSource, *, view: bool) -> str:
    """What an interrupt leaves of a run, and how to go on."""
    from replay.integrity.verify import view_again

    if (run / RUN_FILE).is_file():
        but = "" if not view or (run / VIEW_FILE).is_file() else " but its view: "
        return f"all of {run} is there{but and but + view_again(run)}"
    if isinstance(source, SeekableSource):
        return f"{run} is not finished: go on with --resume"
    return f"{run} is not finished, and cameras cannot go back: cdmisfa info {run}"


def write_results(
    log: RunWriter, result: RunResult, manifest: Mapping[str, Any], *, view: bool
) -> None:
    """Write modules and run.json, close the log with its final record, and build the view.

    Args:
        log: of the run, with all its blocks and events.
        result: what it came to.
        manifest: what the log states at its beginning, and `versions`.
        view: whether to build one.
    """
    folder = log.path.parent
    save_modules(folder / MODULES_FILE, result.modules)
    known = (COMMAND, FORK, ARITHMETIC, "versions")
    document = {
        "schema": 1,
        "signals_schema": SCHEMA_VERSION,
        "config": manifest["config"],
        "seed": result.seed,
        "source": dict(result.source),
        "streams": list(result.streams),
        "platform": machine(),
        "result": result.as_json(),
        **{key: manifest[key] for key in known if key in manifest},
    }
    write_json(folder / RUN_JSON, document)
    log.finish(final_record(folder, document, result.signals_sha256, view=view))
    if view:
        from replay.view.build import build_view

        build_view(folder, folder / VIEW_FILE)


@contextlib.contextmanager
def _telling(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        reason = error.strerror or error
        raise UsageError(f"{folder} cannot be a run's folder ({reason}): choose another") from error
