"""Open scenes by name, and render the blocks of their frames in order of time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Any

from cdmisfa.core.blocks import Block, ClockedSource, FrameSource, SeekableSource
from cdmisfa.core.config import section_table
from cdmisfa.core.errors import CdmisfaError, Registry, UsageError
from recorder.config import RecordConfig, SceneConfig
from recorder.world.icub.config import IcubConfig
from recorder.world.icub.source import IcubSource
from recorder.world.oscillatory import OscillatoryConfig, OscillatorySource

if TYPE_CHECKING:
    from concurrent.futures import Future


# Opens a scene's source by its configuration and the clock of the frames.
#
# Worker processes import the function: it must not be local.
Opener = Callable[[Any, RecordConfig], ClockedSource]


# Stream, first frame and number of frames of a block.
Request = tuple[int, int, int]

# Frames rendered at a time; divides `motions.CHUNK`, so no block needs two chunks.
BLOCK = 64

# Blocks that each process may render ahead of the writer.
_AHEAD = 3


@dataclass(frozen=True, slots=True)
class Scene:
    """A simulated world; its default preset has its name.

    Attributes:
        config: class of its configuration (keys `scene.*`).
        open: opens its source.
        packages: packages on whose versions its frames depend.
    """

    config: type[SceneConfig]
    open: Opener
    packages: tuple[str, ...] = ()


def _open_oscillatory(config: OscillatoryConfig, record: RecordConfig) -> ClockedSource:
    return OscillatorySource(config.streams, fps=record.fps, start_ns=record.start_ns)


# The live scenes.
SCENES: Registry[Scene] = Registry(
    "scene",
    {
        "icub": Scene(IcubConfig, IcubSource, ("pybullet", "icub-models")),
        "oscillatory": Scene(OscillatoryConfig, _open_oscillatory),
    },
)


@dataclass(frozen=True, slots=True)
class OpenScene:
    """The arguments with which a scene's source was opened.

    Attributes:
        name: of the scene.
        config: its configuration, with a seed.
        record: the clock of the frames.
    """

    name: str
    config: SceneConfig
    record: RecordConfig

    def table(self) -> dict[str, Any]:
        """Return the scene's configuration as recordings state it.

        Recordings state the keys of both scenes, to keep their bytes.
        """
        configs = IcubConfig(), OscillatoryConfig(), self.config
        return {key: value for config in configs for key, value in section_table(config).items()}


def open_scene(
    name: str, config: SceneConfig | None = None, record: RecordConfig | None = None
) -> SeekableSource:
    """Open a live source of a scene's streams.

    Args:
        name: one of `SCENES`.
        config: of the scene; by default the preset's, with seed 0.
        record: the clock of the frames.

    Raises:
        UsageError: no such scene, or one that cannot be built.
        CdmisfaError: the scene needs a simulator that is not installed.
    """
    config = config or SCENES[name].config()
    scene = OpenScene(name, replace(config, seed=config.seed or 0), record or RecordConfig())
    source = SCENES[name].open(scene.config, scene.record)
    source._scene_opened = scene
    return source


def scene_of(source: FrameSource) -> OpenScene | None:
    """Return what `open_scene` opened a source from; None for any other source."""
    return getattr(source, "_scene_opened", None)


def requests(starts: dict[int, int], frames: int) -> Iterator[Request]:
    """Yield all missing blocks, by time and then by stream, so that no view gets far ahead.

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
    """Yield the missing blocks of streams, one after the other, from one source.

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
            f"the source is at frame {source.t} and cannot go back to {first}: open it again"
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
    """Yield the blocks of `take_here` in the same order, by `jobs` processes with a world each.

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
            "a rendering process ended: continue with --resume; if it ends again, use --jobs 1 to "
            "see why, or more memory"
        ) from error


@cache
def _source(opener: Opener, config: SceneConfig, record: RecordConfig) -> SeekableSource:
    """Open the world of a rendering process, once."""
    return opener(config, record)


def _render(opened: tuple[Opener, SceneConfig, RecordConfig], request: Request) -> list[Block]:
    """Render a block in a rendering process."""
    return list(_take(_source(*opened), request))


def _take(source: SeekableSource, request: Request) -> Iterator[Block]:
    """Yield a block's frames: all of them, or each stretch between gaps."""
    stream, first, n = request
    for low, high in source.spans(stream, first, first + n):
        source.seek(low)
        yield source.take(stream, high - low)
