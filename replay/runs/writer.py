"""Writing run.mcap: readable while it is being written, and up to the cut after a crash."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from foxglove_schemas_protobuf import Log_pb2

from cdmisfa.core.blocks import Block, SourceSpec
from cdmisfa.core.learning import Keyframe, Learner, Sink, weights_after
from cdmisfa.core.signals import SCHEMA_VERSION, BlockSignals
from recorder.log.logfile import LogFile
from recorder.log.messages import ENCODING, ImageEncoder, descriptor_set
from recorder.mcap.reader import LogReader
from replay.runs import codec, folders, keyframes, log

# More log time than any run has.
NEVER_NS = 2**62

# Size at which a chunk of the log is closed.
CHUNK_BYTES = 1024 * 1024

# Longest time for which something that was written waits for the operating system.
FLUSH_SECONDS = 1.0


class RunWriter(Sink):
    """Writes run.mcap: to the end with `close`, or to wherever it was `abandon`ed.

    Args:
        path: the file's name once it is finished.
        spec: what the source delivers.
        manifest: what the run was started with, see `RunHeader`, as JSON values.
        force: overwrite an existing run.
        watched_every: keep every this many frames of images; vectors are all kept.
        phi_every: keep the weights every this many iterations, on each save, where a learner that
            has weights of each stream switches to another one, and at the end.

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
        phi_every: int = log.PHI_EVERY,
    ) -> None:
        self.spec, self.path = spec, Path(path)
        self._watched_every = max(watched_every, 1)
        self._phi_every = max(phi_every, 1)
        self._by_progress = log.RunHeader(spec, manifest).by_progress
        # Learning runs faster than log time: flushing every second of log time would be too
        # often, so the wall clock decides. Of images zstd leaves a tenth less than lz4, and
        # takes twice as long.
        self._log = LogFile(
            path,
            force=force,
            compression="lz4",
            chunk_size=CHUNK_BYTES,
            flush_ns=NEVER_NS,
        )
        self._next_flush = time.monotonic() + FLUSH_SECONDS
        self._log.add_metadata(
            folders.RUN_METADATA,
            {
                "schema": str(SCHEMA_VERSION),
                "spec": json.dumps(spec.as_json()),
                "manifest": json.dumps(manifest, sort_keys=True),
                "watched_every": str(self._watched_every),
            },
        )
        self._last_keyframe = -1
        self._without_weights: tuple[int, int, int, Learner] | None = None
        self._channels: dict[str, int] = {}
        matrix = codec.MATRIX_SCHEMA, codec.MATRIX_DEFINITION
        self._add_channel(log.SIGNALS_TOPIC, codec.SIGNALS_SCHEMA, codec.SIGNALS_DEFINITION)
        self._add_channel(log.PHI_TOPIC, *matrix)
        self._add_channel(log.TRUTH_TOPIC, *matrix)
        self._add_channel(
            keyframes.KEYFRAME_TOPIC, keyframes.KEYFRAME_SCHEMA, keyframes.KEYFRAME_DEFINITION
        )
        self._add_channel(log.EVENT_TOPIC, "foxglove.Log", descriptor_set(Log_pb2.Log.DESCRIPTOR))
        self._images: dict[int, ImageEncoder] = {}
        for stream, name in enumerate(spec.streams):
            if spec.of(stream).images:
                (height, width), _ = spec.kind(stream)
                self._images[stream] = encoder = ImageEncoder(height, width, name)
        self._values_topic = log.VALUES_TOPIC if self._images else log.WATCHED_TOPIC
        if self._images:
            self._add_channel(log.WATCHED_TOPIC, encoder.schema, encoder.schema_data())
        if len(self._images) < len(spec.streams):
            self._add_channel(self._values_topic, *matrix)

    def block(self, block: Block, signals: BlockSignals, learner: Learner) -> None:
        """Write what one iteration gave; see `Sink`."""
        at, k, t = signals.log_time, signals.iteration, block.t
        messages = [(log.SIGNALS_TOPIC, at, codec.encode_signals(signals))]
        if block.truth.shape[1]:
            messages.append((log.TRUTH_TOPIC, at, codec.encode_matrix(t, block.truth)))
        if block.stream in self._images:
            encode, every = self._images[block.stream], self._watched_every
            for i in range(-t % every, len(block), every):
                log_time = self.spec.time_ns(t + i)
                messages.append((log.WATCHED_TOPIC, log_time, encode(log_time, block.frames[i])))
        else:
            frames = block.frames.reshape(len(block), -1)
            messages.append((self._values_topic, at, codec.encode_matrix(t, frames)))
        leaves = self._by_progress and signals.action == 1
        self._without_weights = at, k, t, learner
        if k % self._phi_every == 0 or signals.saved or leaves:
            messages.append(
                (log.PHI_TOPIC, at, codec.encode_matrix(t, weights_after(signals, learner)))
            )
            self._without_weights = None
        self._write(k, *messages)
        if time.monotonic() >= self._next_flush:
            self.flush()

    def finish(self) -> None:
        """Write the last weights; the file stays open until `close`."""
        if self._without_weights is not None:
            at, k, t, learner = self._without_weights
            self._write(k, (log.PHI_TOPIC, at, codec.encode_matrix(t, learner.phi)))
            self._without_weights = None
        self.flush()

    def event(self, t: int, iteration: int, text: str, level: str = "INFO") -> None:
        """Write the text of an event at frame t; see `Sink`."""
        entry = Log_pb2.Log(
            level=Log_pb2.Log.Level.Value(level), message=text, name=f"iteration {iteration}"
        )
        at = self.spec.time_ns(t)
        entry.timestamp.FromNanoseconds(at)
        self._write(iteration, (log.EVENT_TOPIC, at, entry.SerializeToString()))

    @property
    def size(self) -> int:
        """Bytes written so far, as stored; what waits for a flush is not among them."""
        return self._log.size

    def keyframe(self, keyframe: Keyframe, *, again: bool = False) -> None:
        """Write a keyframe in a chunk of its own, and hand all data to the operating system.

        Args:
            keyframe: once for each iteration.
            again: also where there is one of this iteration.
        """
        at = keyframe.iteration
        if again or at != self._last_keyframe:
            self.flush()
            time_ns = self.spec.time_ns(keyframe.t)
            self._write(
                at, (keyframes.KEYFRAME_TOPIC, time_ns, keyframes.encode_keyframe(keyframe))
            )
            self._last_keyframe = at
            self.flush()

    def copy_log(self, path: Path, iterations: int) -> Iterator[BlockSignals]:
        """Copy the first iterations of another log of the same run, and yield their signals.

        Messages are copied as they are, so a run that is resumed keeps its past bit for bit.
        """
        where, taken = f"{path} {log.SIGNALS_TOPIC}", list[bytes]()
        with LogReader(path) as reader:
            for entry in reader.messages(self._channels):
                topic = entry.channel.topic
                if topic == log.SIGNALS_TOPIC:
                    if codec.iteration_of(entry.data, where) >= iterations:
                        break
                    taken.append(entry.data)
                elif topic == keyframes.KEYFRAME_TOPIC:
                    self._last_keyframe = entry.sequence
                self._log.write(self._channels[topic], entry.log_time, entry.data, entry.sequence)
                if len(taken) >= log.BATCH_ITERATIONS:
                    yield from _records(taken, where)
                    taken = []
        yield from _records(taken, where)

    def flush(self) -> None:
        """Hand everything written so far to the operating system."""
        self._log.flush()
        self._next_flush = time.monotonic() + FLUSH_SECONDS

    def sync(self) -> None:
        """Let the disk have everything written so far."""
        self._log.sync()

    def close(self, final: Mapping[str, str] | None = None) -> None:
        """Write a final record where there is one, and the index; give the file its name."""
        if final is not None:
            self._log.add_metadata(folders.FINAL_METADATA, final)
        self._log.finish()

    def abandon(self) -> None:
        """Leave a readable NAME.partial."""
        self._log.abandon()

    def _add_channel(self, topic: str, name: str, definition: bytes) -> None:
        schema = self._log.add_schema(name, ENCODING, definition)
        self._channels[topic] = self._log.add_channel(topic, schema)

    def _write(self, iteration: int, *messages: tuple[str, int, bytes]) -> None:
        """Write messages of an iteration: topic, log time and data of each."""
        number, channels = iteration & 0xFFFFFFFF, self._channels
        records = [(channels[topic], at, data, at, number) for topic, at, data in messages]
        self._log.write_all(records)


def _records(messages: Sequence[bytes], where: str) -> Iterator[BlockSignals]:
    for columns in codec.decode_columns(messages, where):
        yield from columns.records()
