"""Frames on their way to the learner: `Block`, and where they come from: `FrameSource`.

All streams share one clock: a frame counter t that runs on for every stream,
whichever is watched, as the channels of a television do.
"""

from __future__ import annotations

import contextlib
from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.clock import NANOSECONDS, SLOWEST, Times, nearest_frames, time_of, times_of
from cdmisfa.core.errors import LogExhaustedError, UsageError

# The only type whose values are pixels, and the value of one step of a pixel.
UINT8 = np.dtype(np.uint8)
PIXEL = 1.0 / 255.0


@dataclass(frozen=True, slots=True)
class Block:
    """The frames one stream shows from t on.

    Attributes:
        stream: index of the stream, from 0.
        t: global frame counter of the first frame.
        frames: (n, *frame_shape), uint8 pixels or float64 values; C-contiguous,
            read-only, and never written again by the source.
        truth: (n, D) float64, what the world knows and the learner must not:
            one column per name in `SourceSpec.truth`. D may be 0.
    """

    stream: int
    t: int
    frames: NDArray[Any]
    truth: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.frames)


@dataclass(frozen=True, slots=True)
class SourceSpec:
    """Specification of a source: what all its blocks have in common.

    Attributes:
        streams: a name for each stream (the view's name in a recording).
        frame_shape: (height, width) of an image, (I,) of a vector.
        dtype: "uint8" for pixels, "float64" for values.
        truth: a name for each column of `Block.truth`.
        fps: frames per second of the common clock.
        start_ns: log time of frame 0, in nanoseconds.
        length: number of frames, or None where the stream does not end.

    Raises:
        UsageError: there is no clock of so many frames a second.
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
            raise UsageError(f"a source of {self.fps} frames a second has no clock")

    @property
    def images(self) -> bool:
        """Whether frames are gray images, and not values."""
        return self.dtype == "uint8" and len(self.frame_shape) == 2

    def time_ns(self, t: int) -> int:
        """Log time of frame t, in nanoseconds."""
        return time_of(t, self.fps, self.start_ns)

    def times(self, start: int, stop: int) -> Times:
        """Log times of the frames [start, stop), (stop - start,) nanoseconds."""
        return times_of(np.arange(start, stop), self.fps, self.start_ns)

    def frames_at(self, times: NDArray[Any]) -> Times:
        """Return the frames nearest to log times, (n,) nanoseconds."""
        return nearest_frames(times, self.fps, self.start_ns)

    def facts(self) -> dict[str, Any]:
        """Return facts for a notebook, by names."""
        return {
            "streams": ", ".join(self.streams),
            "frames": "without end" if self.length is None else self.length,
            "shape": "x".join(map(str, self.frame_shape)),
            "rate": f"{self.fps:g} Hz",
        }


@runtime_checkable
class FrameSource(Protocol):
    """Streams of frames on one clock: simulated, synthetic, live or recorded, all the same.

    It only goes forward; what can also go back is a `SeekableSource`.

    Blocks do not depend on how they are cut: `take(s, 40)` gives the frames of
    `take(s, 15)` followed by `take(s, 25)`. Which stream is watched never changes
    what the streams show.

    Streams of cameras have gaps: frames that a stream lacks. Then `take` gives the next n frames
    that follow one another, wherever they begin, and moves t behind them; `take_all` gives a
    block for each unbroken stretch, and none for a stream that shows nothing.
    """

    @property
    def spec(self) -> SourceSpec:
        """Specification of the source's blocks."""

    @property
    def t(self) -> int:
        """Global counter of the next frame."""

    def take(self, stream: int, n: int) -> Block:
        """Return the n frames that `stream` shows at t .. t+n-1; moves t by n.

        Raises:
            LogExhaustedError: a recording has fewer than n frames left; t stays.
            ValueError: no such stream, or n < 1.
        """

    def take_all(self, n: int) -> tuple[Block, ...]:
        """Return what every stream shows in the next n frames, in their order; moves t by n.

        Raises:
            LogExhaustedError: fewer than n frames are left; t stays.
            ValueError: n < 1.
        """

    def describe(self) -> Mapping[str, Any]:
        """Return what identifies the source, as JSON values: its kind, seed or file hashes.

        Raises:
            LogDamagedError: it was replaced since it was opened, by others or in part.
        """

    def close(self) -> None:
        """Let go of files and simulators; harmless when called twice."""


@runtime_checkable
class SeekableSource(FrameSource, Protocol):
    """A source that can show any frame again; deriving from it gives `spans` and `take_all`."""

    def seek(self, t: int) -> None:
        """Move the clock to frame t, so that the next block starts there.

        Raises:
            ValueError: there is no frame before 0.
        """

    def spans(self, stream: int, start: int, stop: int) -> list[tuple[int, int]]:
        """Return the unbroken stretches [low, high) of a stream within the frames [start, stop)."""
        return [(start, stop)]

    def take_all(self, n: int) -> tuple[Block, ...]:
        """Return what every stream shows in the next n frames; see `FrameSource`."""
        start = self.t
        blocks = []
        for stream in range(len(self.spec.streams)):
            self.seek(start)
            blocks.append(self.take(stream, n))
        return tuple(blocks)


@runtime_checkable
class LongSource(FrameSource, Protocol):
    """A source of files that take long to read: less is known of it until all of them were."""

    def describe(self, progress: Callable[[int, int], None] = ...) -> Mapping[str, Any]:
        """See `FrameSource`; tells how many bytes were read and how many there are, if many."""

    def describe_at_once(self) -> Mapping[str, Any]:
        """Return what `describe` returns, with a sample of each file that takes long to read."""


class Described:
    """An object whose `repr` states some facts about it."""

    __slots__ = ()

    @abstractmethod
    def _facts(self) -> Mapping[str, Any]:
        """Return facts about the object, by names."""

    def __repr__(self) -> str:
        first, *rest = self._facts().items()
        facts = "".join(f", {name} {value}" for name, value in rest)
        return f"<{type(self).__name__} {first[1]}{facts}>"


class ForwardSource(Described, FrameSource):
    """A source that holds its spec and its clock, and need not be able to go back.

    A class that derives from it sets `_spec`, and `_t` where its first frame is not 0.

    Attributes:
        gaps: whether streams may lack frames.
    """

    gaps: bool = False
    _spec: SourceSpec
    _t: int = 0

    @property
    def spec(self) -> SourceSpec:
        """Specification of the source's blocks."""
        return self._spec

    @property
    def t(self) -> int:
        """Global counter of the next frame."""
        return self._t

    def take(self, stream: int, n: int) -> Block:
        """Return the next n frames of a stream that follow one another without a gap.

        What the other streams show meanwhile is passed over.

        Raises:
            LogExhaustedError: the source ends before.
            ValueError: no such stream, or n < 1.
        """
        check_request(self.spec, stream, n)
        run: list[Block] = []
        held = 0
        while held < n:
            for block in self.take_all(n - held):
                if block.stream != stream:
                    continue
                if run and run[-1].t + len(run[-1]) != block.t:
                    run, held = [], 0
                run.append(block)
                held += len(block)
        return _as_one(run)

    def close(self) -> None:
        """Nothing to let go of."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, at: object, /) -> None:
        self.close()

    def _facts(self) -> Mapping[str, Any]:
        return self._spec.facts()


class ClockedSource(ForwardSource, SeekableSource):
    """A source of which any frame can be shown again, and so needs `take` and `describe` alone."""

    # The arguments with which `open_scene` opened it.
    _scene_opened: Any = None

    def seek(self, t: int) -> None:
        """Move the clock to frame t; see `SeekableSource.seek`."""
        if t < 0:
            raise ValueError(f"there is no frame {t}: the first is 0")
        self._t = t


def turn_to(source: FrameSource, before: int, after: int) -> None:
    """Pass over the frames that are lost as a head turns from one stream to another.

    A source whose head has to turn says how many: `turns`, [from][to]. They depend on the two
    alone, so that a recording gives the blocks that the scene gave.
    """
    turns = getattr(source, "turns", ())
    if turns and isinstance(source, SeekableSource):
        with contextlib.suppress(LogExhaustedError):  # which the next `take` says
            source.seek(source.t + turns[before][after])


@dataclass(frozen=True, slots=True)
class HeadPose:
    """Pose of the head in the robot's root frame.

    Attributes:
        position: (x, y, z) of the neck yaw joint, metres.
        quaternion: (x, y, z, w) of its turn about the vertical.
    """

    position: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]


def description(
    source: FrameSource,
    *,
    at_once: bool = False,
    progress: Callable[[int, int], None] = lambda done, size: None,
) -> dict[str, Any]:
    """Return what identifies a source, its kind at least; see `FrameSource.describe`.

    Args:
        source: the source.
        at_once: with less of its files where they take long to read; see `LongSource`.
        progress: of bytes that were read and that are to be read, where they take long to read.

    Raises:
        LogDamagedError: as for `FrameSource.describe`.
    """
    if isinstance(source, LongSource):
        return dict(source.describe_at_once() if at_once else source.describe(progress))
    return dict(source.describe())


def check_request(spec: SourceSpec, stream: int, n: int) -> None:
    """Refuse a block that no source can give.

    Raises:
        ValueError: no such stream, or fewer than one frame.
    """
    if not 0 <= stream < len(spec.streams):
        raise ValueError(f"stream {stream} does not exist: there are {len(spec.streams)}")
    if n < 1:
        raise ValueError(f"a block has at least one frame, not {n}")


def unbroken(blocks: Iterable[Block]) -> list[Block]:
    """Return the unbroken stretches of streams that were read in pieces.

    Args:
        blocks: those of each stream in order of time.
    """
    found: dict[int, list[list[Block]]] = {}
    for block in blocks:
        runs = found.setdefault(block.stream, [[]])
        if runs[-1] and runs[-1][-1].t + len(runs[-1][-1]) != block.t:
            runs.append([])
        runs[-1].append(block)
    return [_as_one(run) for runs in found.values() for run in runs]


def _as_one(run: Sequence[Block]) -> Block:
    """Return blocks of a stream that follow one another, as one."""
    if len(run) == 1:
        return run[0]
    frames = freeze(np.concatenate([block.frames for block in run]))
    truth = freeze(np.concatenate([block.truth for block in run]))
    return Block(run[0].stream, run[0].t, frames, truth)


def freeze(array: NDArray[Any]) -> NDArray[Any]:
    """Mark an array as never to be written again, and return it."""
    array.flags.writeable = False
    return array
