"""Blocks of frames, and the interfaces of the sources that deliver them.

All streams of a source share one clock: a frame counter t that advances for every stream,
whichever the learner attends to.
"""

from __future__ import annotations

import contextlib
from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.clock import NANOSECONDS, SLOWEST, Times, nearest_frames, time_of, times_of
from cdmisfa.core.errors import LogExhaustedError, UsageError

# The only element type that holds pixels, and the value of one gray level.
UINT8 = np.dtype(np.uint8)
PIXEL = 1.0 / 255.0


@dataclass(frozen=True, slots=True)
class Block:
    """Consecutive frames of one stream.

    Attributes:
        stream: index of the stream, from 0.
        t: global frame counter of the first frame.
        frames: (n, *frame_shape), uint8 pixels or float64 values; C-contiguous,
            read-only, and never written again by the source.
        truth: (n, D) float64 true state of the world, which the learner does not see: one column
            for each name in `SourceSpec.truth`. D may be 0.
    """

    stream: int
    t: int
    frames: NDArray[Any]
    truth: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.frames)


@dataclass(frozen=True, slots=True)
class SourceSpec:
    """Properties that all blocks of a source have in common.

    Attributes:
        streams: name of each stream (of the view in a recording).
        frame_shape: (height, width) of an image, (I,) of a vector.
        dtype: "uint8" for pixels, "float64" for values.
        truth: name of each column of `Block.truth`.
        fps: frames per second of the common clock.
        start_ns: log time of frame 0 (ns).
        length: number of frames, or None if the source is endless.

    Raises:
        UsageError: `fps` is outside of 1e-6 to 1e9.
    """

    streams: tuple[str, ...]
    frame_shape: tuple[int, ...]
    dtype: str
    truth: tuple[str, ...] = ()
    fps: float = 50.0
    start_ns: int = 0
    length: int | None = None

    def __post_init__(self) -> None:
        if not SLOWEST <= self.fps <= NANOSECONDS:
            raise UsageError(f"a source cannot have {self.fps} frames a second: give 1e-6 to 1e9")

    @property
    def images(self) -> bool:
        """Whether frames are gray images."""
        return self.dtype == "uint8" and len(self.frame_shape) == 2

    def time_ns(self, t: int) -> int:
        """Return the log time of frame t (ns)."""
        return time_of(t, self.fps, self.start_ns)

    def times(self, start: int, stop: int) -> Times:
        """Return (stop - start,) log times of the frames [start, stop) (ns)."""
        return times_of(np.arange(start, stop), self.fps, self.start_ns)

    def frames_at(self, times: NDArray[Any]) -> Times:
        """Return the numbers of the frames nearest to the log times (n,) (ns)."""
        return nearest_frames(times, self.fps, self.start_ns)

    def facts(self) -> dict[str, Any]:
        """Return facts for the `repr`, by name."""
        return {
            "streams": ", ".join(self.streams),
            "frames": "without end" if self.length is None else self.length,
            "shape": "x".join(map(str, self.frame_shape)),
            "rate": f"{self.fps:g} Hz",
        }


@runtime_checkable
class FrameSource(Protocol):
    """Streams of frames on one clock: simulated, synthetic, live or recorded.

    A source moves forward only; one that can also go back is a `SeekableSource`.

    Frames do not depend on the lengths of the blocks: `take(s, 40)` gives the frames of
    `take(s, 15)` followed by `take(s, 25)`. Attending to a stream never changes the frames of any
    stream.

    Streams of cameras have gaps, that is missing frames. `take` then returns the next n consecutive
    frames, wherever they begin, and moves t behind them; `take_all` returns a block for each
    stretch without a gap, and none for a stream without frames.
    """

    @property
    def spec(self) -> SourceSpec:
        """Properties of the source's blocks."""

    @property
    def t(self) -> int:
        """Number of the next frame."""

    def take(self, stream: int, n: int) -> Block:
        """Return the frames t to t + n - 1 of a stream, and move t by n.

        Raises:
            LogExhaustedError: the recording has fewer than n frames left; t does not move.
            ValueError: the stream does not exist, or n < 1.
        """

    def take_all(self, n: int) -> tuple[Block, ...]:
        """Return the next n frames of every stream, in the streams' order, and move t by n.

        Raises:
            LogExhaustedError: fewer than n frames are left; t does not move.
            ValueError: n < 1.
        """

    def describe(self) -> Mapping[str, Any]:
        """Return the identity of the source as JSON values: its kind, seed or file hashes.

        Raises:
            LogDamagedError: another program replaced a file of it since it was opened.
        """

    def close(self) -> None:
        """Close files and simulators; a second call does nothing."""


@runtime_checkable
class SeekableSource(FrameSource, Protocol):
    """Source that can return any frame again; it inherits `spans` and `take_all`."""

    def seek(self, t: int) -> None:
        """Set t, so that the next block starts there.

        Raises:
            ValueError: t is negative.
        """

    def spans(self, stream: int, start: int, stop: int) -> list[tuple[int, int]]:
        """Return the stretches [low, high) of a stream without a gap, within [start, stop)."""
        return [(start, stop)]

    def take_all(self, n: int) -> tuple[Block, ...]:
        """Return the next n frames of every stream; see `FrameSource`."""
        start = self.t
        blocks = []
        for stream in range(len(self.spec.streams)):
            self.seek(start)
            blocks.append(self.take(stream, n))
        return tuple(blocks)


@runtime_checkable
class LongSource(FrameSource, Protocol):
    """Source of files that take long to read, so that their hashes are optional."""

    def describe(self, progress: Callable[[int, int], None] = ...) -> Mapping[str, Any]:
        """Return the identity of the source; see `FrameSource`.

        Args:
            progress: called with the number of bytes read and the total, if reading takes long.
        """

    def describe_at_once(self) -> Mapping[str, Any]:
        """Return the identity of the source from a sample of each file that takes long to read."""


class Described:
    """Object whose `repr` shows facts about it."""

    __slots__ = ()

    @abstractmethod
    def _facts(self) -> Mapping[str, Any]:
        """Return facts about the object, by name."""

    def __repr__(self) -> str:
        first, *rest = self._facts().items()
        facts = "".join(f", {name} {value}" for name, value in rest)
        return f"<{type(self).__name__} {first[1]}{facts}>"


class ForwardSource(Described, FrameSource):
    """Base of a source that moves forward only: it stores the spec and the clock.

    A derived class sets `_spec`, and `_t` if the first frame is not 0.

    Attributes:
        gaps: True if frames of a stream can be missing.
    """

    gaps: bool = False
    _spec: SourceSpec
    _t: int = 0

    @property
    def spec(self) -> SourceSpec:
        """Properties of the source's blocks."""
        return self._spec

    @property
    def t(self) -> int:
        """Number of the next frame."""
        return self._t

    def take(self, stream: int, n: int) -> Block:
        """Return the next n consecutive frames of a stream.

        Frames of the other streams in the meantime are skipped.

        Raises:
            LogExhaustedError: the source ends first.
            ValueError: the stream does not exist, or n < 1.
        """
        check_request(self.spec, stream, n)
        run: list[Block] = []
        count = 0
        while count < n:
            for block in self.take_all(n - count):
                if block.stream != stream:
                    continue
                if run and run[-1].t + len(run[-1]) != block.t:
                    run, count = [], 0
                run.append(block)
                count += len(block)
        return _join(run)

    def close(self) -> None:
        """Do nothing: there is nothing to close."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, at: object, /) -> None:
        self.close()

    def _facts(self) -> Mapping[str, Any]:
        return self._spec.facts()


class ClockedSource(ForwardSource, SeekableSource):
    """Base of a source that can return any frame again; it needs `take` and `describe` only."""

    # Arguments of the `open_scene` call that opened the source.
    _scene_opened: Any = None

    def seek(self, t: int) -> None:
        """Set t; see `SeekableSource.seek`."""
        if t < 0:
            raise ValueError(f"there is no frame {t}: the first is 0")
        self._t = t


def turn_to(source: FrameSource, before: int, after: int) -> None:
    """Skip the frames that are lost while a head turns from one stream to another.

    A source whose head has to turn has the attribute `turns`: turns[from][to] is the number of lost
    frames. It depends on the two streams only, so that a recording gives the same blocks as the
    scene.

    Args:
        source: the source.
        before: index of the stream of the last block.
        after: index of the stream of the next block.
    """
    turns = getattr(source, "turns", ())
    if turns and isinstance(source, SeekableSource):
        with contextlib.suppress(LogExhaustedError):  # the next `take` raises it
            source.seek(source.t + turns[before][after])


@dataclass(frozen=True, slots=True)
class HeadPose:
    """Pose of the head in the robot's root frame.

    Attributes:
        position: (x, y, z) of the neck yaw joint (m).
        quaternion: (x, y, z, w) of the rotation about the vertical.
    """

    position: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]


def description(
    source: FrameSource,
    *,
    at_once: bool = False,
    progress: Callable[[int, int], None] = lambda done, size: None,
) -> dict[str, Any]:
    """Return the identity of a source, at least its kind; see `FrameSource.describe`.

    Args:
        source: the source.
        at_once: True to use a sample of files that take long to read; see `LongSource`.
        progress: called with the number of bytes read and the total, if reading takes long.

    Raises:
        LogDamagedError: as for `FrameSource.describe`.
    """
    if isinstance(source, LongSource):
        return dict(source.describe_at_once() if at_once else source.describe(progress))
    return dict(source.describe())


def check_request(spec: SourceSpec, stream: int, n: int) -> None:
    """Check that a request for a block is valid.

    Raises:
        ValueError: the stream does not exist, or n < 1.
    """
    if not 0 <= stream < len(spec.streams):
        raise ValueError(f"stream {stream} does not exist: there are {len(spec.streams)}")
    if n < 1:
        raise ValueError(f"a block has at least one frame, not {n}")


def stretches(
    rows: Sequence[Sequence[Any]], t: int, truth: NDArray[np.float64]
) -> tuple[Block, ...]:
    """Return the blocks of consecutive frames of all streams, one for each stretch without a gap.

    Args:
        rows: frame of each stream at each step, None for a missing one.
        t: number of the first step.
        truth: (n, D) truth of the steps, read-only.
    """
    blocks: list[Block] = []
    for stream, column in enumerate(zip(*rows, strict=True)):
        for is_gap, stretch in groupby(enumerate(column), lambda step: step[1] is None):
            if not is_gap:
                steps, frames = zip(*stretch, strict=True)
                part = truth[steps[0] : steps[-1] + 1]
                blocks.append(Block(stream, t + steps[0], freeze(np.stack(frames)), part))
    return tuple(blocks)


def unbroken(blocks: Iterable[Block]) -> list[Block]:
    """Return the stretches without a gap of streams that were read in pieces.

    Args:
        blocks: pieces, those of each stream in order of time.
    """
    by_stream: dict[int, list[list[Block]]] = {}
    for block in blocks:
        runs = by_stream.setdefault(block.stream, [[]])
        if runs[-1] and runs[-1][-1].t + len(runs[-1][-1]) != block.t:
            runs.append([])
        runs[-1].append(block)
    return [_join(run) for runs in by_stream.values() for run in runs]


def _join(run: Sequence[Block]) -> Block:
    """Return consecutive blocks of a stream as one block."""
    if len(run) == 1:
        return run[0]
    frames = freeze(np.concatenate([block.frames for block in run]))
    truth = freeze(np.concatenate([block.truth for block in run]))
    return Block(run[0].stream, run[0].t, frames, truth)


def freeze(array: NDArray[Any]) -> NDArray[Any]:
    """Mark an array as read-only, and return it."""
    array.flags.writeable = False
    return array
