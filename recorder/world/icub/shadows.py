"""Shadows in the furnished room, from images that are rendered from the lamp, with soft edges."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray
from recorder.world.icub.eyes import FAR, Matrix, far_projection, metres, to_camera, view_matrix
from recorder.world.icub.room import Room
from recorder.world.icub.world import World

# Direction to the lamp in the root frame. These and the next constants are set by hand.
LAMP = (-0.45, -0.6, 1.0)

# Half the size of the lamp, as a share of its height; it determines how soft shadows are.
_WIDTH = 0.09

# Points of a lamp of half size 1.
_ROUND = [(i / 2, j / 2) for i in range(-2, 3) for j in range(-2, 3) if i * i + j * j <= 5]

# Pixels, half size (m) and centre (m) of the image of the room from the lamp.
_SIDE, _REACH, _MIDDLE = 1024, 2.6, (-0.5, 0.0, -0.3)

# Smallest distance from a body to its shadow, and width of a shadow's edge (m). The distance avoids
# that a surface shades itself because of rounding.
_SLACK, _BLUR = 0.02, 0.01


class RoomShadows:
    """Shadows of all bodies that never move, everywhere in the room.

    Args:
        world: the world without objects.
        room: the bodies.
        robot: True if the robot casts a shadow too.
    """

    def __init__(self, world: World, room: Room, *, robot: bool) -> None:
        casting = [i for i, piece in enumerate(room.pieces) if piece.casts]
        world.show_room(casting, robot=robot)
        middle = np.array(_MIDDLE)
        self._view = view_matrix(middle + np.array(LAMP) * (FAR / math.hypot(*LAMP)), middle)
        picture = far_projection(_REACH)
        _, depth = world.render(self._view, picture, _SIDE, _SIDE, LAMP)
        self._depth = metres(depth, picture)

    def hidden(self, places: FloatArray) -> FloatArray:
        """Return the share of the lamp's light that is hidden at points (3, ...)."""
        x, y, z = to_camera(self._view, places)
        x, y, depth = x * (-FAR / z), y * (-FAR / z), -z - _SLACK
        total = np.zeros(x.shape)
        for dx, dy in _ROUND:
            column = np.floor(((x + dx * _BLUR) / _REACH + 1) * (_SIDE / 2))
            row = np.floor((1 - (y + dy * _BLUR) / _REACH) * (_SIDE / 2))
            inside = (abs(column - _SIDE / 2) < _SIDE / 2) & (abs(row - _SIDE / 2) < _SIDE / 2)
            i, j = (np.where(inside, at, 0).astype(np.int64) for at in (row, column))
            total += inside & (self._depth[i, j] < depth)
        return np.asarray(total / len(_ROUND))


class ObjectShadow:
    """Shadow of an object on the table, the same at all positions.

    Args:
        world: the world without other bodies; the object is moved above the root's origin.
        number: index of the object.
        height: height of the table (m).
        reach: distance from the object up to which the shadow is drawn (m).
    """

    def __init__(self, world: World, number: int, height: float, reach: float) -> None:
        world.place(np.zeros((3, 2)))
        world.show_objects([number])
        self._size = 2 * math.ceil(reach / TEXEL)
        half = self._size * TEXEL / 2
        picture = far_projection(half)
        total = np.zeros((self._size, self._size))
        for dx, dy in _ROUND:
            lamp = LAMP[0] + dx * _WIDTH, LAMP[1] + dy * _WIDTH, LAMP[2]
            view = _flattened(lamp, height)
            total += world.render(view, picture, self._size, self._size, LAMP)[1] < _NOTHING
        self._share = np.pad((total / len(_ROUND))[::-1], 1).astype(np.float32)

    def hidden(
        self, rows: NDArray[np.float32], columns: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Return the share of the lamp's light that is hidden; offsets in units of `TEXEL`."""
        middle, last = np.float32(self._size / 2 + 1), np.float32(self._size + 1)
        i, j = (
            np.minimum(np.maximum(at + middle, np.float32(0)), last).astype(np.int32)
            for at in (rows, columns)
        )
        return np.asarray(self._share[i, j])


# Size of a pixel of an object's shadow (m).
TEXEL = 0.004

# Depth of a pixel without a body.
_NOTHING = np.float32(0.9999)


def _flattened(lamp: tuple[float, float, float], height: float) -> Matrix:
    """Return a view from `FAR` above a plane, onto which all points are moved along the light."""
    x, y = lamp[0] / lamp[2], lamp[1] / lamp[2]
    return (
        *(1.0, 0.0, 0.0, 0.0),
        *(0.0, 1.0, 0.0, 0.0),
        *(-x, -y, 0.0, 0.0),
        *(x * height, y * height, -FAR, 1.0),
    )
