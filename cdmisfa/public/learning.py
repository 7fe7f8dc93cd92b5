"""`cdmisfa.learn`: learn from any source of frames, and write a run."""

from __future__ import annotations

import contextlib
import shutil
import tempfile
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from cdmisfa.core.blocks import FrameSource, description
from cdmisfa.core.learning import Sink
from cdmisfa.experiments.holdout import hold_out
from cdmisfa.experiments.run_folder import command_of
from cdmisfa.experiments.session import run as run_to_its_end
from cdmisfa.experiments.sources import (
    Configuration,
    Layers,
    configure_for,
    open_source,
    read_inputs,
)
from cdmisfa.public.recording import Given, Recording, as_words
from cdmisfa.public.run import Run
from recorder.images.options import OPTIONS, Centre, InputOptions
from replay.logs.source import LoggedSource
from replay.stored_source import centre_as


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
        out: the run's folder; by default a temporary one, removed with the run.
        algorithm: "2.0", the default of scenes, "progress", that of other streams, "1.0", or a
            class of yours as "package.module:Class".
        seed: the seed of random choices, scenes and simulated tasks.
        max_iterations: end after this many.
        max_modules: end after this many; by default the learner ends by itself, and any learner
            where the source ends.
        preset: settings by name or from a .toml file.
        holdout: the share of a log, at its end, that the progress learner does not learn from and
            is judged on; by default a tenth.
        loop: start logs or arrays again at their end.
        episodes: see `Recording`.
        centre: "episode" learns from frames without the mean of their episode.
        force: replace an existing run.
        view: also write the view, run.rrd.
        sinks: called with every iteration; one that raises ends the run.
        stop: called before every iteration; true ends the run.
        settings: keys of the learner: `tau=20`, `outputs=4`; see docs/reference/configuration.md.

    Raises:
        UsageError: the source, a setting or the folder is wrong; the line names it.
        LogDamagedError: a log is damaged.
        LogExhaustedError: the source has not enough frames for a single block.
    """
    words = [f"learner.{name}={value}" for name, value in settings.items()]
    if algorithm is not None:
        words.append(f"learner.algorithm={algorithm}")
    words += InputOptions(holdout=holdout, centre=centre).settings()
    how: dict[str, Any] = {"preset": preset, "settings": words, "seed": int(seed)}
    limits = {"max_iterations": max_iterations, "max_modules": max_modules}
    logs: dict[str, Any] = {"loop": loop, "episodes": episodes}
    with _opened(source, logs, how) as (frames, configuration, command), _folder(out) as folder:
        hold_out(frames, configuration)
        if command is not None:
            command = command_of(command[0], {**how, **limits, **command[1]}, folder)
        run_to_its_end(
            frames,
            configuration.learner,
            folder,
            seed=how["seed"],
            sections=configuration.tables(),
            command=command,
            force=force,
            rerun=view,
            sinks=sinks,
            stop=stop,
            **limits,
        )
        run = Run(folder)
        if command is None and isinstance(frames, LoggedSource) and frames.in_memory:
            run._learned_from = Recording.of(source)  # the folder has only hashes of arrays
        if out is None:
            weakref.finalize(run, shutil.rmtree, folder.parent, ignore_errors=True)
    return run


@contextlib.contextmanager
def _folder(out: str | Path | None) -> Iterator[Path]:
    """Yield the folder of a run; a temporary one is removed if learning fails."""
    if out is not None:
        yield Path(out)
        return
    made = Path(tempfile.mkdtemp(prefix="cdmisfa-"))
    try:
        yield made / "run"
    except BaseException:
        shutil.rmtree(made, ignore_errors=True)
        raise


@contextlib.contextmanager
def _opened(
    source: Given, logs: dict[str, Any], how: dict[str, Any]
) -> Iterator[tuple[FrameSource, Configuration, Any]]:
    """Open a source; yield it with its configuration, and with the words and options of a command.

    The command is None where the command line cannot name the source. An open source stays open.
    """
    if isinstance(source, FrameSource):
        yield source, _configured(source, how), None
        return
    streams = {"stream": source} if isinstance(source, Iterator) else source
    if isinstance(streams, Mapping) and any(isinstance(s, Iterator) for s in streams.values()):
        from recorder.cameras.stepped import ArraySource

        with ArraySource(streams) as made:
            yield made, _configured(made, how), None
        return
    if words := as_words(source):
        opened, configuration = open_source(words, **how, **logs)
        with contextlib.closing(opened):
            yield opened, configuration, (words, logs)
        return
    recording = Recording.of(source)
    with recording.source(loop=logs["loop"]) as frames:
        how["settings"] = [*recording.inputs.settings(), *how["settings"]]
        configuration = _configured(frames, how, recording.inputs)
        options: dict[str, Any] = {"loop": logs["loop"] or recording.loop}
        options |= {"skip_damaged": recording.skip_damaged, "episodes": recording.episodes}
        for name in recording.inputs.chosen(OPTIONS):
            options[name] = getattr(recording.inputs, name)
        yield frames, configuration, (recording.words, options) if recording.words else None


def _configured(
    source: FrameSource, how: dict[str, Any], inputs: InputOptions | None = None
) -> Configuration:
    """Return the configuration of an open source, and centre its frames as `input.centre` says."""
    given = Layers.read(how["preset"], how["settings"])
    inputs = read_inputs(inputs, given)
    centre_as(inputs.centre, source, "this source")
    described = description(source, at_once=True)
    return configure_for(source.spec, described, given, how["seed"], inputs)
