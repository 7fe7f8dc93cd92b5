"""Input options: how external logs and live streams are read, and how images become frames."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar, Final, Literal, cast

from cdmisfa.core.config import Section, build, key

# Recordings and runs store these texts, so that the meaning of pixels is known years later.

# How images become frames.
RECIPE: Final = (
    "gray: 16 bit by its high byte, colour as (19595 R + 38470 G + 7471 B + 32768) >> 16; "
    "size: area average (Pillow BOX); turned as the EXIF of a JPEG or PNG says"
)

# How images of videos become frames.
VIDEO_RECIPE: Final = (
    f"{RECIPE}; of a video the stored luma, 16 to 235 stretched to 0 to 255 as "
    "((Y - 16) * 510 + 219) // 438 where its range is limited, by the nearest quarter turns of its "
    "display matrix"
)

# How images become frames in color.
COLOR_RECIPE: Final = (
    "red, green and blue beside one another, each as gray is; of a Bayer pattern green is the mean "
    "of two; of a video by BT.709 or, where it states another or none, BT.601, in 16 bit whole "
    "numbers, with each chroma pixel repeated"
)

# How numbers become frames.
NUMBERS_RECIPE: Final = "numbers as they are, float64"

# (height, width) in pixels.
Size = tuple[int, int]

# Range of distances (m) that are black and white, or range to which numbers are limited.
Depth = tuple[float, float]

# Whether frames are in color; "auto" decides by the first frames of a log.
Color = bool | Literal["auto"]

# How an image of another aspect ratio becomes a frame: see `fitted`.
Fit = Literal["crop", "pad", "stretch"]

# What is subtracted from frames before learning: nothing, or the mean of each episode.
Centre = Literal["run", "episode"]

# Time of a message: when it was logged, or the time in its header.
Clock = Literal["log", "header"]

# Frames while a camera paused: none, or its last image.
Gaps = Literal["skip", "hold"]

# How streams with different times get one clock: by index, by the last image at each time, or by
# the nearest one.
Align = Literal["index", "time", "nearest"]

# Reaction to a live stream that stalls or disconnects.
OnLoss = Literal["reconnect", "wait", "end"]


@dataclass(frozen=True, slots=True)
class InputConfig(Section):
    """Rare settings of how external logs and live streams are read (keys `input.*`).

    Attributes:
        fit: how an image of another aspect ratio becomes a frame: cut (`crop`), with black
            borders (`pad`), or distorted (`stretch`).
        range: `NEAR,FAR`. Depth images show distances from NEAR (black) to FAR (white), in metres.
            Numbers below NEAR or above FAR are set to NEAR or FAR.
        time: column with the times of a table: dates, or seconds. `stamp:ns` reads the column
            `stamp` in nanoseconds; `us` and `ms` work, too.
        stamp: time of a message: when it was logged (`log`), or the time in its `header`.
        gaps: what happens where a camera paused for more than ten frame periods: `skip` leaves a
            gap, `hold` repeats the last image.
        centre: what is subtracted from frames before learning: nothing (`run`), or the mean frame
            of each `episode`, that is of each log, or of each part between two gaps.
        holdout: share of an external log, at its end, that is not learned from and used to measure
            the modules of the progress learner. `auto`: 0.1 if the log is long enough.
        hold: time for which the last image of a live stream replaces missing images, before the
            stream has a gap (s).
        lost: reaction to a live stream that stalls or disconnects: `reconnect`, `wait` or `end`.
        stall: time without an image after which a live stream counts as stalled (s).
    """

    prefix: ClassVar[str] = "input"
    fit: Fit = "crop"
    range: Depth | None = key(None, rising=True)
    time: str | None = None
    stamp: Clock = "log"
    gaps: Gaps = "skip"
    centre: Centre = "run"
    holdout: float | None = key(None, 0, 0.9)
    hold: float = key(0.25, 0, 1e6)
    lost: OnLoss = "reconnect"
    stall: float = key(5.0, 0.1, 1e6)


# Options of the command line for settings that are not keys `input.*`.
OPTIONS: Final = {
    "topics": "--topic",
    "fields": "--field",
    "size": "--size",
    "rate": "--rate",
    "start": "--start",
    "end": "--end",
    "align": "--align",
    "color": "--color",
}

# Keys that apply to recordings too: setting them does not make a source an external log.
COMMON_KEYS: Final = ("centre", "holdout", "hold", "lost", "stall")


@dataclass(frozen=True, slots=True, kw_only=True)
class InputOptions(InputConfig):
    """How external logs and live streams become streams of frames.

    Attributes:
        topics: topics of a log, one for each stream, or patterns of topics.
        fields: fields of numbers to use instead of images; see `Field`.
        size: (height, width) of frames; None: the aspect ratio of the images with at most as many
            pixels as 128x48.
        rate: frames a second; None: that of the first stream.
        start: time of the log at which frames begin (s).
        end: time of the log at which frames end (s); None: its end.
        align: how streams with different times get one clock; None: refuse them.
        color: True to show the red, green and blue images side by side.
        native: True for frames (height, width, 3 or 1) of the size and colors of their images,
            unless `size` or `color` change them.
    """

    topics: tuple[str, ...] = ()
    fields: tuple[str, ...] = ()
    size: Size | None = key(None, 1)
    rate: float | None = key(None, 1e-3, 1e6)
    start: float = key(0.0, 0)
    end: float | None = key(None, 0)
    align: Align | None = None
    color: Color = False
    native: bool = False

    @classmethod
    def key_name(cls, name: str) -> str:
        """Return the option of the command line for a setting, or its key."""
        return OPTIONS.get(name, f"{cls.prefix}.{name}")

    def chosen(self, names: Collection[str] | None = None) -> tuple[str, ...]:
        """Return the names of the settings that are not the defaults, of all or of `names`."""
        return tuple(
            field.name
            for field in fields(self)
            if getattr(self, field.name) != field.default and (names is None or field.name in names)
        )

    def named(self, names: Collection[str] | None = None) -> list[str]:
        """Return the options and keys of the `chosen` settings, for errors."""
        return [self.key_name(name) for name in self.chosen(names)]

    @property
    def external(self) -> bool:
        """Whether a setting requires that recordings are read like external logs."""
        return any(name not in COMMON_KEYS for name in self.chosen())

    @property
    def config(self) -> InputConfig:
        """The keys `input.*`."""
        names = (field.name for field in fields(InputConfig))
        return InputConfig(**{name: getattr(self, name) for name in names})

    def configured(self, *layers: Mapping[str, Any]) -> InputOptions:
        """Return the options with keys `input.*` from layers of values; later layers override.

        Raises:
            UsageError: a key is unknown, or a value does not fit.
        """
        return cast(InputOptions, build(InputConfig, "input", *layers, base=self))

    def settings(self) -> list[str]:
        """Return the keys `input.*` that are not the defaults, as `--set` takes them."""
        chosen = ((name, getattr(self, name)) for name in self.chosen() if name not in OPTIONS)
        return [
            f"input.{name}={','.join(map(str, v)) if isinstance(v, tuple) else v}"
            for name, v in chosen
        ]


# Images, and no numbers.
IMAGES: Final = InputOptions()
