"""Live streams by the words that name them on the command line."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Any, Final
from urllib.parse import unquote

from cdmisfa.core.blocks import FrameSource
from cdmisfa.core.errors import UsageError, are_for
from cdmisfa.core.names import stream_names
from recorder.images.options import COLOR_RECIPE, NUMBERS_RECIPE, InputOptions

# Endings of http addresses that are live streams; other addresses are logs.
_LIVE_ENDINGS: Final = (".mjpg", ".mjpeg", ".m3u8")


# Schemes of live streams; `FoxgloveCamera` opens the first, `VideoCamera` the others.
CAMERAS = ["foxglove", "camera", "av", "http", "https", "rtsp", "rtsps", "rtmp", "tcp", "udp"]


def is_live(word: str) -> bool:
    """Return whether a word on the command line names a live stream."""
    scheme, colon, rest = word.partition(":")
    if scheme.lower() in ("http", "https"):
        return re.split("[?#]", rest)[0].lower().endswith(_LIVE_ENDINGS)
    return bool(colon) and scheme.lower() in ("gym", *CAMERAS)


def open_live(
    words: Sequence[str],
    options: InputOptions,
    *,
    seed: int = 0,
    say: Callable[[str], None] = lambda line: None,
) -> FrameSource:
    """Open live streams on one clock.

    Args:
        words: one word for each stream.
        options: input options; those of logs are refused.
        seed: seed of simulated tasks.
        say: called with a line when the state of a camera changes.

    Raises:
        UsageError: a word does not name a live stream, an option is for other sources, a package is
            missing, or a camera cannot be opened.
    """
    from recorder.cameras.live import LiveSource
    from recorder.cameras.readers import CameraFrames, Readers

    if stored := [word for word in words if not is_live(word)]:
        raise UsageError(
            f"{stored[0]} is not a live stream, but other sources are: record these, and use "
            "recordings and logs separately"
        )
    of_logs = options.named(("topics", "start", "end", "align", "centre", "holdout"))
    of_logs += ["--color auto"] if options.color == "auto" else []
    if of_logs:
        raise UsageError(f"{words[0]} is a live stream: {are_for(of_logs, 'logs')}")
    schemes = [word.partition(":")[0].lower() for word in words]
    of_messages = options.named(("fields", "range"))
    if of_messages and "foxglove" not in schemes:
        refusal = are_for(of_messages, "logs and foxglove:// streams")
        raise UsageError(f"{words[0]} has images: {refusal}")
    names = live_names(words)
    color = options.color is True
    if "gym" in schemes:
        from recorder.cameras.stepped import GymSource

        if set(schemes) != {"gym"}:
            raise UsageError("gym: streams cannot be combined with cameras: record each separately")
        tasks = [word.partition(":")[2] for word in words]
        framing: dict[str, Any] = {"size": options.size, "fit": options.fit, "fps": options.rate}
        return GymSource(tasks, names=names, seed=seed, color=color, **framing)
    cameras = [_camera(word, name, options) for word, name in zip(words, names, strict=True)]
    about: dict[str, Any] = {
        "cameras": [dict(camera.describe()) for camera in cameras],
        "recipe": "; ".join(dict.fromkeys(camera.recipe for camera in cameras)),
        "fit": options.fit,
    }
    if options.fields:
        recipes = NUMBERS_RECIPE if len(words) == 1 else f"{about['recipe']}; {NUMBERS_RECIPE}"
        about |= {"recipe": recipes, "fields": list(options.fields)}
    if color:
        about["recipe"] = COLOR_RECIPE
    if options.range is not None:
        about["range_metres"] = list(options.range)
    frames = CameraFrames(names, options.size, options.fit, color=color, say=say)
    readers = Readers(cameras, frames.frame, on_loss=options.lost, stall=options.stall, say=say)
    return LiveSource(readers, names, about, rate=options.rate, hold=options.hold)


def _camera(word: str, name: str, options: InputOptions) -> Any:
    if not word.lower().startswith("foxglove:"):
        from recorder.cameras.video import VideoCamera

        return VideoCamera(word, name, color=options.color is True)
    from recorder.cameras.foxglove import FoxgloveCamera

    return FoxgloveCamera(*_host_and_path(word), name, options)


def live_names(words: Sequence[str]) -> tuple[str, ...]:
    """Return a name for each stream that can be a file name: rtsp://host/left becomes left."""
    return stream_names([_stream_of(word) for word in words])


def _stream_of(word: str) -> str:
    """Return the part of a word that names its stream."""
    scheme, _, rest = word.partition(":")
    host, path = _host_and_path(word)
    if scheme == "foxglove":
        return unquote(path)
    if host:
        last = path.rstrip("/").rpartition("/")[2].rpartition(".")[0] or path
        return unquote(last.strip("/")) or host.rpartition("@")[2]
    return re.sub(r"\.\w{2,4}$", "", re.split(r"[=,]", rest)[0].rpartition("/")[2])


def _host_and_path(word: str) -> tuple[str, str]:
    """Return host and path of SCHEME://HOST/PATH?QUERY; both empty for other words."""
    match = re.match(r"\w+://([^/?#]*)([^?#]*)", word)
    return (match[1], match[2]) if match else ("", "")
