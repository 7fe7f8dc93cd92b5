"""Is a log whole: every checksum, every length, and every frame in every view."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import shlex
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError
from cdmisfa.core.signals import SignalsHash
from cdmisfa.core.untrusted import read_regular
from recorder.images.messages import Decoder
from recorder.images.options import IMAGES
from recorder.mcap.reader import NO_CHECKSUMS, LogReader
from recorder.mcap.records import MalformedRecord, Problem, Segment
from replay.camera_logs.mcap_log import channels_on, topics_in
from replay.camera_logs.opening import (
    channels_of,
    image_topics,
    log_format,
    only_foreign,
    open_images,
)
from replay.camera_logs.stream import ImageStream, explained, sorted_times
from replay.camera_logs.table import table_notes
from replay.integrity.counting import count_messages, read_once
from replay.integrity.info import SCHEMA, as_problem, kind_of, problems_of
from replay.integrity.state import Crc, State, crc_of, failed_state, located, state_of, worst
from replay.recordings.source import RecordedSource
from replay.recordings.view_file import ViewFile
from replay.runs.folders import FINAL_METADATA, MODULES_FILE, RUN_JSON, VIEW_FILE, read_run_json
from replay.runs.log import SIGNALS_TOPIC, Batch, BatchReader, header_in
from replay.runs.modules import load_modules
from replay.runs.run import facts_sha256
from replay.storage.arrays import MAX_BYTES
from replay.storage.location import location
from replay.storage.opening import log_files


class RunPass:
    """Checks a run against what it states while the chunks of its log are decoded.

    Args:
        log: of the run, whole.
        reader: of the log.
        beside: also look at the files beside it.
    """

    def __init__(self, log: Path, reader: LogReader, *, beside: bool) -> None:
        self._log, self._reader, self._beside = log, reader, beside
        self._final = next((r.metadata for r in reader.metadata if r.name == FINAL_METADATA), None)
        self._document = read_run_json(log.parent) if beside else {}
        self._stated = self._stated_signals()
        self._hash, self._expected = SignalsHash(), 0
        self._batches: BatchReader | None = None
        self._found: list[Problem] = []
        with self._catching():
            header = header_in(reader)
            if self._stated is not None:
                self._batches = BatchReader(log, header, reader.channels, topics=(SIGNALS_TOPIC,))

    def add(self, segment: Segment) -> None:
        """Check the next chunk of the log."""
        table = self._reader.table(segment)
        with self._catching():
            if self._batches is not None and table is not None:
                for batch in self._batches.take(table):
                    self._add(batch)

    def finish(self) -> None:
        """Compare the signals with what the run states, after the last chunk."""
        with self._catching():
            if self._batches is not None:
                self._add(self._batches.rest())
                if self._hash.hexdigest() != self._stated:
                    what = f"its {self._hash.count} iterations are not those that the run had"
                    self._found.append(Problem(str(self._log), what))

    def problems(self) -> Iterator[Problem]:
        """Where the run is not what it states, of a log that is whole."""
        yield from self._found
        final, folder = self._final, self._log.parent
        if final is None or not self._beside:
            return
        if not self._document:
            yield Problem(str(folder / RUN_JSON), "is missing, empty or no JSON")
        elif facts_sha256(self._document) != final.get("facts_sha256"):
            what = "states something else than the run's final record"
            yield Problem(str(folder / RUN_JSON), what)
        yield from _check_modules(folder / MODULES_FILE, final.get("modules_sha256"))
        view = folder / VIEW_FILE
        if final.get("view") == json.dumps(True) and not view.is_file():
            yield Problem(str(view), f"is missing; {view_again(folder)}")

    def notes(self) -> Iterator[str]:
        """What nothing proves."""
        folder = self._log.parent
        if self._beside and (view := folder / VIEW_FILE).is_file():
            yield f"{view} is not checked: {view_again(folder)}"
        if self._final is None:
            yield f"{self._log} holds no final record: nothing proves what is beside it"

    def _stated_signals(self) -> Any:
        """SHA-256 of its signals as it states it, None where it does not."""
        if self._final is not None:
            return self._final.get("signals_sha256")
        result = self._document.get("result")
        return result.get("signals_sha256") if isinstance(result, Mapping) else None

    def _add(self, batch: Batch) -> None:
        for signals in (record for columns in batch.signals for record in columns.records()):
            if signals.iteration != self._expected:
                what = f"iterations {self._expected} to {signals.iteration - 1} are missing"
                self._found.append(Problem(str(self._log), what))
            self._expected = signals.iteration + 1
            self._hash.add(signals)

    @contextlib.contextmanager
    def _catching(self) -> Iterator[None]:
        try:
            yield
        except CdmisfaError as error:
            self._found.append(as_problem(self._log, error))
            self._batches = None


def view_again(run: Path) -> str:
    """How the view of a run comes back; it holds nothing that the log does not."""
    command = ("cdmisfa", "view", str(run), "--save", str(run / VIEW_FILE), "--force")
    return f"make it again with {shlex.join(command)}"


def _check_modules(path: Path, stated: str | None) -> Iterator[Problem]:
    try:
        if not path.is_file():
            yield Problem(str(path), "is missing")
        elif hashlib.sha256(read_regular(path, MAX_BYTES)).hexdigest() != stated:
            yield Problem(str(path), "holds something else than the run's final record states")
        else:
            load_modules(path)
    except CdmisfaError as error:
        yield as_problem(path, error)


@dataclass(frozen=True, slots=True)
class FileCheck:
    """One log: its checksums, "absent" where nothing protects its messages, and its state."""

    file: str
    crc: Crc
    state: State


@dataclass(frozen=True, slots=True)
class LogCheck:
    """Whether a log, or all logs of a folder, are whole; `notes` are no problems."""

    problems: tuple[Problem, ...]
    files: tuple[FileCheck, ...]
    notes: tuple[str, ...] = ()

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong."""
        return not self.problems

    @property
    def state(self) -> State:
        """The worst of the files; "damaged" where these are whole, and hold what they must not."""
        found = worst(file.state for file in self.files)
        refused = {file.file for file in self.files if file.state == "not read"}
        wrong = any(problem.where not in refused for problem in self.problems)
        return "damaged" if wrong and found in ("whole", "not read") else found

    def as_json(self) -> dict[str, Any]:
        """What was found as JSON values."""
        return {"schema": SCHEMA, "ok": self.ok, "state": self.state, **asdict(self)}


def check_logs(*words: str | Path) -> LogCheck:
    """Check several logs, each by itself; see `check_log`, which raises where there is one."""
    named, refused = located(words)
    checks = []
    for place in named:
        try:
            checks.append(check_log(place))
        except CdmisfaError as error:
            if len(words) == len(named) == 1:
                raise
            checks.append(_unread(place, error))
    checks += [_unread(word, error) for word, error in refused]
    return LogCheck(
        tuple(problem for check in checks for problem in check.problems),
        tuple(file for check in checks for file in check.files),
        tuple(note for check in checks for note in check.notes),
    )


def _unread(place: str | Path, error: CdmisfaError) -> LogCheck:
    return LogCheck((as_problem(place, error),), (FileCheck(str(place), *failed_state(error)),))


def check_log(path: str | Path) -> LogCheck:
    """Check a log, or all logs of a folder, by decoding everything in them, in one pass of each.

    Of a run also: its signals and, in its folder, the files beside its log are those that its
    final record states. Of a recording also: each view has every frame once; of a folder, that
    the views have the same frames and none is missing.

    Of a camera log every image is decoded.

    Raises:
        UsageError: no such log.
        CdmisfaError: a package that reads it is missing.
    """
    place = location(path)
    if only_foreign(place):
        return _check_images(place)
    problems: list[Problem] = []
    files: list[FileCheck] = []
    views: list[_ViewPass] = []
    notes: list[str] = []
    for file in log_files(place):
        checked, found, passed = _check_file(file, beside=place.is_dir())
        problems += found
        files.append(checked)
        if checked.crc == "absent":
            notes.append(f"{file}: {NO_CHECKSUMS}")
        if isinstance(passed, _ViewPass):
            views.append(passed)
        elif isinstance(passed, RunPass) and not found:
            problems += passed.problems()
            notes += passed.notes()
        elif passed is None and not found:
            told = _check_topics(file, image_topics(file))
            problems += told.problems
            notes += told.notes
    if views:
        problems += _check_views(views, alone=place.is_file())
    return LogCheck(tuple(dict.fromkeys(problems)), tuple(files), tuple(dict.fromkeys(notes)))


def _check_images(path: Path) -> LogCheck:
    """Decode every image of a camera log that has no checksums."""
    try:
        kind = log_format(path)
        notes = table_notes(path) if kind == "table" else []
        if kind == "bag":
            notes = [f"{path}: a ROS bag has no checksums, changed bytes may go unnoticed"]
        channels = channels_of(path, whole=True)
    except LogDamagedError as error:
        return LogCheck((as_problem(path, error),), (FileCheck(str(path), "absent", "damaged"),))
    found = _check_topics(path, [c.topic for c in channels if c.images and c.messages])
    files = found.files
    if kind == "pictures" and channels[0].encoding == "png":
        files = (replace(files[0], crc="bad" if found.problems else "ok"),)
    return replace(found, files=files, notes=(*notes, *found.notes))


def _check_topics(path: Path, topics: Iterable[str]) -> LogCheck:
    """Decode every image on some topics of a camera log."""
    problems: list[Problem] = []
    missing: dict[str, None] = {}
    notes: dict[str, None] = {}
    for topic in topics:
        try:
            with contextlib.closing(open_images(path, topic)) as images:
                problems += _broken(images)
                missing |= dict.fromkeys([images.missing] if images.missing else [])
                notes |= dict.fromkeys((*images.remarks, *images.warnings))
        except LogDamagedError as error:
            problems.append(as_problem(path, error))
        except UsageError as error:  # it needs an option, or what is not installed
            said = str(error).removeprefix(f"{path}: ")
            notes[f"{path}: {topic} is not decoded: {said}"] = None
    state: State = "damaged" if problems else "cut short" if missing else "whole"
    problems += [Problem(str(path), what) for what in missing]
    told = (note for note in notes if note.removeprefix(f"{path}: ") not in missing)
    return LogCheck(tuple(problems), (FileCheck(str(path), "absent", state),), tuple(told))


def _broken(images: ImageStream) -> Iterator[Problem]:
    for row in range(images.count):
        try:
            images.image(row)
        except (MalformedRecord, LogDamagedError) as error:
            yield Problem(images.where(row), str(error))


class _ViewPass:
    """Checks the frames of one file of a recording while its chunks are decoded."""

    def __init__(self, path: Path, reader: LogReader) -> None:
        self.path = path
        self.view: ViewFile | None = None
        self.error: LogDamagedError | None = None
        with self._catching():
            self.view = ViewFile(path, reader=reader)

    def add(self, segment: Segment) -> None:
        with self._catching():
            if self.view is not None and self.error is None:
                self.view.check_chunk(segment)

    def finish(self) -> None:
        with self._catching():
            if self.view is not None:
                self.view.finish()

    @contextlib.contextmanager
    def _catching(self) -> Iterator[None]:
        try:
            yield
        except LogDamagedError as error:
            self.error = error


class _ImagesPass:
    """Decodes the images of an external log while its chunks are decoded.

    It raises if one is broken: then the log is read again.
    """

    def __init__(self, path: Path, reader: LogReader) -> None:
        self._path, self._reader = path, reader
        self._decoders: dict[int, Decoder] = {}
        for topic in topics_in(reader, IMAGES):
            channels, decode = channels_on(reader, topic, IMAGES)
            self._decoders |= dict.fromkeys((channel.id for channel in channels), decode)

    def add(self, segment: Segment) -> None:
        table = self._reader.table(segment)
        assert table is not None
        rows = np.flatnonzero(np.isin(table.channel, list(self._decoders)))
        if len(rows):
            sorted_times(str(self._path), np.sort(table.log_time[rows]))
        with explained(self._path, "its decoder", held=table.data.nbytes):
            for row in rows.tolist():
                self._decoders[int(table.channel[row])](table.view(row))

    def finish(self) -> None:
        """Nothing is left to check."""


Pass = _ViewPass | RunPass | _ImagesPass
Checked = tuple[FileCheck, list[Problem], Pass | None]


def _check_file(path: Path, *, beside: bool) -> Checked:
    try:
        return read_once(path, lambda reader: _checked(path, reader, beside=beside))
    except LogDamagedError as error:
        return FileCheck(str(path), "bad", "damaged"), [as_problem(path, error)], None


def _checked(path: Path, reader: LogReader, *, beside: bool) -> Checked:
    passed = _pass_of(path, reader, beside)
    counts = count_messages(reader, decode=True, told=passed.add if passed else lambda _: None)
    if passed:
        passed.finish()
    wrong = [
        f"holds messages of channel {number}, never defined"
        for number in counts.keys() - reader.channels.keys()
    ]
    there = sum(channel.messages for channel in counts.values())
    stated = reader.statistics.message_count if reader.statistics else there
    if stated != there and not reader.problems:
        wrong.append(f"its summary states {stated} messages, there are {there}")
    problems = [Problem(str(path), what) for what in wrong]
    checked = FileCheck(str(path), crc_of(reader), state_of(reader))
    return checked, [*problems, *problems_of(reader)], passed


def _pass_of(path: Path, reader: LogReader, beside: bool) -> Pass | None:
    """Return the check of a log's content while it is decoded; None if images are checked later."""
    kind = kind_of(reader)
    if kind == "run" and reader.complete:
        return RunPass(path, reader, beside=beside)
    if kind == "recording":
        return _ViewPass(path, reader)
    return None if reader.salvage else _ImagesPass(path, reader)


def _check_views(passes: list[_ViewPass], *, alone: bool) -> Iterator[Problem]:
    folder = str(passes[0].path.parent)
    streams: set[str] = set()
    names: set[str] = set()
    numbers: set[int] = set()
    count = 0
    for checked in passes:
        if checked.view is not None:
            facts = checked.view.facts
            names.add(facts.view)
            streams |= set(filter(None, facts.streams))
            numbers.add(facts.stream_index)
            count = max(count, facts.stream_count)
            edges = [(0, facts.first_frame), *checked.view.ranges]
            for (_, end), (start, _) in itertools.pairwise(edges):
                if start > end and not facts.gaps:
                    yield Problem(str(checked.path), f"frames {end} to {start - 1} are missing")
        if checked.error is not None:
            yield as_problem(checked.path, checked.error)
    for name in () if alone else sorted(streams - names):
        yield Problem(folder, f"the view {name!r} of the recording has no file")
    if absent := set() if alone else set(range(count)) - numbers:
        what = f"of the recording's views 0 to {count - 1} {len(absent)} have no file, the first is"
        yield Problem(folder, f"{what} {min(absent)}")
    if any(checked.error is not None for checked in passes):
        return
    views = [checked.view for checked in passes if checked.view is not None]
    try:
        source = RecordedSource([v.path for v in views], salvage=True, opened=views)
    except LogDamagedError as error:
        yield replace(as_problem(passes[0].path, error), where=folder)
        return
    with contextlib.closing(source):
        if source.gaps:
            return
        ends = {name: ranges[-1][1] for name, ranges in source.coverage().items()}
        shortest = min(ends.values())
        for name, end in ends.items():
            if end > shortest:
                what = f"the view {name!r} ends before frame {end}, another before {shortest}"
                yield Problem(folder, what)
