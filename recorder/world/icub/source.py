"""The iCub scene as a `FrameSource`, what its two eyes see, and a picture of it from outside.

Only the watched view is rendered. The table never changes, so each eye draws it once; a frame
draws only the objects and puts them in front of that picture by depth: six times as fast.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import ByteArray, FloatArray
from cdmisfa.core.blocks import Block, ClockedSource, HeadPose, SourceSpec, check_request, freeze
from cdmisfa.core.config import section_table
from recorder.config import RecordConfig
from recorder.world.icub.config import EyesConfig, IcubConfig, TableConfig
from recorder.world.icub.world import Motions, World

if TYPE_CHECKING:
    from PIL import Image

TRUTH = tuple(f"object{i}_{axis}" for i in (1, 2, 3) for axis in "xy")
"""Columns of ground truth: the objects' positions in the paper's coordinates, metres."""

LUMA = (299, 587, 114)
"""Thousandths of red, green and blue in grey (ITU-R BT.601); whole numbers round exactly."""

Matrix = tuple[float, ...]


def eye_matrix(eyes: EyesConfig, neck: FloatArray, yaw: float, side: int) -> Matrix:
    """View matrix of an eye, column by column as OpenGL has it.

    Args:
        eyes: the head's measures.
        neck: (3,) origin of the neck yaw joint, root frame (x back, y right, z up).
        yaw: of the head, degrees to the left.
        side: +1 the left eye, -1 the right one.
    """
    turn, tilt = math.radians(yaw), math.radians(eyes.tilt)
    forward = np.array([-math.cos(turn), -math.sin(turn), 0.0])
    left = np.array([math.sin(turn), -math.cos(turn), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    place = neck + eyes.forward * forward + side * eyes.half_distance * left + eyes.up * up
    gaze = math.cos(tilt) * forward + math.sin(tilt) * up
    return look(place, place + gaze)


def look(place: FloatArray, target: FloatArray) -> Matrix:
    """View matrix of an upright camera at `place` that looks at `target`."""
    gaze = (target - place) / np.linalg.norm(target - place)
    right = np.cross(gaze, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, gaze)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, up, -gaze])
    matrix[:3, 3] = -matrix[:3, :3] @ place
    return tuple(matrix.T.ravel().tolist())


def perspective(vertical_fov: float, aspect: float, near: float, far: float) -> Matrix:
    """Projection matrix of a camera, column by column; degrees and metres."""
    scale = 1.0 / math.tan(math.radians(vertical_fov) / 2)
    depth = near - far
    columns = (
        (scale / aspect, 0.0, 0.0, 0.0),
        (0.0, scale, 0.0, 0.0),
        (0.0, 0.0, (near + far) / depth, -1.0),
        (0.0, 0.0, 2 * near * far / depth, 0.0),
    )
    return tuple(value for column in columns for value in column)


def grey(colours: ByteArray) -> ByteArray:
    """Colours, (..., 3 or 4), as grey, (...): BT.601, rounded."""
    red, green, blue = (colours[..., i].astype(np.uint32) for i in range(3))
    mixed = LUMA[0] * red + LUMA[1] * green + LUMA[2] * blue
    return ((mixed + 500) // 1000).astype(np.uint8)


class Eyes:
    """Renders what both eyes see in each view, side by side.

    Hides the world's table for good, since it is already in every eye's background.

    Args:
        eyes: the head's measures.
        world: before any object was placed, so that it shows the table alone.

    Attributes:
        shape: (height, width) of the joined image.
    """

    def __init__(self, eyes: EyesConfig, world: World) -> None:
        self._eyes, self._world = eyes, world
        self.shape = eyes.height, 2 * eyes.width
        aspect = eyes.width / eyes.height
        self._projection = perspective(eyes.vertical_fov, aspect, eyes.near, eyes.far)
        self._matrices = [
            [eye_matrix(eyes, world.neck, yaw, side) for side in (1, -1)] for yaw in eyes.yaw
        ]
        self._tables = [[self._draw_table(m) for m in view] for view in self._matrices]
        world.hide_table()

    def see(self, view: int, out: ByteArray) -> None:
        """Write what a view shows now into `out`, (height, width of both eyes)."""
        width = self._eyes.width
        for eye, matrix in enumerate(self._matrices[view]):
            colours, depth = self._draw(matrix)
            table, table_depth = self._tables[view][eye]
            half = out[:, eye * width : (eye + 1) * width]
            half[...] = table
            seen = np.nonzero(depth < table_depth)
            half[seen] = grey(colours[seen])

    def _draw_table(self, matrix: Matrix) -> tuple[ByteArray, NDArray[np.float32]]:
        """The grey picture and the depth of the table, to be drawn over."""
        colours, depth = self._draw(matrix)
        return grey(colours), depth.copy()

    def _draw(self, matrix: Matrix) -> tuple[ByteArray, NDArray[np.float32]]:
        eyes = self._eyes
        return self._world.render(matrix, self._projection, eyes.width, eyes.height, eyes.light)


class IcubSource(ClockedSource):
    """What the robot's eyes see in a scene, rendered when it is asked for, on a clock.

    Raises:
        CdmisfaError: the simulator is not installed.
        UsageError: a scene that cannot be built.
    """

    def __init__(self, scene: IcubConfig, record: RecordConfig) -> None:
        self._scene = scene
        self._seed = scene.seed or 0
        self._motions = Motions(scene, self._seed)
        self._world = World(scene)
        self._eyes = Eyes(scene.eyes, self._world)
        self._spec = SourceSpec(
            scene.eyes.views, self._eyes.shape, "uint8", TRUTH, record.fps, record.start_ns
        )

    @property
    def head_poses(self) -> Sequence[HeadPose]:
        """The head's pose in each view."""
        x, y, z = self._world.neck.tolist()
        halves = [math.radians(yaw) / 2 for yaw in self._scene.eyes.yaw]
        return [HeadPose((x, y, z), (0.0, 0.0, math.sin(h), math.cos(h))) for h in halves]

    def take(self, stream: int, n: int) -> Block:
        """Render the next n frames of a view; see `FrameSource.take`."""
        check_request(self._spec, stream, n)
        positions = self._motions.positions(self._t, n)
        frames = np.empty((n, *self._spec.frame_shape), np.uint8)
        for frame, places in zip(frames, positions, strict=True):
            self._world.place(places)
            self._eyes.see(stream, frame)
        block = Block(stream, self._t, freeze(frames), freeze(positions.reshape(n, -1)))
        self._t += n
        return block

    def describe(self) -> Mapping[str, Any]:
        """The scene's seed and everything it was built from."""
        return {"kind": "icub", "seed": self._seed, "scene": section_table(self._scene)}

    def close(self) -> None:
        """End the simulator."""
        self._world.close()


SIZE = (960, 720)
"""Width and height of the picture, pixels."""

_SAMPLES = 2
_CAMERA = np.array([-1.15, -3.1, 0.85])
_TARGET = np.array([-0.36, 0.0, -0.16])
_FOV = 29.0
_LIGHT = (-0.6, -0.8, 1.4)
_FLOOR = -0.6
_TABLE_BACK, _TABLE_FRONT, _TABLE_SIDE, _HALF_THICKNESS = -0.3, -0.95, 0.75, 0.015


def scene_picture(scene: IcubConfig) -> Image.Image:
    """The iCub scene at its first frame, the head turned to the middle view.

    The table is drawn as large as the objects need, since the real one, which fills
    every eye image, would hide the robot's legs.

    Raises:
        CdmisfaError: the simulator is not installed.
    """
    from PIL import Image

    width, height = SIZE[0] * _SAMPLES, SIZE[1] * _SAMPLES
    with contextlib.closing(World(scene, robot_seen=True)) as world:
        _furnish(world, scene.table)
        world.place(Motions(scene, scene.seed or 0).positions(0, 1)[0])
        world.turn_head(scene.eyes.yaw[len(scene.eyes.yaw) // 2])
        colours, _ = world.render(
            look(_CAMERA, _TARGET),
            perspective(_FOV, width / height, 0.1, 20.0),
            width,
            height,
            _LIGHT,
        )
    return Image.fromarray(colours[..., :3]).resize(SIZE, Image.Resampling.LANCZOS)


def _furnish(world: World, table: TableConfig) -> None:
    """A floor and a table with legs in place of the endless table top."""
    world.hide_table()
    centre = (_TABLE_BACK + _TABLE_FRONT) / 2
    depth = (_TABLE_BACK - _TABLE_FRONT) / 2
    middle = table.top - _HALF_THICKNESS
    world.add_box((centre, 0.0, middle), (depth, _TABLE_SIDE, _HALF_THICKNESS), table.colour)
    length = (middle - _FLOOR) / 2
    for x in (_TABLE_BACK - 0.05, _TABLE_FRONT + 0.05):
        for y in (-_TABLE_SIDE + 0.05, _TABLE_SIDE - 0.05):
            world.add_box((x, y, _FLOOR + length), (0.02, 0.02, length), (0.35, 0.32, 0.3))
    world.add_box((0.0, 0.0, _FLOOR - 0.01), (12.0, 12.0, 0.01), (0.82, 0.84, 0.86))
