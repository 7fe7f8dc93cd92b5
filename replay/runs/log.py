"""run.mcap: what the learner thought in every iteration, with the frames it watched.

One file holds the whole story of a run: its configuration, every `BlockSignals`,
watched frames, ground truth, the abstraction's weights now and then, and what
happened as text. It is readable while it is being written, and up to the cut when
the writing was cut short.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from foxglove_schemas_protobuf import Log_pb2, RawImage_pb2
from google.protobuf import message
from numpy.typing import NDArray

from cdmisfa.core.blocks import SourceSpec
from cdmisfa.core.clock import NANOSECONDS
from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.core.signals import SCHEMA_VERSION, BlockSignals
from recorder.log.whole import PARTIAL
from replay.mcap.reader import LogReader
from replay.runs.folders import METADATA, RUN_FILE, run_log
from replay.runs.messages import decode_matrix, decode_signals, missing

SIGNALS_TOPIC = "/signals"
WATCHED_TOPIC = "/watched"
PHI_TOPIC = "/phi"
TRUTH_TOPIC = "/truth"
EVENT_TOPIC = "/event"

_ITERATION = re.compile(r"iteration (\d{1,18})")


@dataclass(frozen=True, slots=True)
class RunHeader:
    """What stands at the beginning of a run's log.

    Attributes:
        schema: version of `BlockSignals` it was written with.
        spec: what the learner's source delivered.
        manifest: what the run was started with: `config` by sections, `seed`, `source`.
        watched_every: every how many frames an image was kept.
    """

    schema: int
    spec: SourceSpec
    manifest: Mapping[str, Any]
    watched_every: int

    @property
    def missing(self) -> tuple[str, ...]:
        """Signals that this log lacks, being older: they are read as NaN."""
        return missing(self.schema)

    def setting(self, section: str, key: str, default: Any = None) -> Any:
        """A value of the run's configuration, as `setting("learner", "delta")`."""
        config = self.manifest.get("config")
        table = config.get(section) if isinstance(config, Mapping) else None
        return table.get(key, default) if isinstance(table, Mapping) else default

    def frame_at(self, log_time: int) -> int:
        """Global frame counter at a log time."""
        return round((log_time - self.spec.start_ns) * self.spec.fps / NANOSECONDS)


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened, in words, at the end of an iteration's block."""

    t: int
    iteration: int
    text: str
    level: str


def read_header(path: Path) -> RunHeader:
    """What stands at the beginning of a run's log.

    Raises:
        UsageError: the file is no run's log, or of a later version of this software.
        LogDamagedError: it cannot be read.
    """
    log = run_log(path)
    found = _metadata(log)
    schema = _schema(log, found)
    try:
        spec = json.loads(found["spec"])
        for name in ("streams", "frame_shape", "truth"):
            spec[name] = tuple(spec[name])
        return RunHeader(
            schema=schema,
            spec=SourceSpec(**spec),
            manifest=json.loads(found["manifest"]),
            watched_every=int(found["watched_every"]),
        )
    except (KeyError, TypeError, ValueError, UsageError) as error:
        raise LogDamagedError(f"{log}: its metadata {METADATA} is broken ({error})") from error


def _schema(log: Path, found: Mapping[str, str]) -> int:
    """The version of the record, asked first: all else may look different in a later one."""
    text = found.get("schema", "")
    version = int(text) if text.isascii() and text.isdigit() and len(text) < 10 else 0
    if version < 1:
        raise LogDamagedError(f"{log}: its metadata {METADATA} is broken (schema {text[:20]!r})")
    if version > SCHEMA_VERSION:
        raise UsageError(
            f"{log} was written with version {version} of the signals, this is version "
            f"{SCHEMA_VERSION}: install a newer cdmisfa to read it"
        )
    return version


def read_signals(path: Path, header: RunHeader | None = None) -> Iterator[BlockSignals]:
    """Every iteration's record, in order; NaN where an older log lacks a signal.

    Args:
        path: of the run.
        header: what stands at the beginning of its log, where that was read already.

    Raises:
        UsageError: there is no such run, or it is of a later version of this software.
        LogDamagedError: a record is damaged, or a finished file is cut short.
    """
    log = run_log(path)
    version = (header or read_header(log)).schema
    for _, data in _messages(log, SIGNALS_TOPIC):
        yield decode_signals(data, f"{log} {SIGNALS_TOPIC}", version)


def count_iterations(path: Path) -> int:
    """How many iterations' records a run's log holds, without decoding them."""
    return sum(1 for _ in _messages(run_log(path), SIGNALS_TOPIC))


def read_watched(path: Path) -> Iterator[tuple[int, NDArray[Any]]]:
    """Watched frames as (t of the first, (n, *frame_shape)), in order."""
    log = run_log(path)
    header = read_header(log)
    shape = header.spec.frame_shape
    for at, data in _messages(log, WATCHED_TOPIC):
        if header.spec.images:
            yield header.frame_at(at), decode_image(data, shape, log)[None]
        else:
            t, values = decode_matrix(data, f"{log} {WATCHED_TOPIC}")
            yield t, reshaped(values, (-1, *shape), log)


def read_truth(path: Path) -> Iterator[tuple[int, NDArray[np.float64]]]:
    """Ground truth of each block as (t of its first frame, (n, D)), in order."""
    log = run_log(path)
    columns = len(read_header(log).spec.truth)
    for _, data in _messages(log, TRUTH_TOPIC):
        t, values = decode_matrix(data, f"{log} {TRUTH_TOPIC}")
        yield t, reshaped(values, (-1, columns), log)


def read_phi(path: Path) -> Iterator[tuple[int, NDArray[np.float64]]]:
    """The abstraction's weights as (t of the block's first frame, (J, I)), in order."""
    log = run_log(path)
    for _, data in _messages(log, PHI_TOPIC):
        yield decode_matrix(data, f"{log} {PHI_TOPIC}")


def read_events(path: Path) -> Iterator[Event]:
    """What happened, in order."""
    log = run_log(path)
    header = read_header(log)
    for at, data in _messages(log, EVENT_TOPIC):
        yield decode_event(data, header.frame_at(at), log)


def decode_event(data: bytes, t: int, log: Path) -> Event:
    """What happened at frame t, in the bytes of its message.

    Raises:
        LogDamagedError: the bytes are not such a message.
    """
    try:
        entry = Log_pb2.Log.FromString(data)
    except message.DecodeError as error:
        raise LogDamagedError(f"{log} {EVENT_TOPIC}: not a foxglove.Log message") from error
    match = _ITERATION.fullmatch(entry.name)
    level = Log_pb2.Log.Level.Name(entry.level) if entry.level <= 5 else "INFO"
    return Event(t, int(match[1]) if match else -1, entry.message, level)


def decode_image(data: bytes, shape: tuple[int, ...], log: Path) -> NDArray[np.uint8]:
    """The watched (height, width) image in the bytes of its message.

    Raises:
        LogDamagedError: the bytes are not such a message, or of another size.
    """
    try:
        pixels = RawImage_pb2.RawImage.FromString(data).data
    except message.DecodeError as error:
        raise LogDamagedError(f"{log} {WATCHED_TOPIC}: not a foxglove.RawImage") from error
    image: NDArray[np.uint8] = reshaped(np.frombuffer(pixels, np.uint8), shape, log)
    return image


def reshaped(values: NDArray[Any], shape: tuple[int, ...], log: Path) -> NDArray[Any]:
    """Values in another shape.

    Raises:
        LogDamagedError: they do not fill it.
    """
    try:
        return values.reshape(shape)
    except ValueError as error:
        raise LogDamagedError(f"{log}: {values.size} values do not fill {shape}") from error


def _metadata(log: Path) -> Mapping[str, str]:
    with LogReader(log) as reader:
        for record in reader.metadata:
            if record.name == METADATA:
                return record.values
    raise UsageError(f"{log} is no run's log: name a run's folder or its {RUN_FILE}")


def _messages(log: Path, topic: str) -> Iterator[tuple[int, bytes]]:
    """Log time and bytes of each message on a topic, in the order of writing."""
    with LogReader(log) as reader:
        for entry in reader.messages({topic}, ordered=False):
            yield entry.log_time, entry.data
        if not reader.complete and not log.name.endswith(PARTIAL):
            raise LogDamagedError(f"{log} is cut short: save what is there with cdmisfa recover")
