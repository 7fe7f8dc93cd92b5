"""List the episodes of a dataset, open one, and measure it: each image is decoded once."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.errors import CdmisfaError, UsageError
from cdmisfa.core.names import stream_names
from recorder.images.options import InputOptions
from replay.episodes.measure import CameraMeter, Measured
from replay.integrity.info import describe_log
from replay.integrity.listing import ListedLog, find_logs
from replay.logs.formats import lerobot
from replay.logs.formats.messages import NoTopicError
from replay.logs.open_logs import ALL, FORMATS, log_format
from replay.logs.stream import BROKEN, LogStream
from replay.open_sources import is_recording, locations
from replay.runs.folders import is_run
from replay.storage.location import location
from replay.storage.paths import natural_order, no_such

# Increased whenever a measure changes, so that stored ones are not used any more.
VERSION: Final = 1

# Words in the names of topics with commands, not states.
COMMANDS: Final = ("action", "command", "cmd", "target", "goal", "desired", "leader")

# Images per second of a log that states no times.
RATE: Final = 30.0

# Formats of logs with topics.
_WITH_TOPICS: Final = ("mcap", "split", "bag")

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
    """

    name: str
    files: tuple[str, ...]
    state: tuple[int, str]
    about: Mapping[str, str]
    number: int = -1
    first: int = 0
    count: int = 0
    problem: str = ""

    def key(self, *options: object) -> str:
        """Return a name for measures of this episode, which differs if the log changes."""
        text = json.dumps([VERSION, asdict(self), *options], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:20]


def list_episodes(words: Sequence[str | Path], out: Path) -> list[EpisodeLog]:
    """Return the episodes of datasets, folders, patterns and files, in order of their names.

    Args:
        words: the datasets.
        out: folder of the results, which is not searched.

    Raises:
        UsageError: a word names nothing, or there is no episode.
        LogDamagedError: a LeRobot dataset cannot be read.
    """
    for path in locations(words):
        if not path.exists():
            raise no_such(path)
    logs: dict[str, list[ListedLog]] = {}
    wholes: dict[Path, bool] = {}
    for log in find_logs(words):
        folder, place = Path(log.file).parent, log.file
        if os.path.abspath(place).startswith(os.path.join(os.path.abspath(out), "")):
            continue
        if place.endswith(".mcap") and "://" not in place and not log.problem:
            wholes.setdefault(folder, folder not in wholes and _is_whole(folder))
            place = str(folder) if wholes[folder] else place
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
        if format == "dataset":
            prefix = f"{name}: " if len(logs) > 1 else ""
            episodes += _of_dataset(place, state, prefix)
            continue
        files = tuple(log.file for log in members) if len(members) > 1 else (place,)
        about = {"folder": os.path.dirname(name)} if os.path.dirname(name) else {}
        files = (place,) if format == "split" else files
        episodes.append(EpisodeLog(name, files, state, about, problem=problem))
    if not episodes:
        raise UsageError(f"{' '.join(map(str, words))}: there is no log with images in it")
    return episodes


def _is_whole(folder: Path) -> bool:
    """Return whether the MCAP files of a folder are one log: a split bag, or a recording."""
    with suppress(CdmisfaError, OSError):
        several = len([*folder.glob("*.mcap")]) > 1
        return log_format(folder) == "split" or (several and is_recording([str(folder)]))
    return False


def _of_dataset(place: str, state: tuple[int, str], prefix: str) -> Iterator[EpisodeLog]:
    """Yield the episodes of a LeRobot dataset."""
    first = 0
    for row in lerobot.episode_facts(location(place)):
        length, number = int(row.pop("length")), int(row.pop("episode_index"))
        row["task"] = "; ".join(map(str, row.pop("tasks", None) or []))
        about = {k: str(v) for k, v in row.items() if isinstance(v, str | int) and v != ""}
        name = f"{prefix}episode {number}"
        yield EpisodeLog(name, (place,), state, about, number, first, length)
        first += length


class Feed(NamedTuple):
    """The images of one camera of an episode.

    Attributes:
        name: name of the camera.
        times: (T,) times (s).
        image: returns the image of a row.
    """

    name: str
    times: FloatArray
    image: Callable[[int], NDArray[Any]]


class OpenEpisode:
    """An episode whose log is open.

    Args:
        log: where it is.
        opened: closes the log.
        state: topics or features of the joint states, as TOPIC or TOPIC:FIELD; empty for those
            that are found by type and name.
        action: the same of the actions.

    Attributes:
        cameras: its cameras.
        untimed: whether a log states no times.

    Raises:
        CdmisfaError: the log cannot be read.
    """

    def __init__(
        self, log: EpisodeLog, opened: ExitStack, state: Sequence[str], action: Sequence[str]
    ) -> None:
        self._log, self._opened = log, opened
        self._chosen = {"state": state, "action": action}
        self._paths = [location(file) for file in log.files]
        self._format = log_format(self._paths[0])
        streams: list[LogStream] = []
        for path in self._paths:
            topics = ALL if self._format in (*_WITH_TOPICS, "dataset") else ()
            if self._format != "dataset" or lerobot.features(path)[1]:
                with suppress(NoTopicError):
                    options = InputOptions(topics=topics, color=True)
                    streams += FORMATS[self._format](path, options, opened)
        # A file without topics is named by itself, but its camera is the same in all episodes.
        alone = self._format in ("video", "images")
        names = ("camera",) if alone else stream_names([stream.topic for stream in streams])
        self.untimed = any(stream.times is None for stream in streams)
        self.cameras = [
            Feed(name, _seconds(stream, self._rows(stream)), self._images(stream))
            for name, stream in zip(names, streams, strict=True)
        ]

    def numbers(self) -> dict[str, Rows]:
        """Read joint states and actions, if there are any."""
        topics_of: dict[str, list[str]] = {"state": [], "action": []}
        if self._format == "dataset":
            known = lerobot.features(self._paths[0])[0]
            topics_of = {"state": ["observation.state"], "action": ["action"]}
            topics_of = {
                kind: [n for n in names if n in known] for kind, names in topics_of.items()
            }
        elif self._format in _WITH_TOPICS:
            for channel in describe_log(self._paths[0], decode=False).channels:
                if channel.schema.endswith("JointState") and channel.messages:
                    command = any(word in channel.topic.lower() for word in COMMANDS)
                    topics_of["action" if command else "state"].append(channel.topic)
        chosen = {kind: self._chosen[kind] or names for kind, names in topics_of.items()}
        return {kind: self._joined(words) for kind, words in chosen.items() if words}

    def _joined(self, words: Sequence[str]) -> Rows:
        """Read numbers; several topics are put beside each other, at the times of the first."""
        parts = [self._numbers(word) for word in words]
        clock = parts[0][0]
        columns = [np.interp(clock, times, x) for times, values in parts for x in values.T]
        return clock, np.stack(columns, axis=1)

    def _numbers(self, word: str) -> Rows:
        topic, _, field = word.partition(":")
        options = InputOptions(topics=(topic,), fields=(field or "position",))
        if self._format == "dataset":
            options = InputOptions(fields=(word,))
        (stream,) = FORMATS[self._format](self._paths[0], options, self._opened)
        rows = self._rows(stream)
        times, whole, values = _seconds(stream, rows), [], []
        if stream.read is not None:
            return times, np.asarray(stream.read(rows)[0], np.float64)
        for place, row in enumerate(rows):
            with suppress(*BROKEN):
                values.append(stream.image(row))
                whole.append(place)
        if len({len(row) for row in values}) != 1:
            raise UsageError(
                f"{self._paths[0]}: {topic} has a changing number of values: choose a part of "
                f"them, as in --state {topic}:position[0:6]"
            )
        return times[whole], np.stack(values)

    def _rows(self, stream: LogStream) -> range:
        """Return the rows of the episode in a stream."""
        log = self._log
        return range(log.first, log.first + log.count) if log.number >= 0 else range(stream.count)

    def _images(self, stream: LogStream) -> Callable[[int], NDArray[Any]]:
        rows = self._rows(stream)
        return lambda row: stream.image(rows[row])


def _seconds(stream: LogStream, rows: range) -> FloatArray:
    if stream.times is None:
        return np.arange(len(rows)) / RATE
    return np.asarray(stream.times[rows.start : rows.stop] / 1e9, np.float64)


def measure_episode(log: EpisodeLog, state: Sequence[str], action: Sequence[str]) -> Measured:
    """Measure an episode; one that cannot be read has a `problem` instead of measures."""
    measured = Measured(log.name, problem=log.problem)
    try:
        if not log.problem:
            with ExitStack() as opened:
                _measure(OpenEpisode(log, opened, state, action), measured)
    except CdmisfaError as error:
        measured.problem = str(error)
    except Exception as error:  # libraries raise anything for a broken file
        measured.problem = f"{type(error).__name__}: {error}"
    return measured


def _measure(episode: OpenEpisode, measured: Measured) -> None:
    """Read numbers and all images, in order of time over all cameras: a log is read once."""
    cameras = [feed for feed in episode.cameras if len(feed.times)]
    numbers = {kind: rows for kind, rows in episode.numbers().items() if len(rows[0])}
    clocks = [feed.times for feed in cameras] + [times for times, _ in numbers.values()]
    if not clocks:
        raise UsageError(f"{measured.name}: no images and no joint states were found")
    if episode.untimed:
        measured.remarks.append(f"no times: {RATE:g} images per second are assumed")
    zero = min(float(times[0]) for times in clocks)
    measured.numbers = {kind: (times - zero, values) for kind, (times, values) in numbers.items()}
    meters = [CameraMeter(feed.times - zero) for feed in cameras]
    camera_of = np.repeat(np.arange(len(cameras)), [len(feed.times) for feed in cameras])
    row_of = np.concatenate([np.arange(len(feed.times)) for feed in cameras] or [camera_of])
    times = np.concatenate([feed.times for feed in cameras] or [np.zeros(0)])
    for place in np.argsort(times, kind="stable"):
        feed, meter = cameras[camera_of[place]], meters[camera_of[place]]
        row = int(row_of[place])
        try:
            meter.add(row, feed.image(row))
        except BROKEN as error:
            meter.broken.append(f"{feed.name} at {feed.times[row] - zero:.1f} s: {error}")
    for feed, meter in zip(cameras, meters, strict=True):
        if meter.broken:
            count = f"{len(meter.broken)} of {len(feed.times)} images are broken"
            measured.remarks.append(f"{count}: {meter.broken[0]}")
        if camera := meter.result():
            measured.cameras[feed.name] = camera
