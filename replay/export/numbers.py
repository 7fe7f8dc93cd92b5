"""Numbers of logs as features of a dataset: every topic, at the times of its frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray, IntArray
from cdmisfa.core.clock import NANOSECONDS, times_of
from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError
from cdmisfa.core.names import is_command, stream_name
from recorder.images.options import InputOptions
from recorder.mcap.reader import LogReader
from replay.logs.clock import GAP_STEPS, nearest_rows, step_of
from replay.logs.formats import lerobot
from replay.logs.formats.mcap_log import message_kind
from replay.logs.formats.messages import fits_topic
from replay.logs.open_logs import FORMATS, channels_of, image_logs, log_format
from replay.logs.source import LoggedSource
from replay.logs.stream import BROKEN, LogStream
from replay.storage.paths import log_files

# Formats whose numbers are read here; those of other sources are frames.
READ: Final = ("mcap", "split", "bag", "dataset", "table")

# LeRobot's names of actions and of the state of a robot or an agent.
ACTIONS, STATE = "action", "observation.state"

# From here on float32 rounds whole numbers.
ROUNDED: Final = 2.0**24

# Values (n,) or (n, k) of each feature, and the names of its k numbers.
Columns = dict[str, tuple[NDArray[Any], list[str] | None]]

Message = Callable[[str], None]


def log_columns(
    source: LoggedSource,
    paths: Sequence[Path],
    times: IntArray,
    inputs: InputOptions,
    chosen: Mapping[str, Sequence[str]],
    warn: Message,
) -> Columns:
    """Return the numbers of all topics of a log, each from the message nearest to a frame.

    Args:
        source: the images of the log.
        paths: the log, and tables beside it.
        times: (n,) times of the frames (ns).
        inputs: options of logs; with `topics` no others are read.
        chosen: for `STATE` and `ACTIONS` the topics or TOPIC:FIELD to put there.
        warn: called with a line for each topic or field that no feature holds, and each gap.

    Raises:
        UsageError: a chosen topic or field does not exist, or cannot be read.
    """
    parts: dict[str, list[tuple[str, FloatArray, list[str]]]] = {}
    missing = {word for words in chosen.values() for word in words}
    with ExitStack() as opened:
        for path, topic, kind in _topics(source, paths, inputs, chosen, warn):
            options = replace(inputs, topics=(topic,))

            def stream_of(
                *fields: str, path: Path = path, options: InputOptions = options
            ) -> LogStream:
                how = replace(options, fields=fields or options.fields)
                (stream,) = FORMATS[log_format(path)](path, how, opened)
                return stream

            words = [(key, word) for key in chosen for word in chosen[key] if _topic(word) == topic]
            missing -= {word for _, word in words}
            try:
                places = _places(topic, kind, stream_of().fields, words, chosen)
            except CdmisfaError as error:
                if words:
                    raise
                warn(f"{topic} is left out: {_reason(error, path, topic)}")
                continue
            for key, fields in places:
                try:
                    stream = _timed(stream_of(*fields), source)
                    values = _nearest(stream, times, warn)
                except CdmisfaError as error:
                    if key in chosen:
                        raise
                    why = _reason(error, path, topic)
                    warn(f"{', '.join(fields)} of {topic} is left out: {why}")
                    continue
                names = list(stream.elements() or stream.columns())
                parts.setdefault(key, []).append((topic, values, names))
    if missing:
        raise UsageError(f"{source.streams[0].path} has no numbers on {min(missing)}")
    return {key: _joined(key, parts[key], warn) for key in sorted(parts)}


def _reason(error: CdmisfaError, path: Path, topic: str) -> str:
    """Return an error without the names of the log and of the topic."""
    return str(error).removeprefix(f"{path}: ").removeprefix(f"{topic} ").removeprefix(f"{topic}: ")


def _topic(word: str) -> str:
    return word.partition(":")[0]


def log_topics(path: Path) -> dict[str, str]:
    """Return the topics of a log and their types; none of a format without topics."""
    format = log_format(path)
    if format == "dataset":
        return dict.fromkeys(set(lerobot.features(path)[0]) - set(lerobot.CLOCK), "")
    if format == "bag":
        return {c.info.topic: c.info.schema for c in channels_of(path)}
    topics = dict[str, str]()
    for file in log_files(path) if format in ("mcap", "split") else ():
        with LogReader(file) as reader:
            channels = reader.channels.values()
            topics |= {c.topic: message_kind(reader, c).schema for c in channels}
    return topics


def _topics(
    source: LoggedSource,
    paths: Sequence[Path],
    inputs: InputOptions,
    chosen: Mapping[str, Sequence[str]],
    warn: Message,
) -> Iterator[tuple[Path, str, str]]:
    """Yield path, name and type of each topic with numbers that is to be read."""
    images = {s.topic for i, s in enumerate(source.streams) if len(source.spec.kind(i)[0]) > 1}
    named = [*inputs.topics, *(_topic(word) for words in chosen.values() for word in words)]
    for path in image_logs(paths):
        topics = log_topics(path) or ({path.stem: ""} if log_format(path) == "table" else {})
        for topic in sorted(topics.keys() - images):
            if inputs.topics and not fits_topic(topic, named):
                warn(f"{topic} is left out: --topic does not name it")
            else:
                yield path, topic, topics[topic]


def _places(
    topic: str,
    kind: str,
    every: Sequence[str],
    words: Sequence[tuple[str, str]],
    chosen: Mapping[str, Sequence[str]],
) -> list[tuple[str, tuple[str, ...]]]:
    """Return the features of a topic and the fields that each holds; no field is left out."""
    joints = kind.endswith("JointState") and "position" in every
    places = []
    for key, word in words:
        field = word.partition(":")[2]
        places.append((key, (field,) if field else ("position",) if joints else tuple(every)))
    if joints and not words:
        key = ACTIONS if is_command(topic) else STATE
        if not chosen[key]:
            places.append((key, ("position",)))
    used = {field for _, fields in places for field in fields}
    if rest := tuple(field for field in every if field not in used):
        known = topic == ACTIONS or topic.startswith("observation.")
        places.append((topic if known else f"observation.{stream_name(topic)}", rest))
    return places


def _timed(stream: LogStream, source: LoggedSource) -> LogStream:
    """Return a stream with times: rows without times have the rate of the frames."""
    if stream.times is not None:
        return stream
    spec = source.spec
    return replace(stream, times=times_of(np.arange(stream.count), spec.fps, spec.start_ns))


def _nearest(stream: LogStream, times: IntArray, warn: Message) -> FloatArray:
    """Read the row of a stream nearest to each time, (n, k)."""
    assert stream.times is not None
    rows = nearest_rows(stream.times, times)
    here, apart = f"{stream.path}: {stream.topic}", np.abs(stream.times[rows] - times)
    far = apart > GAP_STEPS / 2 * step_of(stream.times) * NANOSECONDS
    if far.all():
        raise UsageError(f"{here} has no message near any frame")
    if far.any():
        most = round(apart.max() / NANOSECONDS, 2)
        warn(f"{here} has gaps: {far.sum()} frames show numbers from up to {most:g} s away")
    read, place = np.unique(rows, return_inverse=True)
    if stream.read is not None:
        return np.asarray(stream.read(read)[0], np.float64)[place]
    values = []
    for row in read.tolist():
        try:
            values.append(stream.image(row))
        except BROKEN as error:
            raise LogDamagedError(f"{stream.name_of(row)}: {error}") from None
    if len({value.shape for value in values}) > 1 or values[0].ndim > 1:
        what = "a changing number of values" if values[0].ndim == 1 else "images"
        raise UsageError(f"{here} has {what}")
    return np.stack(values)[place]


def _joined(
    key: str, parts: Sequence[tuple[str, FloatArray, list[str]]], warn: Message
) -> tuple[NDArray[Any], list[str]]:
    """Return the values of all parts of a feature beside one another, and their names."""
    values = np.concatenate([part for _, part, _ in parts], axis=1)
    if np.abs(values).max(initial=0) > ROUNDED:
        warn(f"{key} has numbers above 2^24, which float32 rounds")
    several = len({topic for topic, _, _ in parts}) > 1
    named = [(topic, name) for topic, _, columns in parts for name in columns]
    return values, [f"{topic}:{name}" if several else name for topic, name in named]
