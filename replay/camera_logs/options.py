"""How images of other people's logs become streams of frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Final, Literal

from cdmisfa.core.clock import RECORDED_FPS
from cdmisfa.core.errors import UsageError
from recorder.images.decoding import Clock, Reading
from recorder.images.framing import Fit, Size
from recorder.images.pixels import Depth

Align = Literal["index", "time"]
Gaps = Literal["skip", "hold"]

_SPELLED: Final[Mapping[str, str]] = {
    "topics": "topic",
    "start": "from",
    "stop": "to",
    "depth": "range",
    "fields": "field",
}
"""Options that the command line calls otherwise."""


@dataclass(frozen=True, slots=True)
class CameraOptions:
    """How images of other people's logs become streams of frames.

    Attributes:
        topics: the topics, a stream each; patterns as of file names mean all that match.
        size: (height, width) of a frame, or None for one from the images' own.
        align: how streams of unequal length, start or rate are put on one clock: "index" takes
            the i-th image of each, "time" the last image at or before each tick, None refuses
            them.
        rate: frames a second; None for the rate of the first stream.
        fit: how images of another aspect ratio become frames: see `fitted`.
        gaps: what frames show in which a stream pauses: "skip" for nothing, so that no block
            reaches across, "hold" for the last image before.
        start: seconds after the first image of all, before which images are left out.
        stop: seconds after it from which on they are left out; None for never.
        depth: distances in metres that are shown black and white, and the range that numbers
            are kept in; None for none.
        fields: the numbers that are taken of messages or of a table instead of images, one after
            the other; see `Field`.
        stamp: the times of messages: those of the log, or those in their headers.
        color: whether frames show red, green and blue beside one another, (height, 3 width).
        time: the column of a table's times; see `TableNumbers`.
    """

    topics: tuple[str, ...] = ()
    size: Size | None = None
    align: Align | None = None
    rate: float | None = None
    fit: Fit = "crop"
    gaps: Gaps = "skip"
    start: float = 0.0
    stop: float | None = None
    depth: Depth | None = None
    fields: tuple[str, ...] = ()
    time: str | None = None
    stamp: Clock = "log"
    color: bool = False

    @property
    def reading(self) -> Reading:
        """What is taken of messages and files."""
        return Reading(self.depth, tuple(self.fields), self.time, self.stamp, self.color)

    def given(self) -> tuple[str, ...]:
        """The options of the command line that say other than the defaults."""
        return tuple(
            f"--{_SPELLED.get(field.name, field.name)}"
            for field in fields(self)
            if getattr(self, field.name) != field.default
        )

    def check(self) -> None:
        """Refuse what no log can be read with; raises UsageError."""
        slowest, fastest = RECORDED_FPS
        if self.rate is not None and not slowest <= self.rate <= fastest:
            raise UsageError(f"--rate is {self.rate}: it must be in [{slowest:g}, {fastest:.0f}]")
        if self.size is not None and min(self.size) < 1:
            raise UsageError(f"--size is {self.size[1]}x{self.size[0]}: it must be above 0")
        if self.stop is not None and not self.start < self.stop:
            raise UsageError(
                f"--from {self.start:g} is no earlier than --to {self.stop:g}, both in seconds "
                "after the first image: no image lies between them"
            )

    def words(self) -> list[str]:
        """The words of a command line that say what is taken, but for topics, align and rate."""
        words = ["--size", f"{self.size[1]}x{self.size[0]}"] if self.size is not None else []
        words += ["--fit", self.fit] if self.fit != "crop" else []
        for field in self.fields:
            words += ["--field", field]
        words += ["--time", self.time] if self.time is not None else []
        words += ["--stamp", self.stamp] if self.stamp != "log" else []
        words += ["--color"] if self.color else []
        words += ["--range", "{:g}:{:g}".format(*self.depth)] if self.depth is not None else []
        words += ["--from", f"{self.start:g}"] if self.start else []
        words += ["--to", f"{self.stop:g}"] if self.stop is not None else []
        return words + (["--gaps", "hold"] if self.gaps == "hold" else [])
