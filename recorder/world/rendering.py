"""Blocks of several streams in order of time, taken here or by several processes."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterator
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool

from cdmisfa.core.blocks import Block, FrameSource, SeekableSource
from cdmisfa.core.errors import CdmisfaError, UsageError
from cdmisfa.core.processes import Workers
from recorder.config import RecordConfig, SceneConfig
from recorder.world.scenes import SCENES, Opener, OpenScene

Request = tuple[int, int, int]
"""Stream, first frame and number of frames of a block."""

BLOCK = 64
"""Frames rendered at a time; divides `motions.CHUNK`, so no block needs two chunks."""

_AHEAD = 3
"""Blocks a process may be ahead of the writer."""

_source: SeekableSource | None = None


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
        if source.t < first:
            source.take_all(min(step, first - source.t))
            continue
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
    pending: deque[Future[list[Block]]] = deque()
    workers = Workers(jobs, _start, (SCENES[scene.name].open, scene.config, scene.record))
    try:
        for request in requests(starts, frames):
            pending.append(workers.submit(_render, request))
            if len(pending) > _AHEAD * jobs:
                yield from pending.popleft().result()
        while pending:
            yield from pending.popleft().result()
    except BrokenProcessPool as error:
        raise CdmisfaError(
            "a rendering process ended: go on with --resume; if it ends again, with --jobs 1 to "
            "see why, or with more memory"
        ) from error
    finally:
        workers.close()


def _start(opener: Opener, config: SceneConfig, record: RecordConfig) -> None:
    """Open a world in a rendering process."""
    global _source
    _source = opener(config, record)


def _render(request: Request) -> list[Block]:
    if _source is None:
        raise RuntimeError("the rendering process was not started")
    return list(_take(_source, request))


def _take(source: SeekableSource, request: Request) -> Iterator[Block]:
    """What a stream shows of a block's frames: all, or each stretch between its gaps."""
    stream, first, n = request
    for low, high in source.spans(stream, first, first + n):
        source.seek(low)
        yield source.take(stream, high - low)
