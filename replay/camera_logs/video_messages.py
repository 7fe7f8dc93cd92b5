"""Videos in the messages of logs: their pictures, in any order."""

from __future__ import annotations

from typing import Any

from cdmisfa.core.errors import UsageError
from recorder.images.pixels import MalformedImage, Shown
from recorder.images.videos import VIDEO_RECIPE, VideoPackets
from recorder.mcap.records import MalformedRecord
from replay.camera_logs.stream import ImagesOf, ImageStream


class VideoMessages(ImagesOf):
    """The pictures of a video in a log's messages, from the first that needs none before it.

    Args:
        messages: the log's: a stream with `taken`, what a function takes of a message.
        packets: their decoder.

    Raises:
        UsageError: no picture needs none before it.
        LogDamagedError: the log is damaged.
    """

    def __init__(self, messages: Any, packets: VideoPackets) -> None:
        self._messages, self._packets = messages, packets
        self._next = -1
        self._broken: dict[int, MalformedImage | MalformedRecord] = {}
        rows = range(len(messages.times))
        self._first = next((row for row in rows if self._begins(row)), len(rows))
        if self._first == len(rows):
            raise UsageError(f"{messages.path}: {messages.topic}: {self._why()}")
        super().__init__(messages, messages.times[self._first :])
        self.recipe = VIDEO_RECIPE
        lost = f"{self.path}: {self._first} pictures that need earlier ones are left out"
        self.warnings = [*messages.warnings, *([lost] if self._first else [])]

    def image(self, row: int) -> Shown:
        row += self._first
        if row != self._next:
            start = row
            while start not in (self._first, self._next) and not self._begins(start):
                start -= 1
                if start in self._broken:  # of which those behind it are made
                    raise self._broken[start]
            if start != self._next:
                self._packets.forget()
            self._next = -1
            for before in range(start, row):
                self._taken(before)
        self._next = -1
        shown = self._taken(row)
        self._next = row + 1
        return shown

    def _taken(self, row: int) -> Shown:
        """The picture of a message; raises for one that is broken, which is remembered."""
        try:
            shown: Shown = self._messages.taken(row, self._packets)
        except (MalformedImage, MalformedRecord) as error:
            self._broken[row] = error
            raise
        return shown

    def distances(self) -> bool:
        return False  # known without a message, which may be broken

    def _row(self, row: int) -> int:
        return self._first + row

    def _why(self) -> str:
        """Why nothing of the video can be decoded."""
        try:
            self._messages.taken(0, self._packets.begins)
        except (MalformedImage, MalformedRecord) as error:
            return str(error)
        return "each picture of its video needs earlier ones"

    def _begins(self, row: int) -> bool:
        try:
            return bool(self._messages.taken(row, self._packets.begins))
        except (MalformedImage, MalformedRecord):
            return False


def in_order(images: ImageStream) -> ImageStream:
    """A stream of a log's messages, its pictures in any order where these are of a video."""
    decode = images.decode
    return VideoMessages(images, decode) if isinstance(decode, VideoPackets) else images
