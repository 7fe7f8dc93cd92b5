"""Other people's camera logs as streams of frames on a common clock."""

from __future__ import annotations

import contextlib
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cdmisfa.core.blocks import Block, SourceSpec, freeze
from cdmisfa.core.errors import LogDamagedError, UsageError
from recorder.images.fields import rounded
from recorder.images.framing import framings
from recorder.images.options import COLOR_RECIPE, Align, InputOptions
from recorder.images.pixels import DISTANCES, Shown, UnknownPixels
from replay.camera_logs.ahead import AheadSource
from replay.camera_logs.alignment import (
    Rows,
    by_index,
    by_time,
    counts,
    gaps_by_time,
    gaps_in_words,
    known_times,
    of_other_rate,
    overlap,
    pauses,
    rate_of,
    retimed,
    step_of,
    unlike,
)
from replay.camera_logs.hue import CHOSEN, shows_hue
from replay.camera_logs.mcap_log import Readers
from replay.camera_logs.opening import identity_of, image_logs, named_streams, open_images
from replay.camera_logs.selected import (
    BROKEN,
    SALVAGE,
    WholeImages,
    copies,
    excerpts,
    join_parts,
    names_of,
)
from replay.storage.identity import Identity
from replay.stored import Span, outside


class UnequalError(UsageError):
    """Streams that are on no common clock unless they are aligned."""


class ForeignSource(AheadSource):
    """Other people's logs on one clock: images of cameras, gray and small, or numbers.

    Args:
        paths: one log, or one log, video, table or folder of pictures a stream. Logs that follow
            one another in time are parts of one stream, unless they are aligned by index.
        topics: the topics, a stream each, or patterns; see `named_streams`.
        loop: begin again at the end.
        salvage: leave out what is damaged, and broken images; see `WholeImages`.
        goal: the command and the folder of its result that a refusal names in what would work.
        **chosen: how images become frames; see `InputOptions`.

    Attributes:
        alignment: for each stream the counts of its messages, of repeated frames and of
            dropped messages.
        gaps: whether streams lack frames: then `take` gives the next n that follow one another.
        pauses: for each stream the frames [start, stop) of its gaps.
        framings: for each stream how an image becomes a frame.
        changes: for each stream whose images change their size, or whose numbers are held
            rounded, a line that says so; as soon as one was shown.
        color: whether frames show colours; see `shows_hue` of "auto".
        warnings: what the user should know: logs that were cut, damage that was left out, images
            that are shown at other times than their own.
    """

    to_judge = True

    def __init__(
        self,
        paths: str | Path | Sequence[str | Path],
        topics: Sequence[str] = (),
        *,
        loop: bool = False,
        salvage: bool = False,
        goal: tuple[str, str] = ("learn", "RUN"),
        **chosen: Any,
    ) -> None:
        """Open the logs and find their images.

        Raises:
            UsageError: no such log or topic, images smaller than a frame, or streams that
                need `align`.
            LogDamagedError: a log is damaged.
        """
        self._options = options = InputOptions(topics=tuple(topics), **chosen)
        if options.color == "auto":
            how = {"loop": loop, "salvage": salvage, "goal": goal, **chosen, "color": True}
            with contextlib.closing(type(self)(paths, topics, **how)) as shown:
                color = shows_hue(shown)
            self._options = options = replace(options, color=color)
            self.notes = (CHOSEN[color],)
        self.color = bool(options.color)
        self._files = image_logs([paths] if isinstance(paths, str | Path) else paths)
        self._loop, self._salvage, self._goal = loop, salvage, goal
        self._readers, self.changes = Readers(), dict[int, str]()
        super().__init__()
        try:
            self._open()
            try:
                start_ns, self._rows, self._gaps = self._put_on_clock()
            except UsageError as error:
                raise self._of_copies(error) from None
            firsts = [self._image(stream, int(rows[0])) for stream, rows in enumerate(self._rows)]
            if options.range and firsts[0].ndim > 1 and not self._may_show_distances():
                raise UsageError(
                    f"{self._files[0]}: it holds no distances (16UC1, 32FC1): input.range is for "
                    "these"
                )
            self.framings = framings(firsts, options.size, options.fit, color=self.color)
            for stream, rows in enumerate(self._rows):  # refused before anything is written
                self._frame(stream, int(rows[0]))
        except BaseException:
            self.close()
            raise
        self._count = len(self._rows[0])
        names, length = names_of(self._streams), None if loop else self._count
        shape, dtype = self.framings[0].shape, str(firsts[0].dtype)
        self._spec = SourceSpec(names, shape, dtype, (), self._fps, start_ns, length)
        self.gaps = options.gaps == "skip" and any(self._gaps)
        left_out = self._gaps if self.gaps else [[] for _ in self._gaps]
        counted = map(counts, self._times, self._rows, left_out)
        self.alignment = dict(zip(names, counted, strict=True))
        self.pauses = dict(zip(names, self._gaps, strict=True))
        self._held = [outside(own, self._count) for own in self._gaps]
        self.copies = tuple(copies(self._streams))
        self.warnings = tuple(dict.fromkeys(self._warned()))

    def _open(self) -> None:
        """Open the streams, and find what is taken of them and when each image was."""
        options, reading = self._options, self._options
        if options.end is not None and not options.start < options.end:
            raise UsageError(
                f"--start {options.start:g} is no earlier than --end {options.end:g}, both in "
                "seconds after the first image: no image lies between them"
            )
        for path, topic in named_streams(self._files, options.topics, reading):
            how: dict[str, Any] = {"salvage": self._salvage, "readers": self._readers}
            self._streams.append(open_images(path, topic, reading=reading, **how))
        if options.align != "index":
            self._streams = join_parts(self._streams)
        if len({bool(stream.fields) for stream in self._streams}) > 1:  # refused with any --align
            framings(self._firsts(), None, options.fit)
        self._fps = options.rate or rate_of(self._streams)
        self._times = known_times(self._streams, self._fps)
        if options.start or options.end is not None:
            self._streams = excerpts(self._streams, self._times, options.start, options.end)
            self._times = known_times(self._streams, self._fps)
        if self._salvage:
            self._streams = [WholeImages(stream) for stream in self._streams]

    def _firsts(self) -> list[Shown]:
        return [self._image(stream, 0) for stream in range(len(self._streams))]

    def _may_show_distances(self) -> bool:
        return any(stream.pixels() in (None, *DISTANCES) for stream in self._streams)

    def _warned(self) -> Iterator[str]:
        for images in self._streams:
            yield from images.warnings
        yield from self.copies
        held = "no block reaches across" if self.gaps else "the last image is shown"
        for images, own in zip(self._streams, self._gaps, strict=True):
            if own:
                said = gaps_in_words(own, self._fps)
                yield f"{images.path}: {images.topic} has {said}: {held}"
        if self._options.align is not None:
            return
        if said := retimed(self._times[0], self._rows[0], self._fps):
            one, way = self._streams[0], f"--align time --rate {self._fps:g} to keep its times"
            said = f"{one.path}: {one.topic} is taken by number, {said}"
            yield f"{said}; convert or learn it with {way}"

    def _logs(self) -> list[Identity]:
        parts = [part for stream in self._streams for part in stream.logs]
        return [identity_of(path, parts) for path in self._files]

    def _described(self, logs: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
        """The logs, the topics, and how they became frames."""
        recipes = dict.fromkeys(s.recipe for s in self._streams)
        return {
            "kind": "foreign",
            "files": list(logs),
            "topics": [s.topic for s in self._streams],
            "size": list(self._spec.frame_shape),
            "recipe": COLOR_RECIPE if self.color else "; ".join(recipes),
            "align": self._options.align,
            "rate": self._fps,
            **self._chosen(),
            "alignment": self.alignment,
            "frames": self._count,
            **({"held_out": self.held_out} if self.held_out else {}),
            "loop": self._loop,
        }

    def pixels(self, stream: int) -> str:
        """See `LoggedSource`."""
        return self._streams[stream].pixels() or ""

    def salvaged(self) -> list[str]:
        """A line for each stream of which broken images were replaced so far."""
        whole = [s.said() for s in self._streams if isinstance(s, WholeImages)]
        return [line for line in whole if line is not None]

    def _chosen(self) -> dict[str, Any]:
        """The options that changed the frames, as JSON values."""
        options = self._options
        chosen: dict[str, Any] = {}
        if any(self._gaps):
            chosen["gaps"] = {name: [list(gap) for gap in own] for name, own in self.pauses.items()}
            chosen["gaps_are"] = "left out" if self.gaps else "the last image"
        if options.fit != "crop" or any(framing.lossy for framing in self.framings):
            chosen["fit"] = options.fit
        if options.range is not None:
            chosen["range_metres" if self._spec.images else "range"] = list(options.range)
        if not self._spec.images:
            chosen["fields"] = [list(s.fields) for s in self._streams]
        if options.time is not None:
            chosen["time"] = options.time
        if options.stamp != "log":
            chosen["stamp"] = options.stamp
        if self.color:
            chosen["color"] = "red, green and blue beside one another"
        return chosen

    def close(self) -> None:
        for stream in self._streams:
            stream.close()
        self._readers.close()
        self._ahead.close()

    def _block(self, stream: int, t: int, n: int) -> Block:
        """The frames of a stream; an image smaller than a frame is a UsageError."""
        frames = np.empty((n, *self._spec.frame_shape), self._spec.dtype)
        rows = self._rows[stream][np.arange(t, t + n) % self._count].tolist()
        if self._spec.images:
            self._expect(stream, t, rows)
        for i, row in enumerate(rows):
            frames[i] = self._frame(stream, row)
        return Block(stream, t, freeze(frames), freeze(np.empty((n, 0))))

    def _name(self) -> str:
        return str(self._files[0])

    def _frame(self, stream: int, row: int) -> Shown:
        """A stream's image as a frame; decoded once where it is repeated."""
        shown = self._shown.get(stream)
        if shown is not None and shown[0] == row:
            return shown[1]
        image = self._image(stream, row)
        framing = self.framings[stream]
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
            raise type(error)(f"{self._streams[stream].path}: {error}") from None
        self._shown[stream] = (row, frame)
        return frame

    def _image(self, stream: int, row: int) -> Shown:
        """A stream's image as it is."""
        if (begun := self._ahead.pop((stream, row))) is not None:
            return begun
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

    def _put_on_clock(self) -> tuple[int, list[Rows], list[list[Span]]]:
        """When frame 0 is, which image of each stream every frame shows, and each one's gaps."""
        first, align = self._times[0], self._options.align
        if align == "time":
            start, stop = overlap(self._times)
            if stop < start:
                of = range(len(self._times))
                ends = self._streams[min(of, key=lambda i: int(self._times[i][-1]))]
                begins = self._streams[max(of, key=lambda i: int(self._times[i][0]))]
                raise UsageError(
                    f"{ends.path}: {ends.topic} ends before {begins.topic} begins, they have no "
                    "time in common: take each by itself, with --topic"
                )
            rows = by_time(self._times, start, stop, self._fps)
            gaps = [gaps_by_time(t, start, len(rows[0]), self._fps) for t in self._times]
            return start, rows, gaps
        as_asked = align == "index" and len(self._times) > 1
        if not as_asked:
            self._refuse_unequal()
        try:
            shows, shared = by_index(self._times, self._fps, gaps=not as_asked)
        except UsageError as error:
            one = self._streams[0]
            raise UsageError(f"{one.path}: {one.topic}: {error}") from None
        return int(first[0]), [shows] * len(self._times), [shared] * len(self._times)

    def _of_copies(self, error: UsageError) -> UsageError:
        """Why streams cannot be put on one clock; where one is a copy of another, that."""
        said = next(copies(self._streams), None)
        return error if said is None else type(error)(f"{said}: leave one out")

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
                    "without with --start and --end"
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
        if self._options.fields:
            try:
                firsts = self._firsts()
            except UsageError as error:
                said = f"{error}; --field is of every stream, images are no numbers"
                raise UsageError(said) from None
            framings(firsts, None, self._options.fit)
        words = ["cdmisfa", self._goal[0], *map(str, self._files)]
        for stream in self._streams:
            words += ["--topic", stream.topic]
        words += replace(self._options, topics=(), align=None, rate=None).words()
        words += ["--align", align, "--rate", f"{self._fps:g}"]
        return shlex.join([*words, "-o", self._goal[1]])
