"""The log of one view: its channels and metadata, as one file or as parts of limited size."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from cdmisfa.core.blocks import Block, HeadPose
from cdmisfa.core.errors import LogDamagedError
from recorder.config import RecordConfig
from recorder.log.folder import part_name
from recorder.log.logfile import LogFile
from recorder.log.messages import (
    ENCODING,
    POSE_TOPIC,
    RECORDING_METADATA,
    TRUTH_TOPIC,
    ImageEncoder,
    PoseEncoder,
    TruthEncoder,
    VectorEncoder,
    view_topic,
)
from recorder.log.resume import aside_path, messages
from recorder.log.scenemessages import (
    OBJECTS_TOPIC,
    SIDES,
    TRANSFORMS_TOPIC,
    CalibrationEncoder,
    ObjectsEncoder,
    TransformsEncoder,
    calibration_topic,
)
from recorder.log.scenery import scenery_of
from recorder.log.split import Split
from recorder.log.viewfacts import MAX_FRAMES, Identity, version

CONFIG_NAME = "config.json"
ROOT_FRAME = "root"


class ViewLog:
    """Writes one view of a recording: frames, ground truth, the head's pose, and the world.

    Cameras and frames are written with the pose, the objects at every frame.

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
        fsync_every: see `LogFile`.

    Attributes:
        file: the log itself, to be flushed, finished or abandoned.
        t: the next frame to be written.
        frames: how many are written.
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
        fsync_every: float | None = None,
    ) -> None:
        self.t = self._first = first_frame
        self.frames = 0
        self._gaps = identity.gaps
        self._spec = spec = identity.spec
        self._stream = spec.streams.index(view)
        self._topic = view_topic(view)
        self._pose = pose
        self._pose_every = max(round(spec.fps), 1)
        encoders: dict[str, Any] = {self._topic: VectorEncoder()}
        if spec.images:
            height, width = spec.frame_shape
            encoders[self._topic] = ImageEncoder(height, width, frame_id=view)
        if spec.truth:
            encoders[TRUTH_TOPIC] = TruthEncoder(spec.truth)
        if pose is not None:
            encoders[POSE_TOPIC] = PoseEncoder(ROOT_FRAME)
        world = _world_of(view, identity, pose)
        self._standing = tuple(topic for topic in world if topic != OBJECTS_TOPIC)
        self._moving = OBJECTS_TOPIC in world
        encoders |= world
        self.file = log = LogFile(
            folder / (name or part_name(view, None)),
            library=f"cdmisfa {version('cdmisfa')}",
            compression=settings.compression,
            chunk_size=settings.chunk_size,
            fsync_every=fsync_every,
        )
        facts = identity.facts(view, first_frame)
        log.add_metadata(RECORDING_METADATA, facts.as_metadata())
        if not facts.stream_count or facts.stream_index == 0:  # it may name all streams, too
            log.add_attachment(
                CONFIG_NAME, "application/json", identity.config_json(), log_time=spec.start_ns
            )
        self._channels = {
            topic: (
                log.add_channel(topic, log.add_schema(e.schema, ENCODING, e.schema_data())),
                e,
            )
            for topic, e in encoders.items()
        }

    def write(self, block: Block) -> None:
        """Write the frames of a block, which must start at `t`, or later where there are gaps.

        Raises:
            ValueError: the block is of another stream or time.
            LogWriteError: the disk does not take it.
        """
        follows = block.t >= self.t if self._gaps else block.t == self.t
        if block.stream != self._stream or not follows:
            raise ValueError(f"{self.file.path}: frame {self.t} is next, not {block.t}")
        self.t = block.t
        pose = self._pose
        for frame, values in zip(block.frames, block.truth, strict=True):
            if pose is not None and (self.t % self._pose_every == 0 or self.t == self._first):
                self._write(POSE_TOPIC, pose.position, pose.quaternion)
                for topic in self._standing:
                    self._write(topic)
            if self._moving:
                self._write(OBJECTS_TOPIC, values)
            if self._spec.truth:
                self._write(TRUTH_TOPIC, values)
            self._write(self._topic, frame)
            self.t += 1
        self.frames += len(block)

    def copy(self, path: Path, stop: int) -> None:
        """Take over the frames before `stop` of an earlier log of the same part.

        Raises:
            LogDamagedError: they are not there any more.
        """
        held = self._first
        frames = 0
        for channel, message in messages(path):
            if message.sequence >= stop:
                break
            if channel.topic in self._channels:
                number, _ = self._channels[channel.topic]
                self.file.write(number, message.log_time, message.data, message.sequence)
                if channel.topic == self._topic:
                    held, frames = message.sequence + 1, frames + 1
        if held != stop or (not self._gaps and frames != stop - self._first):
            raise LogDamagedError(f"{path} changed while it was read: resume it again")
        self.t, self.frames = stop, frames

    def _write(self, topic: str, *values: Any) -> None:
        number, encode = self._channels[topic]
        time = self._spec.time_ns(self.t)
        self.file.write(number, time, encode(time, *values), self.t)


def _world_of(view: str, identity: Identity, pose: HeadPose | None) -> dict[str, Any]:
    """What encodes the world of a scene that is described, by topic; nothing of others."""
    config = identity.config.get("scene")
    if pose is None or not isinstance(config, Mapping):
        return {}
    scenery = scenery_of(config, pose.position)
    gaze = scenery.gaze(view) if scenery is not None else None
    if scenery is None or gaze is None:
        return {}
    eyes = zip(SIDES, gaze.eyes, strict=True)
    found: dict[str, Any] = {
        calibration_topic(view, side): CalibrationEncoder(eye, f"{view}/{side}")
        for side, eye in eyes
    }
    found[TRANSFORMS_TOPIC] = TransformsEncoder(gaze, ROOT_FRAME)
    if all(set(thing.truth) <= set(identity.spec.truth) for thing in scenery.objects):
        found[OBJECTS_TOPIC] = ObjectsEncoder(scenery, identity.spec.truth, ROOT_FRAME)
    return found


class ViewParts:
    """Writes one view: VIEW.mcap, or VIEW-000.mcap, VIEW-001.mcap, ... where it is split.

    Where a part ends depends on its frames only, not on the blocks they came in.

    Args:
        folder, view, identity, settings, pose, fsync_every: as for `ViewLog`.
        split: where parts end; None for a single file.
        parts: file and number of frames of each part that is done; more are added.
        first: first frame of the part that is next.
    """

    def __init__(
        self,
        folder: Path,
        view: str,
        identity: Identity,
        settings: RecordConfig,
        split: Split | None,
        pose: HeadPose | None,
        parts: list[tuple[Path, int]],
        first: int,
        fsync_every: float | None = None,
    ) -> None:
        self._parts = parts
        self._view = view
        self._split = split
        self._length = split.frames(identity.spec.fps) if split else None
        self._first = first
        self._open = partial(
            ViewLog, folder, view, identity, settings, pose=pose, fsync_every=fsync_every
        )
        self._log = self._next()

    @property
    def t(self) -> int:
        """The next frame to be written."""
        return self._log.t

    def copy(self, path: Path, stop: int) -> None:
        """Take over what an earlier attempt left of the part to be written; see `ViewLog`."""
        self._log.copy(path, stop)

    def write(self, block: Block) -> None:
        """Write the frames of a block, which must start at `t`; see `ViewLog`."""
        at = 0
        while at < len(block):
            n = min(self._room(), len(block) - at)
            if n == 0:
                self._begin_next()
                continue
            piece = slice(at, at + n)
            self._log.write(
                Block(block.stream, block.t + at, block.frames[piece], block.truth[piece])
            )
            at += n

    def state(self, name: str, values: Mapping[str, str]) -> None:
        """Write what is known only now into the last part, as a metadata record."""
        self._log.file.add_metadata(name, values)

    def finish(self) -> None:
        """Give the last part its index and its name, and forget what it was copied from."""
        file = self._log.file
        file.finish()
        aside_path(file.path).unlink(missing_ok=True)
        self._parts.append((file.path, self._log.frames))

    def abandon(self) -> None:
        """Leave a readable partial."""
        self._log.file.abandon()

    def _next(self) -> ViewLog:
        """The log of the part that comes after those that are done."""
        number = None if self._split is None else len(self._parts)
        return self._open(name=part_name(self._view, number), first_frame=self._first)

    def _room(self) -> int:
        """Frames that the part takes before it must be looked at again; 0 where it is full."""
        if self._split is None:
            return MAX_FRAMES
        written = self.t - self._first
        if self._length is not None:
            return max(self._length - written, 0)  # a gap may reach beyond
        return int(written == 0 or self._log.file.size < (self._split.size or 0))

    def _begin_next(self) -> None:
        """Begin a part before the one before is finished, so that some file is always open.

        Whoever follows the recording sees that it continues.
        """
        full = self._log.file
        full.flush()
        self._parts.append((full.path, self._log.frames))
        self._first = self.t
        try:
            self._log = self._next()
        finally:
            full.finish()
        aside_path(full.path).unlink(missing_ok=True)
