"""How images of other people's logs become streams of frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from cdmisfa.core.options import TIME, setting
from recorder.images.options import Clock, ImageOptions, Reading

Align = Literal["index", "time"]
Gaps = Literal["skip", "hold"]


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraOptions(ImageOptions):
    """How images of other people's logs become streams of frames."""

    topics: tuple[str, ...] = setting(
        (),
        "A topic of images in a log, one stream each, or a pattern of topics, such as "
        "'/cam*'; repeatable.",
        unit="TOPIC",
        name="topic",
    )
    time: str | None = setting(
        None,
        "The column of a table's times: dates, or seconds; stamp:ns counts in ns, us or ms.",
        unit="COLUMN",
    )
    stamp: Clock = setting(
        "log", "When a message is of: when it was logged, or the time in its header."
    )
    start: float = setting(
        0.0,
        "Leave out images before this time of the log, in seconds or as MINUTES:SECONDS.",
        unit=TIME,
        name="from",
    )
    stop: float | None = setting(None, "Leave out images from then on.", unit=TIME, name="to")
    gaps: Gaps = setting(
        "skip",
        "Where a camera paused for more than ten of its steps: skip it, so that nothing is "
        "learned across, or hold the last image.",
    )
    align: Align | None = setting(
        None,
        "Put camera streams that differ on one clock: the i-th image of each, or the "
        "last image at each time. By default they are refused.",
    )

    @property
    def reading(self) -> Reading:
        """What is taken of messages and files."""
        return Reading(self.depth, tuple(self.fields), self.time, self.stamp, self.color is True)
