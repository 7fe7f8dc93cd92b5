"""Blocks of frames, and the interfaces of the sources that deliver them.

All streams of a source share one clock: a frame counter t that advances for every stream,
whichever the learner attends to.
"""

from __future__ import annotations

import contextlib
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.clock import NANOSECONDS, SLOWEST, Times, nearest_frames, time_of, times_of
from cdmisfa.core.errors import LogExhaustedError, UsageError

# The only element type that holds pixels, and the value of one gray level.
UINT8 = np.dtype(np.uint8)
PIXEL = 1.0 / 255.0

# Shape of a frame, and its element type.
FrameKind = tuple[tuple[int, ...], str]


@dataclass(frozen=True, slots=True)
class Block:
    """Consecutive frames of one stream.

    Attributes:
        stream: index of the stream, from 0.
        t: global frame counter of the first frame.
        frames: (n, *shape) of the stream's kind, uint8 pixels or float64 values; C-contiguous,
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
        frame_shape: (height, width) of an image, (I,) of a vector; () if `kinds` differ.
        dtype: "uint8" for pixels, "float64" for values; "mixed" if `kinds` differ.
        truth: name of each column of `Block.truth`.
        fps: frames per second of the common clock.
        start_ns: log time of frame 0 (ns).
        length: number of frames, or None if the source is endless.
        kinds: shape and type of the frames of each stream, only if they differ; see `of_kinds`.

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
    kinds: tuple[FrameKind, ...] = ()

    @classmethod
    def of_kinds(cls, streams: Sequence[str], kinds: Sequence[FrameKind], *about: Any) -> Self:
        """Return the spec of streams with frames of some kinds; `about` is `truth` to `length`."""
        if len(set(kinds)) == 1:
            return cls(tuple(streams), *kinds[0], *about)
        if len({shape for shape, dtype in kinds if len(shape) == 2}) > 1:
            raise UsageError("the images of the streams differ in size: give all one size")
        return replace(cls(tuple(streams), (), "mixed", *about), kinds=tuple(kinds))

    def __post_init__(self) -> None:
        if not SLOWEST <= self.fps <= NANOSECONDS:
            raise UsageError(f"a source cannot have {self.fps} frames a second: give 1e-6 to 1e9")

    @property
    def images(self) -> bool:
        """Whether the frames of every stream are gray images, all of one shape."""
        return self.dtype == "uint8" and len(self.frame_shape) == 2

    def kind(self, stream: int) -> FrameKind:
        """Return shape and type of the frames of a stream."""
        return self.kinds[stream] if self.kinds else (self.frame_shape, self.dtype)

    @property
    def every_kind(self) -> list[FrameKind]:
        """Shapes and types of the frames of all streams, each once."""
        return list(dict.fromkeys(self.kinds)) or [self.kind(0)]

    def of(self, stream: int) -> SourceSpec:
        """Return the spec of one stream alone."""
        shape, dtype = self.kind(stream)
        name = (self.streams[stream],)
        return replace(self, streams=name, frame_shape=shape, dtype=dtype, kinds=())

    @property
    def size(self) -> list[Any]:
        """Shape of a frame as JSON values, a list for each stream if they differ."""
        return [list(shape) for shape, _ in self.kinds] or list(self.frame_shape)

    def as_json(self) -> dict[str, Any]:
        """Return the attributes as JSON values, `kinds` only if they differ."""
        stated = asdict(self)
        return stated if self.kinds else {k: v for k, v in stated.items() if k != "kinds"}

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
            "shape": ", ".join("x".join(map(str, shape)) for shape, _ in self.every_kind),
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
        return one_block(run)

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


def one_block(run: Sequence[Block]) -> Block:
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
