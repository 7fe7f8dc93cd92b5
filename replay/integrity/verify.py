"""Is a log whole: every checksum, every length, and every frame in every view."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError
from recorder.mcap.reader import NO_CHECKSUMS, LogReader
from recorder.mcap.records import MalformedRecord, Problem
from replay.camera_logs.opening import (
    channels_of,
    image_topics,
    log_format,
    only_foreign,
    open_images,
)
from replay.camera_logs.stream import ImageStream
from replay.camera_logs.table import table_notes
from replay.integrity.counting import count_messages, read_once
from replay.integrity.info import SCHEMA, as_problem, kind_of, problems_of
from replay.integrity.passes import ImagesPass, RunPass, ViewPass
from replay.integrity.state import Crc, State, crc_of, failed_state, located, state_of, worst
from replay.recordings.source import RecordedSource
from replay.storage.location import location
from replay.storage.opening import log_files


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
    views: list[ViewPass] = []
    notes: list[str] = []
    for file in log_files(place):
        checked, found, passed = _check_file(file, beside=place.is_dir())
        problems += found
        files.append(checked)
        if checked.crc == "absent":
            notes.append(f"{file}: {NO_CHECKSUMS}")
        if isinstance(passed, ViewPass):
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


Pass = ViewPass | RunPass | ImagesPass
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
        return ViewPass(path, reader)
    return None if reader.salvage else ImagesPass(path, reader)


def _check_views(passes: list[ViewPass], *, alone: bool) -> Iterator[Problem]:
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
