"""Configuration of the iCub scene (keys `scene.*`).

Lengths are metres and angles degrees. Positions of objects are in the paper's
coordinates: x to the robot's back, y to its left.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import ClassVar, Literal

from cdmisfa.core.config import Section, key
from cdmisfa.core.errors import UsageError
from recorder.config import SceneConfig, check_view_names
from recorder.world.icub.head import ROAM

Range = tuple[float, float]


def place(low: float, high: float) -> Range:
    """Declare a key of the least and the largest coordinate of an object, both within 1 km."""
    default: Range = key((low, high), -1e3, 1e3, rising=True)
    return default


# Corners of the table of a furnished room, and of that which pictures from outside show: the plain
# one fills every eye image, and would hide the robot's legs. Root frame, metres.
TABLE_FROM, TABLE_TO = (-0.95, -0.75), (-0.3, 0.75)


@dataclass(frozen=True, slots=True)
class TableConfig(Section):
    """The plain table top; wide enough to fill every eye image (keys `scene.table.*`).

    Attributes:
        top: height of the table's surface in the root frame of the robot (m).
        half_size: distance from the middle of the table to each side (m).
        thickness: thickness of the table top (m).
        colour: red, green and blue of the table, each from 0 to 1.
    """

    prefix: ClassVar[str] = "scene.table"
    top: float = -0.05
    half_size: float = key(2.0, 0, above=True)
    thickness: float = key(0.03, 0, above=True)
    colour: tuple[float, float, float] = key((0.55, 0.5, 0.45), 0, 1)


@dataclass(frozen=True, slots=True)
class EyesConfig(Section):
    """The head and its two parallel eyes (keys `scene.eyes.*`).

    The eyes' places are iKin's for iCub v2.5, relative to the neck yaw joint. The angles are those
    of joints: `yaw` and `pitch` of the neck, to the left and upwards, and `tilt` of the eyes.

    Attributes:
        views: names of the views.
        yaw: angle of the neck to the left in each view (degrees).
        tilt: angle of the eyes upwards (degrees).
        vertical_fov: vertical field of view of an eye (degrees).
        width: width of the image of one eye (pixels). A frame shows both eyes side by side.
        height: height of the image (pixels).
        forward: distance of the eyes in front of the neck yaw joint (m).
        up: height of the eyes above the neck yaw joint (m).
        half_distance: half the distance between the eyes (m).
        near: smallest distance at which bodies are drawn (m).
        far: largest distance at which bodies are drawn (m).
        light: direction to the light as x, y, z; not all zero.
        pitch: angle of the neck upwards (degrees).
    """

    prefix: ClassVar[str] = "scene.eyes"
    views: tuple[str, ...] = ("left", "center", "right")
    yaw: tuple[float, ...] = (45.0, 0.0, -45.0)
    tilt: float = key(-34.0, -89, 89)
    vertical_fov: float = key(38.0, 1, 170)
    width: int = key(64, 1, 4096)
    height: int = key(48, 1, 4096)
    forward: float = 0.0509
    up: float = 0.08205
    half_distance: float = key(0.034, 0, above=True)
    near: float = key(0.1, 0, above=True)
    far: float = key(5.0, "near", above=True)
    light: tuple[float, float, float] = (-0.3, 0.2, 1.0)
    pitch: float = key(0.0, -89, 89, unstated=True)

    def __post_init__(self) -> None:
        Section.__post_init__(self)
        if len(self.views) != len(self.yaw):
            raise UsageError(
                f"scene.eyes.yaw has {len(self.yaw)} angles for the {len(self.views)} views of "
                "scene.eyes.views: give one for each"
            )
        check_view_names(self.views, "scene.eyes.views")


@dataclass(frozen=True, slots=True)
class BoxConfig(Section):
    """Object 1: a box, x uniform, y toggling between two places (keys `scene.object1.*`).

    Attributes:
        half_size: half the length of an edge of the box (m).
        grey: gray level of the box, from 0 (black) to 1 (white).
        x: range of x (m).
        y: the two values of y (m).
        toggle_every: number of frames between two changes of y.
    """

    prefix: ClassVar[str] = "scene.object1"
    half_size: float = key(0.05, 0, above=True)
    grey: float = key(0.1, 0, 1)
    x: Range = place(-0.6, -0.4)
    y: tuple[float, float] = (0.4, 0.6)
    toggle_every: int = key(10, 1)


@dataclass(frozen=True, slots=True)
class CylinderConfig(Section):
    """Object 2: a cylinder, x and y uniform (keys `scene.object2.*`).

    Attributes:
        radius: radius of the cylinder (m).
        height: height of the cylinder (m).
        grey: gray level of the cylinder, from 0 (black) to 1 (white).
        x: range of x (m).
        y: range of y (m).
    """

    prefix: ClassVar[str] = "scene.object2"
    radius: float = key(0.045, 0, above=True)
    height: float = key(0.09, 0, above=True)
    grey: float = key(0.25, 0, 1)
    x: Range = place(-0.8, -0.6)
    y: Range = place(-0.1, 0.1)


@dataclass(frozen=True, slots=True)
class SphereConfig(Section):
    """Object 3: a sphere on a reflecting walk, y slow against x (keys `scene.object3.*`).

    Attributes:
        radius: radius of the sphere (m).
        grey: gray level of the sphere, from 0 (black) to 1 (white).
        x: range of x (m).
        y: range of y (m).
        step_x: standard deviation of the step of x in a frame (m).
        step_y: standard deviation of the step of y in a frame (m).
    """

    prefix: ClassVar[str] = "scene.object3"
    radius: float = key(0.055, 0, above=True)
    grey: float = key(0.2, 0, 1)
    x: Range = place(-0.58, -0.42)
    y: Range = place(-0.58, -0.42)
    step_x: float = key(0.06, 0, 1e3)
    step_y: float = key(0.004, 0, 1e3)


@dataclass(frozen=True, slots=True)
class IcubConfig(SceneConfig):
    """The iCub scene (keys `scene.*`); the plain one, unless one of the last keys is set.

    Attributes:
        robot: name of a robot model in the package icub-models.
        room: whether the table has edges and legs, in a room with floor, walls and furniture.
        texture: whether surfaces show wood, tiles, plaster and paint instead of plain grays.
        shadow: share of the light that is missing in a shadow.
        arms: whether the arms of the robot rest on the table, where the eyes see them.
        blur: whether each pixel is blurred with its neighbours, by (1, 2, 1) / 4 in each direction.
        vignette: share of the light that is lost in the corners of an image.
        noise: standard deviation of the sensor noise at middle gray (gray levels).
        color: whether a frame shows red, green and blue side by side.
        physics: whether objects slide and roll to their next position instead of jumping there.
        transit: speed of the head in degrees a frame: frames are lost while it turns to another
            view. Below 0.1 the head jumps.
        roam: whether to add the view `roam`, of a head that looks at each of the other views in
            random order and turns from one to the next.
        drift: share by which the light gets brighter and darker over minutes.
        exposure: whether the eyes adapt to the light, so that all images of a view have the same
            mean brightness.
    """

    kind: Literal["icub"] = "icub"
    robot: str = "iCubGazeboV2_5"
    eyes: EyesConfig = field(default_factory=EyesConfig)
    table: TableConfig = field(default_factory=TableConfig)
    object1: BoxConfig = field(default_factory=BoxConfig)
    object2: CylinderConfig = field(default_factory=CylinderConfig)
    object3: SphereConfig = field(default_factory=SphereConfig)
    room: bool = key(False, unstated=True)
    texture: bool = key(False, unstated=True)
    shadow: float = key(0.0, 0, 1, unstated=True)
    arms: bool = key(False, unstated=True)
    blur: bool = key(False, unstated=True)
    vignette: float = key(0.0, 0, 1, unstated=True)
    noise: float = key(0.0, 0, 64, unstated=True)
    color: bool = key(False, unstated=True)
    physics: bool = key(False, unstated=True)
    transit: float = key(0.0, 0, 360, unstated=True)
    roam: bool = key(False, unstated=True)
    drift: float = key(0.0, 0, 1, unstated=True)
    exposure: bool = key(False, unstated=True)

    def __post_init__(self) -> None:
        SceneConfig.__post_init__(self)
        check_view_names(self.views, "scene.eyes.views")  # with `roam`

    @property
    def plain(self) -> bool:
        """Whether the scene has nothing but objects over one endless table."""
        return all(
            getattr(self, f.name) == f.default
            for f in fields(self)
            if f.metadata.get("unstated") and f.name != "transit"
        )

    @property
    def views(self) -> tuple[str, ...]:
        """Names of all views."""
        return (*self.eyes.views, ROAM) if self.roam else self.eyes.views
