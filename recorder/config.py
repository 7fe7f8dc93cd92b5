"""What the worlds and the recorder can be told (keys `scene.*` and `record.*`).

Lengths are metres and angles degrees. Positions of objects are in the paper's
coordinates: x to the robot's back, y to its left.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final, Literal

from cdmisfa.core.clock import START_NS
from cdmisfa.core.config import as_table, positive, within
from cdmisfa.core.errors import UsageError

Range = tuple[float, float]


@dataclass(frozen=True, slots=True)
class TableConfig:
    """The plain table top; wide enough to fill every eye image (keys `scene.table.*`)."""

    top: float = -0.05
    half_size: float = 2.0
    thickness: float = 0.03
    colour: tuple[float, float, float] = (0.55, 0.5, 0.45)

    def __post_init__(self) -> None:
        positive(self, "scene.table", "half_size", "thickness")
        _colours("scene.table.colour", self.colour)


@dataclass(frozen=True, slots=True)
class EyesConfig:
    """The head and its two parallel eyes (keys `scene.eyes.*`).

    The eyes' places are iKin's for iCub v2.5, relative to the neck yaw joint.
    """

    views: tuple[str, ...] = ("left", "center", "right")
    yaw: tuple[float, ...] = (45.0, 0.0, -45.0)
    tilt: float = -34.0
    vertical_fov: float = 38.0
    width: int = 64
    height: int = 48
    forward: float = 0.0509
    up: float = 0.08205
    half_distance: float = 0.034
    near: float = 0.1
    far: float = 5.0
    light: tuple[float, float, float] = (-0.3, 0.2, 1.0)

    def __post_init__(self) -> None:
        positive(self, "scene.eyes", "near", "far", "half_distance")
        within(self, "scene.eyes", 1.0, 170.0, "vertical_fov")
        within(self, "scene.eyes", -89.0, 89.0, "tilt")
        within(self, "scene.eyes", 1, 4096, "width", "height")
        if len(self.views) != len(self.yaw) or not self.views:
            raise UsageError(
                f"scene.eyes.yaw has {len(self.yaw)} angles for the {len(self.views)} views of "
                "scene.eyes.views: give one for each"
            )
        view_names(self.views, "scene.eyes.views")
        if self.near >= self.far:
            raise UsageError(f"scene.eyes.near is {self.near}: it must be below scene.eyes.far")
        if not any(self.light):
            raise UsageError("scene.eyes.light is zero: it must be a direction")


@dataclass(frozen=True, slots=True)
class BoxConfig:
    """Object 1: a box, x uniform, y toggling between two places (keys `scene.object1.*`)."""

    half_size: float = 0.05
    grey: float = 0.1
    x: Range = (-0.6, -0.4)
    y: Range = (0.4, 0.6)
    toggle_every: int = 10

    def __post_init__(self) -> None:
        positive(self, "scene.object1", "half_size", "toggle_every")
        within(self, "scene.object1", 0.0, 1.0, "grey")
        _range("scene.object1.x", self.x)


@dataclass(frozen=True, slots=True)
class CylinderConfig:
    """Object 2: a cylinder, x and y uniform (keys `scene.object2.*`)."""

    radius: float = 0.045
    height: float = 0.09
    grey: float = 0.25
    x: Range = (-0.8, -0.6)
    y: Range = (-0.1, 0.1)

    def __post_init__(self) -> None:
        positive(self, "scene.object2", "radius", "height")
        within(self, "scene.object2", 0.0, 1.0, "grey")
        _range("scene.object2.x", self.x)
        _range("scene.object2.y", self.y)


@dataclass(frozen=True, slots=True)
class SphereConfig:
    """Object 3: a sphere on a reflecting walk, y slow against x (keys `scene.object3.*`)."""

    radius: float = 0.055
    grey: float = 0.2
    x: Range = (-0.58, -0.42)
    y: Range = (-0.58, -0.42)
    step_x: float = 0.06
    step_y: float = 0.004

    def __post_init__(self) -> None:
        positive(self, "scene.object3", "radius")
        within(self, "scene.object3", 0.0, 1.0, "grey")
        within(self, "scene.object3", 0.0, 1e3, "step_x", "step_y")
        _range("scene.object3.x", self.x)
        _range("scene.object3.y", self.y)


@dataclass(frozen=True, slots=True)
class SceneConfig:
    """The world (keys `scene.*`); all but `kind` and `streams` is about the iCub scene.

    Attributes:
        kind: which scene; `streams` belongs to the oscillatory one.
        seed: of the objects' motions; None is "as the run's seed".
        robot: a model of the icub-models package.
    """

    kind: Literal["icub", "oscillatory"] = "icub"
    seed: int | None = None
    streams: tuple[str, ...] = ("x1", "x2", "x3")
    robot: str = "iCubGazeboV2_5"
    eyes: EyesConfig = field(default_factory=EyesConfig)
    table: TableConfig = field(default_factory=TableConfig)
    object1: BoxConfig = field(default_factory=BoxConfig)
    object2: CylinderConfig = field(default_factory=CylinderConfig)
    object3: SphereConfig = field(default_factory=SphereConfig)

    def __post_init__(self) -> None:
        if self.seed is not None and self.seed < 0:
            raise UsageError(f"scene.seed is {self.seed}: it must be 0 or above")
        view_names(self.streams, "scene.streams")


SCENE_KEYS: Final = {
    "icub": ("kind", "seed", "robot", "eyes", "table", "object1", "object2", "object3"),
    "oscillatory": ("kind", "seed", "streams"),
}
"""The keys `scene.*` that mean something for a kind of scene."""


def scene_table(scene: SceneConfig) -> dict[str, Any]:
    """A scene as plain JSON values: the keys of its kind, and no others."""
    table = as_table(scene)
    return {key: table[key] for key in SCENE_KEYS[scene.kind]}


@dataclass(frozen=True, slots=True)
class RecordConfig:
    """How frames become a log (keys `record.*`).

    Attributes:
        fps: frames per second of the common clock.
        start_ns: log time of frame 0, in nanoseconds; never the wall clock, so that a
            recording is the same bytes every time.
        compression: of the chunks.
        chunk_size: most bytes of a chunk before compression.
    """

    fps: float = 50.0
    start_ns: int = START_NS
    compression: Literal["zstd", "lz4", "none"] = "zstd"
    chunk_size: int = 1024 * 1024

    def __post_init__(self) -> None:
        within(self, "record", 1e-3, 1e6, "fps")
        within(self, "record", 0, 2**62, "start_ns")
        within(self, "record", 1024, 2**28, "chunk_size")


def view_names(names: tuple[str, ...], key: str) -> None:
    """Refuse names of views that could not be told apart, or not be names of files.

    Raises:
        UsageError: at the first such name.
    """
    if not names:
        raise UsageError(f"{key} is empty: name at least one")
    if len(set(names)) != len(names):
        raise UsageError(f"{key} names one twice: {', '.join(names)}")
    for name in names:
        if not (name.isidentifier() and name.isascii() and len(name) <= 64):
            raise UsageError(f"{key} has {name!r}: use letters, digits and _")


def _range(key: str, limits: Range) -> None:
    if not -1e3 <= limits[0] <= limits[1] <= 1e3:
        raise UsageError(f"{key} is {limits}: give the lower limit first, both within 1 km")


def _colours(key: str, parts: tuple[float, ...]) -> None:
    if not all(0 <= part <= 1 for part in parts):
        raise UsageError(f"{key} is {parts}: each part must be in [0, 1]")
