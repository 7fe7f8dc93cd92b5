"""The log of one view: its channels, its metadata, and taking one up again."""

from __future__ import annotations

import hashlib
import json
import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader
from mcap.records import Channel, Message

from cdmisfa.core.blocks import Block, HeadPose, SourceSpec
from cdmisfa.core.errors import UsageError
from recorder.config import RecordConfig
from recorder.log.logfile import LogFile
from recorder.log.messages import (
    METADATA,
    POSE_TOPIC,
    SCHEMA_VERSION,
    TRUTH_TOPIC,
    ImageEncoder,
    PoseEncoder,
    TruthEncoder,
    VectorEncoder,
    view_topic,
)
from recorder.log.whole import partial_path

CONFIG_NAME = "config.json"
ROOT_FRAME = "root"

_PACKAGES = ("cdmisfa", "numpy", "zstandard", "pybullet", "icub-models")
_DAMAGE = (McapError, ValueError, struct.error, OSError, OverflowError, MemoryError, KeyError)
_RECORD_LIMIT = 2**30


@dataclass(frozen=True, slots=True)
class Identity:
    """What makes two recordings the same one.

    Attributes:
        kind: the scene's name.
        seed: of the scene's motions.
        spec: what its source delivers.
        config: the `scene` and `record` sections as JSON values.
    """

    kind: str
    seed: int
    spec: SourceSpec
    config: Mapping[str, Any]

    def config_json(self) -> bytes:
        """The configuration as the attachment holds it."""
        return (json.dumps(self.config, indent=2, sort_keys=True) + "\n").encode()

    def metadata(self, view: str, first_frame: int = 0) -> dict[str, str]:
        """The view's metadata record, in a file that begins with a frame."""
        spec = self.spec
        values = {
            "schema": str(SCHEMA_VERSION),
            "scene": self.kind,
            "view": view,
            "stream_index": str(spec.streams.index(view)),
            "streams": ",".join(spec.streams),
            "frame_shape": "x".join(str(size) for size in spec.frame_shape),
            "dtype": spec.dtype,
            "truth": ",".join(spec.truth),
            "fps": repr(spec.fps),
            "start_ns": str(spec.start_ns),
            "first_frame": str(first_frame),
            "seed": str(self.seed),
            "config_sha256": hashlib.sha256(self.config_json()).hexdigest(),
        }
        used = _PACKAGES if self.kind == "icub" else _PACKAGES[:3]
        return values | {f"version_{name}": _version(name) for name in used}


class ViewLog:
    """Writes one view of a recording: frames, ground truth and the head's pose.

    The frame is the last message of its time, so that a frame that can be read has its
    truth, too.

    Args:
        folder: of the recording.
        view: name of the view.
        identity: what is recorded.
        settings: how it is written.
        pose: of the head in this view, where there is a head; written once a second.
        name: of the file, instead of the view's.
        first_frame: with which the file begins.

    Attributes:
        view: name of the view.
        stream: its index.
        t: the next frame to be written.
    """

    def __init__(
        self,
        folder: Path,
        view: str,
        identity: Identity,
        settings: RecordConfig,
        *,
        pose: HeadPose | None = None,
        name: str | None = None,
        first_frame: int = 0,
    ) -> None:
        spec = identity.spec
        self.view = view
        self.stream = spec.streams.index(view)
        self.t = self._first = first_frame
        self._spec = spec
        self._pose = pose
        self._pose_every = max(round(spec.fps), 1)
        self._frame: ImageEncoder | VectorEncoder
        if len(spec.frame_shape) == 2:
            self._frame = ImageEncoder(*spec.frame_shape, frame_id=view)
        else:
            self._frame = VectorEncoder()
        self._truth = TruthEncoder(spec.truth)
        self._head = PoseEncoder(ROOT_FRAME)
        self._log = LogFile(
            folder / (name or f"{view}.mcap"),
            library=f"cdmisfa {_version('cdmisfa')}",
            compression=settings.compression,
            chunk_size=settings.chunk_size,
        )
        self._log.add_metadata(METADATA, identity.metadata(view, first_frame))
        self._log.add_attachment(
            CONFIG_NAME, "application/json", identity.config_json(), log_time=spec.start_ns
        )
        encoders: list[tuple[str, Any]] = [(view_topic(view), self._frame)]
        if spec.truth:
            encoders.append((TRUTH_TOPIC, self._truth))
        if pose is not None:
            encoders.append((POSE_TOPIC, self._head))
        self._channels = {
            topic: self._log.add_channel(
                topic, self._log.add_schema(encoder.schema, "protobuf", encoder.schema_data())
            )
            for topic, encoder in encoders
        }

    @property
    def path(self) -> Path:
        """The file's name once it is finished."""
        return self._log.path

    @property
    def size(self) -> int:
        """Bytes that were handed to the operating system: whole chunks."""
        return self._log.size

    def write(self, block: Block) -> None:
        """Write the frames of a block, which must start at `t`.

        Raises:
            ValueError: the block is of another stream or time.
            LogWriteError: the disk does not take it.
        """
        if block.stream != self.stream or block.t != self.t:
            raise ValueError(f"{self.view}: frame {self.t} is next, not {block.t}")
        write, channels = self._log.write, self._channels
        image = channels[view_topic(self.view)]
        truth, pose = channels.get(TRUTH_TOPIC), self._pose
        for frame, values in zip(block.frames, block.truth, strict=True):
            t, time = self.t, self._spec.time_ns(self.t)
            if pose is not None and (t % self._pose_every == 0 or t == self._first):
                data = self._head(time, pose.position, pose.quaternion)
                write(channels[POSE_TOPIC], time, data, t)
            if truth is not None:
                write(truth, time, self._truth(time, values), t)
            write(image, time, self._frame(time, frame), t)
            self.t += 1

    def copy(self, path: Path, frames: int) -> None:
        """Take over the frames before `frames` of an earlier log of the same part.

        Raises:
            LogWriteError: the disk does not take it.
        """
        for channel, message in _messages(path):
            if message.sequence >= frames:
                break
            if channel.topic in self._channels:
                target = self._channels[channel.topic]
                self._log.write(target, message.log_time, message.data, message.sequence)
        self.t = frames

    def flush(self) -> None:
        """Hand everything to the operating system.

        Raises:
            LogWriteError: the disk does not take it.
        """
        self._log.flush()

    def finish(self) -> None:
        """Give the file its index and its name."""
        self._log.finish()

    def abandon(self) -> None:
        """Leave a readable partial."""
        self._log.abandon()


class FramesHeld(NamedTuple):
    """What an earlier log of a view holds.

    Attributes:
        first: its first frame.
        stop: up to before which frame all from the first on are there.
        end: one more than its last frame; 0 without any.
    """

    first: int
    stop: int
    end: int

    def whole(self, first: int) -> int:
        """Up to before which frame all from a given one on are there."""
        return self.stop if self.end and self.first == first else first


def frames_held(path: Path, view: str) -> FramesHeld:
    """Read once through a log, damaged or not, for the frames of a view that it holds."""
    first = stop = end = 0
    for channel, message in _messages(path):
        if channel.topic == view_topic(view):
            if not end:
                first = stop = message.sequence
            if message.sequence == stop:
                stop += 1
            end = max(end, message.sequence + 1)
    return FramesHeld(first, stop, end)


def check_identity(path: Path, expected: Mapping[str, str]) -> None:
    """Refuse to go on with a log of something else.

    Raises:
        UsageError: a value of its metadata record differs.
    """
    try:
        with path.open("rb") as file:
            reader = NonSeekingReader(file, validate_crcs=True, record_size_limit=_RECORD_LIMIT)
            record = next((m for m in reader.iter_metadata() if m.name == METADATA), None)
    except _DAMAGE:
        record = None
    if record is None:
        raise UsageError(f"{path} does not say what it is a recording of: overwrite with --force")
    for key, value in expected.items():
        if record.metadata.get(key) != value:
            raise UsageError(
                f"{path} cannot be continued: its {key} is {record.metadata.get(key)!r}, now it is "
                f"{value!r}; use the same command and versions, or overwrite with --force"
            )


def earlier_logs(path: Path) -> Sequence[Path]:
    """Where an earlier attempt at a log may have left frames."""
    return [p for p in (path, partial_path(path), kept_path(path)) if p.exists()]


def kept_path(path: Path) -> Path:
    """Where a partial is kept while its frames are copied into the new one."""
    return path.with_name(path.name + ".partial.kept")


def sha256(path: Path) -> str:
    """Checksum of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def keep(path: Path, source: Path) -> Path:
    """Move an earlier log aside, and remove the poorer ones.

    Returns:
        Where it is now.
    """
    kept = kept_path(path)
    if source != kept:
        os.replace(source, kept)
    for other in (path, partial_path(path)):
        other.unlink(missing_ok=True)
    return kept


def _messages(path: Path) -> Iterator[tuple[Channel, Message]]:
    """Messages in file order, up to where the file is damaged or torn."""
    try:
        with path.open("rb") as file:
            reader = NonSeekingReader(file, validate_crcs=True, record_size_limit=_RECORD_LIMIT)
            for _, channel, message in reader.iter_messages(log_time_order=False):
                yield channel, message
    except _DAMAGE:
        return


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "unknown"
