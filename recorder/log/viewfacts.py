"""What the file of a view states about itself: written and read by one class, `ViewFacts`."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import metadata
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.blocks import SourceSpec
from cdmisfa.core.clock import RECORDED_FPS, frames_of, times_of
from cdmisfa.core.errors import LogDamagedError
from recorder.log.messages import SCHEMA_VERSION

MAX_FRAME_VALUES: Final = 64 * 1024 * 1024
MAX_STREAMS: Final = 100_000
MAX_FRAMES: Final = 2**33

MOST_NAMED = 100
"""Streams that every file of a recording names; of more each names its own, so that all together
do not grow with their square."""

PACKAGES: Final = ("cdmisfa", "numpy", "zstandard")
"""Packages whose versions every file states."""

_VERSION = "version_"

_AT_NEED = ("gaps", "stream_count")
"""Keys that stand in a file only where they say something."""


@dataclass(frozen=True, slots=True)
class ViewFacts:
    """What a view's file states about itself; each is a key of its metadata record.

    Attributes:
        scene: name of what was recorded.
        view: name of the stream.
        stream_index: its place among the streams of the recording, from 0.
        streams: all of them; none where they are more than `MOST_NAMED`.
        frame_shape: (height, width) or (I,).
        dtype: "uint8" or "float64".
        truth: a name for each column of ground truth.
        fps: frames a second.
        start_ns: log time of frame 0.
        first_frame: number of the file's first frame.
        seed: of the scene's motions.
        config_sha256: checksum of the configuration that is attached.
        gaps: whether frames may be missing, of live streams that had none to show; a key only
            where they may.
        stream_count: how many streams there are where they are not named; a key only there.
        versions: of packages that the bytes may depend on, each a key, too.
        values: the record as it stands in the file, where it was read from one.
    """

    scene: str
    view: str
    stream_index: int
    streams: tuple[str, ...]
    frame_shape: tuple[int, ...]
    dtype: str
    truth: tuple[str, ...]
    fps: float
    start_ns: int
    first_frame: int
    seed: str
    config_sha256: str
    gaps: bool = False
    stream_count: int = 0
    versions: Mapping[str, str] = field(default_factory=dict)
    values: Mapping[str, str] = field(default_factory=dict, compare=False)

    @property
    def spec(self) -> SourceSpec:
        """What the file's view delivers, without a length."""
        return SourceSpec(
            (self.view,), self.frame_shape, self.dtype, self.truth, self.fps, self.start_ns
        )

    def times(self, frames: NDArray[np.int64]) -> NDArray[np.uint64]:
        """Log times of frames, (n,) nanoseconds, as `SourceSpec.time_ns` gives them."""
        return times_of(frames, self.fps, self.start_ns).astype(np.uint64)

    def frames_at(self, times: NDArray[np.uint64]) -> NDArray[np.int64]:
        """Frames at log times, (n,) nanoseconds.

        A time that is not exactly a frame's gets a frame near it.
        """
        return np.clip(frames_of(times, self.fps, self.start_ns), -1, MAX_FRAMES)

    def as_metadata(self) -> dict[str, str]:
        """The file's metadata record."""
        others = ["versions", "values", *(n for n in _AT_NEED if not getattr(self, n))]
        names = [f.name for f in dataclasses.fields(self) if f.name not in others]
        stated = {name: _text(getattr(self, name)) for name in names}
        return {"schema": str(SCHEMA_VERSION), **stated, **self.versions}

    @classmethod
    def from_metadata(cls, path: object, values: Mapping[str, str]) -> ViewFacts:
        """Check a file's metadata record.

        Raises:
            LogDamagedError: a key that reading depends on is missing or makes no sense.
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
        slowest, fastest = RECORDED_FPS
        if not slowest <= fps <= fastest:
            raise refuse("fps", f"it must be in [{slowest:g}, {fastest:.0f}]")
        truth = _names(values.get("truth", ""))
        if len(set(truth)) != len(truth) or not all(n.isidentifier() for n in truth):
            raise refuse("truth", "they must be different names")
        return cls(
            scene=values.get("scene", ""),
            view=view,
            stream_index=number("stream_index", 0, MAX_STREAMS),
            streams=_names(values.get("streams", "")),
            frame_shape=frame_shape,
            dtype=dtype,
            truth=truth,
            fps=fps,
            start_ns=number("start_ns", 0, 2**62),
            first_frame=number("first_frame", 0, MAX_FRAMES, "0"),
            seed=values.get("seed", ""),
            config_sha256=values.get("config_sha256", ""),
            gaps=values.get("gaps") == str(True),
            stream_count=number("stream_count", 0, MAX_STREAMS, "0"),
            versions={key: v for key, v in values.items() if key.startswith(_VERSION)},
            values=dict(values),
        )


@dataclass(frozen=True, slots=True)
class Identity:
    """What makes two recordings the same one.

    Attributes:
        kind: name of what is recorded: a scene's, or the kind of a source.
        seed: of the scene's motions.
        spec: what its source delivers, with the names of the views as its streams.
        config: what it was told, as JSON values.
        packages: whose versions the frames depend on, beside `PACKAGES`.
        gaps: whether streams may lack frames.
    """

    kind: str
    seed: int
    spec: SourceSpec
    config: Mapping[str, Any]
    packages: tuple[str, ...] = ()
    gaps: bool = False

    def config_json(self) -> bytes:
        """The configuration as the attachment holds it."""
        return (json.dumps(self.config, indent=2, sort_keys=True) + "\n").encode()

    def facts(self, view: str, first_frame: int = 0) -> ViewFacts:
        """What the file of a view that begins with a frame states."""
        spec, named = self.spec, len(self.spec.streams) <= MOST_NAMED
        return ViewFacts(
            scene=self.kind,
            view=view,
            stream_index=spec.streams.index(view),
            streams=spec.streams if named else (),
            frame_shape=spec.frame_shape,
            dtype=spec.dtype,
            truth=spec.truth,
            fps=float(spec.fps),
            start_ns=spec.start_ns,
            first_frame=first_frame,
            seed=str(self.seed),
            config_sha256=hashlib.sha256(self.config_json()).hexdigest(),
            gaps=self.gaps,
            stream_count=0 if named else len(spec.streams),
            versions={_VERSION + name: version(name) for name in (*PACKAGES, *self.packages)},
        )


@cache
def version(package: str) -> str:
    """Version of an installed package."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "unknown"


def _text(value: Any) -> str:
    """A fact as a metadata record has it."""
    if isinstance(value, tuple):
        between = "," if not value or isinstance(value[0], str) else "x"
        return between.join(map(str, value))
    return str(value)


def _names(text: str) -> tuple[str, ...]:
    return tuple(text.split(",")) if text else ()
