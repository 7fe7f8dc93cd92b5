"""Manifest of a recording: the metadata of each view's file, and the arguments of its start.

The file RECORDING has the arguments until every view is finished, for --resume.
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

# Limits of the values in a file, far above those of any recording, so that a damaged file cannot
# take all memory.
MAX_FRAME_VALUES: Final = 64 * 1024 * 1024
MAX_STREAMS: Final = 100_000
MAX_FRAMES: Final = 2**33

# Largest number of streams that every file of a recording names. With more, each file names only
# its own stream, because the total size of the names grows with the square of their number.
MAX_NAMED: Final = 100

# Packages whose versions every file states.
PACKAGES: Final = ("cdmisfa", "numpy", "zstandard")

# Prefix of the keys that state the versions of packages.
_VERSION = "version_"

# Keys that a file has only if they are not the default.
_OPTIONAL = ("gaps", "stream_count")


@dataclass(frozen=True, slots=True)
class RecordingStart:
    """The arguments with which a recording was started.

    Attributes:
        scene: name of the recorded source; "" if unknown.
        seed: seed of the scene's motions.
        frames: number of frames that each unfinished view will have.
        split: length of a part of each unfinished view that is split (s).
    """

    scene: str = ""
    seed: int | None = None
    frames: Mapping[str, int] = field(default_factory=dict)
    split: Mapping[str, float] = field(default_factory=dict)


def read_start(folder: Path) -> RecordingStart:
    """Return the arguments of an unfinished recording; empty ones if RECORDING is damaged.

    Raises:
        UsageError: the file is too large.
        LogDamagedError: the disk cannot read it.
    """
    path = folder / RECORDING
    data = read_regular(path, MAX_JSON) if path.is_file() else b""
    try:
        values = parse_json(data)
        frames = {str(v): n for v, n in values["frames"].items() if type(n) is int and n > 0}
        split = {str(v): float(limit) for v, limit in values["split"].items()}
        scene, seed = str(values["scene"]), values["seed"]
    except (ValueError, KeyError, TypeError, AttributeError):
        return RecordingStart()
    if not frames:
        return RecordingStart()
    valid = type(seed) is int and 0 <= seed < 2**63
    return RecordingStart(scene, seed if valid else None, frames, split)


def store_start(folder: Path, views: Sequence[str], start: RecordingStart | None = None) -> None:
    """Store the arguments of views that are started; remove those of finished views.

    Args:
        folder: folder of the recording.
        views: names of the views.
        start: the arguments; None: the views are finished.

    Raises:
        LogWriteError: the file cannot be written.
    """
    before = read_start(folder)
    start = start or dataclasses.replace(before, frames={}, split={})
    frames = {v: n for v, n in before.frames.items() if v not in views} | dict(start.frames)
    split = {v: limit for v, limit in before.split.items() if v not in views} | dict(start.split)
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
    """Metadata record of a view's file; each attribute is a key.

    Attributes:
        scene: name of the recorded source.
        view: name of the stream.
        stream_index: index of the stream in the recording, from 0.
        streams: names of all streams; empty for more than `MAX_NAMED`.
        frame_shape: (height, width) or (I,).
        dtype: "uint8" or "float64".
        truth: name of each column of ground truth.
        fps: frames a second.
        start_ns: log time of frame 0 (ns).
        first_frame: number of the file's first frame.
        seed: seed of the scene's motions.
        config_sha256: SHA-256 of the attached configuration.
        gaps: True if frames can be missing, because a live stream did not deliver them.
        stream_count: number of streams if they are not named, else 0.
        versions: versions of packages on which the bytes can depend; each is a key too.
        values: the record as it was read from the file.
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
        """Properties of the file's view as a source, without a length."""
        return SourceSpec(
            (self.view,), self.frame_shape, self.dtype, self.truth, self.fps, self.start_ns
        )

    def times(self, frames: NDArray[np.int64]) -> NDArray[np.uint64]:
        """Return the log times of frames, (n,) ns, as `SourceSpec.time_ns` does."""
        return times_of(frames, self.fps, self.start_ns).astype(np.uint64)

    def frames_at(self, times: NDArray[np.uint64]) -> NDArray[np.int64]:
        """Return the numbers of the frames nearest to log times (n,) (ns)."""
        return np.clip(nearest_frames(times, self.fps, self.start_ns), -1, MAX_FRAMES)

    def record(self) -> dict[str, str]:
        """Return the metadata record as texts."""
        omitted = ["versions", "values", *(n for n in _OPTIONAL if not getattr(self, n))]
        names = [f.name for f in dataclasses.fields(self) if f.name not in omitted]
        stated = {name: _text(getattr(self, name)) for name in names}
        return {"schema": str(SCHEMA_VERSION), **stated, **self.versions}

    @classmethod
    def parse(cls, path: object, values: Mapping[str, str]) -> ViewMetadata:
        """Parse and check a file's metadata record.

        Raises:
            LogDamagedError: a key that is needed to read the file is missing or not valid.
        """
        try:
            shape = tuple(map(int, values["frame_shape"].split("x")))
            stated = cls(
                scene=values.get("scene", ""),
                view=values["view"],
                stream_index=int(values["stream_index"]),
                streams=_names(values.get("streams", "")),
                frame_shape=shape,
                dtype=values["dtype"],
                truth=_names(values.get("truth", "")),
                fps=float(values["fps"]),
                start_ns=int(values["start_ns"]),
                first_frame=int(values.get("first_frame", "0")),
                seed=values.get("seed", ""),
                config_sha256=values.get("config_sha256", ""),
                gaps=values.get("gaps") == str(True),
                stream_count=int(values.get("stream_count", "0")),
                versions={key: v for key, v in values.items() if key.startswith(_VERSION)},
                values=dict(values),
            )
            possible = {
                "schema": values["schema"] == str(SCHEMA_VERSION),
                "view": stated.view != "",
                "stream_index": 0 <= stated.stream_index <= MAX_STREAMS,
                "frame_shape": min(shape) > 0 and math.prod(shape) <= MAX_FRAME_VALUES,
                "dtype": (stated.dtype, len(shape)) in (("uint8", 2), ("float64", 1)),
                "truth": len(set(stated.truth)) == len(stated.truth)
                and all(name.isidentifier() for name in stated.truth),
                "fps": RECORDED_FPS[0] <= stated.fps <= RECORDED_FPS[1],
                "start_ns": 0 <= stated.start_ns <= 2**62,
                "first_frame": 0 <= stated.first_frame <= MAX_FRAMES,
                "stream_count": 0 <= stated.stream_count <= MAX_STREAMS,
            }
            if wrong := [key for key, right in possible.items() if not right]:
                raise ValueError(f"{wrong[0]} is {values[wrong[0]][:60]!r}")
        except (KeyError, ValueError) as error:
            raise LogDamagedError(f"{path}: its metadata is damaged ({error})") from None
        return stated


def _text(value: Any) -> str:
    """Return a value as a text of a metadata record."""
    if isinstance(value, tuple):
        between = "," if not value or isinstance(value[0], str) else "x"
        return between.join(map(str, value))
    return str(value)


def _names(text: str) -> tuple[str, ...]:
    return tuple(text.split(",")) if text else ()


@dataclass(frozen=True, slots=True)
class RecordingSpec:
    """Specification of a recording; all attempts at one recording have the same.

    Attributes:
        kind: name of the scene, or kind of the source.
        seed: seed of the scene's motions.
        spec: properties of the source; its streams are the views.
        config: configuration of the recording, as JSON values.
        packages: packages on whose versions the frames depend, in addition to `PACKAGES`.
        gaps: True if frames of streams can be missing.
    """

    kind: str
    seed: int
    spec: SourceSpec
    config: Mapping[str, Any]
    packages: tuple[str, ...] = ()
    gaps: bool = False

    def config_json(self) -> bytes:
        """Return the configuration as the bytes of the attachment."""
        return (json.dumps(self.config, indent=2, sort_keys=True) + "\n").encode()

    def metadata(self, view: str, first_frame: int = 0) -> ViewMetadata:
        """Return the metadata of a view's file that begins with a frame."""
        spec, named = self.spec, len(self.spec.streams) <= MAX_NAMED
        stream = spec.streams.index(view)
        shape, dtype = spec.kind(stream)
        return ViewMetadata(
            scene=self.kind,
            view=view,
            stream_index=stream,
            streams=spec.streams if named else (),
            frame_shape=shape,
            dtype=dtype,
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
    """Return the version of an installed package."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "unknown"
