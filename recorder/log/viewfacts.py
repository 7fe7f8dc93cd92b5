"""What the file of a view states about itself, checked."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.clock import frames_of, times_of
from cdmisfa.core.errors import LogDamagedError
from recorder.log.messages import SCHEMA_VERSION

MAX_FRAME_VALUES: Final = 64 * 1024 * 1024
MAX_STREAMS: Final = 100_000
MAX_FRAMES: Final = 2**33


@dataclass(frozen=True, slots=True)
class ViewFacts:
    """What a view's file states about itself, checked.

    Attributes:
        view: name of the stream.
        stream_index: its place among the streams of the recording, from 0.
        frame_shape: (height, width) or (I,).
        dtype: "uint8" or "float64".
        truth: a name for each column of ground truth.
        fps: frames a second.
        start_ns: log time of frame 0.
        first_frame: number of the file's first frame.
        values: the metadata record as it stands there.
    """

    view: str
    stream_index: int
    frame_shape: tuple[int, ...]
    dtype: str
    truth: tuple[str, ...]
    fps: float
    start_ns: int
    first_frame: int
    values: Mapping[str, str]

    def times(self, frames: NDArray[np.int64]) -> NDArray[np.uint64]:
        """Log times of frames, as `SourceSpec.time_ns` gives them."""
        return times_of(frames, self.fps, self.start_ns).astype(np.uint64)

    def frames_at(self, times: NDArray[np.uint64]) -> NDArray[np.int64]:
        """Frames at log times; one that is not exactly a frame's gets a frame near it."""
        return np.clip(frames_of(times, self.fps, self.start_ns), -1, MAX_FRAMES)


def view_facts(path: object, values: Mapping[str, str]) -> ViewFacts:
    """Check a file's statement about itself.

    Raises:
        LogDamagedError: a key is missing or makes no sense.
    """

    def refuse(key: str, remedy: str) -> LogDamagedError:
        value = values.get(key)
        said = "misses" if value is None else f"says {value[:60]!r} for"
        return LogDamagedError(f"{path}: its recording metadata {said} {key}: {remedy}")

    def number(key: str, low: int, high: int, default: str | None = None) -> int:
        text = values.get(key, default)
        if text is None or not text.isascii() or not text.isdigit() or len(text) > 19:
            raise refuse(key, "record it again")
        if not low <= int(text) <= high:
            raise refuse(key, f"it must be in [{low}, {high}]")
        return int(text)

    if values.get("schema") != str(SCHEMA_VERSION):
        raise refuse("schema", f"this version reads schema {SCHEMA_VERSION}")
    view = values.get("view", "")
    if not view:
        raise refuse("view", "record it again")
    shape = values.get("frame_shape", "").split("x")
    if not 1 <= len(shape) <= 2 or not all(
        s.isascii() and s.isdigit() and len(s) < 10 for s in shape
    ):
        raise refuse("frame_shape", "it must be as 48x128 or 2")
    frame_shape = tuple(int(s) for s in shape)
    dtype = values.get("dtype", "")
    if (dtype, len(frame_shape)) not in (("uint8", 2), ("float64", 1)):
        raise refuse("dtype", "it must be uint8 for images, float64 for vectors")
    if not 0 < math.prod(frame_shape) <= MAX_FRAME_VALUES:
        raise refuse("frame_shape", "no frame has that size")
    try:
        fps = float(values.get("fps", ""))
    except ValueError:
        fps = math.nan
    if not 1e-3 <= fps <= 1e6:
        raise refuse("fps", "it must be in [0.001, 1000000]")
    names = values.get("truth", "")
    truth = tuple(names.split(",")) if names else ()
    if len(set(truth)) != len(truth) or not all(n.isidentifier() for n in truth):
        raise refuse("truth", "they must be different names")
    return ViewFacts(
        view,
        number("stream_index", 0, MAX_STREAMS),
        frame_shape,
        dtype,
        truth,
        fps,
        number("start_ns", 0, 2**62),
        number("first_frame", 0, MAX_FRAMES, "0"),
        dict(values),
    )
