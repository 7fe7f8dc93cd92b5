"""The iCub scene from outside, in colour."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

import numpy as np

from cdmisfa.core.arrays import ByteArray
from recorder.world.icub.config import TABLE_FROM, TABLE_TO, IcubConfig, TableConfig
from recorder.world.icub.furnished import LIGHTING, light_at, seen_at
from recorder.world.icub.matrices import Matrix, eye_matrix, look, perspective
from recorder.world.icub.room import room_of
from recorder.world.icub.shadows import LAMP, RoomShadows
from recorder.world.icub.world import Motions, World

if TYPE_CHECKING:
    from PIL import Image

SIZE = (960, 720)
"""Width and height of the picture from outside, pixels."""

_SAMPLES = 2
_TARGET = np.array([-0.36, 0.0, -0.16])
_CAMERA, _FOV = np.array([-1.15, -3.1, 0.85]), 29.0
_INSIDE, _WIDE = np.array([-1.8, -1.7, 0.72]), 45.0
_LIGHT = (-0.6, -0.8, 1.4)
_FLOOR = -0.6
_HALF_THICKNESS = 0.015


def scene_picture(scene: IcubConfig, size: tuple[int, int] = SIZE) -> Image.Image:
    """The iCub scene at its first frame, the head turned to the middle view.

    A furnished scene is drawn with what the left eye sees in each view, in colour, below it. The
    plain one's table is drawn as large as the objects need, since the real one, which fills
    every eye image, would hide the robot's legs.

    Args:
        scene: what stands where.
        size: width and height of the picture from outside, pixels.

    Raises:
        CdmisfaError: the simulator is not installed.
    """
    with contextlib.closing(World(scene, robot_seen=True)) as world:
        if scene.room:
            return _furnished(scene, world, size)
        _furnish(world, scene.table)
        world.place(Motions(scene, scene.seed or 0).positions(0, 1)[0])
        world.turn_head(scene.eyes.yaw[len(scene.eyes.yaw) // 2])
        width, height = size[0] * _SAMPLES, size[1] * _SAMPLES
        colours, _ = world.render(
            look(_CAMERA, _TARGET),
            perspective(_FOV, width / height, 0.1, 20.0),
            *(width, height, _LIGHT),
        )
    return _small(colours[..., :3], size)


def _furnished(scene: IcubConfig, world: World, size: tuple[int, int]) -> Image.Image:
    """The room, and what the left eye sees of it in each view."""
    from PIL import Image

    room, eyes = room_of(scene), scene.eyes
    world.furnish(room, arms=scene.arms)
    world.place(Motions(scene, scene.seed or 0).positions(0, 1)[0])
    shadows = RoomShadows(world, room, robot=True) if scene.shadow else None
    world.show_room(range(len(room.pieces)), robot=True)

    def drawn(view: Matrix, fov: float, far: float, size: tuple[int, int]) -> Image.Image:
        width, height = size[0] * _SAMPLES, size[1] * _SAMPLES
        projection = perspective(fov, width / height, 0.1, far)
        colours, depth = world.render(view, projection, width, height, LAMP, **LIGHTING)
        small = depth[::_SAMPLES, ::_SAMPLES]
        light = light_at(scene, *seen_at(view, projection, small, shadows))
        light = light.repeat(_SAMPLES, axis=0).repeat(_SAMPLES, axis=1)
        return _small(np.rint(colours[..., :3] * light[..., None]).astype(np.uint8), size)

    width = size[0] // len(eyes.yaw)
    below = width, width * eyes.height // eyes.width
    picture = Image.new("RGB", (size[0], size[1] + below[1]))
    for number, yaw in enumerate(eyes.yaw):
        world.turn_head(yaw)
        view = eye_matrix(eyes, world.neck, yaw, 1)
        picture.paste(drawn(view, eyes.vertical_fov, eyes.far, below), (number * width, size[1]))
    world.turn_head(eyes.yaw[len(eyes.yaw) // 2])
    picture.paste(drawn(look(_INSIDE, _TARGET), _WIDE, 20.0, size), (0, 0))
    return picture


def _small(colours: ByteArray, size: tuple[int, int]) -> Image.Image:
    from PIL import Image

    return Image.fromarray(colours).resize(size, Image.Resampling.LANCZOS)


def _furnish(world: World, table: TableConfig) -> None:
    """A floor and a table with legs in place of the endless table top."""
    world.hide_table()
    (back, left), (front, right) = TABLE_FROM, TABLE_TO
    middle = table.top - _HALF_THICKNESS
    centre = ((back + front) / 2, (left + right) / 2, middle)
    half = ((front - back) / 2, (right - left) / 2, _HALF_THICKNESS)
    world.add_box(centre, half, table.colour)
    length = (middle - _FLOOR) / 2
    for x in (front - 0.05, back + 0.05):
        for y in (left + 0.05, right - 0.05):
            world.add_box((x, y, _FLOOR + length), (0.02, 0.02, length), (0.35, 0.32, 0.3))
    world.add_box((0.0, 0.0, _FLOOR - 0.01), (12.0, 12.0, 0.01), (0.82, 0.84, 0.86))
