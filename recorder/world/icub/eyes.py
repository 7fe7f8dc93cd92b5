"""Cameras as OpenGL matrices (column by column), and the images of the eyes in the plain scene.

Only the attended view is rendered. The table never changes: each eye draws it once, and a frame
draws only the objects and merges them with that image by depth, which is six times as fast.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import ByteArray, FloatArray
from recorder.world.icub.config import EyesConfig
from recorder.world.icub.head import bent
from recorder.world.icub.world import World

# Weights of red, green and blue in gray, in thousandths (ITU-R BT.601). Whole numbers round the
# same on every machine.
LUMA = (299, 587, 114)

Matrix = tuple[float, ...]


def eye_matrix(eyes: EyesConfig, neck: FloatArray, yaw: float, side: int) -> Matrix:
    """Return the view matrix of an eye.

    Args:
        eyes: dimensions of the head.
        neck: (3,) origin of the neck yaw joint at the head's pitch, in the root frame (x back,
            y right, z up; m).
        yaw: angle of the head (degrees to the left).
        side: +1 for the left eye, -1 for the right one.
    """
    turn, tilt = math.radians(yaw), math.radians(eyes.tilt)
    forward = bent((-math.cos(turn), -math.sin(turn), 0.0), eyes.pitch)
    left = bent((math.sin(turn), -math.cos(turn), 0.0), eyes.pitch)
    up = bent((0.0, 0.0, 1.0), eyes.pitch)
    place = neck + eyes.forward * forward + side * eyes.half_distance * left + eyes.up * up
    gaze = math.cos(tilt) * forward + math.sin(tilt) * up
    return view_matrix(place, place + gaze)


def view_matrix(place: FloatArray, target: FloatArray) -> Matrix:
    """Return the view matrix of an upright camera at `place` that looks at `target`."""
    gaze = (target - place) / np.linalg.norm(target - place)
    right = np.cross(gaze, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, gaze)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, up, -gaze])
    matrix[:3, 3] = -matrix[:3, :3] @ place
    return tuple(matrix.T.ravel().tolist())


def perspective(vertical_fov: float, aspect: float, near: float, far: float) -> Matrix:
    """Return the projection matrix of a camera; `vertical_fov` in degrees, distances in m."""
    scale = 1.0 / math.tan(math.radians(vertical_fov) / 2)
    return _projection(scale / aspect, scale, near, far)


def _projection(across: float, up: float, near: float, far: float) -> Matrix:
    depth = near - far
    return (
        *(across, 0.0, 0.0, 0.0),
        *(0.0, up, 0.0, 0.0),
        *(0.0, 0.0, (near + far) / depth, -1.0),
        *(0.0, 0.0, 2 * near * far / depth, 0.0),
    )


def grey(colours: ByteArray) -> ByteArray:
    """Convert colors (..., 3 or 4) to gray (...) by BT.601, rounded."""
    red, green, blue = (colours[..., i].astype(np.uint32) for i in range(3))
    mixed = LUMA[0] * red + LUMA[1] * green + LUMA[2] * blue
    return ((mixed + 500) // 1000).astype(np.uint8)


def far_projection(half: float) -> Matrix:
    """Return the projection of a camera `FAR` metres away with a field of `half` m to each side.

    It replaces a parallel projection, which the renderer does not have.
    """
    return _projection(FAR / half, FAR / half, FAR - 5.0, FAR + 5.0)


# Distance from which rays are practically parallel (m).
FAR = 100.0


def to_camera(view: Matrix, places: FloatArray) -> FloatArray:
    """Transform points (3, ...) from the root frame to a camera's: right, up, and backwards.

    It computes element by element, so that sums are the same on every processor.
    """
    x, y, z = places
    return np.stack(
        [view[i] * x + view[4 + i] * y + view[8 + i] * z + view[12 + i] for i in range(3)]
    )


def rays(
    view: Matrix, projection: Matrix, height: int, width: int
) -> tuple[FloatArray, FloatArray]:
    """Return the position of a camera, (3, 1, 1), and the rays of its pixels, in the root frame.

    A ray, (3, height, width), is the step for one metre of depth.
    """
    across = ((np.arange(width) + 0.5) / width * 2 - 1) / projection[0]
    up = (1 - (np.arange(height) + 0.5) / height * 2) / projection[5]
    x, y = np.broadcast_arrays(across[None, :], up[:, None])
    turn = [view[4 * k : 4 * k + 3] for k in range(3)]
    a, b, c = view[12:15]
    place = np.array([-(r * a + u * b + back * c) for r, u, back in turn])
    return place[:, None, None], np.stack([r * x + u * y - back for r, u, back in turn])


def metres(depth: NDArray[Any], projection: Matrix) -> FloatArray:
    """Convert a depth image, 0 to 1, to distances in front of a camera (m)."""
    return projection[14] / (2 * np.asarray(depth, np.float64) - 1 + projection[10])


class Eyes:
    """Renderer of the images of both eyes in each view, side by side.

    It hides the world's table, which is in the background of every eye already.

    Args:
        eyes: dimensions of the head.
        world: the world before any object was placed, so that only the table is visible.

    Attributes:
        shape: (height, width) of the joined image.
    """

    def __init__(self, eyes: EyesConfig, world: World) -> None:
        self._eyes, self._world = eyes, world
        self.shape = eyes.height, 2 * eyes.width
        aspect = eyes.width / eyes.height
        self._projection = perspective(eyes.vertical_fov, aspect, eyes.near, eyes.far)
        self._views = []
        for yaw in eyes.yaw:
            matrices = [eye_matrix(eyes, world.neck, yaw, side) for side in (1, -1)]
            drawn = map(self._draw, matrices)
            tables = [(grey(colours), depth.copy()) for colours, depth in drawn]
            self._views.append((matrices, tables))
        world.hide_table()

    def look(self, view: int, t: int, positions: FloatArray, yaw: Sequence[float]) -> ByteArray:
        """Render a view from frame t on.

        Args:
            view: index of the view.
            t: ignored: a plain scene depends only on the positions of the objects.
            positions: (n, objects, ...) positions of the objects, see `World.place`.
            yaw: ignored: in a plain scene the head does not turn within a view.

        Returns:
            (n, height, width of both eyes) gray levels.
        """
        del t, yaw
        frames = np.empty((len(positions), *self.shape), np.uint8)
        width = self._eyes.width
        for frame, places in zip(frames, positions, strict=True):
            self._world.place(places)
            for eye, (matrix, table) in enumerate(zip(*self._views[view], strict=True)):
                colours, depth = self._draw(matrix)
                half = frame[:, eye * width : (eye + 1) * width]
                half[...] = table[0]
                nearer = np.nonzero(depth < table[1])
                half[nearer] = grey(colours[nearer])
        return frames

    def _draw(self, matrix: Matrix) -> tuple[ByteArray, NDArray[np.float32]]:
        eyes = self._eyes
        return self._world.render(matrix, self._projection, eyes.width, eyes.height, eyes.light)
