"""Detect the format of a log by its path, and open its streams."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Final, Literal

from cdmisfa.core.errors import LogDamagedError
from recorder.images.options import InputOptions
from recorder.mcap.reader import LogReader
from replay.logs.formats import arrays, bag, images, lerobot, mcap_log, table, video
from replay.logs.formats.messages import NoTopicError, fits_topic
from replay.logs.stream import ChannelInfo, ExternalChannel, LogStream
from replay.storage.identity import Identity, McapIdentity
from replay.storage.location import location
from replay.storage.paths import log_files

Format = Literal["mcap", "split", "bag", "dataset", "images", "video", "table", "arrays"]


# Functions that open the streams of a log; the ExitStack that they are given closes what they open.
FORMATS: Final[Mapping[Format, Callable[..., list[LogStream]]]] = {
    "mcap": mcap_log.streams,
    "split": mcap_log.streams,
    "bag": bag.streams,
    "dataset": lerobot.streams,
    "images": images.streams,
    "video": video.streams,
    "table": table.streams,
    "arrays": arrays.streams,
}

# Formats of files that are known by their endings; other files are MCAP.
_BY_ENDING: Final[Mapping[str, Format]] = {
    **dict.fromkeys(video.ENDINGS, "video"),
    **dict.fromkeys(bag.ENDINGS, "bag"),
    **dict.fromkeys(table.ENDINGS, "table"),
    **dict.fromkeys(arrays.ENDINGS, "arrays"),
}

# Endings of logs in one file, without that of MCAP.
ENDINGS: Final = tuple(_BY_ENDING)

# Topics that mean every one with images.
ALL: Final = ("*",)


def log_format(path: Path) -> Format:
    """Return the format of a log; a folder of MCAP files that are parts of one log is "split"."""
    if path.is_dir():
        if lerobot.is_dataset(path):
            return "dataset"
        parts, metadata = any(path.glob("*.mcap")), path / bag.METADATA
        if metadata.exists() and not parts:
            return "bag"
        if metadata.is_file():
            return "split"
        has_images = any(file.suffix.lower() in images.ENDINGS for file in path.iterdir())
        return "images" if has_images and not any(path.glob("*.mcap*")) else "mcap"
    known = _BY_ENDING.get(path.suffix.lower(), "mcap")
    return known if known == "bag" or path.is_file() else "mcap"


def is_external_format(path: Path) -> bool:
    """Return whether a path cannot be one of our recordings, by its format."""
    return log_format(path) not in ("mcap", "split")


def image_logs(paths: Sequence[str | Path]) -> list[Path]:
    """Return the logs that paths mean: a folder of MCAP files is each, a rosbag2 is one log."""
    logs: list[Path] = []
    for path in map(location, paths):
        logs += log_files(path) if log_format(path) == "mcap" else [path]
    return logs


def open_streams(
    files: Sequence[Path], options: InputOptions, opened: ExitStack, *, skip_damaged: bool = False
) -> tuple[list[LogStream], list[tuple[Path, LogReader | None]], list[str]]:
    """Open the topics of several logs that are asked for.

    Without topics each log has one stream. As many topics as logs are one of each log in turn;
    otherwise a topic, or every one that a pattern fits, is looked for in every log.

    Args:
        files: the logs.
        options: the topics, and whether images or fields are read.
        opened: closes the logs.
        skip_damaged: skip damaged parts, and of several logs those that cannot be read.

    Returns:
        The streams, in the order of their topics, and of the logs; the logs that were opened, MCAP
        files with their readers; and a line for each log that could not be read.

    Raises:
        UsageError: no log has a topic.
        LogDamagedError: a log is damaged; with `skip_damaged` all are.
    """
    topics, result = options.topics, list[LogStream]()
    logs: list[tuple[Path, LogReader | None]] = []
    patterns = any(letter in topic for topic in topics for letter in "*?[")
    in_turn = len(topics) == len(files) > 1 and not patterns
    broken: list[LogDamagedError] = []
    refused: list[NoTopicError] = []
    for i, file in enumerate(files):
        chosen = replace(options, topics=topics[i : i + 1]) if in_turn else options
        try:
            streams = FORMATS[log_format(file)](file, chosen, opened, skip_damaged=skip_damaged)
            result += streams
            logs.append((file, streams[0].reader))
        except NoTopicError as error:
            if in_turn or len(files) == 1 or not topics:
                raise
            refused.append(error)
        except LogDamagedError as error:
            if not skip_damaged or len(files) == 1:
                raise
            broken.append(error)
    if not result:
        raise [*refused, *broken][0]
    if topics and not in_turn:
        for topic in topics:
            if not any(fits_topic(stream.topic, [topic]) for stream in result):
                alone = replace(options, topics=(topic,))  # whose error names those there are
                FORMATS[log_format(files[0])](files[0], alone, opened)

        def place(stream: LogStream) -> int:
            return [*(fits_topic(stream.topic, [t]) for t in topics), True].index(True)

        result.sort(key=place)
    return result, logs, [f"{error}: this log is skipped" for error in broken]


@contextlib.contextmanager
def open_stream(path: Path, topic: str | None = None) -> Iterator[LogStream]:
    """Open one stream of a log; raises as `open_streams`."""
    options = InputOptions() if topic is None else InputOptions(topics=(topic,))
    with ExitStack() as opened:
        yield FORMATS[log_format(path)](path, options, opened)[0]


def identity_of(path: Path, reader: LogReader | None = None) -> Identity:
    """Return the identity of a log: its bytes; of a folder, names and contents count.

    Args:
        path: the log.
        reader: reader of an MCAP file.
    """
    if reader is not None:
        return McapIdentity(reader)
    if not path.is_dir():
        return Identity(path)
    members = path.rglob("*") if lerobot.is_dataset(path) else path.iterdir()
    return Identity(path, (file for file in members if file.is_file()))


def image_topics(path: Path) -> list[str]:
    """Return the topics of an MCAP file with images.

    Raises:
        LogDamagedError: the file is not an MCAP file, or is empty.
    """
    with LogReader(path, skip_damaged=True) as reader:
        mcap_log.refuse_empty(reader)
        return mcap_log.topics_in(reader)


def channels_of(path: Path, *, whole: bool = False) -> list[ExternalChannel]:
    """Return the contents of each topic of a log that is not in MCAP files.

    Args:
        path: the log.
        whole: read all messages of a bag, not only its index, and all cells of a table.

    Raises:
        LogDamagedError: the log cannot be read.
        CdmisfaError: a package that reads it is missing.
    """
    kind = log_format(path)
    if kind == "dataset":
        return lerobot.dataset_channels(path)
    if kind == "bag":
        return bag.bag_channels(path, whole=whole)
    if kind == "table":
        return table.table_channels(path, whole=whole)
    if kind == "arrays":
        return arrays.array_channels(path)
    with open_stream(path) as stream:
        first, last = (None, None) if stream.times is None else map(int, stream.times[[0, -1]])
        schema = "image" if kind == "images" else "video"
        info = ChannelInfo(stream.topic, stream.encoding, schema, stream.count, first, last)
        return [ExternalChannel(info, True, stream.missing, tuple(stream.remarks))]
