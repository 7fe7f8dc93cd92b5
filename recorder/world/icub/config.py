"""What the iCub scene can be told (keys `scene.*`).

Lengths are metres and angles degrees. Positions of objects are in the paper's
coordinates: x to the robot's back, y to its left.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

from cdmisfa.core.config import in_range, positive
from cdmisfa.core.errors import UsageError
from recorder.config import SceneConfig, check_view_names
from recorder.world.icub.head import ROAM, SLOWEST_TURN

Range = tuple[float, float]

TABLE_FROM, TABLE_TO = (-0.95, -0.75), (-0.3, 0.75)
"""Corners of the table of a furnished room, and of that which pictures from outside show: the plain
one fills every eye image, and would hide the robot's legs. Root frame, metres."""


def later(default: Any) -> Any:
    """Field of a key that the plain scene does not state."""
    return field(default=default, metadata={"unsaid": True})


@dataclass(frozen=True, slots=True)
class TableConfig:
    """The plain table top; wide enough to fill every eye image (keys `scene.table.*`).

    Attributes:
        top: height of its surface in the root frame (m).
        half_size: from its middle to each side (m).
        thickness: of the top (m).
        colour: red, green and blue, 0 to 1.
    """

    top: float = -0.05
    half_size: float = 2.0
    thickness: float = 0.03
    colour: tuple[float, float, float] = (0.55, 0.5, 0.45)

    def __post_init__(self) -> None:
        positive(self, "scene.table", "half_size", "thickness")
        if not all(0 <= part <= 1 for part in self.colour):
            raise UsageError(f"scene.table.colour is {self.colour}: each part must be in [0, 1]")


@dataclass(frozen=True, slots=True)
class EyesConfig:
    """The head and its two parallel eyes (keys `scene.eyes.*`).

    The eyes' places are iKin's for iCub v2.5, relative to the neck yaw joint. The angles are those
    of joints: `yaw` and `pitch` of the neck, to the left and upwards, and `tilt` of the eyes.

    Attributes:
        views: their names.
        yaw: where the head is turned in each (degrees).
        tilt: of the eyes (degrees).
        vertical_fov: field of view (degrees).
        width: of what one eye sees (pixels); the frame shows both, side by side.
        height: the same (pixels).
        forward: of the eyes before the joint (m).
        up: of the eyes above it (m).
        half_distance: of the eyes from their middle (m).
        near: what is nearer is not seen (m).
        far: what is farther is not seen (m).
        light: the direction that it comes from.
        pitch: of the neck (degrees).
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
    pitch: float = later(0.0)

    def __post_init__(self) -> None:
        positive(self, "scene.eyes", "near", "far", "half_distance")
        in_range(self, "scene.eyes", 1.0, 170.0, "vertical_fov")
        in_range(self, "scene.eyes", -89.0, 89.0, "tilt", "pitch")
        in_range(self, "scene.eyes", 1, 4096, "width", "height")
        if len(self.views) != len(self.yaw):
            raise UsageError(
                f"scene.eyes.yaw has {len(self.yaw)} angles for the {len(self.views)} views of "
                "scene.eyes.views: give one for each"
            )
        check_view_names(self.views, "scene.eyes.views")
        if self.near >= self.far:
            raise UsageError(f"scene.eyes.near is {self.near}: it must be below scene.eyes.far")
        if not any(self.light):
            raise UsageError("scene.eyes.light is zero: it must be a direction")


@dataclass(frozen=True, slots=True)
class BoxConfig:
    """Object 1: a box, x uniform, y toggling between two places (keys `scene.object1.*`).

    Attributes:
        half_size: half the length of its edges (m).
        grey: 0 black, 1 white.
        x: from and to (m).
        y: its two places (m).
        toggle_every: frames between changes of place.
    """

    half_size: float = 0.05
    grey: float = 0.1
    x: Range = (-0.6, -0.4)
    y: Range = (0.4, 0.6)
    toggle_every: int = 10

    def __post_init__(self) -> None:
        positive(self, "scene.object1", "half_size", "toggle_every")
        in_range(self, "scene.object1", 0.0, 1.0, "grey")
        _range("scene.object1.x", self.x)


@dataclass(frozen=True, slots=True)
class CylinderConfig:
    """Object 2: a cylinder, x and y uniform (keys `scene.object2.*`).

    Attributes:
        radius: (m).
        height: (m).
        grey: 0 black, 1 white.
        x: from and to (m).
        y: from and to (m).
    """

    radius: float = 0.045
    height: float = 0.09
    grey: float = 0.25
    x: Range = (-0.8, -0.6)
    y: Range = (-0.1, 0.1)

    def __post_init__(self) -> None:
        positive(self, "scene.object2", "radius", "height")
        in_range(self, "scene.object2", 0.0, 1.0, "grey")
        _range("scene.object2.x", self.x)
        _range("scene.object2.y", self.y)


@dataclass(frozen=True, slots=True)
class SphereConfig:
    """Object 3: a sphere on a reflecting walk, y slow against x (keys `scene.object3.*`).

    Attributes:
        radius: (m).
        grey: 0 black, 1 white.
        x: from and to (m).
        y: from and to (m).
        step_x: standard deviation of a step of x, one a frame (m).
        step_y: the same of y (m).
    """

    radius: float = 0.055
    grey: float = 0.2
    x: Range = (-0.58, -0.42)
    y: Range = (-0.58, -0.42)
    step_x: float = 0.06
    step_y: float = 0.004

    def __post_init__(self) -> None:
        positive(self, "scene.object3", "radius")
        in_range(self, "scene.object3", 0.0, 1.0, "grey")
        in_range(self, "scene.object3", 0.0, 1e3, "step_x", "step_y")
        _range("scene.object3.x", self.x)
        _range("scene.object3.y", self.y)


@dataclass(frozen=True, slots=True)
class IcubConfig(SceneConfig):
    """The iCub scene (keys `scene.*`); the plain one, unless one of the last keys is set.

    Attributes:
        robot: a model of the icub-models package.
        room: the table has edges and legs, and stands in a room with floor, walls and furniture.
        texture: wood, tiles, plaster and painted objects instead of plain greys.
        shadow: share of the light that the lamp's shadow takes.
        arms: the robot's arms rest on the table, and are in its sight.
        blur: of a pixel over its neighbours, (1, 2, 1) / 4 each way.
        vignette: share of the light that is lost in the corners of an image.
        noise: of the sensor at middle grey, standard deviation in grey levels.
        color: a frame shows red, green and blue beside one another.
        physics: objects slide and roll after where they are to be, instead of being put there.
        transit: degrees that the head turns in a frame: who looks at another view loses the frames
            of the turn. 0 where it jumps.
        roam: another view, `roam`, is of a head that looks at one of the others for a while, then
            turns to the next.
        drift: share by which the light goes up and down, over minutes.
        exposure: the eyes adapt to the light: all images of a view are as bright in the mean.
    """

    kind: str = "icub"
    robot: str = "iCubGazeboV2_5"
    eyes: EyesConfig = field(default_factory=EyesConfig)
    table: TableConfig = field(default_factory=TableConfig)
    object1: BoxConfig = field(default_factory=BoxConfig)
    object2: CylinderConfig = field(default_factory=CylinderConfig)
    object3: SphereConfig = field(default_factory=SphereConfig)
    room: bool = later(False)
    texture: bool = later(False)
    shadow: float = later(0.0)
    arms: bool = later(False)
    blur: bool = later(False)
    vignette: float = later(0.0)
    noise: float = later(0.0)
    color: bool = later(False)
    physics: bool = later(False)
    transit: float = later(0.0)
    roam: bool = later(False)
    drift: float = later(0.0)
    exposure: bool = later(False)

    def __post_init__(self) -> None:
        SceneConfig.__post_init__(self)
        in_range(self, "scene", 0.0, 1.0, "shadow", "vignette", "drift")
        in_range(self, "scene", 0.0, 64.0, "noise")
        in_range(self, "scene", 0.0, 360.0, "transit")
        if 0 < self.transit < SLOWEST_TURN:
            raise UsageError(
                f"scene.transit is {self.transit}: 0, or {SLOWEST_TURN} degrees a frame or more"
            )
        if self.roam and ROAM in self.eyes.views:
            raise UsageError(f"scene.eyes.views has a {ROAM}, as scene.roam would: rename it")

    @property
    def plain(self) -> bool:
        """Whether objects over one endless table are all that there is to be drawn."""
        return all(
            getattr(self, f.name) == f.default
            for f in fields(self)
            if f.metadata and f.name != "transit"
        )

    @property
    def views(self) -> tuple[str, ...]:
        """Names of all views."""
        return (*self.eyes.views, ROAM) if self.roam else self.eyes.views


def _range(key: str, limits: Range) -> None:
    if not -1e3 <= limits[0] <= limits[1] <= 1e3:
        raise UsageError(f"{key} is {limits}: give the lower limit first, both within 1 km")
