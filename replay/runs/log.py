"""Read run.mcap: the settings of a run, and its messages in batches of iterations."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from foxglove_schemas_protobuf import Log_pb2, RawImage_pb2
from mcap.records import Channel
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray, IntArray
from cdmisfa.core.blocks import SourceSpec
from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.core.learning import ARITHMETIC
from cdmisfa.core.signals import SCHEMA_VERSION
from cdmisfa.core.untrusted import MAX_LIST, parse_json
from recorder.mcap.chunks import MessageTable
from recorder.mcap.reader import LogReader
from recorder.mcap.store import PARTIAL
from replay.runs.codec import decode_columns, decode_matrices, parsed
from replay.runs.columns import Blocks, SignalColumns
from replay.runs.folders import RUN_FILE, RUN_METADATA, run_log

SIGNALS_TOPIC = "/signals"
WATCHED_TOPIC = "/watched"
# Numbers of the attended stream, if the source has images too.
VALUES_TOPIC = "/values"
PHI_TOPIC = "/phi"
TRUTH_TOPIC = "/truth"
EVENT_TOPIC = "/event"

# Iterations between two copies of the abstraction's weights in a log.
PHI_EVERY = 50


@dataclass(frozen=True, slots=True)
class RunHeader:
    """Header of a run's log.

    Attributes:
        spec: specification of the source.
        manifest: inputs of the run: `config` by sections, `seed`, `source`, and the version of the
            learner's `arithmetic`.
    """

    spec: SourceSpec
    manifest: Mapping[str, Any]

    @property
    def by_progress(self) -> bool:
        """Whether the learner is the progress learner."""
        return bool(self.setting("learner", "algorithm") == "progress")

    @property
    def clusters(self) -> bool:
        """Whether the learner is CD-MISFA 1.0, which saves modules by a clustering error."""
        return bool(self.setting("learner", "algorithm") == "1.0")

    @property
    def arithmetic(self) -> int:
        """Version of the learner's arithmetic; see `arithmetic_of`."""
        version = self.manifest.get(ARITHMETIC)
        return version if isinstance(version, int) else 0

    @property
    def forked_at(self) -> int | None:
        """Iterations that a fork shares with its parent; None if the run is no fork."""
        fork = self.manifest.get("fork")
        at = fork.get("at") if isinstance(fork, Mapping) else None
        return at if isinstance(at, int) and at >= 0 else None

    def number(self, key: str) -> float | None:
        """Return a number of the learner's configuration, as `number("delta")`, or None."""
        value = self.setting("learner", key)
        return float(value) if isinstance(value, int | float) else None

    def setting(self, section: str, key: str) -> Any:
        """Return a value of the run's configuration, as `setting("learner", "delta")`, or None."""
        config = self.manifest.get("config")
        table = config.get(section) if isinstance(config, Mapping) else None
        return table.get(key) if isinstance(table, Mapping) else None


@dataclass(frozen=True, slots=True)
class Event:
    """An event with its text, at the end of an iteration's block."""

    t: int
    iteration: int
    text: str
    level: str


def read_header(path: Path) -> RunHeader:
    """Read the header of a run's log.

    Raises:
        UsageError: the file is no run's log, or of another version of the signals.
        LogDamagedError: the log cannot be read.
    """
    with LogReader(run_log(path)) as reader:
        return header_in(reader)


def header_in(reader: LogReader) -> RunHeader:
    """Return the header of a run's log that is open; raises as `read_header`."""
    log = reader.path
    metadata = next((r.metadata for r in reader.metadata if r.name == RUN_METADATA), None)
    if metadata is None:
        raise UsageError(
            f"{log} is not a run: name a folder that cdmisfa learn wrote, or its {RUN_FILE}"
        )
    schema = metadata.get("schema", "")[:20]
    if not (schema.isascii() and schema.isdigit() and 0 < int(schema) < 10**9):
        raise LogDamagedError(f"{log}: its metadata {RUN_METADATA} is broken (schema {schema!r})")
    if int(schema) != SCHEMA_VERSION:  # checked first: other versions may differ in all else
        written = f"{log} was written with version {schema} of the signals"
        raise UsageError(f"{written}: read it with the version of cdmisfa that wrote it")
    try:
        spec = parse_json(metadata["spec"])
        for name in ("streams", "frame_shape", "truth"):
            spec[name] = tuple(spec[name])
        spec["kinds"] = tuple((tuple(shape), str(kind)) for shape, kind in spec.get("kinds", ()))
        if len(spec["kinds"]) not in (0, len(spec["streams"])):
            raise ValueError("it has other kinds than streams")
        return RunHeader(SourceSpec(**spec), {**parse_json(metadata["manifest"], MAX_LIST)})
    except (KeyError, TypeError, ValueError, UsageError) as error:
        raise LogDamagedError(f"{log}: its metadata {RUN_METADATA} is broken ({error})") from error


TOPICS = (SIGNALS_TOPIC, WATCHED_TOPIC, VALUES_TOPIC, PHI_TOPIC, TRUTH_TOPIC, EVENT_TOPIC)

# Most iterations of a batch.
BATCH_ITERATIONS = 500

# Bytes of messages after which a batch ends with fewer iterations, so that it fits into memory.
MAX_BYTES = 16 * 1024 * 1024

# (n,) frames and (n, ...) their values.
Frames = tuple[IntArray, NDArray[Any]]

_ITERATION = re.compile(r"iteration (\d{1,18})")


@dataclass(frozen=True, slots=True)
class Batch:
    """Messages of some consecutive iterations, decoded.

    Attributes:
        blocks: the last block before the batch, to which its first messages may belong, then the
            blocks of `signals`; empty if the signals are not read.
        watched: frames of the attended stream, in an entry for each shape of frames.
        truth: ground truth, (n, D).
        phi: (t, (J, I)) weights of the abstraction.
    """

    signals: tuple[SignalColumns, ...]
    blocks: Blocks
    watched: tuple[Frames, ...]
    truth: tuple[Frames, ...]
    phi: tuple[tuple[int, FloatArray], ...]
    events: tuple[Event, ...]


def read_batches(
    path: Path,
    header: RunHeader | None = None,
    *,
    every: int = 1,
    topics: Sequence[str] = TOPICS,
    start: int = 0,
) -> Iterator[Batch]:
    """Read a run's log to the end, once.

    Args:
        path: the run's folder, or its log.
        header: header of the log, if it was read already.
        every: decode one image in so many frames.
        topics: topics to read.
        start: frame to begin at, the first of a block.

    Raises:
        UsageError: the run does not exist, or has another version of the signals.
        LogDamagedError: a message is damaged, or a finished file is cut short.
    """
    log = run_log(path)
    header = header or read_header(log)
    with LogReader(log) as reader:
        batches = BatchReader(log, header, reader.channels, every=every, topics=topics)
        since = header.spec.time_ns(start) if start else 0
        for _, table in reader.tables(start=since):
            yield from batches.take(table)
        yield batches.rest()
        if not reader.complete and not log.name.endswith(PARTIAL):
            raise LogDamagedError(
                f"{log} is cut short: save its readable part with cdmisfa recover"
            )


def read_columns(
    path: Path, header: RunHeader | None = None, *, start: int = 0
) -> Iterator[SignalColumns]:
    """Yield the records of a run from a frame on, in order, as arrays; see `read_batches`."""
    for batch in read_batches(path, header, topics=(SIGNALS_TOPIC,), start=start):
        yield from batch.signals


class BatchReader:
    """Makes batches from the chunks of a run's log, in file order.

    Args:
        log: path of the log, for messages.
        header: header of the log.
        channels: channels of the log.
        every: see `read_batches`.
        topics: see `read_batches`.
    """

    def __init__(
        self,
        log: Path,
        header: RunHeader,
        channels: Mapping[int, Channel],
        *,
        every: int = 1,
        topics: Sequence[str] = TOPICS,
    ) -> None:
        self._log, self._spec, self._every = log, header.spec, every
        kinds = self._spec.every_kind
        images = [(shape, dtype) for shape, dtype in kinds if len(shape) == 2 and dtype == "uint8"]
        self._images = images[0][0] if images else ()
        self._numbers = [shape for shape, dtype in kinds if (shape, dtype) not in images]
        self._wanted = {n: c.topic for n, c in channels.items() if c.topic in topics}
        self._begin(Blocks.concatenated(()))

    def _begin(self, before: Blocks) -> None:
        """Start an empty batch after the last block of the previous batch."""
        self._before = before
        self._data: dict[str, list[bytes]] = {topic: [] for topic in TOPICS}
        self._frames: dict[str, list[int]] = {topic: [] for topic in TOPICS}
        self._bytes = 0

    def take(self, table: MessageTable) -> Iterator[Batch]:
        """Take the messages of the next chunk, and yield the batches that end with them."""
        wanted = np.isin(table.channel, list(self._wanted))
        frames = self._spec.frames_at(table.log_time)
        if self._images and self._every > 1:
            watched_channels = [n for n, topic in self._wanted.items() if topic == WATCHED_TOPIC]
            wanted &= ~np.isin(table.channel, watched_channels) | (frames % self._every == 0)
        if not wanted.all():
            table, frames = table.select(wanted), frames[wanted]
        data = memoryview(table.data.data)
        columns = (table.channel, frames, table.at, table.size)
        for number, t, at, size in zip(*(c.tolist() for c in columns), strict=True):
            topic = self._wanted[number]
            if self._is_full(topic):
                yield self.rest()
            self._data[topic].append(bytes(data[at : at + size]))
            self._frames[topic].append(t)
            self._bytes += size

    def _is_full(self, topic: str) -> bool:
        """Return whether a batch ends before this message: if possible, with a whole iteration."""
        if topic != SIGNALS_TOPIC:
            return self._bytes >= 4 * MAX_BYTES
        return self._bytes >= MAX_BYTES or len(self._data[topic]) >= BATCH_ITERATIONS

    def rest(self) -> Batch:
        """Return the messages since the last batch ended, as one batch."""
        spec, data = self._spec, self._data
        values_topic = VALUES_TOPIC if self._images else WATCHED_TOPIC
        watched = *self._watched_images(), *self._rows(values_topic, *self._numbers)
        signals = self._records()
        blocks = Blocks.concatenated([self._before, *map(Blocks.of, signals)])
        events = zip(data[EVENT_TOPIC], self._frames[EVENT_TOPIC], strict=True)
        batch = Batch(
            signals=signals,
            blocks=blocks,
            watched=watched,
            truth=self._rows(TRUTH_TOPIC, (len(spec.truth),)),
            phi=tuple(
                (int(t), weights)
                for matrices in decode_matrices(data[PHI_TOPIC], f"{self._log} {PHI_TOPIC}")
                for t, weights in zip(*matrices, strict=True)
            ),
            events=tuple(_event(message, t, self._log) for message, t in events),
        )
        self._begin(blocks.last())
        return batch

    def _records(self) -> tuple[SignalColumns, ...]:
        """Return the decoded records of the batch."""
        where = f"{self._log} {SIGNALS_TOPIC}"
        records = tuple(decode_columns(self._data[SIGNALS_TOPIC], where))
        streams = len(self._spec.streams)
        for columns in records:
            watched, rewards = columns["stream"], columns["R"]
            if (
                watched.min() < 0
                or watched.max() >= streams
                or columns["policy"].shape[1] != streams
                or columns["Q"].shape[1:] != (streams, 2)
                or (rewards.size and rewards.shape[1:] != (streams, 2, streams))
            ):
                raise LogDamagedError(f"{where}: a record has other streams than the run")
        return records

    def _watched_images(self) -> tuple[Frames, ...]:
        """Return the decoded images of the batch as one array, or none."""
        where, shape = f"{self._log} {WATCHED_TOPIC}", self._images
        data = self._data[WATCHED_TOPIC] if shape else ()
        images = [parsed(RawImage_pb2.RawImage, message, where).data for message in data]
        if not images:
            return ()
        for pixels in images:
            if len(pixels) != math.prod(shape):
                raise LogDamagedError(f"{self._log}: {len(pixels)} values do not fill {shape}")
        whole = np.frombuffer(b"".join(images), np.uint8).reshape(len(images), *shape)
        return ((np.array(self._frames[WATCHED_TOPIC], dtype=np.int64), whole),)

    def _rows(self, topic: str, *shapes: tuple[int, ...]) -> tuple[Frames, ...]:
        """Return the rows of matrix messages, one per frame, of one of some shapes."""
        by_size = {math.prod(shape): shape for shape in shapes}
        pieces = []
        data = self._data[topic] if shapes else ()
        for t, values in decode_matrices(data, f"{self._log} {topic}"):
            frames = (t[:, None] + np.arange(values.shape[1])).reshape(-1)
            shape = by_size.get(values.shape[2])
            if shape is None:
                raise LogDamagedError(f"{self._log}: {values.size} values do not fill {shapes[0]}")
            pieces.append((frames, values.reshape(-1, *shape)))
        return tuple(pieces)


def _event(data: bytes, t: int, log: Path) -> Event:
    entry = parsed(Log_pb2.Log, data, f"{log} {EVENT_TOPIC}")
    match = _ITERATION.fullmatch(entry.name)
    level = Log_pb2.Log.Level.Name(entry.level) if entry.level <= 5 else "INFO"
    return Event(t, int(match[1]) if match else -1, entry.message, level)
