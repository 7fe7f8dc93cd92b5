"""Log of one view: its channels, metadata and messages, in one file or in parts."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

from cdmisfa.core.blocks import Block, HeadPose
from cdmisfa.core.errors import LogDamagedError
from recorder.config import RecordConfig
from recorder.log.files import aside_path, part_name
from recorder.log.logfile import LogFile
from recorder.log.manifest import RecordingSpec, version
from recorder.log.messages import (
    ENCODING,
    OBJECTS_TOPIC,
    POSE_TOPIC,
    RECORDING_METADATA,
    SIDES,
    TRANSFORMS_TOPIC,
    TRUTH_TOPIC,
    Encoder,
    ImageEncoder,
    ObjectsEncoder,
    TruthEncoder,
    VectorEncoder,
    calibration_encoder,
    calibration_topic,
    pose_encoder,
    transforms_encoder,
    view_topic,
)
from recorder.log.resume import messages
from recorder.log.scenery import scenery_of

# Name of the attachment with the configuration of the recorded source.
CONFIG_NAME: Final = "config.json"

# Name of the coordinate frame of the robot's root.
ROOT_FRAME: Final = "root"


class ViewLog:
    """Writer of one view: VIEW.mcap, or VIEW-000.mcap, VIEW-001.mcap, ... if it is split.

    It writes frames, ground truth, head pose and scene: cameras and coordinate frames together with
    the pose, objects at every frame. The frame is the last message of its time, so that a frame
    that can be read has its truth too.

    The end of a part depends on its frames only, not on the lengths of the blocks.

    Args:
        folder: folder of the recording.
        view: name of the view.
        recording: specification of the recording.
        settings: settings of the files.
        pose: pose of the head in this view, written once a second; None without a head.
        split: length of a part (s); None: one file.
        parts: file and number of frames of each finished part.
        first: first frame of the next part.

    Attributes:
        parts: the finished parts, to which further ones are added.
        t: number of the next frame.
    """

    def __init__(
        self,
        folder: Path,
        view: str,
        recording: RecordingSpec,
        settings: RecordConfig,
        pose: HeadPose | None = None,
        split: float | None = None,
        parts: list[tuple[Path, int]] | None = None,
        first: int = 0,
    ) -> None:
        self.parts = [] if parts is None else parts
        self.t = first
        self._folder, self._view, self._recording = folder, view, recording
        self._settings = settings
        self._spec = spec = recording.spec
        self._length = None if split is None else max(round(split * spec.fps), 1)
        self._stream = spec.streams.index(view)
        self._topic = view_topic(view)
        self._encoders = _encoders(view, recording, pose)
        self._moving = [t for t in (OBJECTS_TOPIC, TRUTH_TOPIC, self._topic) if t in self._encoders]
        self._still = [t for t in self._encoders if t not in self._moving]
        self._second = max(round(spec.fps), 1)
        self._channels: dict[str, int] = {}
        self._first, self._frames = first, 0
        self._file = self._begin_part()

    def write(self, block: Block) -> None:
        """Write the frames of a block, which must start at `t` or, with gaps, later.

        Raises:
            ValueError: the block has another stream or time.
            LogWriteError: the file cannot be written.
        """
        follows = block.t >= self.t if self._recording.gaps else block.t == self.t
        if block.stream != self._stream or not follows:
            raise ValueError(f"{self._file.path}: the next frame is {self.t}, not {block.t}")
        for t, (frame, truth) in enumerate(zip(block.frames, block.truth, strict=True), block.t):
            if self._length is not None and self.t - self._first >= self._length:
                self._begin_next_part()
            time, begins = self._spec.time_ns(t), t % self._second == 0 or t == self._first
            for topic in (*self._still, *self._moving) if begins else self._moving:
                data = self._encoders[topic](time, frame if topic == self._topic else truth)
                self._file.write(self._channels[topic], time, data, t)
            self.t = t + 1
            self._frames += 1

    def copy(self, path: Path, stop: int) -> None:
        """Copy the frames before `stop` from an earlier log of the part.

        Raises:
            LogDamagedError: the frames are no longer there.
        """
        last = self._first
        for topic, sequence, log_time, data in messages(path):
            if sequence >= stop:
                break
            if topic in self._channels:
                self._file.write(self._channels[topic], log_time, data, sequence)
                if topic == self._topic:
                    last, self._frames = sequence + 1, self._frames + 1
        if last != stop or (not self._recording.gaps and self._frames != stop - self._first):
            raise LogDamagedError(f"{path} changed while it was read: resume it again")
        self.t = stop

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Add a metadata record to the last part."""
        self._file.add_metadata(name, values)

    def finish(self) -> None:
        """Finish the last part, and remove the log from which it was copied."""
        self._file.finish()
        aside_path(self._file.path).unlink(missing_ok=True)
        self.parts.append((self._file.path, self._frames))

    def abandon(self) -> None:
        """Close the present part as a readable partial file."""
        self._file.abandon()

    def _begin_part(self) -> LogFile:
        """Create the part that begins with the next frame."""
        self._first, self._frames = self.t, 0
        number = None if self._length is None else len(self.parts)
        log = LogFile(
            self._folder / part_name(self._view, number),
            library=f"cdmisfa {version('cdmisfa')}",
            compression=self._settings.compression,
            chunk_size=self._settings.chunk_size,
        )
        stated = self._recording.metadata(self._view, self.t)
        log.add_metadata(RECORDING_METADATA, stated.record())
        if not stated.stream_count or stated.stream_index == 0:  # for many views: once is enough
            config, start = self._recording.config_json(), self._spec.start_ns
            log.add_attachment(CONFIG_NAME, "application/json", config, log_time=start)
        self._channels = {
            topic: log.add_channel(topic, log.add_schema(e.schema, ENCODING, e.schema_data()))
            for topic, e in self._encoders.items()
        }
        return log

    def _begin_next_part(self) -> None:
        """Begin the next part before the present one is finished.

        A recording that is killed then always has an unfinished file, which shows its state.
        """
        full = self._file
        full.flush()
        self.parts.append((full.path, self._frames))
        try:
            self._file = self._begin_part()
        finally:
            full.finish()
        aside_path(full.path).unlink(missing_ok=True)


def _encoders(view: str, recording: RecordingSpec, pose: HeadPose | None) -> dict[str, Encoder]:
    """Return the encoders of a view by topic: frames, truth, and the world of its scene if any."""
    spec = recording.spec.of(recording.spec.streams.index(view))
    encoders: dict[str, Encoder] = {view_topic(view): VectorEncoder()}
    if spec.images:
        height, width = spec.frame_shape
        encoders[view_topic(view)] = ImageEncoder(height, width, frame_id=view)
    if spec.truth:
        encoders[TRUTH_TOPIC] = TruthEncoder(spec.truth)
    if pose is None:
        return encoders
    encoders[POSE_TOPIC] = pose_encoder(ROOT_FRAME, pose)
    config = recording.config.get("scene")
    scenery = scenery_of(config, pose.position) if isinstance(config, Mapping) else None
    gaze = None if scenery is None else scenery.gaze(view)
    if scenery is None or gaze is None:
        return encoders
    for side, eye in zip(SIDES, gaze.eyes, strict=True):
        encoders[calibration_topic(view, side)] = calibration_encoder(eye, f"{view}/{side}")
    encoders[TRANSFORMS_TOPIC] = transforms_encoder(gaze, ROOT_FRAME)
    if all(set(thing.truth) <= set(spec.truth) for thing in scenery.objects):
        encoders[OBJECTS_TOPIC] = ObjectsEncoder(scenery, spec.truth, ROOT_FRAME)
    return encoders
