"""Open live streams by the words that name them on the command line."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import SplitResult, unquote, urlsplit

from cdmisfa.core.blocks import FrameSource
from cdmisfa.core.errors import Registry, UsageError, are_for
from cdmisfa.core.names import stream_names
from recorder.images.options import COLOR_RECIPE, NUMBERS_RECIPE, RECIPE, VIDEO_RECIPE, InputOptions

if TYPE_CHECKING:
    from recorder.cameras.readers import Camera

_VIDEO: Final = ("camera", "av", "http", "https", "rtsp", "rtsps", "rtmp", "tcp", "udp")

_STREAMED: Final = (".mjpg", ".mjpeg", ".m3u8")

_NO_FIELDS: Final = "shows images: --field is for messages, of foxglove://"
_NO_DISTANCES: Final = "shows no distances: input.range is for those of foxglove://"

_TIMEOUT: Final = 10.0
"""Seconds that opening a network stream may take."""


@dataclass(frozen=True, slots=True)
class CameraKind:
    """A kind of camera: how words KIND:ADDRESS are opened.

    Attributes:
        open: makes the camera of a word, KIND included, with the name of its stream; what it
            cannot open is a UsageError.
        takes: what `open` takes besides, by name: of the input options what it can heed ("range",
            "fields", "color"), and "say", to be told what the user should know, in a line.
        recipe: how what it shows becomes gray and small, for the record.
    """

    open: Callable[..., Camera]
    takes: tuple[str, ...] = ()
    recipe: str = RECIPE


def _foxglove(word: str, name: str, *, say: Callable[[str], None], **chosen: Any) -> Camera:
    from recorder.cameras.foxglove import FoxgloveCamera

    return FoxgloveCamera(word, name, timeout=_TIMEOUT, reading=InputOptions(**chosen), say=say)


def _video(word: str, name: str, *, color: bool = False) -> Camera:
    from recorder.cameras.video import VideoCamera

    return VideoCamera(word, name, timeout=_TIMEOUT, color=color)


CAMERAS: Registry[CameraKind] = Registry(
    "kind of camera",
    {
        "foxglove": CameraKind(_foxglove, ("range", "fields", "color", "say")),
        **{kind: CameraKind(_video, ("color",), VIDEO_RECIPE) for kind in _VIDEO},
    },
)
"""What cameras' words begin with."""


def is_live(word: str) -> bool:
    """Whether a word on the command line names a live stream.

    Raises:
        UsageError: it is the address of no host.
    """
    scheme = word.partition(":")[0].lower()
    if scheme in ("http", "https"):
        return _split(word).path.lower().endswith(_STREAMED)
    return ":" in word and (scheme == "gym" or scheme in CAMERAS)


def refuse_stored(words: Sequence[str], options: InputOptions) -> None:
    """Refuse words that name no live stream, and options that are of logs alone.

    Raises:
        UsageError: there is one.
    """
    if stored := [word for word in words if not is_live(word)]:
        raise UsageError(
            f"{stored[0]} is no live stream, as the others are: record these, and name recordings "
            "and logs apart"
        )
    if of_logs := options.named(("topics", "start", "end", "align", "centre", "holdout")):
        raise UsageError(f"{words[0]} is a live stream: {are_for(of_logs, 'logs')}")


def open_live(
    words: Sequence[str],
    options: InputOptions,
    *,
    seed: int = 0,
    say: Callable[[str], None] = lambda line: None,
) -> FrameSource:
    """Open live streams on one clock.

    Args:
        words: a stream each.
        options: see there.
        seed: of simulated tasks.
        say: told in a line when a camera's state changes.

    Raises:
        UsageError: a word names nothing, a package is missing, or a camera cannot be opened.
    """
    from recorder.cameras.live import LiveSource
    from recorder.cameras.readers import CameraFrames, Readers

    names = live_names(words)
    schemes = [word.partition(":")[0].lower() for word in words]
    if "gym" in schemes:
        return _simulated(words, names, options, seed)
    kinds = [CAMERAS[scheme] for scheme in schemes]
    _refuse_inapplicable(words, [kind.takes for kind in kinds], options)
    told = {"range": options.range, "fields": options.fields, "color": options.color, "say": say}
    cameras = [
        kind.open(word, name, **{key: told[key] for key in kind.takes})
        for kind, word, name in zip(kinds, words, names, strict=True)
    ]
    about: dict[str, Any] = {
        "cameras": [dict(camera.describe()) for camera in cameras],
        "recipe": "; ".join(dict.fromkeys(kind.recipe for kind in kinds)),
        "fit": options.fit,
    }
    if options.fields:
        about |= {"recipe": NUMBERS_RECIPE, "fields": list(options.fields)}
    if options.color:
        about["recipe"] = COLOR_RECIPE
    if options.range is not None:
        about["range_metres"] = list(options.range)
    frames = CameraFrames(names, options.size, options.fit, color=bool(options.color), say=say)
    readers = Readers(cameras, frames.frame, on_loss=options.lost, stall=options.stall, say=say)
    source = LiveSource(readers, names, about, rate=options.rate, hold=options.hold)
    may_show = [
        "range" in kind.takes and getattr(camera, "distances", None) is not False
        for kind, camera in zip(kinds, cameras, strict=True)
    ]
    if options.range is not None and not any(may_show):
        source.close()
        raise UsageError(f"{words[0]} shows no distances (16UC1, 32FC1): input.range is for these")
    return source


def _refuse_inapplicable(
    words: Sequence[str], takes: Sequence[Sequence[str]], options: InputOptions
) -> None:
    """Refuse options that do not apply to the named streams, given what each takes."""
    if options.color == "auto":
        raise UsageError(f"{words[0]} is a live stream: --color auto is for logs, give on or off")
    for word, taken in zip(words, takes, strict=True):
        if options.fields and "fields" not in taken:
            raise UsageError(f"{word} {_NO_FIELDS}")
        if options.color and "color" not in taken:
            raise UsageError(f"{word} shows gray images: leave out --color")
    if options.range is not None and not any("range" in taken for taken in takes):
        raise UsageError(f"{words[0]} {_NO_DISTANCES}")


def _simulated(
    words: Sequence[str], names: Sequence[str], options: InputOptions, seed: int
) -> FrameSource:
    """Simulated tasks on one clock."""
    from recorder.cameras.stepped import GymSource

    if any(word.partition(":")[0].lower() != "gym" for word in words):
        raise UsageError(
            "gym: is simulated as fast as it is watched, and cameras are not: record each apart"
        )
    _refuse_inapplicable(words, [("color",)] * len(words), options)
    return GymSource(
        [word.partition(":")[2] for word in words],
        names=names,
        size=options.size,
        fit=options.fit,
        fps=options.rate,
        seed=seed,
        color=bool(options.color),
    )


def live_names(words: Sequence[str]) -> tuple[str, ...]:
    """A name for each stream, that can be one of a file: rtsp://host/left is left."""
    return stream_names([_stream_of(word) for word in words])


def _stream_of(word: str) -> str:
    """The part of a word that names its stream."""
    scheme, _, rest = word.partition(":")
    place = _split(word)
    if scheme == "foxglove":
        return unquote(place.path)
    if place.netloc:
        last = place.path.rstrip("/").rpartition("/")[2].rpartition(".")[0] or place.path
        return unquote(last.strip("/")) or place.netloc.rpartition("@")[2]
    return re.sub(r"\.\w{2,4}$", "", re.split(r"[=,]", rest)[0].rpartition("/")[2])


def _split(word: str) -> SplitResult:
    try:
        return urlsplit(word)
    except ValueError as error:
        shown = re.sub(r"(?<=://)[^/@]*@", "", word)
        raise UsageError(f"{shown} names no host: {error}") from None
