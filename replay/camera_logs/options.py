"""How images of other people's logs become streams of frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Final, Literal

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
        align: how streams of unequal length, start or rate are put on one clock: "index",
            "time", or None to refuse them.
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
        stamp: when a message is taken to be of: when it was logged, or as its header says.
        color: whether frames show red, green and blue beside one another.
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

    def given(self) -> tuple[str, ...]:
        """The options of the command line that say other than the defaults."""
        return tuple(
            f"--{_SPELLED.get(field.name, field.name)}"
            for field in fields(self)
            if getattr(self, field.name) != field.default
        )


def spelled(
    reading: Reading, size: Size | None, fit: Fit, start: float, stop: float | None, gaps: Gaps
) -> list[str]:
    """The options of the command line that choose what is taken; of defaults, none."""
    words = ["--size", f"{size[1]}x{size[0]}"] if size is not None else []
    words += ["--fit", fit] if fit != "crop" else []
    for field in reading.fields:
        words += ["--field", field]
    words += ["--time", reading.time] if reading.time is not None else []
    words += ["--stamp", reading.stamp] if reading.stamp != "log" else []
    words += ["--color"] if reading.color else []
    words += ["--range", "{:g}:{:g}".format(*reading.depth)] if reading.depth is not None else []
    words += ["--from", f"{start:g}"] if start else []
    words += ["--to", f"{stop:g}"] if stop is not None else []
    return words + (["--gaps", "hold"] if gaps == "hold" else [])
