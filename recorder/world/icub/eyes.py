"""The robot's two eyes: where they are, and the one grey image they give together.

The table never changes, so each eye draws it once; a frame draws only the objects
and puts them in front of that picture by depth. It is one rendering path for
everything, six times as fast as drawing the table again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.blocks import HeadPose
from recorder.world.icub.config import EyesConfig
from recorder.world.icub.world import World

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


def grey(colours: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Colours, (..., 3 or 4), as grey, (...): BT.601, rounded."""
    red, green, blue = (colours[..., i].astype(np.uint32) for i in range(3))
    mixed = LUMA[0] * red + LUMA[1] * green + LUMA[2] * blue
    return ((mixed + 500) // 1000).astype(np.uint8)


class Eyes:
    """Renders what both eyes see in each view, side by side.

    Hides the world's table for good, since it is already in every eye's background.
    """

    def __init__(self, eyes: EyesConfig, world: World) -> None:
        self._eyes = eyes
        self._world = world
        self._projection = perspective(
            eyes.vertical_fov, eyes.width / eyes.height, eyes.near, eyes.far
        )
        self._matrices = [
            [eye_matrix(eyes, world.neck, yaw, side) for side in (1, -1)] for yaw in eyes.yaw
        ]
        with world.only(table=True):
            self._background = [[self._plate(m) for m in view] for view in self._matrices]
        world.hide_table()

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) of the joined image."""
        return self._eyes.height, 2 * self._eyes.width

    def see(self, view: int, out: NDArray[np.uint8]) -> None:
        """Write what a view shows now into `out`, (height, width of both eyes)."""
        width = self._eyes.width
        for eye, matrix in enumerate(self._matrices[view]):
            colours, depth = self._draw(matrix)
            table, table_depth = self._background[view][eye]
            half = out[:, eye * width : (eye + 1) * width]
            half[...] = table
            seen = np.nonzero(depth < table_depth)
            half[seen] = grey(colours[seen])

    def poses(self) -> Sequence[HeadPose]:
        """The head's pose in each view."""
        x, y, z = self._world.neck.tolist()
        halves = [math.radians(yaw) / 2 for yaw in self._eyes.yaw]
        return [HeadPose((x, y, z), (0.0, 0.0, math.sin(h), math.cos(h))) for h in halves]

    def _plate(self, matrix: Matrix) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """The grey picture and the depth of the world as it is, to be drawn over."""
        colours, depth = self._draw(matrix)
        return grey(colours), depth.copy()

    def _draw(self, matrix: Matrix) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        eyes = self._eyes
        return self._world.render(matrix, self._projection, eyes.width, eyes.height, eyes.light)
