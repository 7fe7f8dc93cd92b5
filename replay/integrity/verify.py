"""Is a log whole: every checksum, every length, and every frame in every view."""

from __future__ import annotations

import contextlib
import itertools
from dataclasses import asdict, dataclass
from typing import Any

from cdmisfa.core.errors import LogDamagedError
from replay.integrity.survey import (
    SCHEMA,
    Crc,
    Kind,
    Problem,
    crc_state,
    kind_of,
    problems_of,
    survey,
)
from replay.mcap.reader import LogReader
from replay.recordings.source import RecordedSource
from replay.recordings.view_file import ViewFile
from replay.storage.listing import log_files
from replay.storage.location import Location, location
from replay.storage.opening import fetched


@dataclass(frozen=True, slots=True)
class FileCheck:
    """What the checksums of one log amount to.

    Attributes:
        file: the log.
        crc: "absent" where nothing protects the messages of a log that is fine otherwise.
    """

    file: str
    crc: Crc


@dataclass(frozen=True, slots=True)
class LogCheck:
    """Whether a log, or all logs of a folder, are whole."""

    problems: tuple[Problem, ...]
    files: tuple[FileCheck, ...]

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong."""
        return not self.problems

    def as_json(self) -> dict[str, Any]:
        """What was found as JSON values."""
        return {"schema": SCHEMA, "ok": self.ok, **asdict(self)}


def check_log(path: str | Location) -> LogCheck:
    """Check a log, or all logs of a folder, by decoding everything in them.

    What lies behind a URL is copied first, for all of it is needed more than once.

    Of a recording also: each view has every frame once; of a folder, that the views have the
    same frames and none is missing.

    Raises:
        UsageError: no such log.
    """
    place = location(path)
    problems: list[Problem] = []
    files: list[FileCheck] = []
    views: list[Location] = []
    with fetched(place) as copy:
        for file in log_files(copy):
            state, kind = _check_file(file, problems)
            files.append(FileCheck(str(file).replace(str(copy), str(place)), state))
            if kind == "recording":
                views.append(file)
        if views:
            _check_views(views, problems, alone=copy.is_file())
    unique = dict.fromkeys(problem.moved(copy, place) for problem in problems)
    return LogCheck(tuple(unique), tuple(files))


def _check_file(path: Location, problems: list[Problem]) -> tuple[Crc, Kind]:
    try:
        with LogReader(path, salvage=True) as reader:
            found = survey(reader, decode=True)
            for number in found.keys() - reader.channels.keys():
                what = f"holds messages of channel {number}, never defined"
                problems.append(Problem(str(path), what))
            there = sum(channel.messages for channel in found.values())
            if reader.statistics and not reader.problems and reader.statistics.messages != there:
                stated = reader.statistics.messages
                what = f"its summary states {stated} messages, there are {there}"
                problems.append(Problem(str(path), what))
            problems += problems_of(reader)
            return crc_state(reader, decoded=True), kind_of(reader)
    except LogDamagedError as error:
        problems.append(_said(path, error))
        return "bad", "foreign"


def _check_views(paths: list[Location], problems: list[Problem], *, alone: bool) -> None:
    sound, folder = True, paths[0].parent
    streams: set[str] = set()
    names: set[str] = set()
    for path in paths:
        try:
            with contextlib.closing(ViewFile(path, salvage=True)) as view:
                names.add(view.facts.view)
                streams |= set(filter(None, view.facts.values.get("streams", "").split(",")))
                edges = [(0, view.facts.first_frame), *view.ranges]
                for (_, end), (start, _) in itertools.pairwise(edges):
                    if start > end:
                        what = f"frames {end} to {start - 1} are missing"
                        problems.append(Problem(str(path), what))
                view.check()
        except LogDamagedError as error:
            sound = False
            problems.append(_said(path, error))
    for name in () if alone else sorted(streams - names):
        what = f"the view {name!r} of the recording has no file"
        problems.append(Problem(str(folder), what))
    if not sound:
        return
    try:
        source = RecordedSource(paths, salvage=True)
    except LogDamagedError as error:
        problems.append(_said(paths[0], error, folder))
        return
    with contextlib.closing(source):
        ends = {name: ranges[-1][1] for name, ranges in source.coverage().items()}
        shortest = min(ends.values())
        for name, end in ends.items():
            if end > shortest:
                what = f"the view {name!r} ends before frame {end}, another before {shortest}"
                problems.append(Problem(str(folder), what))


def _said(path: Location, error: LogDamagedError, where: Location | None = None) -> Problem:
    """An error as a problem of the log that it names, or of another place."""
    return Problem(str(where or path), str(error).removeprefix(f"{path}: "))
