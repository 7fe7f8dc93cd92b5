"""How images of cameras, live or stored, become frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

from cdmisfa.core.errors import UsageError
from cdmisfa.core.options import RANGE, SIZE, check_settings, given, option_name, setting

RECIPE: Final = (
    "gray: 16 bit by its high byte, colour as (19595 R + 38470 G + 7471 B + 32768) >> 16; "
    "size: area average (Pillow BOX); turned as the EXIF of a JPEG or PNG says"
)
"""How any image becomes a frame, for the record."""

VIDEO_RECIPE: Final = (
    f"{RECIPE}; of a video the stored luma, 16 to 235 stretched to 0 to 255 as "
    "((Y - 16) * 510 + 219) // 438 where its range is limited, by the nearest quarter turns of its "
    "display matrix"
)
"""How a picture of a video becomes a frame, for the record."""

COLOR_RECIPE: Final = (
    "red, green and blue beside one another, each as gray is; of a Bayer pattern green is the mean "
    "of two; of a video by BT.709 or, where it states another or none, BT.601, in 16 bit whole "
    "numbers, with each chroma pixel repeated"
)
"""How any image becomes a frame in colours, for the record."""

NUMBERS_RECIPE: Final = "numbers as they are, float64"
"""How numbers become a frame, for the record."""

Size = tuple[int, int]
"""(height, width) in pixels."""

Depth = tuple[float, float]
"""Distances in metres that are shown black and white, or the range that numbers are kept in."""

Color = bool | Literal["auto"]
"""Whether frames show colours; "auto" looks at a log's first frames."""

Fit = Literal["crop", "pad", "stretch"]
"""How an image of another ratio of the sides becomes a frame: see `fitted`."""

Centre = Literal["run", "episode"]
"""What frames are shown without before anything is learned: nothing, or each episode's mean."""

Clock = Literal["log", "header"]
"""Which time of a message counts: when it was logged, or that in its header."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageOptions:
    """How images of cameras, live or stored, become frames, or their messages numbers."""

    size: Size | None = setting(
        None,
        "Shrink camera images to this size; by default to what has their ratio of the sides "
        "and no more pixels than 128x48.",
        unit=SIZE,
        group="Images",
    )
    fit: Fit = setting(
        "crop",
        "Where images have another ratio of the sides than --size: cut two sides, put black "
        "at them, or change the ratio.",
        group="Images",
    )
    rate: float | None = setting(
        None,
        "Frames a second of cameras and logs; by default the first stream's.",
        unit="HZ",
        least=1e-3,
        most=1e6,
        group="Images",
    )
    fields: tuple[str, ...] = setting(
        (),
        "Take numbers instead of images: a field of a topic's messages, such as "
        "pose.position.x or ranges[0:100], or a column of a table; several are one vector.",
        unit="FIELD",
        name="field",
        group="Images",
    )
    color: Color = setting(
        False,
        "Show red, green and blue beside one another, as a frame of three times the width; auto "
        "does where hue varies in the first frames of a log and brightness does not.",
        group="Images",
    )
    depth: Depth | None = setting(
        None,
        "Show distances of depth cameras, in metres, from black to white, as 0.3:5; keep numbers "
        "within, as -3.2:3.2.",
        unit=RANGE,
        name="range",
        group="Images",
    )

    def __post_init__(self) -> None:
        check_settings(self)
        if self.color not in (False, True, "auto"):
            raise UsageError(f"--color is {self.color}: give on, off or auto")

    def given(self) -> tuple[str, ...]:
        """The options of the command line that say other than the defaults."""
        return tuple(option_name(field) for field in given(self))


@dataclass(frozen=True, slots=True)
class Reading:
    """What is taken of messages and files.

    Attributes:
        depth: what is shown of distances, see `raw_image`, and the range that numbers are kept in.
        fields: the numbers that are taken instead of images; see `Field`.
        time: the column of a table's times, with its unit; see `TableNumbers`.
        stamp: the times of messages: those of the log, or those in their headers.
        color: whether images are taken in their colours; see `raw_image`.
    """

    depth: Depth | None = None
    fields: tuple[str, ...] = ()
    time: str | None = None
    stamp: Clock = "log"
    color: bool = False


IMAGES = Reading()
"""Images, and no numbers."""
