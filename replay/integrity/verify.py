"""Verify that logs are whole: every checksum, every length, and every frame in every view."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import itertools
import json
import shlex
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError
from cdmisfa.core.signals import SignalsHash
from cdmisfa.core.untrusted import read_regular
from recorder.log.messages import view_topic
from recorder.mcap.reader import NO_CHECKSUMS, LogReader
from recorder.mcap.records import Problem, Segment
from replay.integrity.info import count_decoded, kind_of, read_once, report_all, report_on
from replay.integrity.listing import each_report
from replay.integrity.report import LogReport, State, as_problem, combined, failed, with_health
from replay.logs.formats import views as recorded
from replay.logs.formats.mcap_log import decoders_in
from replay.logs.formats.recording import ViewFile
from replay.logs.health import Health, broken_rows
from replay.logs.open_logs import (
    channels_of,
    image_topics,
    is_external_format,
    log_format,
    open_stream,
)
from replay.logs.source import LoggedSource
from replay.logs.stream import MissingFileError, check_times, limited
from replay.runs.folders import FINAL_METADATA, MODULES_FILE, RUN_JSON, VIEW_FILE, read_run_json
from replay.runs.log import SIGNALS_TOPIC, Batch, BatchReader, header_in
from replay.runs.modules import load_modules
from replay.runs.provenance import facts_sha256
from replay.storage.arrays import MAX_BYTES
from replay.storage.location import location


def check_logs(*words: str | Path) -> LogReport:
    """Check several logs, each by itself; see `check_log`, which raises where there is one."""
    return report_all(words, lambda place, alone: [check_log(place, alone)])


def check_log(path: str | Path, alone: bool = True) -> LogReport:
    """Check a log, or all logs of a folder, by decoding everything in them, in one pass of each.

    A run is compared with its final record: its signals and, in its folder, the files beside its
    log. Each view of a recording must have every frame once; in a folder, the views must have the
    same frames and none may be missing. Every image of a camera log is decoded.

    Raises:
        CdmisfaError: `alone`, and the only log cannot be read.
    """
    place = location(path)
    views: dict[Path, list[_ViewContent]] = {}

    def check(file: Path) -> LogReport:
        if is_external_format(file):
            return _check_external(file)
        report, content = _check_file(file, beside=place.is_dir())
        if isinstance(content, _ViewContent):
            views.setdefault(file.parent, []).append(content)
        return report

    reports = list(each_report(place, check, alone))
    checks = [_check_views(contents, alone=place.is_file()) for contents in views.values()]
    return combined(str(place), reports, itertools.chain(*checks))


def _check_file(path: Path, *, beside: bool) -> tuple[LogReport, _Content | None]:
    """Check an MCAP file, and the files beside it if it is the log of a run."""
    try:
        report, content = read_once(path, lambda reader: _check_content(path, reader, beside))
    except LogDamagedError as error:
        return failed(path, error), None
    if report.problems:
        return report, content
    if isinstance(content, _RunContent):
        notes = (*report.notes, *content.notes())
        report = replace(report, problems=tuple(content.problems()), notes=notes)
    elif content is None:
        # The pass above failed at an image and not at a checksum: list all broken images.
        images = _check_topics(path, image_topics(path))
        notes = (*report.notes, *images.notes)
        report = replace(report, problems=images.problems, notes=notes, state=images.state)
        report = replace(report, health=images.health)
    return report, content


def _check_content(
    path: Path, reader: LogReader, beside: bool
) -> tuple[LogReport, _Content | None]:
    """Decode every chunk of an MCAP file and check what they hold on the way."""
    content = _content_of(path, reader, beside)
    counts = count_decoded(reader, content.add if content else lambda segment: None)
    if content:
        content.finish()
    problems = [
        Problem(str(path), f"has messages on channel {number}, which is not defined")
        for number in counts.keys() - reader.channels.keys()
    ]
    messages = sum(channel.messages for channel in counts.values())
    stated = reader.statistics.message_count if reader.statistics else messages
    if stated != messages and not reader.problems:
        what = f"its summary states {stated} messages, but it has {messages}"
        problems.append(Problem(str(path), what))
    report = report_on(reader, counts)
    notes = (f"{path}: {NO_CHECKSUMS}",) if report.crc == "absent" else ()
    report = replace(report, problems=(*problems, *report.problems), notes=notes)
    return with_health(report, content.health if content else {}), content


def _content_of(path: Path, reader: LogReader, beside: bool) -> _Content | None:
    """Return the check of a log's content; None if its images are to be checked later."""
    kind = kind_of(reader)
    if kind == "run" and reader.complete:
        return _RunContent(path, reader, beside=beside)
    if kind == "recording":
        return _ViewContent(path, reader)
    return None if reader.skip_damaged else _ImageContent(path, reader)


class _Content:
    """Check the content of a log while its chunks are decoded.

    Attributes:
        path: the log.
        error: the error at which the check ended.
        health: health of each stream of images.
    """

    def __init__(self, path: Path, reader: LogReader) -> None:
        self.path, self.reader = path, reader
        self.error: CdmisfaError | None = None
        self.health: dict[str, Health] = {}

    def add(self, segment: Segment) -> None:
        """Check the next chunk of the log."""

    def finish(self) -> None:
        """Check the whole, after the last chunk."""

    @contextlib.contextmanager
    def record_errors(self) -> Iterator[None]:
        """Store the error that ends a step of the check."""
        try:
            yield
        except CdmisfaError as error:
            self.error = error


class _ImageContent(_Content):
    """Decode the images of an external log; a broken one raises, and the log is read again."""

    def __init__(self, path: Path, reader: LogReader) -> None:
        super().__init__(path, reader)
        self._decoders = decoders_in(reader)

    def add(self, segment: Segment) -> None:
        table = self.reader.table(segment)
        assert table is not None
        rows = np.flatnonzero(np.isin(table.channel, list(self._decoders)))
        if len(rows):
            check_times(self.path, np.sort(table.log_time[rows]).astype(np.int64))
        with limited(self.path, "its decoder", memory_bytes=table.data.nbytes):
            for row in rows[np.argsort(table.log_time[rows], kind="stable")].tolist():
                channel = int(table.channel[row])
                health = self.health.setdefault(self.reader.channels[channel].topic, Health())
                read = functools.partial(self._decoders[channel], table.view(row))
                health.add(int(table.log_time[row]) / 1e9, read)


class _ViewContent(_Content):
    """Check every frame of one file of a recording."""

    def __init__(self, path: Path, reader: LogReader) -> None:
        super().__init__(path, reader)
        self.view: ViewFile | None = None
        with self.record_errors():
            self.view = ViewFile(path, reader=reader)

    def add(self, segment: Segment) -> None:
        if self.view is not None and self.error is None:
            with self.record_errors():
                topic = view_topic(self.view.facts.view)
                self.view.check_chunk(segment, self.health.setdefault(topic, Health()))

    def finish(self) -> None:
        if self.view is not None:
            self.view.finish()


class _RunContent(_Content):
    """Compare a run with its own final record.

    Args:
        path: log of the run, whole.
        reader: reader of the log.
        beside: also check the files beside it.
    """

    def __init__(self, path: Path, reader: LogReader, *, beside: bool) -> None:
        super().__init__(path, reader)
        records = (r.metadata for r in reader.metadata if r.name == FINAL_METADATA)
        self._final = next(records, None)
        self._folder = path.parent if beside else None
        self._document = read_run_json(path.parent) if beside else {}
        result = self._document.get("result") if self._final is None else self._final
        self._stated = result.get("signals_sha256") if isinstance(result, Mapping) else None
        self._hash, self._next = SignalsHash(), 0
        self._batches: BatchReader | None = None
        self._problems: list[Problem] = []
        with self.record_errors():
            header, topics = header_in(reader), (SIGNALS_TOPIC,)
            if self._stated is not None:
                self._batches = BatchReader(path, header, reader.channels, topics=topics)

    def add(self, segment: Segment) -> None:
        table = self.reader.table(segment)
        if self._batches is not None and self.error is None and table is not None:
            with self.record_errors():
                for batch in self._batches.take(table):
                    self._add_signals(batch)

    def finish(self) -> None:
        if self._batches is None or self.error is not None:
            return
        with self.record_errors():
            self._add_signals(self._batches.rest())
        if self.error is None and self._hash.hexdigest() != self._stated:
            what = f"the signals of its {self._hash.count} iterations differ from the final record"
            self._problems.append(Problem(str(self.path), what))

    def problems(self) -> Iterator[Problem]:
        """Yield contradictions between the intact log of a run and its other files."""
        yield from self._problems
        if self.error is not None:
            yield as_problem(self.path, self.error)
        if self._final is None or self._folder is None:
            return
        facts = self._folder / RUN_JSON
        if not self._document:
            yield Problem(str(facts), "is missing, empty or not JSON")
        elif facts_sha256(self._document) != self._final.get("facts_sha256"):
            yield Problem(str(facts), "differs from the run's final record")
        modules, stated = self._folder / MODULES_FILE, self._final.get("modules_sha256")
        try:
            if not modules.is_file():
                yield Problem(str(modules), "is missing")
            elif hashlib.sha256(read_regular(modules, MAX_BYTES)).hexdigest() != stated:
                yield Problem(str(modules), "differs from the run's final record")
            else:
                load_modules(modules)
        except CdmisfaError as error:
            yield as_problem(modules, error)
        view = self._folder / VIEW_FILE
        if self._final.get("view") == json.dumps(True) and not view.is_file():
            command = shlex.join(("cdmisfa", "view", str(self._folder), "--save", str(view)))
            yield Problem(str(view), f"is missing; write it again with {command}")

    def notes(self) -> Iterator[str]:
        """Yield a note for each file that cannot be verified."""
        if self._folder is not None and (view := self._folder / VIEW_FILE).is_file():
            yield f"{view} was not checked: it has no checksum"
        if self._final is None:
            yield f"{self.path} has no final record: the other files of the run cannot be verified"

    def _add_signals(self, batch: Batch) -> None:
        for signals in (record for columns in batch.signals for record in columns.records()):
            if signals.iteration != self._next:
                what = f"iterations {self._next} to {signals.iteration - 1} are missing"
                self._problems.append(Problem(str(self.path), what))
            self._next = signals.iteration + 1
            self._hash.add(signals)


def _check_views(contents: list[_ViewContent], *, alone: bool) -> Iterator[Problem]:
    """Yield missing frames and views of a recording after checking one or all of its files."""
    folder = str(contents[0].path.parent)
    views = [content.view for content in contents if content.view is not None]
    for content in contents:
        if content.view is not None and not content.view.facts.gaps:
            edges = [(0, content.view.facts.first_frame), *content.view.ranges]
            for (_, end), (start, _) in itertools.pairwise(edges):
                if start > end:
                    yield Problem(str(content.path), f"frames {end} to {start - 1} are missing")
        if content.error is not None:
            yield as_problem(content.path, content.error)
    if not alone:
        facts = [view.facts for view in views]
        streams = {name for stated in facts for name in stated.streams if name}
        for name in sorted(streams - {stated.view for stated in facts}):
            yield Problem(folder, f"the file of view {name!r} is missing")
        count = max((stated.stream_count for stated in facts), default=0)
        if absent := set(range(count)) - {stated.stream_index for stated in facts}:
            what = f"{len(absent)} files of the recording's views 0 to {count - 1} are missing"
            yield Problem(folder, f"{what}, the first of view {min(absent)}")
    if any(content.error is not None for content in contents):
        return
    try:
        source = LoggedSource(recorded.streams(views, skip_damaged=True))
    except CdmisfaError as error:
        yield replace(as_problem(views[0].path, error), where=folder)
        return
    ends = {name: ranges[-1][1] for name, ranges in source.coverage().items() if not source.gaps}
    for name, end in ends.items():
        if end > min(ends.values()):
            what = f"view {name!r} ends before frame {end}, another view before "
            yield Problem(folder, f"{what}{min(ends.values())}")


# Camera logs


def _check_external(path: Path) -> LogReport:
    """Decode every image of a camera log without checksums."""
    try:
        kind = log_format(path)
        channels = channels_of(path, whole=True)
    except LogDamagedError as error:
        return replace(failed(path, error), crc="absent")
    topics = [c.info.topic for c in channels if c.images and c.info.messages]
    report = _check_topics(path, topics, [c.missing for c in channels if c.missing])
    if kind == "images" and channels[0].info.encoding == "png":  # PNG has checksums of its own
        report = replace(report, crc="ok" if report.ok else "bad")
    notes = dict.fromkeys(line for channel in channels for line in channel.remarks)
    return replace(report, notes=tuple(notes | dict.fromkeys(report.notes)))


def _check_topics(path: Path, topics: Iterable[str], absent: Iterable[str] = ()) -> LogReport:
    """Decode every image on some topics of a camera log; `absent` parts are reported with it."""
    problems: list[Problem] = []
    files: dict[str, Problem] = {}
    health: dict[str, Health] = {}
    missing = dict.fromkeys(absent)
    notes: dict[str, None] = {}
    for topic in topics:
        try:
            with open_stream(path, topic) as stream:
                measured = health.setdefault(topic, Health())
                for row, error in broken_rows(stream, measured):
                    if isinstance(error, MissingFileError):
                        files[str(error)] = Problem(*str(error).rsplit(": ", 1))
                    else:
                        problems.append(Problem(stream.name_of(row), str(error)))
                missing |= dict.fromkeys([stream.missing] if stream.missing else [])
                notes |= dict.fromkeys((*stream.remarks, *stream.warnings))
        except LogDamagedError as damage:
            problems.append(as_problem(path, damage))
        except UsageError as refusal:  # it needs an option
            reason = str(refusal).removeprefix(f"{path}: ")
            notes[f"{path}: {topic} was not decoded: {reason}"] = None
    problems += files.values()
    state: State = "damaged" if problems else "cut short" if missing else "whole"
    problems += [Problem(str(path), what) for what in missing]
    remarks = tuple(note for note in notes if note.removeprefix(f"{path}: ") not in missing)
    report = LogReport(str(path), problems=tuple(problems), state=state, notes=remarks)
    return with_health(report, health)
