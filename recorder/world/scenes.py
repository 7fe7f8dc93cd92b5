"""Scenes: open one by name, and render blocks of it, also in several processes."""

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


# Opens a scene's source for its configuration and the clock of the frames. Worker processes import
# the function, so that it must not be local.
Opener = Callable[[Any, RecordConfig], ClockedSource]


# Index of the stream, first frame and number of frames of a block.
Request = tuple[int, int, int]

# Frames rendered at a time. It divides `motions.CHUNK`, so that no block needs two chunks.
BLOCK = 64

# Blocks that each process may render before the writer takes them; more use more memory.
_AHEAD = 3


@dataclass(frozen=True, slots=True)
class Scene:
    """A simulated world; its default preset has the same name.

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
        name: name of the scene.
        config: configuration of the scene, with a seed.
        record: clock of the frames.
    """

    name: str
    config: SceneConfig
    record: RecordConfig

    def table(self) -> dict[str, Any]:
        """Return the scene's configuration as a table for recordings.

        It has the keys of all scenes, because recordings always had them and keep their bytes.
        """
        configs = IcubConfig(), OscillatoryConfig(), self.config
        return {key: value for config in configs for key, value in section_table(config).items()}


def open_scene(
    name: str, config: SceneConfig | None = None, record: RecordConfig | None = None
) -> SeekableSource:
    """Open a live source of a scene's streams.

    Args:
        name: name of the scene, one of `SCENES`.
        config: configuration of the scene; None: the preset's, with seed 0.
        record: clock of the frames.

    Raises:
        UsageError: the scene does not exist or cannot be built.
        CdmisfaError: the simulator of the scene is not installed.
    """
    config = config or SCENES[name].config()
    scene = OpenScene(name, replace(config, seed=config.seed or 0), record or RecordConfig())
    source = SCENES[name].open(scene.config, scene.record)
    source._scene_opened = scene
    return source


def scene_of(source: FrameSource) -> OpenScene | None:
    """Return the arguments of `open_scene` for a source; None for any other source."""
    return getattr(source, "_scene_opened", None)


def requests(starts: dict[int, int], frames: int) -> Iterator[Request]:
    """Yield requests for all missing blocks, by time and then by stream.

    Args:
        starts: number of the first missing frame of each stream.
        frames: number of frames of each stream.
    """
    for low in range(0, frames, BLOCK):
        high = min(low + BLOCK, frames)
        for stream, start in starts.items():
            first = max(low, start)
            if first < high:
                yield stream, first, high - first


def blocks_in_process(
    source: FrameSource, starts: dict[int, int], frames: int
) -> Generator[Block, None, None]:
    """Yield the missing blocks of streams from one source.

    Args:
        source: a source that can go back, or is before the first missing frame.
        starts: number of the first missing frame of each stream.
        frames: number of frames of each stream.

    Raises:
        UsageError: the source cannot go back to the first missing frame.
        LogExhaustedError: the source ends first.
    """
    if isinstance(source, SeekableSource):
        for request in requests(starts, frames):
            yield from _take(source, request)
        return
    first = min(starts.values(), default=frames)
    if first >= frames:
        return
    if source.t > first:
        raise UsageError(f"the source is at frame {source.t}, after frame {first}: open it again")
    step = max(1, min(BLOCK, int(source.spec.fps / 2)))  # so that files grow at least every second
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
    """Yield the blocks of `blocks_in_process` in the same order, rendered by several processes.

    Args:
        scene: the scene, which each process opens.
        starts: number of the first missing frame of each stream.
        frames: number of frames of each stream.
        jobs: number of processes.

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
            "a rendering process died: continue with --resume; if it dies again, use --jobs 1 to "
            "see the reason, or more memory"
        ) from error


@cache
def _source(opener: Opener, config: SceneConfig, record: RecordConfig) -> SeekableSource:
    """Open the scene in a rendering process, once."""
    return opener(config, record)


def _render(opened: tuple[Opener, SceneConfig, RecordConfig], request: Request) -> list[Block]:
    """Render a block in a rendering process."""
    return list(_take(_source(*opened), request))


def _take(source: SeekableSource, request: Request) -> Iterator[Block]:
    """Yield the frames of a block: all of them, or each stretch between gaps."""
    stream, first, n = request
    for low, high in source.spans(stream, first, first + n):
        source.seek(low)
        yield source.take(stream, high - low)
