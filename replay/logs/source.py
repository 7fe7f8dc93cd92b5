"""Recordings and external logs as sources of frames: streams on one clock."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, nullcontext
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray, IntArray
from cdmisfa.core.blocks import Block, SourceSpec, freeze
from cdmisfa.core.errors import UsageError
from cdmisfa.core.untrusted import parse_json
from recorder.images.framing import Framing, framings
from recorder.images.options import COLOR_RECIPE, InputOptions
from recorder.images.pixels import GRAY, HIGH_BYTE, TO_8_BITS, Content, losses
from recorder.log.scenery import turns_of
from recorder.log.viewlog import CONFIG_NAME
from recorder.mcap.reader import LogReader
from replay.logs import clock as clocks
from replay.logs.aligning import align, unique_stream_names
from replay.logs.formats.views import SCENE_KEYS
from replay.logs.images import Images
from replay.logs.open_logs import identity_of
from replay.logs.stream import BROKEN, LogStream, Rows
from replay.storage.identity import Identity, McapIdentity
from replay.stored_source import Span, StoredSource, outside

# Least number of frames that are decoded ahead of a block, as several can show the same image.
LIKELY: Final = 32

COLORS: Final = "red, green and blue beside one another"


class LoggedSource(StoredSource):
    """Streams of one recording, or of external logs, on one clock.

    Args:
        streams: the streams, one at least; all views of a recording, or none.
        options: how images become frames, and streams are aligned.
        loop: begin again at the end.
        skip_damaged: show for a broken image the last whole one before it, else the first of all.
        logs: the external logs, MCAP files with their readers.
        opened: the files, which are closed with the source, or if it cannot be made.
        left_out: a line for each log that could not be read.

    Attributes:
        streams: the streams.
        recorded: whether they are the views of a recording.
        framings: for each stream how an image becomes a frame; None for recordings.
        color: whether frames show colors.
        in_memory: whether they are arrays of the caller.
        alignment: for each stream the counts of its rows, of repeated frames and of dropped rows.
        pauses: for each stream the frames [start, stop) of its gaps.
        changes: for each stream whose images change their size or lose what the first one did not,
            or whose numbers are rounded, a line that says so; as soon as one was shown.

    Raises:
        UsageError: images are smaller than a frame, or the streams need `align`.
        LogDamagedError: a log is damaged.
    """

    def __init__(
        self,
        streams: Sequence[LogStream],
        options: InputOptions | None = None,
        *,
        loop: bool = False,
        skip_damaged: bool = False,
        logs: Sequence[tuple[Path, LogReader | None]] = (),
        opened: ExitStack | None = None,
        left_out: Sequence[str] = (),
    ) -> None:
        self.streams, self._options = list(streams), options or InputOptions()
        self._loop, self._skip_damaged = loop, skip_damaged
        self._log_list, self._opened = logs, opened or ExitStack()
        self.recorded, self.color = bool(streams[0].views), self._options.color is True
        self.in_memory = any(stream.digest for stream in streams)
        self._arrays = all(stream.encoding == "numpy" for stream in streams)
        self.to_judge = not (self.recorded or self._arrays)
        if self.recorded:
            self.more = "record more frames, or "
        self.changes: dict[int, str] = {}
        self._last_frames: dict[int, tuple[int, Content]] = {}
        self._together = False
        self._images: Images | None = None
        self._losses: list[tuple[LogStream, str]] = []
        try:
            self._open()
        except BaseException:
            self.close()
            raise
        self.left_out = tuple(left_out)
        self.warnings = (*left_out, *dict.fromkeys(self._warnings()))
        usual = [f"{log.path}: {line}" for log, line in self._losses if line == GRAY]
        self.notes = tuple(dict.fromkeys([*usual, *(n for log in self.streams for n in log.notes)]))

    def _open(self) -> None:
        """Put the streams on one clock, and find out how an image becomes a frame."""
        if self.recorded:
            views = [view.facts for stream in self.streams for view in stream.views]
            facts = replace(views[0], gaps=any(view.gaps for view in views))
            self._clock = clock = clocks.by_number(self.coverage().values(), facts, self._name())
        else:
            self.streams, self._fps, clock = align(self.streams, self._options)
            self._clock = clock
        self.first_frame = self._t = clock.first
        self.frames = len(clock.rows[0])
        length = None if self._loop else self.frames
        self.framings: Sequence[Framing | None] = [None] * len(self.streams)
        if self.recorded:
            names = tuple(stream.topic for stream in self.streams)
            kinds = [stream.views[0].facts.spec.kind(0) for stream in self.streams]
            about = facts.truth, facts.fps, facts.start_ns, length
            self._spec = SourceSpec.of_kinds(names, kinds, *about)
        else:
            names = unique_stream_names(self.streams)
            self._images = images = Images(
                self.streams, color=self.color, skip_damaged=self._skip_damaged
            )
            firsts, how = [], self._options
            for i, rows in enumerate(clock.rows):
                with losses() as lines:
                    firsts.append(images.image(i, int(rows[0])))
                self._losses += [(self.streams[i], line) for line in lines]
                if how.range and HIGH_BYTE in lines:
                    here = f"{self.streams[i].path}: {self.streams[i].topic}"
                    raise UsageError(f"{here} has no distances for input.range: {TO_8_BITS}")
            self.framings = made = framings(
                firsts, how.size, how.fit, color=self.color, native=how.native
            )
            kinds = [framing.kind for framing in made]
            self._spec = SourceSpec.of_kinds(names, kinds, (), self._fps, clock.start_ns, length)
            for i, rows in enumerate(clock.rows):  # refused before anything is written
                self._frame(i, int(rows[0]), firsts[i])
        self.gaps = any(clock.gaps) and self._options.gaps == "skip"
        if self.recorded:
            self.gaps = facts.gaps
        end = self.first_frame + self.frames
        self._ranges = [outside(spans, self.first_frame, end) for spans in clock.gaps]
        self.pauses = dict(zip(names, clock.gaps, strict=True))
        self.alignment: dict[str, dict[str, int]] = {}
        if self.to_judge:
            each = zip(names, self.streams, clock.rows, clock.gaps, strict=True)
            for name, stream, rows, gaps in each:
                left_out = gaps if self.gaps else ()
                self.alignment[name] = clocks.counts(stream.count, rows, left_out)

    # Frames

    def take_all(self, n: int) -> tuple[Block, ...]:
        """See `StoredSource`."""
        self._together = True
        try:
            return super().take_all(n)
        finally:
            self._together = False

    def _block(self, stream: int, t: int, n: int) -> Block:
        place = (t - self.first_frame) % self.lap
        frames, truth = self._frames(stream, t, self._clock.rows[stream][place : place + n])
        return Block(stream, t, freeze(frames), freeze(truth))

    def _frames(self, stream: int, t: int, rows: Rows) -> tuple[NDArray[Any], FloatArray]:
        """Return the frames of rows, the first of them at frame t, and their ground truth."""
        log, framing = self.streams[stream], self.framings[stream]
        if log.read is not None:
            images, truth = log.read(rows)
            if framing is None or images.shape[1:] == framing.shape:
                return images, truth
            return np.stack([framing.frame(image) for image in images]), truth
        if log.compressed is not None:
            self._expect(stream, t, rows)
        shape, dtype = self._spec.kind(stream)
        frames = np.empty((len(rows), *shape), dtype)
        for i, row in enumerate(rows if isinstance(rows, range) else rows.tolist()):
            frames[i] = self._frame(stream, row)
        return frames, np.empty((len(rows), 0))

    def messages(self, stream: int, n: int) -> Iterator[tuple[IntArray, NDArray[Any]]]:
        """Yield log times and content of all messages of a stream, n at a time; or all frames."""
        log, first = self.streams[stream], self.first_frame
        if log.times is None:
            for block in self.pieces(stream, first, first + self.frames, n):
                yield self.spec.times(block.t, block.t + len(block)), block.frames
            return
        for start in range(0, log.count, n):
            rows = range(start, min(start + n, log.count))
            yield log.times[start : rows.stop], self._frames(stream, first, rows)[0]

    def _expect(self, stream: int, t: int, rows: Rows) -> None:
        """Decode ahead the rows from frame t on, and those that are probably requested next.

        These are the same frames of the next stream if all streams are read, else the next frames.
        """
        assert self._images is not None
        after, start = stream, t + len(rows)
        if self._together:
            after, start = stream + 1, t
            if after == len(self.streams):
                after, start = 0, t + len(rows)
        stop = start + max(len(rows), LIKELY)
        ahead = np.arange(start, stop if self._loop else min(stop, self.last))
        ahead = (ahead - self.first_frame) % self.lap
        next_rows = np.asarray(self._clock.rows[after])[ahead[ahead < self.frames]]
        places = [(stream, int(row)) for row in rows]
        places += [(after, row) for row in next_rows.tolist()]
        last = {(number, row) for number, (row, _) in self._last_frames.items()}
        self._images.expect(place for place in places if place not in last)

    def _frame(self, stream: int, row: int, image: Content | None = None) -> Content:
        """Return a stream's image as a frame; decoded once if it is repeated."""
        last = self._last_frames.get(stream)
        if last is not None and last[0] == row:
            return last[1]
        framing, log = self.framings[stream], self.streams[stream]
        assert framing is not None
        assert self._images is not None
        with losses() if log.compressed else nullcontext(list[str]()) as lines:
            image = self._images.image(stream, row) if image is None else image
        if stream not in self.changes:
            change = framing.change(image) if image.ndim > 1 or log.read is None else ""
            known = [line for one, line in self._losses if one is log]
            change = change or next((line for line in lines if line not in known), "")
            if change:
                self.changes[stream] = f"{log.name_of(row)}: {change}"
        try:
            frame = framing.frame(image)
        except UsageError as error:
            raise type(error)(f"{log.path}: {error}") from None
        self._last_frames[stream] = (row, frame)
        return frame

    def close(self) -> None:
        """Close the logs; harmless when called twice."""
        if self._images is not None:
            self._images.close()
        self._opened.close()

    # What the source states

    def _warnings(self) -> Iterator[str]:
        for stream in self.streams:
            yield from stream.warnings
        yield from (f"{log.path}: {line}" for log, line in self._losses if line != GRAY)
        rows = {stream.topic: stream.count for stream in self.streams}
        if self._arrays and len(set(rows.values())) > 1:
            each = ", ".join(f"{name} has {count}" for name, count in rows.items())
            yield f"the arrays differ in length ({each}): only {self.frames} rows of each are read"
        clock = self._clock
        handling = "no block spans a gap" if self.gaps else "the last image is repeated"
        for stream, gaps in zip(self.streams, clock.gaps, strict=True):
            if gaps:
                line = clocks.gaps_in_words(gaps, self._spec.fps)
                yield f"{stream.path}: {stream.topic} has {line}: {handling}"
        if self.recorded:
            lasts = [stream.views[-1].ranges for stream in self.streams]
            ends = {ranges[-1][1] for ranges in lasts if ranges}
            end = int(clock.rows[0][-1]) + 1
            if not self.gaps and len(ends) > 1:
                yield (
                    f"{self._name()}: the views differ in length; the source ends with the "
                    f"shortest view, before frame {end}"
                )
            if left_out := end - self.first_frame - self.frames:
                yield (
                    f"{self._name()}: {left_out} frames that a view lacks are skipped in all views"
                )
            return
        one = self.streams[0]
        assert one.times is not None
        by_number = self._options.align is None and not self._arrays
        if by_number and (line := clocks.retimed(one.times, clock.rows[0], self._fps)):
            yield (
                f"{one.path}: {one.topic} is read one image a frame, {line}; keep its timing with "
                f"--align time --rate {self._fps:g}"
            )

    def skipped_damage(self) -> list[str]:
        """See `StoredSource`."""
        return self._images.broken_lines() if self._images else []

    def pixels(self, stream: int) -> str:
        """See `StoredSource`."""
        log = self.streams[stream]
        try:
            return log.taken(0, log.pixel_format) if log.pixel_format else ""
        except BROKEN:
            if not self._skip_damaged:
                raise
            return ""

    def coverage(self) -> dict[str, list[Span]]:
        """Return the frames that are there of each view of a recording, as ranges [start, stop)."""
        return {s.topic: [span for view in s.views for span in view.ranges] for s in self.streams}

    def scene(self) -> Mapping[str, str]:
        """See `StoredSource`."""
        if not self.recorded:
            return {}
        facts = self.streams[0].views[0].facts
        return {name: getattr(facts, name) for name in SCENE_KEYS if name in facts.values}

    def origin(self) -> Mapping[str, Any]:
        """See `StoredSource`."""
        return self._configured("source")

    @cached_property
    def turns(self) -> tuple[tuple[int, ...], ...]:
        """Frames that are lost between each two views, as in the scene; see `turn_to`."""
        indexes = [stream.views[0].facts.stream_index for stream in self.streams if self.recorded]
        return turns_of(self._configured("scene"), indexes)

    def _configured(self, section: str) -> Mapping[str, Any]:
        """Return a section of the recording's configuration; empty if it has none."""
        if not self.recorded:
            return {}
        reader = self.streams[0].views[0].reader
        entry = next((one for one in reader.attachments if one.name == CONFIG_NAME), None)
        try:
            stated = parse_json(bytes(reader.attachment_data(entry)))[section] if entry else {}
        except (ValueError, LookupError, TypeError):
            return {}
        return stated if isinstance(stated, dict) else {}

    def _name(self) -> str:
        if not self.recorded:
            return str(self.streams[0].path)
        files = [view.path for stream in self.streams for view in stream.views]
        return str(files[0]) if len(files) == 1 else min(str(path.parent) for path in files)

    def _logs(self) -> Sequence[Identity]:
        if not self.recorded:
            return [identity_of(*log) for log in self._log_list]
        return [McapIdentity(view.reader) for stream in self.streams for view in stream.views]

    def described(self, logs: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
        """See `StoredSource`."""
        shared: dict[str, Any] = {"frames": self.frames, "loop": self._loop}
        if self.recorded:
            views = [view for stream in self.streams for view in stream.views]
            named = [{"name": view.facts.view, "frames": view.count} for view in views]
            return {
                "kind": "recording",
                **self.scene(),
                "first_frame": self.first_frame,
                "views": [{**one, **log} for one, log in zip(named, logs, strict=True)],
                **shared,
            }
        options, size = self._options, self._spec.size
        recipes = dict.fromkeys(stream.recipe for stream in self.streams)
        shared |= {"files": list(logs), "size": size, "rate": self._spec.fps}
        if self._arrays:
            return {
                "kind": "arrays",
                "streams": [s.digest() if s.digest else s.topic for s in self.streams],
                "fit": options.fit,
                **({"color": COLORS} if self.color else {}),
                "recipe": "; ".join(recipes),
                **shared,
            }
        return {
            "kind": "foreign",
            "topics": [stream.topic for stream in self.streams],
            "recipe": COLOR_RECIPE if self.color else "; ".join(recipes),
            "align": options.align,
            **self._chosen(),
            "alignment": self.alignment,
            **({"held_out": self.held_out} if self.held_out else {}),
            **shared,
        }

    def _chosen(self) -> dict[str, Any]:
        """Return the options that changed the frames, as JSON values."""
        options = self._options
        chosen: dict[str, Any] = {}
        if any(self.pauses.values()):
            chosen["gaps"] = {s: [*map(list, spans)] for s, spans in self.pauses.items()}
            chosen["gaps_are"] = "left out" if self.gaps else "the last image"
        if options.fit != "crop" or any(framing.lossy for framing in self.framings if framing):
            chosen["fit"] = options.fit
        if options.range is not None:
            has_images = any(framing and framing.first for framing in self.framings)
            chosen["range_metres" if has_images else "range"] = list(options.range)
        if not self._spec.images:
            chosen["fields"] = [list(stream.fields) for stream in self.streams]
        if options.time is not None:
            chosen["time"] = options.time
        if options.stamp != "log":
            chosen["stamp"] = options.stamp
        if self.color:
            chosen["color"] = COLORS
        return chosen
