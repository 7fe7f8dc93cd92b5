"""Other people's camera logs as streams of frames on a common clock."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cdmisfa.core.blocks import Block, SourceSpec, freeze
from cdmisfa.core.clock import RECORDED_FPS
from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.core.options import option_words
from recorder.images.decoding import Reading
from recorder.images.fields import rounded
from recorder.images.framing import framings
from recorder.images.options import Clock, Depth, Fit, Size
from recorder.images.pixels import Shown, UnknownPixels
from recorder.images.videos import COLOR_RECIPE
from replay.camera_logs.alignment import (
    Rows,
    by_index,
    by_time,
    counts,
    gaps_by_time,
    in_words,
    missing,
    of_other_rate,
    overlap,
    pauses,
    retimed,
    step_of,
    unlike,
    with_gaps,
)
from replay.camera_logs.catalogue import named_streams
from replay.camera_logs.joined import excerpts, join_parts, known_times, rate_of
from replay.camera_logs.names import stream_names
from replay.camera_logs.opening import identity_of, image_logs, open_images
from replay.camera_logs.options import Align, CameraOptions, Gaps
from replay.camera_logs.salvaged import BROKEN, SALVAGE, WholeImages
from replay.camera_logs.stream import ImageStream
from replay.storage.identity import Identity, LoggedSource
from replay.storage.location import Location, Url
from replay.stored import Span, outside


class UnequalError(UsageError):
    """Streams that are on no common clock unless they are aligned."""


class ForeignSource(LoggedSource):
    """What others logged, on one clock: images of cameras, gray and small, or numbers.

    Args:
        paths: one log, or one log, video, table or folder of pictures a stream. Logs that follow
            one another in time are parts of one stream, unless they are aligned by index.
        topics: the topics, a stream each, or patterns; see `named_streams`.
        size: (height, width) of a frame; by default `default_size` of the first image.
        fit: how images of another aspect ratio become frames: see `fitted`.
        align: how streams of unequal length, start or rate are put on one clock: "index"
            takes the i-th image of each, "time" the last image at or before each tick.
            None refuses such streams.
        gaps: whether the frames of a pause are left out, so that no block reaches across, or
            show the last image; see `pauses`.
        start: seconds after the first image of all, before which images are left out.
        stop: seconds after it from which on they are left out.
        depth: distances in metres that are shown black and white.
        fields: the numbers that are taken instead of images, one after the other.
        time: the column of a table's times.
        color: show red, green and blue beside one another, (height, 3 width).
        stamp: the times of messages: those of the log, or those in their headers.
        rate: frames a second; the first stream's where not given.
        loop: begin again at the end.
        salvage: leave out what is damaged, and broken images; see `WholeImages`.
        goal: the command and the folder of its result that a refusal names in what would work.

    Attributes:
        alignment: for each stream the counts of its messages, of repeated frames and of
            dropped messages.
        gaps: whether streams lack frames: then `take` gives the next n that follow one another.
        pauses: for each stream the frames [start, stop) of its gaps.
        shapes: for each stream how an image becomes a frame, in words.
        changes: for each stream whose images change their size, or whose numbers are held
            rounded, a line that says so; as soon as one was shown.
        warnings: what the user should know: logs that were cut, damage that was left out, images
            that are shown at other times than their own.
    """

    def __init__(
        self,
        paths: str | Location | Sequence[str | Location],
        topics: Sequence[str] = (),
        *,
        size: Size | None = None,
        fit: Fit = "crop",
        align: Align | None = None,
        gaps: Gaps = "skip",
        start: float = 0.0,
        stop: float | None = None,
        depth: Depth | None = None,
        fields: Sequence[str] = (),
        time: str | None = None,
        stamp: Clock = "log",
        color: bool = False,
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
        slowest, fastest = RECORDED_FPS
        if rate is not None and not slowest <= rate <= fastest:
            raise UsageError(f"--rate is {rate}: it must be in [{slowest:g}, {fastest:.0f}]")
        if size is not None and min(size) < 1:
            raise UsageError(f"--size is {size[1]}x{size[0]}: it must be above 0")
        if stop is not None and not start < stop:
            raise UsageError(
                f"--from {start:g} is no earlier than --to {stop:g}, both in seconds after the "
                "first image: no image lies between them"
            )
        named = [paths] if isinstance(paths, str | Path | Url) else paths
        self._files = image_logs(named)
        self._loop = loop
        self._reading = reading = Reading(depth, tuple(fields), time, stamp, color)
        chosen = CameraOptions(**dataclasses.asdict(reading), size=size, fit=fit, gaps=gaps)
        self._asked = dataclasses.replace(chosen, start=start, stop=stop)
        self._goal, self._salvage = goal, salvage
        self._streams: list[ImageStream] = []
        self.changes: dict[int, str] = {}
        self._shown: dict[int, tuple[int, Shown]] = {}
        try:
            for path, topic in named_streams(self._files, topics, reading):
                self._streams.append(open_images(path, topic, salvage=salvage, reading=reading))
            if align != "index":
                self._streams = join_parts(self._streams)
            if len({bool(stream.fields) for stream in self._streams}) > 1:  # with any --align
                framings([self._image(i, 0) for i in range(len(self._streams))], None, fit)
            self._align_by = align
            self._fps = rate or rate_of(self._streams)
            self._times = known_times(self._streams, self._fps)
            if start or stop is not None:
                self._streams = excerpts(self._streams, self._times, start, stop)
                self._times = known_times(self._streams, self._fps)
            if salvage:
                self._streams = [WholeImages(stream) for stream in self._streams]
            start_ns, self._rows, self._gaps = self._put_on_clock(align)
            firsts = [self._image(stream, int(rows[0])) for stream, rows in enumerate(self._rows)]
            if (
                depth is not None
                and firsts[0].ndim > 1
                and not any(s.distances() for s in self._streams)
            ):
                raise UsageError(
                    f"{self._files[0]}: it holds no distances (16UC1, 32FC1): --range is for these"
                )
            self._framings = framings(firsts, size, fit, color=color)
            shape, dtype = self._framings[0].shape, str(firsts[0].dtype)
            for stream, rows in enumerate(self._rows):  # refused before anything is written
                self._frame(stream, int(rows[0]))
        except BaseException:
            self.close()
            raise
        self._count = len(self._rows[0])
        held_back: list[list[Span]] = self._gaps if gaps == "skip" else [[] for _ in self._gaps]
        names, length = stream_names(self._streams), None if loop else self._count
        self._spec = SourceSpec(names, shape, dtype, (), self._fps, start_ns, length)
        self.alignment = dict(
            zip(names, map(counts, self._times, self._rows, held_back), strict=True)
        )
        self.pauses = dict(zip(names, self._gaps, strict=True))
        self.gaps = gaps == "skip" and any(self._gaps)
        self._held = [outside(own, self._count) for own in self._gaps]
        self.shapes = dict(zip(names, map(str, self._framings), strict=True))
        warnings = [w for s in self._streams for w in s.warnings]
        warnings += [self._said_of_gaps(stream) for stream, own in enumerate(self._gaps) if own]
        if align is None and (said := retimed(self._times[0], self._rows[0], self._fps)):
            one, way = self._streams[0], f"--align time --rate {self._fps:g} to keep its times"
            said = f"{one.path}: {one.topic} is taken by number, {said}"
            warnings.append(f"{said}; convert or learn it with {way}")
        self.warnings = tuple(dict.fromkeys(warnings))

    def scene(self) -> Mapping[str, str]:
        """What was recorded: nobody says."""
        return {}

    def _logs(self) -> list[Identity]:
        parts = [part for stream in self._streams for part in stream.parts]
        return [identity_of(path, parts) for path in self._files]

    def _described(self, logs: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
        """The logs, the topics, and how they became frames."""
        recipes = dict.fromkeys(s.recipe for s in self._streams)
        return {
            "kind": "foreign",
            "files": list(logs),
            "topics": [s.topic for s in self._streams],
            "size": list(self._spec.frame_shape),
            "recipe": COLOR_RECIPE if self._reading.color else "; ".join(recipes),
            "align": self._align_by,
            "rate": self._fps,
            **self._chosen(),
            "alignment": self.alignment,
            "frames": self._count,
            "loop": self._loop,
        }

    def plan(self) -> list[dict[str, Any]]:
        """What would be read of each stream, as JSON values."""
        rows: list[dict[str, Any]] = []
        for name, images, times in zip(self._spec.streams, self._streams, self._times, strict=True):
            step = step_of(times)
            row: dict[str, Any] = {"stream": name, "log": str(images.path), "topic": images.topic}
            row |= {"images": images.count, "rate": 1 / step if step > 0 else None}
            row |= {"shape": self.shapes[name], "missing": missing(times)}
            row |= {"size_changes": self._changes_size(len(rows))}
            row |= {"gaps": [list(gap) for gap in self.pauses[name]], **self.alignment[name]}
            rows.append(row)
        return rows

    def salvaged(self) -> list[str]:
        """For each stream of which broken images were met a line that says so."""
        whole = [s.said() for s in self._streams if isinstance(s, WholeImages)]
        return [line for line in whole if line is not None]

    def _changes_size(self, stream: int) -> bool | None:
        """Whether a stream's images change their size, as far as that is known unread."""
        if not self._spec.images:
            return False
        images, framing = self._streams[stream], self._framings[stream]
        for row in np.unique(self._rows[stream]).tolist():
            size = images.stated_size(row)
            if size is None:
                return None
            if change := framing.change(size):
                self.changes.setdefault(stream, f"{images.where(row)}: {change}")
                return True
        return False

    def _chosen(self) -> dict[str, Any]:
        """What of the options changed the frames, as JSON values."""
        chosen: dict[str, Any] = {}
        if any(self._gaps):
            chosen["gaps"] = {name: [list(gap) for gap in own] for name, own in self.pauses.items()}
            chosen["gaps_are"] = "left out" if self.gaps else "the last image"
        if any(framing.lossy for framing in self._framings):
            chosen["fit"] = self._asked.fit
        if self._reading.depth is not None:
            key = "range_metres" if self._spec.images else "range"
            chosen[key] = list(self._reading.depth)
        if not self._spec.images:
            chosen["fields"] = [list(s.fields) for s in self._streams]
        if self._reading.time is not None:
            chosen["time"] = self._reading.time
        if self._reading.stamp != "log":
            chosen["stamp"] = self._reading.stamp
        if self._reading.color:
            chosen["color"] = "red, green and blue beside one another"
        return chosen

    def close(self) -> None:
        for stream in self._streams:
            stream.close()

    def _block(self, stream: int, t: int, n: int) -> Block:
        """The frames of a stream; an image smaller than a frame is a UsageError."""
        frames = np.empty((n, *self._spec.frame_shape), self._spec.dtype)
        rows = self._rows[stream]
        for i in range(n):
            frames[i] = self._frame(stream, int(rows[(t + i) % self._count]))
        return Block(stream, t, freeze(frames), freeze(np.empty((n, 0))))

    def _name(self) -> str:
        return str(self._files[0])

    def _frame(self, stream: int, row: int) -> Shown:
        """A stream's image as a frame; decoded once where it is repeated."""
        shown = self._shown.get(stream)
        if shown is not None and shown[0] == row:
            return shown[1]
        image = self._image(stream, row)
        framing = self._framings[stream]
        if stream not in self.changes:
            images = self._streams[stream]
            change = framing.change(image.shape)
            if image.ndim == 1 and not images.told_rounded:
                change = rounded(images.fields, image)
            if change:
                self.changes[stream] = f"{images.where(row)}: {change}"
        try:
            frame = framing.frame(image)
        except UsageError as error:
            raise UsageError(f"{self._streams[stream].path}: {error}") from None
        self._shown[stream] = (row, frame)
        return frame

    def _image(self, stream: int, row: int) -> Shown:
        """A stream's image as it is."""
        images = self._streams[stream]
        try:
            return images.image(row)
        except UnknownPixels as error:
            raise UsageError(f"{images.where(row)}: {error}") from None
        except BROKEN as error:
            remedy = "" if self._salvage else f": {SALVAGE}"
            raise LogDamagedError(f"{images.where(row)}: {error}{remedy}") from None
        except UsageError as error:
            raise UsageError(f"{images.where(row)}: {error}") from None

    def _put_on_clock(self, align: Align | None) -> tuple[int, list[Rows], list[list[Span]]]:
        """When frame 0 is, which image of each stream every frame shows, and each one's gaps."""
        first, of = self._times[0], range(len(self._times))
        if align == "time":
            start, stop = overlap(self._times)
            if stop < start:
                ends = self._streams[min(of, key=lambda i: int(self._times[i][-1]))]
                begins = self._streams[max(of, key=lambda i: int(self._times[i][0]))]
                raise UsageError(
                    f"{ends.path}: {ends.topic} ends before {begins.topic} begins, they have no "
                    "time in common: take each by itself, with --topic"
                )
            rows = by_time(self._times, start, stop, self._fps)
            gaps = [gaps_by_time(t, start, len(rows[0]), self._fps) for t in self._times]
            return start, rows, gaps
        rows = by_index(self._times)
        if align == "index" and len(rows) > 1:
            return int(first[0]), rows, [[] for _ in rows]
        self._refuse_unequal()
        try:
            rows, shared = with_gaps(rows, first, self._fps)
        except UsageError as error:
            one = self._streams[0]
            raise UsageError(f"{one.path}: {one.topic}: {error}") from None
        return int(first[0]), rows, [shared for _ in rows]

    def _said_of_gaps(self, stream: int) -> str:
        """What the user should know of a stream's gaps."""
        held = "no block reaches across" if self.gaps else "the last image is shown"
        images, said = self._streams[stream], in_words(self._gaps[stream], self._fps)
        return f"{images.path}: {images.topic} has {said}: {held}"

    def _refuse_unequal(self) -> None:
        """Refuse streams that are not on one clock, or not of the rate asked for."""
        first = self._times[0]
        begins, ends = overlap(self._times)
        for stream, times in zip(self._streams[1:], self._times[1:], strict=True):
            if not (reason := unlike(first, times)):
                continue
            two = f"{self._streams[0].topic} and {stream.topic}"
            if begins < ends:
                raise UnequalError(
                    f"{two} have {reason}: put them on one clock, as with: {self._command()}"
                )
            if any(len(pauses(own)) for own in self._times):
                raise UnequalError(
                    f"{two} have no time in common, and gaps, across which --align index takes "
                    "images for neighbours: take each by itself, with --topic, or a part "
                    "without with --from and --to"
                )
            raise UnequalError(
                f"{two} have no time in common: take the i-th image of each together, as with: "
                f"{self._command('index')}"
            )
        for stream, times in zip(self._streams, self._times, strict=True):
            if of_other_rate(times, self._fps):
                raise UnequalError(
                    f"{stream.topic} has {1 / step_of(times):g} images a second, not "
                    f"{self._fps:g}: choose images by their times, as with: {self._command()}"
                )

    def _command(self, align: Align = "time") -> str:
        """A command that takes these streams; numbers that no clock puts together are refused."""
        if self._reading.fields:
            try:
                firsts = [self._image(i, 0) for i in range(len(self._streams))]
            except UsageError as error:
                said = f"{error}; --field is of every stream, images are no numbers"
                raise UsageError(said) from None
            framings(firsts, None, self._asked.fit)
        words = ["cdmisfa", self._goal[0], *map(str, self._files)]
        for stream in self._streams:
            words += ["--topic", stream.topic]
        words += option_words(self._asked)
        words += ["--align", align, "--rate", f"{self._fps:g}"]
        return shlex.join([*words, "-o", self._goal[1]])
