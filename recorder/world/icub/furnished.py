"""`FurnishedEyes`: images of the robot's eyes in a furnished room.

Everything that never moves (room, table, arms, their shadows) is a plate, an image that is drawn
once for each eye of a view. A frame draws only the objects and their shadows on the table into it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import ByteArray, FloatArray
from recorder.world.icub.config import IcubConfig
from recorder.world.icub.eyes import Matrix, eye_matrix, grey, metres, perspective, rays, to_camera
from recorder.world.icub.lens import SAMPLES, Lens
from recorder.world.icub.room import room_of
from recorder.world.icub.shadows import LAMP, TEXEL, ObjectShadow, RoomShadows
from recorder.world.icub.world import World

# Rays of a plate for each ray of a frame, along each side.
FINE = 2

# Shares of ambient, diffuse and mirrored light. These and the next constants are set by hand, for a
# room that looks like a lit one.
LIGHTING = {"lightAmbientCoeff": 0.62, "lightDiffuseCoeff": 0.68, "lightSpecularCoeff": 0.1}

# Share of light that is lost far from the lamp, distance at which half of it is, and position of
# the brightest point (m).
_POOL, _WIDE, _UNDER = 0.25, 0.8, (-0.55, -0.1)

# Rows and columns of a part of an image.
ImagePart = tuple[slice, slice]

# Distance from the table's height within which a pixel belongs to the table (m).
_FLAT = 0.003


@dataclass(frozen=True, slots=True)
class Plate:
    """Image of an eye without objects.

    Attributes:
        view: view matrix of the eye.
        light: (height, width, channels) the image.
        depth: (height, width) depth of the image.
        rows: (height, width) y of the point where each pixel's ray meets the table, in the root
            frame, in units of `TEXEL`; `columns` is x.
        columns: see `rows`.
        lamp: (height, width) share of the light that a shadow removes; 0 beside the table.
    """

    view: Matrix
    light: NDArray[np.float32]
    depth: NDArray[np.float32]
    rows: NDArray[np.float32]
    columns: NDArray[np.float32]
    lamp: NDArray[np.float32]


class FurnishedEyes:
    """Renderer of the images of both eyes in a furnished room, side by side.

    It hides all bodies that never move, which are in the plates.

    Args:
        scene: configuration of a scene that is not plain.
        world: the world, whose plain bodies are replaced.

    Attributes:
        shape: (height, width) of the joined image; in color, the red, green and blue images of
            both eyes are side by side.
    """

    def __init__(self, scene: IcubConfig, world: World) -> None:
        self._scene, self._world = scene, world
        eyes, self._channels = scene.eyes, 3 if scene.color else 1
        self.shape = eyes.height, 2 * eyes.width * self._channels
        self._size = eyes.height * SAMPLES, eyes.width * SAMPLES
        aspect = eyes.width / eyes.height
        self._projection = perspective(eyes.vertical_fov, aspect, eyes.near, eyes.far)
        self._focal = self._size[0] / 2 / math.tan(math.radians(eyes.vertical_fov) / 2)
        self._lens = Lens(scene)
        room = room_of(scene)
        world.furnish(room, arms=scene.arms)
        world.show_room((), robot=False)
        self._balls = [_ball(scene, across, height) for across, height in sizes_of(scene)]
        self._shadows = []
        for number, (across, height) in enumerate(sizes_of(scene) if scene.shadow else ()):
            reach = across + 1.2 * math.hypot(*_fall(scene, height))
            self._shadows.append(ObjectShadow(world, number, scene.table.top, reach))
        world.show_objects(())
        self._pieces = range(len(room.pieces))
        self._room = RoomShadows(world, room, robot=scene.arms) if scene.shadow else None
        world.show_room((), robot=False)
        self._plates: dict[float, list[Plate]] = {}

    def look(self, view: int, t: int, positions: FloatArray, yaw: Sequence[float]) -> ByteArray:
        """Render a view from frame t on; see `Eyes.look`."""
        height, width = self._size
        frames = np.empty((len(positions), height, 2, width, self._channels), np.uint8)
        for frame, places, turned in zip(frames, positions, yaw, strict=True):
            plates = self._plates_at(turned)
            self._world.place(places)
            for eye, plate in enumerate(plates):
                self._see(plate, places, frame[:, eye])
        images = self._lens.through(frames, t, view)
        return np.moveaxis(images, -1, 2).reshape(len(frames), *self.shape)

    def _see(self, plate: Plate, places: FloatArray, out: ByteArray) -> None:
        """Write an eye's image, (height, width, channels), with the objects at their positions."""
        out[...] = plate.light
        parts = {}
        for number, ((x, y, z), radius) in enumerate(self._balls):
            middle = places[number, 0] + x, y - places[number, 1], z
            if (part := self._part(plate.view, middle, radius)) is not None:
                parts[number] = part
        self._world.show_objects(tuple(parts))
        for part in parts.values():
            image = plate.light[part]
            if self._shadows:
                image = image * self._shade(plate, places, part, tuple(parts))[..., None]
            colours, depth = self._draw_part(plate.view, part)
            nearer = depth < plate.depth[part]
            out[part] = np.where(nearer[..., None], self._toned(colours), image)

    def _shade(
        self, plate: Plate, places: FloatArray, part: ImagePart, objects: Sequence[int]
    ) -> NDArray[np.float32]:
        """Return the share of light that the objects' shadows leave to a part of an image."""
        rows, columns, rest = plate.rows[part], plate.columns[part], np.ones(1, np.float32)
        for number in objects:
            x, y = places[number, :2] / TEXEL
            hidden = self._shadows[number].hidden(rows + np.float32(y), columns - np.float32(x))
            rest = rest * (1 - hidden)
        return np.asarray(1 - (1 - rest) * plate.lamp[part])

    def _part(
        self, view: Matrix, middle: tuple[float, float, float], radius: float
    ) -> ImagePart | None:
        """Return the part of an image that a ball can cover, or None."""
        x, y, z = to_camera(view, np.array(middle)).tolist()
        if -z <= radius + self._scene.eyes.near:
            return None
        part = []
        for at, size in ((y / z, self._size[0]), (-x / z, self._size[1])):
            # Perspective lengthens a ball far from the middle of the image.
            reach = radius * self._focal / -z * math.sqrt(1 + at * at) * 1.1 + 1
            centre = size / 2 + self._focal * at
            low, high = max(0, int(centre - reach)), min(size, int(centre + reach) + 1)
            if low >= high:
                return None
            part.append(slice(low, high))
        return part[0], part[1]

    def _draw_part(self, view: Matrix, part: ImagePart) -> tuple[ByteArray, NDArray[np.float32]]:
        """Render the colors and the depth of a part of an image."""
        (height, width), (rows, columns) = self._size, part
        down, across = rows.stop - rows.start, columns.stop - columns.start
        projection = list(self._projection)
        projection[0] *= width / across
        projection[5] *= height / down
        projection[8] = (columns.start + columns.stop - width) / across
        projection[9] = (height - rows.start - rows.stop) / down
        return self._world.render(view, tuple(projection), across, down, LAMP, **LIGHTING)

    def _toned(self, colours: ByteArray) -> ByteArray:
        """Convert colors (..., 3 or 4) to the channels of the eyes."""
        return colours[..., :3] if self._channels == 3 else grey(colours)[..., None]

    def _plates_at(self, yaw: float) -> list[Plate]:
        """Return the plates of both eyes at an angle of the head, drawn when it is first used."""
        if yaw not in self._plates:
            world, arms = self._world, self._scene.arms
            world.show_objects(())
            world.show_room(self._pieces, robot=arms)
            self._plates[yaw] = [self._plate(self._room, yaw, side) for side in (1, -1)]
            world.show_room((), robot=False)
        return self._plates[yaw]

    def _plate(self, room: RoomShadows | None, yaw: float, side: int) -> Plate:
        scene, fine = self._scene, (self._size[0] * FINE, self._size[1] * FINE)
        view = eye_matrix(scene.eyes, self._world.neck, yaw, side)
        colours, depth = self._world.render(
            view, self._projection, fine[1], fine[0], LAMP, **LIGHTING
        )
        eye, ray = rays(view, self._projection, *depth.shape)
        places = eye + metres(depth, self._projection) * ray
        hidden = np.zeros(depth.shape) if room is None else room.hidden(places)
        light = light_at(scene, places, hidden)[..., None]
        picture = averaged(colours[..., :3] * light, FINE)
        on_table = abs(places[2] - scene.table.top) < _FLAT
        eye, ray = rays(view, self._projection, *self._size)
        x, y, _ = eye + ray * ((scene.table.top - eye[2]) / np.minimum(ray[2], -1e-3))
        return Plate(
            view=view,
            light=self._toned(np.rint(picture).astype(np.uint8)).astype(np.float32),
            depth=averaged(depth, FINE).astype(np.float32),
            rows=(y / TEXEL).astype(np.float32),
            columns=(x / TEXEL).astype(np.float32),
            lamp=averaged(on_table * (1 - hidden) * scene.shadow, FINE).astype(np.float32),
        )


def sizes_of(scene: IcubConfig) -> list[tuple[float, float]]:
    """Return the radius of each object on the table, and its height (m)."""
    return [
        (scene.object1.half_size * math.sqrt(2), 2 * scene.object1.half_size),
        (scene.object2.radius, scene.object2.height),
        (scene.object3.radius, 2 * scene.object3.radius),
    ]


def _fall(scene: IcubConfig, height: float) -> tuple[float, float]:
    """Return the offset (x, y) of the shadow of a point at a height above the table (m)."""
    share = height / LAMP[2] if scene.shadow else 0.0
    return -share * LAMP[0], -share * LAMP[1]


def _ball(scene: IcubConfig, across: float, height: float) -> tuple[tuple[float, ...], float]:
    """Return a ball around an object and its shadow: centre relative to the object, and radius."""
    x, y = _fall(scene, height)
    middle = x / 2, y / 2, scene.table.top + height / 2
    return middle, math.hypot(across + math.hypot(x, y) / 2, height / 2)


def light_at(scene: IcubConfig, places: FloatArray, hidden: FloatArray) -> FloatArray:
    """Return the factor of the colors at points (3, ...): shadows, and distance from the lamp."""
    if not scene.shadow:
        return np.ones(hidden.shape)
    x, y, _ = places
    away = ((x - _UNDER[0]) ** 2 + (y - _UNDER[1]) ** 2) / _WIDE**2
    return np.asarray((1 - scene.shadow * hidden) * (1 - _POOL * away / (1 + away)))


def averaged(image: NDArray[Any], n: int) -> FloatArray:
    """Return the means of each n x n pixels of an image, (n h, n w, ...) to (h, w, ...)."""
    total = np.zeros((image.shape[0] // n, image.shape[1] // n, *image.shape[2:]))
    for i in range(n * n):
        total += image[i // n :: n, i % n :: n]
    return total / (n * n)
