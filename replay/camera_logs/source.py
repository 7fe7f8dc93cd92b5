"""Other people's camera logs as streams of frames on a common clock."""

from __future__ import annotations

import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.blocks import Block, SeekableSource, SourceSpec, check_request, freeze
from cdmisfa.core.clock import NANOSECONDS
from cdmisfa.core.errors import LogExhaustedError, UsageError
from replay.camera_logs.joined import join_parts
from replay.camera_logs.pixels import step_of
from replay.camera_logs.stream import (
    ImageStream,
    even_times,
    fingerprint,
    image_logs,
    open_images,
)
from replay.mcap.records import Bytes
from replay.storage.location import Location, Url

Align = Literal["index", "time"]
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


class ForeignSource(SeekableSource):
    """Cameras in MCAP logs, ROS bags, videos and folders of pictures, gray and small, on one clock.

    Args:
        paths: one log, or one log, video or folder of pictures a stream. Logs that follow one
            another in time are parts of one stream, unless they are aligned by index.
        topics: the topics, a stream each; none where each log has one topic of images.
        size: (height, width) of a frame.
        align: how streams of unequal length, start or rate are put on one clock: "index"
            takes the i-th image of each, "time" the last image at or before each tick.
            None refuses such streams.
        rate: frames a second; the first stream's where not given.
        loop: begin again at the end.
        salvage: leave out what is damaged.
        goal: the command and the folder of its result that a refusal names in what would work.

    Attributes:
        alignment: for each stream the counts of its messages, of repeated frames and of
            dropped messages.
        warnings: what the user should know: logs that were cut, damage that was left out.
    """

    def __init__(
        self,
        paths: str | Location | Sequence[str | Location],
        topics: Sequence[str] = (),
        *,
        size: tuple[int, int] = (48, 128),
        align: Align | None = None,
        rate: float | None = None,
        loop: bool = False,
        salvage: bool = False,
        goal: tuple[str, str] = ("learn", "RUN"),
    ) -> None:
        """Open the logs and find their images.

        Raises:
            UsageError: no such log or topic, images smaller than a frame, or streams that
                need `align`.
            LogDamagedError: a log is damaged.
        """
        if rate is not None and not 1e-3 <= rate <= 1e6:
            raise UsageError(f"--rate is {rate}: it must be in [0.001, 1000000]")
        if min(size) < 1:
            raise UsageError(f"--size is {size[1]}x{size[0]}: it must be above 0")
        named = [paths] if isinstance(paths, str | Path | Url) else paths
        self._files = image_logs(named)
        self._loop = loop
        self._t = 0
        self._hashes: list[dict[str, Any]] | None = None
        self._size = size
        self._goal = goal
        self._streams: list[ImageStream] = []
        self._shown: dict[int, tuple[int, Bytes]] = {}
        try:
            for path, topic in _pairs(self._files, topics):
                self._streams.append(open_images(path, topic, size, salvage=salvage))
            if align != "index":
                self._streams = join_parts(self._streams)
            self._align_by = align
            self._fps = rate or _rate(self._streams)
            self._times = [
                s.times if len(s.times) else even_times(s.count, self._fps) for s in self._streams
            ]
            self._aligned = self._put_on_clock(align)
            for stream, aligned in enumerate(self._aligned):  # refused before anything is written
                self._frame(stream, int(aligned.rows[0]))
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
                "messages": stream.count,
                "repeated": aligned.repeated,
                "dropped": aligned.dropped,
            }
            for name, stream, aligned in zip(
                self._spec.streams, self._streams, self._aligned, strict=True
            )
        }
        self.warnings = tuple(dict.fromkeys(w for s in self._streams for w in s.warnings))

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
            UsageError: an image is smaller than a frame; t stays.
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
            frames[i] = self._frame(stream, int(rows[(self._t + i) % self._count]))
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
            parts = [p for s in self._streams for p in getattr(s, "parts", [s])]
            self._hashes = [fingerprint(path, parts) for path in self._files]
        return {
            "kind": "foreign",
            "files": self._hashes,
            "topics": [s.topic for s in self._streams],
            "size": list(self._spec.frame_shape),
            "recipe": "; ".join(dict.fromkeys(s.recipe for s in self._streams)),
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

    def _frame(self, stream: int, row: int) -> Bytes:
        """A stream's image as a frame; decoded once where it is repeated."""
        shown = self._shown.get(stream)
        if shown is not None and shown[0] == row:
            return shown[1]
        images = self._streams[stream]
        try:
            frame = images.frame(row)
        except UsageError as error:
            raise UsageError(f"{images.path}: {error}") from None
        self._shown[stream] = (row, frame)
        return frame

    def _put_on_clock(self, align: Align | None) -> list[Aligned]:
        if align == "time":
            return self._by_time()
        if align is None:
            self._refuse_unequal()
            self._refuse_rate()
        self._start = int(self._times[0][0])
        count = min(len(times) for times in self._times)
        return [Aligned(np.arange(count), 0, len(times) - count) for times in self._times]

    def _refuse_rate(self) -> None:
        """Refuse to take images at another rate than theirs without being told how.

        Raises:
            UsageError: their rate differs by more than a hundredth from the one asked for.
        """
        for stream in self._streams:
            step = step_of(stream.times)
            if step > 0 and abs(step * self._fps - 1) > 0.01:
                raise UsageError(
                    f"{stream.topic} has {1 / step:g} images a second, not {self._fps:g}: choose "
                    f"images by their times, as with: {self._command()}"
                )

    def _overlap(self) -> tuple[int, int]:
        """From when to when every stream has images, in nanoseconds."""
        starts, stops = zip(*((int(t[0]), int(t[-1])) for t in self._times), strict=True)
        return max(starts), min(stops)

    def _by_time(self) -> list[Aligned]:
        self._start, stop = self._overlap()
        if stop < self._start:
            raise UsageError(
                f"{self._files[0]}: its streams have no time in common; use --align index"
            )
        ticks = (stop - self._start) * self._fps / NANOSECONDS + 1
        if ticks > MAX_FRAMES:
            raise UsageError(f"--rate {self._fps:g} makes {ticks:.0f} frames: choose a lower one")
        offsets = np.rint(np.arange(int(ticks)) * NANOSECONDS / self._fps).astype(np.uint64)
        clock = np.uint64(self._start) + offsets
        aligned = []
        for times in self._times:
            rows = np.searchsorted(times, clock, side="right").astype(np.int64) - 1
            shown = len(np.unique(rows))
            aligned.append(Aligned(rows, len(rows) - shown, len(times) - shown))
        return aligned

    def _refuse_unequal(self) -> None:
        """Refuse streams whose i-th images were not taken together, with what would work.

        Raises:
            UsageError: they differ in number, or by more than half a step.
        """
        first = self._times[0]
        half = NANOSECONDS * step_of(first) / 2
        for stream, times in zip(self._streams[1:], self._times[1:], strict=True):
            if len(times) != len(first):
                reason = f"{len(first)} and {len(times)} images"
            elif np.abs(times.astype(np.int64) - first.astype(np.int64)).max() > half:
                reason = "images at different times"
            else:
                continue
            raise UsageError(
                f"{self._streams[0].topic} and {stream.topic} have {reason}: put them on one "
                f"clock, as with: {self._command()}"
            )

    def _command(self) -> str:
        """Give a command that takes these streams."""
        words = ["cdmisfa", self._goal[0], *map(str, self._files)]
        for stream in self._streams:
            words += ["--topic", stream.topic]
        start, stop = self._overlap()
        words += ["--size", f"{self._size[1]}x{self._size[0]}"]
        words += ["--align", "time" if start < stop else "index", "--rate", f"{self._fps:g}"]
        return shlex.join([*words, "-o", self._goal[1]])


def _pairs(files: Sequence[Location], topics: Sequence[str]) -> list[tuple[Location, str | None]]:
    if len(files) == 1:
        return [(files[0], topic) for topic in topics] or [(files[0], None)]
    if not topics:
        return [(file, None) for file in files]
    if len(topics) == 1:
        return [(file, topics[0]) for file in files]
    if len(topics) != len(files):
        raise UsageError(
            f"{len(files)} logs and {len(topics)} topics: name one log, or one --topic for each; "
            "parts of one log with several topics go in a folder with their metadata.yaml"
        )
    return list(zip(files, topics, strict=True))


def _rate(streams: Sequence[ImageStream]) -> float:
    """Images a second of the first stream that has times."""
    timed = next((s for s in streams if len(s.times)), None)
    if timed is None:
        raise UsageError(f"{streams[0].path}: pictures tell no rate; set one with --rate")
    step = step_of(timed.times)
    if not step > 0:
        raise UsageError(f"{timed.path}: {timed.topic} tells no rate; set one with --rate")
    return float(f"{1 / step:.6g}")


def _names(streams: Sequence[ImageStream]) -> tuple[str, ...]:
    """Topics as names of streams, with the file's and folders' where topics are shared."""
    topics = [s.topic for s in streams]
    if len(set(topics)) == len(topics):
        return tuple(topics)
    places = [_place(stream) for stream in streams]
    for i, place in enumerate(places):
        if place in places[:i]:
            raise UsageError(f"{topics[i]} of {streams[i].path} is named twice: leave one out")
    for folders in range(max(len(Path(path).parts) for path, _ in places)):
        names = [_in_folders(stream, folders) for stream in streams]
        if len(set(names)) == len(names):
            return tuple(names)
    return tuple(f"{i + 1}/{topic}" for i, topic in enumerate(topics))


def _place(stream: ImageStream) -> tuple[str, str]:
    """Where the images of a stream lie, and their topic there."""
    path = stream.path
    return (path.address if isinstance(path, Url) else str(path.resolve())), stream.topic


def _in_folders(stream: ImageStream, folders: int) -> str:
    """A stream's name with those of its file, and of some of the folders this is in."""
    path, topic = stream.path, stream.topic
    of_file = topic == path.stem or (isinstance(path, Path) and topic == path.resolve().name)
    own = topic if of_file else path.stem + topic
    above = Path(str(path) if isinstance(path, Url) else os.path.abspath(path)).parts[:-1]
    return "/".join([*above[max(len(above) - folders, 0) :], own]).removeprefix("//")
