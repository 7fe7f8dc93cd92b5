"""The scenes, opened by name, and the blocks that they show, in order of time."""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable, Generator, Iterator, MutableMapping
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

from cdmisfa.core.blocks import Block, FrameSource, SeekableSource
from cdmisfa.core.config import section_table
from cdmisfa.core.errors import CdmisfaError, Registry, UsageError
from recorder.config import RecordConfig, SceneConfig
from recorder.world.icub.config import IcubConfig
from recorder.world.icub.source import IcubSource
from recorder.world.oscillatory import OscillatoryConfig, OscillatorySource

if TYPE_CHECKING:
    from concurrent.futures import Future


Opener = Callable[[Any, RecordConfig], SeekableSource]
"""Makes a scene's source from its configuration and the clock of the frames.

Only a function that can be imported can also open it in other processes.
"""


Request = tuple[int, int, int]
"""Stream, first frame and number of frames of a block."""

BLOCK = 64
"""Frames rendered at a time; divides `world.CHUNK`, so no block needs two chunks."""

_AHEAD = 3
"""Blocks a process may be ahead of the writer."""


@dataclass(frozen=True, slots=True)
class Scene:
    """A simulated world: everything that the rest knows of it.

    Attributes:
        config: what it can be told (keys `scene.*`).
        open: makes its source.
        preset: its configuration where none is chosen: name of a preset, or a .toml file.
        packages: whose versions its frames depend on.
    """

    config: type[SceneConfig]
    open: Opener
    preset: str
    packages: tuple[str, ...] = ()


def _open_oscillatory(config: OscillatoryConfig, record: RecordConfig) -> SeekableSource:
    return OscillatorySource(config.streams, fps=record.fps, start_ns=record.start_ns)


SCENES: Registry[Scene] = Registry(
    "scene",
    {
        "icub": Scene(IcubConfig, IcubSource, "icub", ("pybullet", "icub-models")),
        "oscillatory": Scene(OscillatoryConfig, _open_oscillatory, "oscillatory"),
    },
)
"""The live scenes."""


@dataclass(frozen=True, slots=True)
class OpenScene:
    """What a scene's source was opened from.

    Attributes:
        name: of the scene.
        config: its configuration, with a seed.
        record: the clock of the frames.
    """

    name: str
    config: SceneConfig
    record: RecordConfig

    def table(self) -> dict[str, Any]:
        """The scene's configuration as recordings state it.

        Those of the first two scenes state the keys of both, so that they stay the same bytes.
        """
        first = (IcubConfig, OscillatoryConfig)
        tables = [section_table(config()) for config in first] if type(self.config) in first else []
        return {
            key: v for table in (*tables, section_table(self.config)) for key, v in table.items()
        }


_OPEN: MutableMapping[FrameSource, OpenScene] = WeakKeyDictionary()


def open_scene(
    name: str, config: SceneConfig | None = None, record: RecordConfig | None = None
) -> SeekableSource:
    """A live source of a scene's streams.

    Args:
        name: one of `SCENES`.
        config: of the scene; by default the preset's, with seed 0.
        record: the clock of the frames.

    Raises:
        UsageError: no such scene, the configuration of another, or one that cannot be built.
        CdmisfaError: the scene needs a simulator that is not installed.
    """
    kind = SCENES[name].config
    config = config if config is not None else kind()
    if not isinstance(config, kind):
        raise UsageError(f"the scene {name} takes {kind.__name__}, not {type(config).__name__}")
    scene = OpenScene(name, replace(config, seed=config.seed or 0), record or RecordConfig())
    source = SCENES[name].open(scene.config, scene.record)
    with contextlib.suppress(TypeError):  # a class without weak references
        _OPEN[source] = scene
    return source


def scene_of(source: FrameSource) -> OpenScene | None:
    """What `open_scene` opened a source from; None for any other source."""
    try:
        return _OPEN.get(source)
    except TypeError:
        return None


def requests(starts: dict[int, int], frames: int) -> Iterator[Request]:
    """All blocks still missing: by time, then by stream, so that no view gets far ahead.

    Args:
        starts: the first missing frame of each stream.
        frames: where all streams end.
    """
    for low in range(0, frames, BLOCK):
        high = min(low + BLOCK, frames)
        for stream, start in starts.items():
            first = max(low, start)
            if first < high:
                yield stream, first, high - first


def take_here(
    source: FrameSource, starts: dict[int, int], frames: int
) -> Generator[Block, None, None]:
    """The missing blocks of some streams, one after the other, from one source.

    Args:
        source: can go back, or has not yet come to any of the missing frames.
        starts: the first missing frame of each stream.
        frames: where all streams end.

    Raises:
        UsageError: the source cannot go back to the first missing frame.
        LogExhaustedError: it ends before.
    """
    if isinstance(source, SeekableSource):
        for request in requests(starts, frames):
            yield from _take(source, request)
        return
    first = min(starts.values(), default=frames)
    if first >= frames:
        return
    if source.t > first:
        raise UsageError(
            f"the source is at frame {source.t} and cannot go back to {first}: open it anew"
        )
    step = max(1, min(BLOCK, int(source.spec.fps / 2)))  # so that files grow every second
    while source.t < frames:
        for block in source.take_all(min(step, frames - source.t)):
            done = starts.get(block.stream, frames) - block.t
            if done < len(block):
                new = slice(max(done, 0), None)
                t = block.t + max(done, 0)
                yield Block(block.stream, t, block.frames[new], block.truth[new])


def render_in_processes(
    scene: OpenScene, starts: dict[int, int], frames: int, jobs: int
) -> Generator[Block, None, None]:
    """The blocks of `take_here` in the same order, by `jobs` processes with a world each.

    Raises:
        CdmisfaError: a process died, or could not open the scene.
    """
    from cdmisfa.core.processes import WorkersError, workers

    pending: deque[Future[list[Block]]] = deque()
    opened = SCENES[scene.name].open, scene.config, scene.record
    try:
        with workers(jobs) as submit:
            for request in requests(starts, frames):
                pending.append(submit(_render, opened, request))
                if len(pending) > _AHEAD * jobs:
                    yield from pending.popleft().result()
            while pending:
                yield from pending.popleft().result()
    except WorkersError as error:
        raise CdmisfaError(
            "a rendering process ended: go on with --resume; if it ends again, with --jobs 1 to "
            "see why, or with more memory"
        ) from error


@cache
def _source(opener: Opener, config: SceneConfig, record: RecordConfig) -> SeekableSource:
    """The world of a rendering process, opened once."""
    return opener(config, record)


def _render(opened: tuple[Opener, SceneConfig, RecordConfig], request: Request) -> list[Block]:
    """Render a block; what a rendering process is asked for."""
    return list(_take(_source(*opened), request))


def _take(source: SeekableSource, request: Request) -> Iterator[Block]:
    """What a stream shows of a block's frames: all, or each stretch between its gaps."""
    stream, first, n = request
    for low, high in source.spans(stream, first, first + n):
        source.seek(low)
        yield source.take(stream, high - low)
