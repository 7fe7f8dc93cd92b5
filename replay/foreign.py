"""Other people's camera logs as streams of frames on a common clock."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from cdmisfa.blocks import NANOSECONDS, Block, SourceSpec, check_request, freeze
from cdmisfa.errors import LogDamagedError, LogExhaustedError, UsageError
from replay.files import log_files, sha256
from replay.images import RECIPE, SCHEMAS, Decoder, image_decoder, shrink, step_of
from replay.reader import LogReader
from replay.records import Bytes, Channel, MalformedRecord
from replay.structure import Segment

Align = Literal["index", "time"]
CACHE_BYTES: Final = 1024 * 1024
MAX_FRAMES: Final = 2**31


@dataclass(frozen=True, slots=True)
class Aligned:
    """A stream on the common clock.

    Attributes:
        rows: (n,) int64, which message each frame shows.
        repeated: frames that show the message of the frame before again.
        dropped: messages that no frame shows.
    """

    rows: NDArray[np.int64]
    repeated: int
    dropped: int


class ForeignStream:
    """The images on one topic of one log, in the order of log time.

    Args:
        path: the log.
        topic: the topic; may be left out where the log has one topic of images.
        size: (height, width) of a frame.
        salvage: leave out what is damaged.

    Raises:
        UsageError: no such topic, or no images on it.
        LogDamagedError: the log is damaged.
    """

    def __init__(
        self, path: Path, topic: str | None, size: tuple[int, int], *, salvage: bool = False
    ) -> None:
        self.path = path
        self.size = size
        self.reader = LogReader(path, salvage=salvage, cache_bytes=CACHE_BYTES)
        self._last: tuple[int, Bytes] | None = None
        try:
            self.channel, self._decode = self._find(topic)
            self._index()
        except BaseException:
            self.reader.close()
            raise

    @property
    def topic(self) -> str:
        """The topic."""
        return self.channel.topic

    def frame(self, row: int) -> Bytes:
        """Decode a message into a frame, (height, width) uint8.

        Raises:
            LogDamagedError: the message is no image that is read.
        """
        if self._last is not None and self._last[0] == row:
            return self._last[1]
        segment = self._segments[int(self._segment_of[row])]
        table = self.reader.table(segment)
        try:
            if table is None:
                raise MalformedRecord("it is damaged")
            image = shrink(self._decode(table.payload(int(self._row_in[row]))), *self.size)
        except MalformedRecord as error:
            raise LogDamagedError(
                f"{self.path}: {self.topic} at {self.times[row]} ns: {error}"
            ) from None
        self._last = (row, image)
        return image

    def close(self) -> None:
        """Let go of the file; harmless when called twice."""
        self.reader.close()

    def _find(self, topic: str | None) -> tuple[Channel, Decoder]:
        readable: list[tuple[Channel, Decoder]] = []
        others: dict[str, str] = {}
        for channel in self.reader.channels.values():
            schema = self.reader.schemas.get(channel.schema_id)
            name = schema.name if schema else "no schema"
            decoder = image_decoder(name, channel.encoding)
            if decoder is None:
                others[channel.topic] = f"{name} in {channel.encoding or 'no encoding'}"
            else:
                readable.append((channel, decoder))
        found = [r for r in readable if topic in (None, r[0].topic)]
        if len(found) == 1:
            return found[0]
        known = ", ".join(sorted(c.topic for c, _ in readable)) or "none"
        if topic is None:
            raise UsageError(f"{self.path}: name one --topic; it has images on: {known}")
        if len(found) > 1:
            raise UsageError(f"{self.path}: {len(found)} channels share the topic {topic}")
        if topic in others:
            raise UsageError(
                f"{self.path}: {topic} holds {others[topic]}, images are {', '.join(SCHEMAS)}"
            )
        raise UsageError(f"{self.path}: no topic {topic}; it has images on: {known}")

    def _index(self) -> None:
        """Find every message of the topic; one pass over the log checks all of it."""
        self._segments: list[Segment] = []
        times, members, rows = [], [], []
        for segment, table in self.reader.tables(ordered=False):
            own = np.flatnonzero(table.channel == self.channel.id)
            if len(own):
                times.append(table.log_time[own])
                members.append(np.full(len(own), len(self._segments), np.int32))
                rows.append(own.astype(np.int32))
                self._segments.append(segment)
        if not times:
            raise UsageError(f"{self.path}: there is no message on {self.channel.topic}")
        order = np.argsort(np.concatenate(times), kind="stable")
        self.times = np.concatenate(times)[order]
        if int(self.times[-1]) >= 2**62:
            raise LogDamagedError(f"{self.path}: {self.channel.topic} has times beyond any clock")
        self._segment_of = np.concatenate(members)[order]
        self._row_in = np.concatenate(rows)[order]


class ForeignSource:
    """Camera topics of any MCAP logs, made gray and small, on a common clock.

    Args:
        paths: one log, or one log a topic.
        topics: the topics, a stream each; none where each log has one topic of images.
        size: (height, width) of a frame.
        align: how streams of unequal length, start or rate are put on one clock: "index"
            takes the i-th image of each, "time" the last image at or before each tick.
            None refuses such streams.
        rate: ticks a second; the first stream's where not given.
        loop: begin again at the end.
        salvage: leave out what is damaged.

    Attributes:
        alignment: for each stream the counts of its messages, of repeated frames and of
            dropped messages.
        warnings: what the user should know: logs that were cut, damage that was left out.
    """

    def __init__(
        self,
        paths: str | Path | Sequence[str | Path],
        topics: Sequence[str] = (),
        *,
        size: tuple[int, int] = (48, 128),
        align: Align | None = None,
        rate: float | None = None,
        loop: bool = False,
        salvage: bool = False,
    ) -> None:
        """Open the logs and find their images.

        Raises:
            UsageError: no such log or topic, or streams that need `align`.
            LogDamagedError: a log is damaged.
        """
        if rate is not None and not 1e-3 <= rate <= 1e6:
            raise UsageError(f"--rate is {rate}: it must be in [0.001, 1000000]")
        if min(size) < 1:
            raise UsageError(f"--size is {size[1]}x{size[0]}: it must be above 0")
        self._files = log_files(paths)
        self._loop = loop
        self._t = 0
        self._hashes: dict[str, str] | None = None
        self._streams: list[ForeignStream] = []
        try:
            for path, topic in _pairs(self._files, topics):
                self._streams.append(ForeignStream(path, topic, size, salvage=salvage))
            self._align_by = align
            self._fps = rate or _rate(self._streams[0])
            self._aligned = self._put_on_clock(align)
        except BaseException:
            self.close()
            raise
        self._count = len(self._aligned[0].rows)
        self._spec = SourceSpec(
            _names(self._streams),
            size,
            "uint8",
            (),
            self._fps,
            self._start,
            None if loop else self._count,
        )
        self.alignment = {
            name: {
                "messages": len(stream.times),
                "repeated": aligned.repeated,
                "dropped": aligned.dropped,
            }
            for name, stream, aligned in zip(
                self._spec.streams, self._streams, self._aligned, strict=True
            )
        }
        self.warnings = tuple(
            dict.fromkeys(
                f"{s.path}: {text}"
                for s in self._streams
                for text in [s.reader.missing, *(f"{p.where}: {p.what}" for p in s.reader.problems)]
                if text
            )
        )

    @property
    def spec(self) -> SourceSpec:
        """What the streams deliver; without a length where they loop."""
        return self._spec

    @property
    def t(self) -> int:
        """Number of the next frame."""
        return self._t

    def take(self, stream: int, n: int) -> Block:
        """The n frames that a stream shows at t .. t+n-1; moves t by n.

        Raises:
            LogExhaustedError: fewer than n frames are left; t stays.
            LogDamagedError: a message is no image; t stays.
            ValueError: no such stream, or n < 1.
        """
        check_request(self._spec, stream, n)
        if not self._loop and self._t + n > self._count:
            raise LogExhaustedError(
                f"{self._files[0]}: {self._count - self._t} frames are left at frame {self._t}, "
                f"{n} are needed; begin again at the end with --loop"
            )
        frames = np.empty((n, *self._spec.frame_shape), np.uint8)
        rows = self._aligned[stream].rows
        for i in range(n):
            frames[i] = self._streams[stream].frame(int(rows[(self._t + i) % self._count]))
        block = Block(stream, self._t, freeze(frames), freeze(np.empty((n, 0))))
        self._t += n
        return block

    def seek(self, t: int) -> None:
        """Move the clock to frame t.

        Raises:
            LogExhaustedError: the logs end before it.
            ValueError: t is below 0.
        """
        if t < 0:
            raise ValueError(f"frame {t} lies before the first, 0")
        if not self._loop and t > self._count:
            raise LogExhaustedError(f"{self._files[0]}: it ends at frame {self._count}, before {t}")
        self._t = t

    def describe(self) -> Mapping[str, Any]:
        """The logs with their SHA-256, the topics, and how they became frames."""
        if self._hashes is None:
            self._hashes = {path.name: sha256(path) for path in self._files}
        return {
            "kind": "foreign",
            "files": self._hashes,
            "topics": [s.topic for s in self._streams],
            "size": list(self._spec.frame_shape),
            "recipe": RECIPE,
            "align": self._align_by,
            "rate": self._fps,
            "alignment": self.alignment,
            "frames": self._count,
            "loop": self._loop,
        }

    def close(self) -> None:
        """Let go of the files; harmless when called twice."""
        for stream in self._streams:
            stream.close()

    def _put_on_clock(self, align: Align | None) -> list[Aligned]:
        streams = self._streams
        self._start = int(streams[0].times[0])
        if align == "time":
            return self._by_time()
        if align is None:
            self._refuse_unequal()
        count = min(len(s.times) for s in streams)
        return [Aligned(np.arange(count), 0, len(s.times) - count) for s in streams]

    def _by_time(self) -> list[Aligned]:
        start = max(int(s.times[0]) for s in self._streams)
        stop = min(int(s.times[-1]) for s in self._streams)
        if stop < start:
            raise UsageError(
                f"{self._files[0]}: its streams have no time in common; use --align index"
            )
        ticks = (stop - start) * self._fps / NANOSECONDS + 1
        if ticks > MAX_FRAMES:
            raise UsageError(f"--rate {self._fps:g} makes {ticks:.0f} frames: choose a lower one")
        self._start = start
        offsets = np.rint(np.arange(int(ticks)) * NANOSECONDS / self._fps).astype(np.uint64)
        clock = np.uint64(start) + offsets
        aligned = []
        for stream in self._streams:
            rows = np.searchsorted(stream.times, clock, side="right").astype(np.int64) - 1
            shown = len(np.unique(rows))
            aligned.append(Aligned(rows, len(rows) - shown, len(stream.times) - shown))
        return aligned

    def _refuse_unequal(self) -> None:
        first = self._streams[0].times
        half = step_of(first) / 2 * 1e9
        reason = ""
        for stream in self._streams[1:]:
            times = stream.times
            if len(times) != len(first):
                reason = f"{len(first)} and {len(times)} images"
            elif np.abs(times.astype(np.int64) - first.astype(np.int64)).max() > half:
                reason = "images at different times"
            if reason:
                break
        if reason:
            words = ["cdmisfa", "learn", *map(str, self._files)]
            for stream in self._streams:
                words += ["--topic", stream.topic]
            raise UsageError(
                f"{self._streams[0].topic} and {stream.topic} have {reason}: put them on one "
                f"clock, as with: {shlex.join(words)} --align time --rate {self._fps:g} -o RUN"
            )


def _pairs(files: Sequence[Path], topics: Sequence[str]) -> list[tuple[Path, str | None]]:
    if len(files) == 1:
        return [(files[0], topic) for topic in topics] or [(files[0], None)]
    if not topics:
        return [(file, None) for file in files]
    if len(topics) == 1:
        return [(file, topics[0]) for file in files]
    if len(topics) != len(files):
        raise UsageError(
            f"{len(files)} logs and {len(topics)} topics: name one log, or one --topic for each"
        )
    return list(zip(files, topics, strict=True))


def _rate(stream: ForeignStream) -> float:
    step = step_of(stream.times)
    if not step > 0:
        raise UsageError(f"{stream.path}: {stream.topic} tells no rate; set one with --rate")
    return float(f"{1 / step:.6g}")


def _names(streams: Sequence[ForeignStream]) -> tuple[str, ...]:
    """Topics as names of streams, with the file's where topics are shared."""
    topics = [s.topic for s in streams]
    if len(set(topics)) == len(topics):
        return tuple(topics)
    names = [f"{s.path.stem}{s.topic}" for s in streams]
    if len(set(names)) < len(names):
        raise UsageError(f"{streams[0].path}: a topic is named twice")
    return tuple(names)
