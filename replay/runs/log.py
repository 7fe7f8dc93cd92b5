"""run.mcap: what the learner thought in every iteration, with the frames it watched.

One file holds the whole story of a run: its configuration, every `BlockSignals`,
watched frames, ground truth, the abstraction's weights now and then, and what
happened as text. It is readable while it is being written, and up to the cut when
the writing was cut short.
"""

from __future__ import annotations

import json
import re
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from foxglove_schemas_protobuf import Log_pb2, RawImage_pb2
from google.protobuf import message
from numpy.typing import NDArray

from cdmisfa.core.blocks import Block, SourceSpec
from cdmisfa.core.clock import NANOSECONDS
from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.core.learning import Learner, Sink, weights_after
from cdmisfa.core.signals import SCHEMA_VERSION, BlockSignals
from recorder.log.logfile import LogFile
from recorder.log.messages import ENCODING, ImageEncoder, descriptor_set
from recorder.log.whole import PARTIAL, partial_path
from replay.mcap.reader import LogReader
from replay.runs import matrix_message, signals_message

RUN_FILE = "run.mcap"
"""Name of the log in a run's folder."""

METADATA = "cdmisfa.run"
"""Name of the metadata record with the run's configuration."""

SIGNALS_TOPIC = "/signals"
WATCHED_TOPIC = "/watched"
PHI_TOPIC = "/phi"
TRUTH_TOPIC = "/truth"
EVENT_TOPIC = "/event"

NEVER_NS = 2**62
"""More log time than any run has."""

CHUNK_BYTES = 1024 * 1024
"""Size at which a chunk of the log is closed."""

FLUSH_SECONDS = 1.0
"""Longest time for which something that was written waits for the operating system."""

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
        return signals_message.missing(self.schema)

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


class RunWriter(Sink):
    """Writes run.mcap; a context manager that finishes on success.

    Args:
        path: the file's name.
        spec: what the source delivers.
        manifest: what the run was started with, JSON values: `config` by sections, `seed`,
            `source`.
        force: overwrite what is there.
        watched_every: keep every this many frames of images; vectors are all kept.
        phi_every: keep the weights every this many iterations, and on each save.

    Raises:
        UsageError: the file exists and `force` is not set.
        LogWriteError: it cannot be written, here or in any later call.
    """

    def __init__(
        self,
        path: Path,
        spec: SourceSpec,
        manifest: Mapping[str, Any],
        *,
        force: bool = False,
        watched_every: int = 10,
        phi_every: int = 50,
    ) -> None:
        self.spec = spec
        self._watched_every = max(watched_every, 1)
        self._phi_every = max(phi_every, 1)
        # The learner is quicker than the log's clock: what waits is flushed by the wall's. Of
        # images zstd leaves a tenth less than lz4, and takes twice as long.
        self._log = LogFile(
            path,
            force=force,
            library="cdmisfa",
            compression="lz4",
            chunk_size=CHUNK_BYTES,
            flush_ns=NEVER_NS,
        )
        self._next_flush = time.monotonic() + FLUSH_SECONDS
        self._log.add_metadata(
            METADATA,
            {
                "schema": str(SCHEMA_VERSION),
                "spec": json.dumps(asdict(spec)),
                "manifest": json.dumps(manifest, sort_keys=True),
                "watched_every": str(self._watched_every),
            },
        )
        matrix = (matrix_message.MESSAGE, matrix_message.schema_data())
        self._signals = self._channel(
            SIGNALS_TOPIC, signals_message.MESSAGE, signals_message.schema_data()
        )
        self._phi = self._channel(PHI_TOPIC, *matrix)
        self._truth = self._channel(TRUTH_TOPIC, *matrix)
        self._event = self._channel(
            EVENT_TOPIC, "foxglove.Log", descriptor_set(Log_pb2.Log.DESCRIPTOR)
        )
        self._images: dict[int, ImageEncoder] = {}
        if is_image(spec):
            height, width = spec.frame_shape
            encoders = [ImageEncoder(height, width, name) for name in spec.streams]
            self._images = dict(enumerate(encoders))
            self._watched = self._channel(
                WATCHED_TOPIC, ImageEncoder.schema, encoders[0].schema_data()
            )
        else:
            self._watched = self._channel(WATCHED_TOPIC, *matrix)

    @property
    def path(self) -> Path:
        """The file's name once it is finished."""
        return self._log.path

    def block(self, block: Block, signals: BlockSignals, learner: Learner) -> None:
        """Write what one iteration gave; see `Sink`."""
        at, k = signals.log_time, signals.iteration
        sequence = k & 0xFFFFFFFF
        self._log.write(self._signals, at, signals_message.encode(signals), sequence)
        if block.truth.shape[1]:
            self._log.write(self._truth, at, matrix_message.encode(block.t, block.truth), sequence)
        if self._images:
            encode = self._images[block.stream]
            for i in range(-block.t % self._watched_every, len(block), self._watched_every):
                shown = self.spec.time_ns(block.t + i)
                self._log.write(self._watched, shown, encode(shown, block.frames[i]), sequence)
        else:
            frames = block.frames.reshape(len(block), -1)
            self._log.write(self._watched, at, matrix_message.encode(block.t, frames), sequence)
        if k % self._phi_every == 0 or signals.saved:
            phi = weights_after(signals, learner)
            self._log.write(self._phi, at, matrix_message.encode(block.t, phi), sequence)
        if time.monotonic() >= self._next_flush:
            self.flush()

    def event(self, t: int, iteration: int, text: str, level: str = "INFO") -> None:
        """Write in words what happened at frame t; see `Sink`."""
        entry = Log_pb2.Log(
            level=Log_pb2.Log.Level.Value(level), message=text, name=f"iteration {iteration}"
        )
        at = self.spec.time_ns(t)
        entry.timestamp.FromNanoseconds(at)
        self._log.write(self._event, at, entry.SerializeToString(), iteration & 0xFFFFFFFF)

    def take_over(self, log: Path, iterations: int) -> Iterator[BlockSignals]:
        """Copy what another log of the same run holds of its first iterations.

        Messages are copied as they are, so a run that goes on keeps its past bit for bit.

        Args:
            log: the log to copy from.
            iterations: how many.

        Yields:
            The signals that were copied, in order.
        """
        channels = {
            SIGNALS_TOPIC: self._signals,
            WATCHED_TOPIC: self._watched,
            PHI_TOPIC: self._phi,
            TRUTH_TOPIC: self._truth,
            EVENT_TOPIC: self._event,
        }
        with LogReader(log) as reader:
            for entry in reader.messages(channels, ordered=False):
                topic, signals = entry.channel.topic, None
                if topic == SIGNALS_TOPIC:
                    signals = signals_message.decode(entry.data, f"{log} {topic}")
                    if signals.iteration >= iterations:
                        return
                self._log.write(channels[topic], entry.log_time, entry.data, entry.sequence)
                if signals is not None:
                    yield signals

    def flush(self) -> None:
        """Hand everything written so far to the operating system."""
        self._log.flush()
        self._next_flush = time.monotonic() + FLUSH_SECONDS

    def finish(self) -> None:
        """Write the index and give the file its name."""
        self._log.finish()

    def abandon(self) -> None:
        """Leave a readable NAME.partial."""
        self._log.abandon()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._log.__exit__(kind, error, trace)

    def _channel(self, topic: str, name: str, data: bytes) -> int:
        return self._log.add_channel(topic, self._log.add_schema(name, ENCODING, data))


def run_log(path: Path) -> Path:
    """The log of a run, given its folder or the log itself; a partial one where it was cut short.

    Raises:
        UsageError: there is none.
    """
    path = Path(path)
    whole = path / RUN_FILE if path.is_dir() else path
    for candidate in (whole, partial_path(whole)):
        if candidate.is_file():
            return candidate
    if path.is_dir():
        raise UsageError(f"{path} holds no {RUN_FILE}: name the folder of a run")
    raise UsageError(f"{path} does not exist: name a run's folder or its {RUN_FILE}")


def is_run(path: Path) -> bool:
    """Whether a folder or a log is that of a run.

    Raises:
        UsageError: it does not exist.
        LogDamagedError: it is no log, or a damaged one.
    """
    path = Path(path)
    if path.is_dir():
        whole = path / RUN_FILE
        return whole.is_file() or partial_path(whole).is_file()
    with LogReader(run_log(path)) as reader:
        return any(record.name == METADATA for record in reader.metadata)


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
        yield signals_message.decode(data, f"{log} {SIGNALS_TOPIC}", version)


def count_iterations(path: Path) -> int:
    """How many iterations' records a run's log holds, without decoding them."""
    return sum(1 for _ in _messages(run_log(path), SIGNALS_TOPIC))


def read_watched(path: Path) -> Iterator[tuple[int, NDArray[Any]]]:
    """Watched frames as (t of the first, (n, *frame_shape)), in order."""
    log = run_log(path)
    header = read_header(log)
    shape = header.spec.frame_shape
    for at, data in _messages(log, WATCHED_TOPIC):
        if is_image(header.spec):
            yield header.frame_at(at), decode_image(data, shape, log)[None]
        else:
            t, values = matrix_message.decode(data, f"{log} {WATCHED_TOPIC}")
            yield t, reshaped(values, (-1, *shape), log)


def read_truth(path: Path) -> Iterator[tuple[int, NDArray[np.float64]]]:
    """Ground truth of each block as (t of its first frame, (n, D)), in order."""
    log = run_log(path)
    columns = len(read_header(log).spec.truth)
    for _, data in _messages(log, TRUTH_TOPIC):
        t, values = matrix_message.decode(data, f"{log} {TRUTH_TOPIC}")
        yield t, reshaped(values, (-1, columns), log)


def read_phi(path: Path) -> Iterator[tuple[int, NDArray[np.float64]]]:
    """The abstraction's weights as (t of the block's first frame, (J, I)), in order."""
    log = run_log(path)
    for _, data in _messages(log, PHI_TOPIC):
        yield matrix_message.decode(data, f"{log} {PHI_TOPIC}")


def read_events(path: Path) -> Iterator[Event]:
    """What happened, in order."""
    log = run_log(path)
    header = read_header(log)
    for at, data in _messages(log, EVENT_TOPIC):
        yield decode_event(data, header.frame_at(at), log)


def is_image(spec: SourceSpec) -> bool:
    """Whether frames are images, not vectors."""
    return spec.dtype == "uint8" and len(spec.frame_shape) == 2


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
