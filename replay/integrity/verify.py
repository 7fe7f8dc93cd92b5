"""Is a log whole: every checksum, every length, and every frame in every view."""

from __future__ import annotations

import contextlib
import itertools
from typing import Any

from cdmisfa.core.errors import LogDamagedError
from replay.integrity.info import crc_state, kind_of, survey
from replay.mcap.reader import Crc, LogReader
from replay.recordings.source import RecordedSource
from replay.recordings.view_file import ViewFile
from replay.storage.copied import fetched
from replay.storage.listing import log_files
from replay.storage.location import Location, location


def verify(path: str | Location) -> dict[str, Any]:
    """Check a log, or all logs of a folder, by decoding everything in them.

    What lies behind a URL is copied first, for all of it is needed more than once.

    Of a recording also: each view has every frame once; of a folder, that the views have the
    same frames and none is missing.

    Returns:
        `ok`, `problems` (where, what), and `files`: for each its name and `crc`, "absent"
        where nothing protects the messages of a log that is fine otherwise.

    Raises:
        UsageError: no such log.
    """
    place = location(path)
    problems: list[dict[str, str]] = []
    files: list[dict[str, str]] = []
    views: list[Location] = []
    with fetched(place) as copy:
        for file in log_files(copy):
            state, kind = _check_file(file, problems)
            files.append({"file": str(file), "crc": state})
            if kind == "recording":
                views.append(file)
        if views:
            _check_views(views, problems, alone=copy.is_file())
    return {
        "ok": not problems,
        "problems": [p | {"where": p["where"].replace(str(copy), str(place))} for p in problems],
        "files": [f | {"file": f["file"].replace(str(copy), str(place))} for f in files],
    }


def _check_file(path: Location, problems: list[dict[str, str]]) -> tuple[Crc, str]:
    try:
        with LogReader(path, salvage=True) as reader:
            found = survey(reader)
            for number in found.keys() - reader.channels.keys():
                _note(problems, path, f"holds messages of channel {number}, never defined")
            there = sum(channel.messages for channel in found.values())
            if reader.statistics and not reader.problems and reader.statistics.messages != there:
                stated = reader.statistics.messages
                _note(problems, path, f"its summary states {stated} messages, there are {there}")
            for problem in reader.problems:
                _note(problems, path, problem.what, problem.where)
            if reader.missing:
                _note(problems, path, reader.missing)
            return crc_state(reader, decoded=True), kind_of(reader)
    except LogDamagedError as error:
        _note(problems, path, _without(path, error))
        return "bad", "foreign"


def _check_views(paths: list[Location], problems: list[dict[str, str]], *, alone: bool) -> None:
    sound = True
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
                        _note(problems, path, f"frames {end} to {start - 1} are missing")
                view.check()
        except LogDamagedError as error:
            sound = False
            _note(problems, path, _without(path, error))
    for name in () if alone else sorted(streams - names):
        _note(problems, paths[0].parent, f"the view {name!r} of the recording has no file")
    if not sound:
        return
    try:
        source = RecordedSource(paths, salvage=True)
    except LogDamagedError as error:
        _note(problems, paths[0].parent, _without(paths[0], error))
        return
    with contextlib.closing(source):
        ends = {name: ranges[-1][1] for name, ranges in source.coverage().items()}
        shortest = min(ends.values())
        for name, end in ends.items():
            if end > shortest:
                what = f"the view {name!r} ends before frame {end}, another before {shortest}"
                _note(problems, paths[0].parent, what)


def _note(problems: list[dict[str, str]], path: Location, what: str, where: str = "") -> None:
    problem = {"where": f"{path}: {where}" if where else str(path), "what": what}
    if problem not in problems:
        problems.append(problem)


def _without(path: Location, error: LogDamagedError) -> str:
    return str(error).removeprefix(f"{path}: ")
