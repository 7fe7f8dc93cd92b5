"""`cdmisfa.learn`: from anything that shows frames to a run on disk."""

from __future__ import annotations

import contextlib
import shutil
import tempfile
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from cdmisfa.core.blocks import FrameSource, description
from cdmisfa.core.errors import UsageError
from cdmisfa.core.learning import Sink
from cdmisfa.experiments.holdout import hold_out
from cdmisfa.experiments.run_folder import command_of
from cdmisfa.experiments.session import run as run_to_its_end
from cdmisfa.experiments.sources import (
    OF_CAMERAS,
    Configuration,
    configure_for,
    is_scene,
    open_source,
    read_inputs,
)
from cdmisfa.public.recording import Given, Recording
from cdmisfa.public.run import Run
from recorder.cameras.words import is_live
from recorder.images.options import OPTIONS, Centre, InputOptions
from replay.arrays import ArrayLog
from replay.stored import StoredSource


def learn(
    source: Given,
    out: str | Path | None = None,
    *,
    algorithm: str | None = None,
    seed: int = 0,
    max_iterations: int | None = None,
    max_modules: int | None = None,
    preset: str | None = None,
    holdout: float | None = None,
    loop: bool = False,
    episodes: bool = False,
    centre: Centre = "run",
    force: bool = False,
    view: bool = False,
    sinks: Sequence[Sink] = (),
    stop: Callable[[], bool] = lambda: False,
    **settings: Any,
) -> Run:
    """Learn slow feature modules, and return the run.

        run = cdmisfa.learn(array)
        run.signals.to_pandas()
        run.modules[0].transform(array)

    Args:
        source: arrays or tables (see `Recording`), or a mapping of them by the streams' names;
            paths, URLs or patterns of logs, one or a list; a `Recording`, where a log needs
            options; the name of a scene ("oscillatory", "icub"); words of live streams
            ("camera:/dev/video0", "gym:CartPole-v1"); or an open source, which is left open.
        out: the run's folder; by default a temporary one, which goes with the run.
        algorithm: "progress", the default but of scenes, "2.0", "1.0", or a class of yours as
            "package.module:Class".
        seed: of the random choices, and of scenes and simulated tasks.
        max_iterations: end after so many.
        max_modules: end after so many; by default the learner ends by itself, and any learner
            where the source ends.
        preset: settings by name or from a .toml file.
        holdout: the share of a camera log, at its end, that is kept from the progress learner, to
            judge on it what was learned; by default a tenth.
        loop: begin logs or arrays again at their end.
        episodes: see `Recording`.
        centre: "episode" learns from frames without the mean of their episode.
        force: replace an existing run.
        view: also write the view, run.rrd.
        sinks: called with every iteration; one that raises ends the run.
        stop: asked before every iteration; true ends the run.
        settings: keys of the learner: `tau=20`, `outputs=4`; see docs/reference/configuration.md.

    Raises:
        UsageError: a source, setting or folder that cannot be; the line names it.
        LogDamagedError: a log is damaged.
        LogExhaustedError: the source has not enough frames for a single block.
    """
    if not isinstance(seed, int | np.integer) or seed < 0:
        raise UsageError(f"seed is {seed!r}: give a whole number from 0 on")
    if misplaced := {field.name for field in fields(InputOptions)} & settings.keys():
        name = min(misplaced)
        raise UsageError(f"{name} is of a recording: learn(Recording(source, {name}=...))")
    seed = int(seed)
    words = [f"learner.{name}={value}" for name, value in settings.items()]
    if algorithm is not None:
        words.append(f"learner.algorithm={algorithm}")
    words += InputOptions(holdout=holdout, centre=centre).settings()
    how: dict[str, Any] = {"preset": preset, "settings": words, "seed": seed}
    limits: dict[str, Any] = {"max_iterations": max_iterations, "max_modules": max_modules}
    logs: dict[str, Any] = {"loop": loop, "episodes": episodes}
    with _opened(source, logs, how) as (frames, configuration, told), _folder(out) as folder:
        by_progress = configuration.learner.algorithm == OF_CAMERAS
        share = None if configuration.inputs is None else configuration.inputs.holdout
        hold_out(frames, share, judged=by_progress)
        run_to_its_end(
            frames,
            configuration.learner,
            folder,
            seed=seed,
            sections=configuration.tables(),
            command=command_of(told[0], {**how, **limits, **told[1]}, folder) if told else None,
            force=force,
            rerun=view,
            sinks=sinks,
            stop=stop,
            max_iterations=max_iterations,
            max_modules=max_modules,
        )
        found = Run(folder)
        if told is None and isinstance(frames, ArrayLog):
            found._learned_from = Recording.of(source)  # of arrays the folder holds only hashes
        if out is None:
            weakref.finalize(found, shutil.rmtree, folder.parent, ignore_errors=True)
    return found


@contextlib.contextmanager
def _folder(out: str | Path | None) -> Iterator[Path]:
    """The folder of a run; a temporary one is removed where learning fails."""
    if out is not None:
        yield Path(out)
        return
    made = Path(tempfile.mkdtemp(prefix="cdmisfa-"))
    try:
        yield made / "run"
    except BaseException:
        shutil.rmtree(made, ignore_errors=True)
        raise


Told = tuple[Sequence[str], dict[str, Any]] | None
"""Words and options that name a source on the command line, where there are any."""


@contextlib.contextmanager
def _opened(
    source: Given, logs: dict[str, Any], how: dict[str, Any]
) -> Iterator[tuple[FrameSource, Configuration, Told]]:
    """A source, open, with its configuration and what names it; closed unless it was open."""
    words = [str(source)] if isinstance(source, str | Path) else []
    if isinstance(source, list | tuple) and all(isinstance(one, str | Path) for one in source):
        words = list(map(str, source))
    if words and not all(map(is_live, words)):
        found, configuration = open_source(words, **how, **logs)
        with contextlib.closing(found):
            yield found, configuration, (words, {} if is_scene(words) else logs)
        return
    if logs["episodes"]:
        if isinstance(source, Recording):
            raise UsageError("episodes is of a recording: learn(Recording(source, episodes=True))")
        raise UsageError("episodes is for logs: record or write what is shown first")
    if words:
        streams, configuration = open_source(words, **how)
        with contextlib.closing(streams):
            yield streams, configuration, (words, {})
        return
    if isinstance(source, FrameSource):
        yield source, _configured(source, how), None
        return
    streamed = {"stream": source} if isinstance(source, Iterator) else source
    if isinstance(streamed, Mapping) and any(isinstance(s, Iterator) for s in streamed.values()):
        from recorder.cameras.stepped import ArraySource

        with ArraySource(streamed) as made:
            yield made, _configured(made, how), None
        return
    recording = Recording.of(source)
    with recording.source(loop=logs["loop"]) as frames:
        how["settings"] = [*recording.inputs.settings(), *how["settings"]]
        configuration = _configured(frames, how, recording.inputs)
        options = {"loop": logs["loop"] or recording.loop, "salvage": recording.salvage}
        options |= {"episodes": recording.episodes}
        options |= {
            name: getattr(recording.inputs, name) for name in recording.inputs.chosen(OPTIONS)
        }
        yield frames, configuration, (recording.words, options) if recording.words else None


def _configured(
    source: FrameSource, how: dict[str, Any], inputs: InputOptions | None = None
) -> Configuration:
    """The configuration of an open source, which shows its frames as keys `input.*` say."""
    inputs = read_inputs(inputs, how["preset"], how["settings"])
    if inputs.centre != "run":
        if not isinstance(source, StoredSource):
            raise UsageError("centre is for logs: record or write what is shown first")
        source.centre_by(inputs.centre)
    described = description(source, at_once=True)
    return configure_for(source.spec, described, **how, inputs=inputs)
