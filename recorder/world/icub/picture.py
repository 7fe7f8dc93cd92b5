"""A picture of the scene from outside: robot, table and objects."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

import numpy as np

from recorder.world.icub.config import IcubConfig, TableConfig
from recorder.world.icub.eyes import look, perspective
from recorder.world.icub.motions import Motions
from recorder.world.icub.world import World

if TYPE_CHECKING:
    from PIL import Image

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
        world.place(Motions(scene, scene.seed or 0).take(1)[0])
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
