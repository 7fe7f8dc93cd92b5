"""The log of one view: its channels and its metadata."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from cdmisfa.core.blocks import Block, HeadPose
from recorder.config import RecordConfig
from recorder.log.logfile import LogFile
from recorder.log.messages import (
    METADATA,
    POSE_TOPIC,
    TRUTH_TOPIC,
    ImageEncoder,
    PoseEncoder,
    TruthEncoder,
    VectorEncoder,
    view_topic,
)
from recorder.log.resume import messages
from recorder.log.viewfacts import Identity, version

CONFIG_NAME = "config.json"
ROOT_FRAME = "root"


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
        if spec.images:
            height, width = spec.frame_shape
            self._frame = ImageEncoder(height, width, frame_id=view)
        else:
            self._frame = VectorEncoder()
        self._truth = TruthEncoder(spec.truth)
        self._head = PoseEncoder(ROOT_FRAME)
        self._log = LogFile(
            folder / (name or f"{view}.mcap"),
            library=f"cdmisfa {version('cdmisfa')}",
            compression=settings.compression,
            chunk_size=settings.chunk_size,
        )
        self._log.add_metadata(METADATA, identity.facts(view, first_frame).as_metadata())
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

    def copy(self, path: Path, stop: int) -> None:
        """Take over the frames before `stop` of an earlier log of the same part.

        Raises:
            LogWriteError: the disk does not take it.
        """
        for channel, message in messages(path):
            if message.sequence >= stop:
                break
            if channel.topic in self._channels:
                target = self._channels[channel.topic]
                self._log.write(target, message.log_time, message.data, message.sequence)
        self.t = stop

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
