"""`cdmisfa.learn`: learn from any source of frames, and write a run."""

from __future__ import annotations

import contextlib
import shutil
import signal
import tempfile
import warnings
import weakref
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from cdmisfa.core.blocks import FrameSource, description
from cdmisfa.core.interrupts import stoppable
from cdmisfa.core.learning import Sink
from cdmisfa.experiments.documents import warnings_of
from cdmisfa.experiments.holdout import arrange_frames
from cdmisfa.experiments.run_folder import command_of
from cdmisfa.experiments.session import run_session
from cdmisfa.experiments.sources import (
    Configuration,
    Layers,
    configure_for,
    open_source,
    read_inputs,
)
from cdmisfa.public.recording import Recording, SourceLike, as_words
from cdmisfa.public.run import Run, TemporaryFolder
from recorder.images.options import OPTIONS, Centre, InputOptions
from replay.logs.source import LoggedSource
from replay.stored_source import centre_as


def learn(
    source: SourceLike,
    out: str | Path | None = None,
    *,
    algorithm: str | None = None,
    seed: int = 0,
    max_iterations: int | None = None,
    max_modules: int | None = None,
    preset: str | None = None,
    holdout: float | None = None,
    loop: bool = False,
    passes: int | None = None,
    episodes: bool = False,
    centre: Centre = "run",
    force: bool = False,
    view: bool = False,
    sinks: Sequence[Sink] = (),
    stop: Callable[[], bool] = lambda: False,
    **settings: Any,
) -> Run:
    """Learn slow feature modules, and return the run.

    What the source drops or changes is a warning. The run has the signals and the modules:

        run = cdmisfa.learn(array)
        run.signals.to_pandas()
        run.modules[0].transform(array)

    Args:
        source: arrays or tables (see `Recording`), or a mapping of them by stream name; paths,
            URLs or patterns of logs, one or a list; a `Recording`, for logs with options; the name
            of a scene ("oscillatory", "icub"); live streams ("camera:/dev/video0",
            "gym:CartPole-v1"); an iterable of time steps (see `ArraySource`); or an open source,
            which stays open.
        out: folder of the run; None: a temporary folder, removed with the returned object and its
            copies. A run that is pickled for later needs a folder.
        algorithm: "2.0" (default for scenes), "progress" (default for other streams), "1.0", or
            a class as "package.module:Class".
        seed: seed of random choices, scenes and simulated tasks.
        max_iterations: largest number of iterations.
        max_modules: largest number of modules; None: the learner decides when to end. Every run
            ends with its source.
        preset: name of a preset, or a .toml file.
        holdout: share of a log, at its end, on which the progress learner is evaluated and does
            not learn; None: 0.1.
        loop: True to start logs or arrays again at their end, without limit.
        passes: largest number of times that logs or arrays are read, until each stream is decided;
            None: 20 for the progress learner, except on recordings of a scene; else 1.
        episodes: see `Recording`.
        centre: "episode" to learn from frames without the mean of their episode.
        force: True to replace an existing run.
        view: True to write the Rerun view, run.rrd.
        sinks: receive every iteration; an exception of one ends the run.
        stop: called before every iteration; True ends the run.
        settings: configuration keys of the learner, such as `tau=20` or `outputs=4`.

    Raises:
        UsageError: the source, a setting or the folder is wrong.
        LogDamagedError: a log is damaged.
        LogExhaustedError: the source is shorter than one block.
        KeyboardInterrupt: Ctrl-C was pressed; the run up to there is saved in `out`.
    """
    words = [f"learner.{name}={value}" for name, value in settings.items()]
    if algorithm is not None:
        words.append(f"learner.algorithm={algorithm}")
    words += InputOptions(holdout=holdout, centre=centre).settings()
    how: dict[str, Any] = {"preset": preset, "settings": words, "seed": int(seed)}
    limits = {"max_iterations": max_iterations, "max_modules": max_modules}
    ends = {**limits, "passes": passes}
    logs: dict[str, Any] = {"loop": loop, "episodes": episodes}
    with (
        _opened(source, logs, how) as (frames, configuration, command),
        _folder(out) as folder,
        _interruptible(folder, stop) as stop,
    ):
        arrange_frames(frames, configuration, passes)
        if command is not None:
            command = command_of(command[0], {**how, **ends, **command[1]}, folder)
        if hasattr(frames, "stop"):
            frames.stop = stop  # so that Ctrl-C also ends waiting for frames
        run_session(
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
        for line in warnings_of(frames):
            warnings.warn(line, stacklevel=2)
        run = Run(folder)
        if command is None and isinstance(frames, LoggedSource) and frames.in_memory:
            run._source = Recording.of(source)  # the folder has only hashes of arrays
        if out is None:
            run.signals._folder = TemporaryFolder()
            weakref.finalize(run.signals._folder, shutil.rmtree, folder.parent, ignore_errors=True)
    return run


@contextlib.contextmanager
def _folder(out: str | Path | None) -> Iterator[Path]:
    """Yield the folder of a run; a temporary one is removed if learning fails."""
    if out is not None:
        yield Path(out)
        return
    temporary = Path(tempfile.mkdtemp(prefix="cdmisfa-"))
    try:
        yield temporary / "run"
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise


@contextlib.contextmanager
def _interruptible(folder: Path, stop: Callable[[], bool]) -> Iterator[Callable[[], bool]]:
    """Let Ctrl-C end the run after its iteration, and then raise KeyboardInterrupt.

    A second Ctrl-C interrupts at once. A handler of the caller keeps its place.

    Yields:
        `stop` of the run, which is also true after Ctrl-C.
    """
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield stop
        return
    with stoppable(signals=[signal.SIGINT]) as pressed:
        yield lambda: pressed() or stop()
    if pressed():
        raise KeyboardInterrupt(f"the run is saved: {folder}")


@contextlib.contextmanager
def _opened(
    source: SourceLike, logs: dict[str, Any], how: dict[str, Any]
) -> Iterator[tuple[FrameSource, Configuration, Any]]:
    """Open a source, and yield it with its configuration and its command.

    The command is the words and options with which `cdmisfa learn` opens the source, None if no
    command can. A source that is open already stays open.
    """
    if isinstance(source, FrameSource):
        yield source, _configured(source, how), None
        return
    if any(map(_is_computed, source.values() if isinstance(source, Mapping) else [source])):
        from recorder.cameras.stepped import ArraySource

        with ArraySource(source) as array_source:
            yield array_source, _configured(array_source, how), None
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


def _is_computed(source: Any) -> bool:
    """Return whether frames come one after the other, from an iterator or an own source."""
    whole = isinstance(source, Collection) or hasattr(source, "__arrow_c_stream__")
    return isinstance(source, Iterable) and not whole and not hasattr(source, "toarray")


def _configured(
    source: FrameSource, how: dict[str, Any], inputs: InputOptions | None = None
) -> Configuration:
    """Return the configuration of an open source, and set the centring of its frames."""
    layers = Layers.read(how["preset"], how["settings"])
    inputs = read_inputs(inputs, layers)
    centre_as(inputs.centre, source, "this source")
    described = description(source, at_once=True)
    return configure_for(source.spec, described, layers, how["seed"], inputs)
