"""Store the manifest of a recording: the metadata of each view's file, and RECORDING.

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

# Limits of what a file may state, far above any recording: a broken file must not take all memory.
MAX_FRAME_VALUES: Final = 64 * 1024 * 1024
MAX_STREAMS: Final = 100_000
MAX_FRAMES: Final = 2**33

# Streams that every file of a recording names; of more each names its own, so that all together do
# not grow with their square.
MOST_NAMED: Final = 100

# Packages whose versions every file states.
PACKAGES: Final = ("cdmisfa", "numpy", "zstandard")

_VERSION = "version_"

# Keys that a file has only if they are not their default, which most recordings have.
_AT_NEED = ("gaps", "stream_count")


@dataclass(frozen=True, slots=True)
class RecordingStart:
    """How a recording was started.

    Attributes:
        scene: name of what is recorded; "" if it is not known.
        seed: of the scene's motions.
        frames: number of frames that each unfinished view shall have.
        split: seconds of a part of each unfinished view that is split.
    """

    scene: str = ""
    seed: int | None = None
    frames: Mapping[str, int] = field(default_factory=dict)
    split: Mapping[str, float] = field(default_factory=dict)


def read_start(folder: Path) -> RecordingStart:
    """Read how an unfinished recording was started; a broken RECORDING says nothing.

    Raises:
        UsageError: the file is too large.
        LogDamagedError: the disk does not give it.
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
    known = type(seed) is int and 0 <= seed < 2**63
    return RecordingStart(scene, seed if known else None, frames, split)


def store_start(folder: Path, views: Sequence[str], start: RecordingStart | None = None) -> None:
    """Store how some views are started, or that they are finished, beside the others.

    Raises:
        LogWriteError: the disk does not take it.
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
        scene: name of what was recorded.
        view: name of the stream.
        stream_index: its place among the streams of the recording, from 0.
        streams: all of them; none if they are more than `MOST_NAMED`.
        frame_shape: (height, width) or (I,).
        dtype: "uint8" or "float64".
        truth: a name for each column of ground truth.
        fps: frames a second.
        start_ns: log time of frame 0.
        first_frame: number of the file's first frame.
        seed: of the scene's motions.
        config_sha256: checksum of the configuration that is attached.
        gaps: whether frames may be missing, because live streams had none to show.
        stream_count: number of streams if they are not named, else 0.
        versions: of packages that the bytes may depend on, each a key, too.
        values: the record as it is in the file that it was read from.
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
        """Specification of the file's view as a source, without a length."""
        return SourceSpec(
            (self.view,), self.frame_shape, self.dtype, self.truth, self.fps, self.start_ns
        )

    def times(self, frames: NDArray[np.int64]) -> NDArray[np.uint64]:
        """Return the log times of frames, (n,) nanoseconds, as `SourceSpec.time_ns` gives them."""
        return times_of(frames, self.fps, self.start_ns).astype(np.uint64)

    def frames_at(self, times: NDArray[np.uint64]) -> NDArray[np.int64]:
        """Return the frames nearest to log times, (n,) nanoseconds."""
        return np.clip(nearest_frames(times, self.fps, self.start_ns), -1, MAX_FRAMES)

    def record(self) -> dict[str, str]:
        """Return the file's metadata record."""
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
            raise LogDamagedError(
                f"{path}: its recording metadata is broken ({error}): record it again"
            ) from None
        return stated


def _text(value: Any) -> str:
    """Return a value as a metadata record has it."""
    if isinstance(value, tuple):
        between = "," if not value or isinstance(value[0], str) else "x"
        return between.join(map(str, value))
    return str(value)


def _names(text: str) -> tuple[str, ...]:
    return tuple(text.split(",")) if text else ()


@dataclass(frozen=True, slots=True)
class RecordingSpec:
    """Specification of a recording; attempts at one recording agree in it.

    Attributes:
        kind: name of what is recorded: a scene's, or the kind of a source.
        seed: of the scene's motions.
        spec: of its source, with the names of the views as its streams.
        config: its configuration, as JSON values.
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
        """Return the configuration as the attachment holds it."""
        return (json.dumps(self.config, indent=2, sort_keys=True) + "\n").encode()

    def metadata(self, view: str, first_frame: int = 0) -> ViewMetadata:
        """Return the metadata of the file of a view that begins with a frame."""
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
    """Return the version of an installed package."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "unknown"
