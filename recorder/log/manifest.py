"""The manifest of a recording: the metadata of each view's file, and RECORDING.

RECORDING holds the command that started a recording, stored for --resume.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.blocks import SourceSpec
from cdmisfa.core.clock import RECORDED_FPS, nearest_frames, times_of
from cdmisfa.core.errors import LogDamagedError
from cdmisfa.core.untrusted import MAX_JSON, parse_json, read_regular
from recorder.log.files import RECORDING, atomic_write, to_disk
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
class RecordingStart:
    """How a recording was started, as far as it says so.

    Attributes:
        scene: name of what is recorded; "" where that is not known.
        seed: of the scene's motions.
        frames: how many each unfinished view shall have.
        split: where the parts of each unfinished view end, as `Split.parse` reads it.
    """

    scene: str = ""
    seed: int | None = None
    frames: Mapping[str, int] = field(default_factory=dict)
    split: Mapping[str, str] = field(default_factory=dict)


def read_start(folder: Path) -> RecordingStart:
    """How an unfinished recording was started, as far as its folder readably says so.

    Raises:
        UsageError: its file is larger than any that says so.
        LogDamagedError: the disk does not give it.
    """
    path = folder / RECORDING
    data = read_regular(path, MAX_JSON) if path.is_file() else b""
    try:
        values = parse_json(data)
        frames = {str(v): n for v, n in values["frames"].items() if type(n) is int and n > 0}
        split = {v: limit for v, limit in values.get("split", {}).items() if isinstance(limit, str)}
        scene, seed = values.get("scene"), values.get("seed")
    except (ValueError, KeyError, TypeError, AttributeError):
        return RecordingStart()
    known = type(seed) is int and 0 <= seed < 2**63
    scene = scene if isinstance(scene, str) else ""
    return RecordingStart(scene, seed if known else None, frames, split)


def store_start(folder: Path, views: Sequence[str], start: RecordingStart | None = None) -> None:
    """Store how some views are started, or that they are finished, beside what the others are.

    Raises:
        LogWriteError: the disk does not take it.
    """
    known = read_start(folder)
    start = start or dataclasses.replace(known, frames={}, split={})
    frames = {v: n for v, n in known.frames.items() if v not in views} | dict(start.frames)
    split = {v: limit for v, limit in known.split.items() if v not in views} | dict(start.split)
    path = folder / RECORDING
    if not frames:
        path.unlink(missing_ok=True)
        to_disk(folder)
        return
    values = {"frames": frames, "split": split, "scene": start.scene, "seed": start.seed}
    with atomic_write(path) as partial:
        partial.write_text(json.dumps(values) + "\n", "utf-8")


@dataclass(frozen=True, slots=True)
class ViewMetadata:
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
        """Frames at log times, (n,) nanoseconds, or near those that are not exactly a frame's."""
        return np.clip(nearest_frames(times, self.fps, self.start_ns), -1, MAX_FRAMES)

    def record(self) -> dict[str, str]:
        """The file's metadata record."""
        others = ["versions", "values", *(n for n in _AT_NEED if not getattr(self, n))]
        names = [f.name for f in dataclasses.fields(self) if f.name not in others]
        stated = {name: _text(getattr(self, name)) for name in names}
        return {"schema": str(SCHEMA_VERSION), **stated, **self.versions}

    @classmethod
    def parse(cls, path: object, values: Mapping[str, str]) -> ViewMetadata:
        """Check a file's metadata record.

        Raises:
            LogDamagedError: a key that reading depends on is missing or makes no sense.
        """

        def demand(right: bool, key: str, remedy: str) -> None:
            if not right:
                value = values.get(key)
                said = "misses" if value is None else f"says {value[:60]!r} for"
                raise LogDamagedError(f"{path}: its recording metadata {said} {key}: {remedy}")

        def number(key: str, low: int, high: int, default: str = "") -> int:
            text = values.get(key, default)
            demand(_is_number(text, 19), key, "record it again")
            demand(low <= int(text) <= high, key, f"it must be in [{low}, {high}]")
            return int(text)

        version = f"this version reads schema {SCHEMA_VERSION}"
        demand(values.get("schema") == str(SCHEMA_VERSION), "schema", version)
        view = values.get("view", "")
        demand(view != "", "view", "record it again")
        sides = values.get("frame_shape", "").split("x")
        whole = len(sides) <= 2 and all(_is_number(side, 9) for side in sides)
        demand(whole, "frame_shape", "it must be as 48x128 or 2")
        shape, dtype = tuple(map(int, sides)), values.get("dtype", "")
        kinds = (("uint8", 2), ("float64", 1))
        remedy = "it must be uint8 for images, float64 for vectors"
        demand((dtype, len(shape)) in kinds, "dtype", remedy)
        most = MAX_FRAME_VALUES
        demand(0 < math.prod(shape) <= most, "frame_shape", "no frame has that size")
        try:
            fps = float(values.get("fps", ""))
        except ValueError:
            fps = math.nan
        slowest, fastest = RECORDED_FPS
        remedy = f"it must be in [{slowest:g}, {fastest:.0f}]"
        demand(slowest <= fps <= fastest, "fps", remedy)
        truth = _names(values.get("truth", ""))
        different = len(set(truth)) == len(truth) and all(n.isidentifier() for n in truth)
        demand(different, "truth", "they must be different names")
        return cls(
            scene=values.get("scene", ""),
            view=view,
            stream_index=number("stream_index", 0, MAX_STREAMS),
            streams=_names(values.get("streams", "")),
            frame_shape=shape,
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
class RecordingSpec:
    """What is recorded; attempts at one recording agree in it.

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

    def metadata(self, view: str, first_frame: int = 0) -> ViewMetadata:
        """What the file of a view that begins with a frame states."""
        spec, named = self.spec, len(self.spec.streams) <= MOST_NAMED
        return ViewMetadata(
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
    """A value as a metadata record has it."""
    if isinstance(value, tuple):
        between = "," if not value or isinstance(value[0], str) else "x"
        return between.join(map(str, value))
    return str(value)


def _names(text: str) -> tuple[str, ...]:
    return tuple(text.split(",")) if text else ()


def _is_number(text: str, most: int) -> bool:
    """Whether a text is a whole number of at most so many digits."""
    return text.isascii() and text.isdigit() and len(text) <= most
