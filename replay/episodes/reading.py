"""List the episodes of a dataset, open one, and measure it: each image is decoded once."""

from __future__ import annotations

import functools
import gc
import hashlib
import json
import os
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.errors import CdmisfaError, UsageError
from cdmisfa.core.names import is_command, stream_names
from recorder.images.options import InputOptions
from replay.episodes.measure import CameraMeter, Measured
from replay.integrity.info import describe_log
from replay.integrity.listing import ListedLog, find_logs
from replay.logs.formats import lerobot
from replay.logs.formats.messages import NoTopicError
from replay.logs.open_logs import ALL, FORMATS, Format, log_format
from replay.logs.stream import BROKEN, RATE, LogStream
from replay.open_sources import is_recording, locations
from replay.runs.folders import is_run
from replay.storage.location import is_url, location
from replay.storage.paths import natural_order, no_such

# Increased whenever a measure changes, so that stored ones are not used any more.
VERSION: Final = 2

# Images between two collections: PyAV's images are freed by the collector only, and each of them is
# so few objects that it does not run by itself.
COLLECT_EVERY: Final = 64

# Formats of logs with topics.
_WITH_TOPICS: Final = ("mcap", "split", "bag")

# Range of numbers that refuses none: NaN becomes -inf, and `_measure` leaves its row out.
_ANY: Final = (-np.inf, np.inf)

# Times (N,) in seconds and values (N, n).
Rows = tuple[FloatArray, FloatArray]


@dataclass(frozen=True, slots=True)
class EpisodeLog:
    """Where an episode is.

    Attributes:
        name: the path of its log relative to the folder of all, or "episode N".
        files: the log: a dataset, a file, a bag, or the views of a recording.
        state: size of the files, and time of the last change.
        about: what the dataset states of the episode, such as its task.
        number: its number in a LeRobot dataset; -1 for a log that is one episode.
        first: its first frame in a LeRobot dataset.
        count: its frames in a LeRobot dataset.
        problem: why it cannot be opened, or "".
        topics: topics or features of "state" and of "action", as TOPIC or TOPIC:FIELD; others
            are found by type and name.
        missing: why further episodes of its dataset are not read, or "".
    """

    name: str
    files: tuple[str, ...]
    state: tuple[int, str]
    about: Mapping[str, str]
    number: int = -1
    first: int = 0
    count: int = 0
    problem: str = ""
    topics: Mapping[str, Sequence[str]] = field(default_factory=dict)
    missing: str = ""

    def key(self) -> str:
        """Return a name for measures of this episode, which differs if the log changes."""
        text = json.dumps([VERSION, asdict(self)], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:20]


def refuse_input(words: Sequence[str | Path], out: Path) -> None:
    """Refuse a folder of results that holds an input; a UsageError."""
    for path in locations(words):
        if not is_url(path) and path.resolve().is_relative_to(out.resolve()):
            raise UsageError(f"{out}: it is, or holds, the input {path}: choose another output")


def list_episodes(
    words: Sequence[str | Path], out: Path, topics: Mapping[str, Sequence[str]]
) -> list[EpisodeLog]:
    """Return the episodes of datasets, folders, patterns and files, in order of their names.

    Args:
        words: the datasets.
        out: folder of the results, which is not searched.
        topics: topics or features of joint states and actions, see `EpisodeLog`.

    Raises:
        UsageError: a word names nothing, or there is no episode.
        LogDamagedError: a LeRobot dataset cannot be read.
    """
    for path in locations(words):
        if not path.exists():
            raise no_such(path)
    logs: dict[str, list[ListedLog]] = {}
    is_whole = functools.cache(_is_whole)
    for log in find_logs(words):
        folder, place = os.path.dirname(log.file), log.file
        if os.path.abspath(place).startswith(os.path.join(os.path.abspath(out), "")):
            continue
        if place.endswith(".mcap") and not (is_url(place) or log.problem) and is_whole(folder):
            place = folder
        logs.setdefault(place, []).append(log)
    episodes: list[EpisodeLog] = []
    root = os.path.commonpath([os.path.dirname(os.path.abspath(log)) for log in logs] or ["/"])
    for place, members in sorted(logs.items(), key=lambda item: natural_order(Path(item[0]))):
        name, format, problem = os.path.relpath(place, root), "", members[0].problem
        with suppress(CdmisfaError, OSError):  # measuring it will state the problem
            format = "" if problem else log_format(location(place))
            if format in ("table", "arrays") or (format == "mcap" and is_run(location(place))):
                continue
        state = sum(log.bytes for log in members), max(log.changed for log in members)
        files = tuple(log.file for log in members) if format != "split" else (place,)
        about = {"folder": os.path.dirname(name)} if os.path.dirname(name) else {}
        one = EpisodeLog(name, files, state, about, problem=problem, topics=topics)
        prefix = f"{name}: " if len(logs) > 1 else ""
        episodes += _of_dataset(one, prefix) if format == "dataset" else [one]
    if not episodes:
        raise UsageError(f"{' '.join(map(str, words))}: there is no log with images in it")
    return episodes


def _is_whole(folder: str) -> bool:
    """Return whether the MCAP files of a folder are one log: a split bag, or a recording."""
    with suppress(CdmisfaError, OSError):
        several = len([*Path(folder).glob("*.mcap")]) > 1
        return log_format(Path(folder)) == "split" or (several and is_recording([folder]))
    return False


def _of_dataset(log: EpisodeLog, prefix: str) -> Iterator[EpisodeLog]:
    """Yield the episodes of a LeRobot dataset."""
    first, dataset = 0, lerobot.Dataset(location(log.files[0]))
    left = f"{log.files[0]}: {dataset.missing}" if dataset.missing else ""
    for row in dataset.rows:
        length, number = int(row.pop("length")), int(row.pop("episode_index"))
        row["task"] = "; ".join(map(str, row.pop("tasks", None) or []))
        about = {k: str(v) for k, v in row.items() if isinstance(v, str | int) and v != ""}
        about = {k: v for k, v in about.items() if "/" not in k and not k.startswith("dataset_")}
        name, place = f"{prefix}episode {number}", (number, first, length)
        yield EpisodeLog(name, log.files, log.state, about, *place, topics=log.topics, missing=left)
        first += length


def open_cameras(log: EpisodeLog, opened: ExitStack) -> dict[str, LogStream]:
    """Open the images of each camera of an episode; `opened` closes them.

    Raises:
        CdmisfaError: the log cannot be read.
    """
    streams: list[LogStream] = []
    for path in map(location, log.files):
        format = log_format(path)
        if format != "dataset" or lerobot.features(path)[1]:
            topics = ALL if format in (*_WITH_TOPICS, "dataset") else ()
            with suppress(NoTopicError):
                streams += _streams(log, path, format, opened, topics=topics, color=True)
    # A file without topics is named by itself, but its camera is the same in all episodes.
    alone = format in ("video", "images")
    names = ("camera",) if alone else stream_names([stream.topic for stream in streams])
    return dict(zip(names, streams, strict=True))


def read_numbers(log: EpisodeLog, opened: ExitStack) -> dict[str, Rows]:
    """Read joint states and actions of an episode, if there are any; raises as `open_cameras`."""
    path, topics = location(log.files[0]), defaultdict[str, list[str]](list)
    if (format := log_format(path)) == "dataset":
        known = lerobot.features(path)[0]
        for kind, name in (("state", "observation.state"), ("action", "action")):
            topics[kind] += [name] if name in known else []
    elif format in _WITH_TOPICS:
        files = sorted(path.glob("*.mcap")) if format == "split" else [path]
        reports = [describe_log(file, decode=False) for file in files]
        for channel in (channel for report in reports for channel in report.channels):
            command = is_command(channel.topic)
            names = topics["action" if command else "state"]
            if channel.schema.endswith("JointState") and channel.messages:
                names += [channel.topic] if channel.topic not in names else []
    numbers: dict[str, Rows] = {}
    for kind in ("state", "action"):
        if words := log.topics.get(kind) or topics[kind]:
            # Several topics are put beside each other, at the times of the first.
            parts = [_numbers(log, path, format, word, opened) for word in words]
            columns = [np.interp(parts[0][0], times, x) for times, rows in parts for x in rows.T]
            numbers[kind] = parts[0][0], np.stack(columns, axis=1)
    return numbers


def _numbers(log: EpisodeLog, path: Path, format: Format, word: str, opened: ExitStack) -> Rows:
    topic, _, field = word.partition(":")
    if format == "dataset":
        (stream,) = _streams(log, path, format, opened, fields=(word,))
    else:
        how = {"topics": (topic,), "fields": (field or "position",), "range": _ANY}
        (stream,) = _streams(log, path, format, opened, **how)
    if stream.read is not None:
        return stream.seconds(), np.asarray(stream.read(range(stream.count))[0], np.float64)
    rows, values = list[int](), list[Any]()
    for row in range(stream.count):
        with suppress(*BROKEN):
            values.append(stream.image(row))
            rows.append(row)
    if len({len(row) for row in values}) != 1:
        raise UsageError(
            f"{path}: {topic} has a changing number of values: choose a part of "
            f"them, as in --state {topic}:position[0:6]"
        )
    # Sorted by the names of joints, columns are the same in all logs, whatever a publisher's order.
    order = np.argsort(stream.elements()) if stream.elements() else slice(None)
    return stream.seconds()[rows], np.stack(values)[:, order]


def _streams(
    log: EpisodeLog, path: Path, format: Format, opened: ExitStack, **options: Any
) -> list[LogStream]:
    """Open streams of a file of an episode; of a dataset, the rows of the episode."""
    chosen = InputOptions(**options)
    if format != "dataset":
        return FORMATS[format](path, chosen, opened)
    streams = _of_dataset_once(path, log.state, chosen)
    rows = np.arange(log.first, log.first + log.count)
    return [stream.part(rows, stream.times[rows]) for stream in streams if stream.times is not None]


@functools.lru_cache(maxsize=8)
def _of_dataset_once(path: Path, state: tuple[int, str], options: InputOptions) -> list[LogStream]:
    """Open streams of a LeRobot dataset once for all of its episodes, until the process ends.

    Its tables and the numbers in them belong to all episodes.
    """
    return FORMATS["dataset"](path, options, ExitStack())


def measure_episode(log: EpisodeLog) -> Measured:
    """Measure an episode; one that cannot be read has a `problem` instead of measures."""
    measured = Measured(log.name, problem=log.problem)
    try:
        if not log.problem:
            with ExitStack() as opened:
                cameras = open_cameras(log, opened)
                _measure(cameras, read_numbers(log, opened), measured)
                if log.number < 0:  # of a dataset, a note states it once
                    cut = (stream.missing for stream in cameras.values())
                    measured.remarks += dict.fromkeys(filter(None, cut))
    except CdmisfaError as error:
        measured.problem = str(error)
    except Exception as error:  # libraries raise anything for a broken file
        measured.problem = f"{type(error).__name__}: {error}"
    return measured


def _measure(
    cameras: Mapping[str, LogStream], numbers: Mapping[str, Rows], measured: Measured
) -> None:
    """Measure all images, in order of time over all cameras: a log is read once."""
    for kind, (times, values) in numbers.items():
        whole = np.isfinite(values.sum(1))
        if not whole.all():
            left = f"{(~whole).sum()} of {len(whole)} rows of the {kind}s are not finite"
            measured.remarks.append(f"{left}: they are left out")
        if whole.any():
            measured.numbers[kind] = times[whole], values[whole]
    clocks = {name: stream.seconds() for name, stream in cameras.items()}
    every = [*clocks.values(), *(times for times, _ in measured.numbers.values())]
    if not every:
        raise UsageError(f"{measured.name}: no images and no joint states were found")
    if any(stream.times is None for stream in cameras.values()):
        measured.remarks.append(f"no times: {RATE:g} images per second are assumed")
    zero = min(float(times[0]) for times in every)
    measured.numbers = {kind: (t - zero, values) for kind, (t, values) in measured.numbers.items()}
    meters = {name: CameraMeter(times - zero) for name, times in clocks.items()}
    rows = [(time, name, row) for name, t in clocks.items() for row, time in enumerate(t.tolist())]
    for place, (time, name, row) in enumerate(sorted(rows, key=lambda one: one[0])):
        if place % COLLECT_EVERY == 0:
            gc.collect()
        try:
            meters[name].add(row, cameras[name].image(row))
        except BROKEN as error:
            meters[name].broken.append(f"{name} at {time - zero:.1f} s: {error}")
    for name, meter in meters.items():
        if meter.broken:
            count = f"{len(meter.broken)} of {len(clocks[name])} images are broken"
            measured.remarks.append(f"{count}: {meter.broken[0]}")
        if camera := meter.result():
            measured.cameras[name] = camera
