"""Is a log whole: every checksum, every length, and every frame in every view."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from cdmisfa.core.errors import LogDamagedError
from replay.integrity.run_files import check_run, read_final, view_again
from replay.integrity.survey import SCHEMA, Crc, Kind, moved, survey
from replay.mcap.reader import LogReader
from replay.mcap.segments import Problem
from replay.recordings.source import RecordedSource
from replay.recordings.view_file import ViewFile
from replay.runs.folders import VIEW_FILE
from replay.storage.listing import log_files
from replay.storage.location import Location, location
from replay.storage.opening import fetched


@dataclass(frozen=True, slots=True)
class FileCheck:
    """The checksums of one log: "absent" where nothing protects its messages."""

    file: str
    crc: Crc


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

    def as_json(self) -> dict[str, Any]:
        """What was found as JSON values."""
        return {"schema": SCHEMA, "ok": self.ok, **asdict(self)}


def check_log(path: str | Location) -> LogCheck:
    """Check a log, or all logs of a folder, by decoding everything in them.

    What lies behind a URL is copied first, for all of it is needed more than once.

    Of a run also: its signals and, in its folder, the files beside its log are those that its
    final record states. Of a recording also: each view has every frame once; of a folder, that
    the views have the same frames and none is missing.

    Raises:
        UsageError: no such log.
    """
    place = location(path)
    problems: list[Problem] = []
    files: list[FileCheck] = []
    views: list[Location] = []
    notes: list[str] = []
    with fetched(place) as copy:
        for file in log_files(copy):
            crc, kind, found = _check_file(file)
            problems += found
            files.append(FileCheck(str(file).replace(str(copy), str(place)), crc))
            if kind == "recording":
                views.append(file)
            if kind == "run" and not found and isinstance(file, Path):
                beside = isinstance(place, Path) and place.is_dir()
                problems += check_run(file, beside=beside)
                if beside and (view := file.parent / VIEW_FILE).is_file():
                    notes.append(f"{view} is not checked: {view_again(file.parent)}")
                if read_final(file) is None:
                    notes.append(f"{file} holds no final record: nothing proves what is beside it")
        if views:
            problems += _check_views(views, alone=copy.is_file())
    unique = dict.fromkeys(moved(problem, copy, place) for problem in problems)
    return LogCheck(tuple(unique), tuple(files), tuple(notes))


def _check_file(path: Location) -> tuple[Crc, Kind, list[Problem]]:
    try:
        with LogReader(path, salvage=True) as reader:
            found = survey(reader, decode=True)
            wrong = [
                f"holds messages of channel {number}, never defined"
                for number in found.channels.keys() - reader.channels.keys()
            ]
            there = sum(channel.messages for channel in found.channels.values())
            stated = reader.statistics.messages if reader.statistics else there
            if stated != there and not reader.problems:
                wrong.append(f"its summary states {stated} messages, there are {there}")
            problems = [Problem(str(path), what) for what in wrong]
            return found.crc, found.kind, [*problems, *found.problems]
    except LogDamagedError as error:
        return "bad", "foreign", [_said(path, error)]


def _check_views(paths: list[Location], *, alone: bool) -> Iterator[Problem]:
    sound, folder = True, str(paths[0].parent)
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
                        yield Problem(str(path), f"frames {end} to {start - 1} are missing")
                view.check()
        except LogDamagedError as error:
            sound = False
            yield _said(path, error)
    for name in () if alone else sorted(streams - names):
        yield Problem(folder, f"the view {name!r} of the recording has no file")
    if not sound:
        return
    try:
        source = RecordedSource(paths, salvage=True)
    except LogDamagedError as error:
        yield replace(_said(paths[0], error), where=folder)
        return
    with contextlib.closing(source):
        ends = {name: ranges[-1][1] for name, ranges in source.coverage().items()}
        shortest = min(ends.values())
        for name, end in ends.items():
            if end > shortest:
                what = f"the view {name!r} ends before frame {end}, another before {shortest}"
                yield Problem(folder, what)


def _said(path: Location, error: LogDamagedError) -> Problem:
    """An error as a problem of the log that it names."""
    return Problem(str(path), str(error).removeprefix(f"{path}: "))
