"""`World`: robot, table and objects of the iCub scene in PyBullet.

Objects are moved by hand in each frame; no physics step is made, so that nothing depends on the
speed of the machine.
"""

from __future__ import annotations

import contextlib
import ctypes
import math
import os
import sys
import tempfile
from collections.abc import Collection, Iterator, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.errors import CdmisfaError, UsageError, one_line
from recorder.world.icub.config import IcubConfig
from recorder.world.icub.head import ARMS
from recorder.world.icub.room import Piece, Room

# Names of the joints that turn the head to the left, and bend it upwards.
NECK_YAW, NECK_PITCH = b"neck_yaw", b"neck_pitch"

_AWAY = (0.0, 0.0, -100.0)
_UPRIGHT = (0.0, 0.0, 0.0, 1.0)


class World:
    """Robot, table and objects in a PyBullet server of their own, without a window.

    Args:
        scene: configuration of robot, table and objects.

    Raises:
        CdmisfaError: PyBullet or the robot models are not installed.
        UsageError: the robot does not exist or has no neck, or its neck cannot turn to a view.

    Attributes:
        neck: (3,) origin of the neck yaw joint in the root frame (m).
    """

    def __init__(self, scene: IcubConfig) -> None:
        self._objects: list[int] = []
        self._pieces: list[int] = []
        self._visible: Sequence[int] = ()
        with silenced():
            self._bullet, models = start_simulator()
            bullet = self._bullet
            # Looked up once, because they are called for every frame.
            self._move = partial(bullet.resetBasePositionAndOrientation, ornObj=_UPRIGHT)
            self._see = partial(
                bullet.getCameraImage,
                shadow=0,
                renderer=bullet.ER_TINY_RENDERER,
                flags=bullet.ER_NO_SEGMENTATION_MASK,
            )
            try:
                self._build(scene, str(models.get_model_file(scene.robot)))
            except (bullet.error, FileNotFoundError, KeyError) as error:
                self.close()
                known = ", ".join(sorted(models.get_robot_names()))
                raise UsageError(
                    f"scene.robot is {scene.robot}, which cannot be built ({one_line(error)}): "
                    f"choose one with a neck; icub-models has {known}"
                ) from error
            except BaseException:
                self.close()
                raise

    def place(self, positions: NDArray[np.float64]) -> None:
        """Move the objects to positions (objects, 2), x and y in the paper's coordinates.

        The paper's y points to the robot's left, the root frame's to its right. Positions can also
        be (objects, 7), with z and a quaternion in the root frame.
        """
        for body, height, (x, y, *pose) in zip(
            self._objects, self._heights, positions.tolist(), strict=True
        ):
            z, *turn = pose or (height, *_UPRIGHT)
            self._move(body, (x, -y, z), ornObj=turn)

    def hide_table(self) -> None:
        """Move the table out of sight."""
        self._move(self._table, _AWAY)

    def furnish(self, room: Room, *, arms: bool) -> None:
        """Replace the plain bodies by the pieces and objects of a furnished room.

        Args:
            room: the pieces and objects.
            arms: True if the robot rests its arms on the table.
        """
        for body in (self._table, *self._objects):
            self._bullet.removeBody(body)
        with silenced(), tempfile.TemporaryDirectory() as folder:
            self._pieces = [self._piece(piece, folder) for piece in room.pieces]
            self._objects = [self._piece(piece, folder) for piece in room.objects]
        self._visible = range(len(room.objects))
        bullet = self._bullet
        for joint in range(bullet.getNumJoints(self._robot)) if arms else ():
            angle = ARMS.get(bullet.getJointInfo(self._robot, joint)[1].decode()[2:])
            if angle is not None:
                bullet.resetJointState(self._robot, joint, math.radians(angle))

    def show_room(self, pieces: Collection[int], *, robot: bool) -> None:
        """Make pieces of the room and the robot visible or not; hidden bodies take no time."""
        for number, body in enumerate(self._pieces):
            self._show(body, -1, visible=number in pieces)
        for body, link in self._colours:
            if body == self._robot:
                self._show(body, link, visible=robot)

    def show_objects(self, numbers: Sequence[int]) -> None:
        """Make only these objects of a furnished room visible."""
        for number, body in enumerate(self._objects):
            if (number in numbers) != (number in self._visible):
                self._show(body, -1, visible=number in numbers)
        self._visible = numbers

    def _show(self, body: int, link: int, *, visible: bool) -> None:
        colour = self._colours[body, link] if visible else (0.0, 0.0, 0.0, 0.0)
        self._bullet.changeVisualShape(body, link, rgbaColor=colour)

    def _piece(self, piece: Piece, folder: str) -> int:
        """Add a body with a mesh and a texture."""
        bullet = self._bullet
        colour = (*(piece.colour if piece.paint is None else (1.0, 1.0, 1.0)), 1.0)
        visual = bullet.createVisualShape(
            bullet.GEOM_MESH,
            rgbaColor=colour,
            specularColor=(piece.gloss,) * 3,
            **asdict(piece.mesh),
        )
        body: int = bullet.createMultiBody(0, baseVisualShapeIndex=visual)
        self._move(body, piece.centre)
        self._colours[body, -1] = colour
        if piece.paint is not None:
            from PIL import Image

            file = f"{folder}/{body}.bmp"
            Image.fromarray(piece.paint).save(file)
            bullet.changeVisualShape(body, -1, textureUniqueId=bullet.loadTexture(file))
        return body

    def render(
        self,
        view: tuple[float, ...],
        projection: tuple[float, ...],
        width: int,
        height: int,
        light: tuple[float, float, float],
        **lighting: float,
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Render a camera's image: colors (height, width, 4) and depth (height, width).

        Raises:
            CdmisfaError: the simulator reports an error.
        """
        try:
            image = self._see(width, height, view, projection, lightDirection=light, **lighting)
        except self._bullet.error as error:
            raise CdmisfaError(f"PyBullet cannot draw: {error}") from error
        colours = np.asarray(image[2], dtype=np.uint8).reshape(height, width, 4)
        return colours, np.asarray(image[3], dtype=np.float32).reshape(height, width)

    def close(self) -> None:
        """End the simulator; a second call does nothing."""
        with contextlib.suppress(self._bullet.error):
            self._bullet.disconnect()

    def _build(self, scene: IcubConfig, path: str) -> None:
        bullet = self._bullet
        # Without merging, PyBullet gives no state for any link: the robot has too many fixed
        # joints.
        self._robot = bullet.loadURDF(
            path,
            useFixedBase=True,
            flags=bullet.URDF_MERGE_FIXED_LINKS | bullet.URDF_IGNORE_COLLISION_SHAPES,
        )
        joints = range(bullet.getNumJoints(self._robot))
        shapes = bullet.getVisualShapeData(self._robot)
        self._colours = {(shape[0], shape[1]): tuple(shape[7]) for shape in shapes}
        # The eyes are inside of the head: without the robot they see the same, 60 times as fast.
        for link in (-1, *joints):
            bullet.changeVisualShape(self._robot, link, rgbaColor=(0, 0, 0, 0))
        by_name = {info[1]: info for info in (bullet.getJointInfo(self._robot, i) for i in joints)}
        neck_joint, eyes = by_name[NECK_YAW][0], scene.eyes
        for key, angles in ((NECK_YAW, eyes.yaw), (NECK_PITCH, (eyes.pitch,))):
            low, high = (math.degrees(limit) for limit in by_name[key][8:10])
            for angle in angles:
                if not low <= angle <= high:
                    raise UsageError(
                        f"scene.eyes.{key.decode()[5:]} has {angle:g}: the neck of {scene.robot} "
                        f"turns from {low:.0f} to {high:.0f} degrees: give an angle in this range"
                    )
        bullet.resetJointState(self._robot, by_name[NECK_PITCH][0], math.radians(eyes.pitch))
        place = bullet.getLinkState(self._robot, neck_joint, computeForwardKinematics=1)[4]
        # Rounded to micrometres: further digits are rounding of the simulator's float32.
        self.neck = np.array([round(part, 6) for part in place])
        self._add_bodies(scene)

    def _add_bodies(self, scene: IcubConfig) -> None:
        bullet, top = self._bullet, scene.table.top
        box, cylinder, sphere = scene.object1, scene.object2, scene.object3
        half = (scene.table.half_size, scene.table.half_size, scene.table.thickness / 2)
        self._table = self._body(bullet.GEOM_BOX, scene.table.colour, halfExtents=half)
        self._move(self._table, (0.0, 0.0, top - scene.table.thickness / 2))
        can = {"radius": cylinder.radius, "length": cylinder.height}
        self._objects = [
            self._body(bullet.GEOM_BOX, (box.grey,) * 3, halfExtents=(box.half_size,) * 3),
            self._body(bullet.GEOM_CYLINDER, (cylinder.grey,) * 3, **can),
            self._body(bullet.GEOM_SPHERE, (sphere.grey,) * 3, radius=sphere.radius),
        ]
        for body in self._objects:  # until they are placed
            self._move(body, _AWAY)
        self._heights = (top + box.half_size, top + cylinder.height / 2, top + sphere.radius)

    def _body(self, shape: int, colour: tuple[float, ...], **size: Any) -> int:
        visual = self._bullet.createVisualShape(shape, rgbaColor=(*colour, 1.0), **size)
        body: int = self._bullet.createMultiBody(baseMass=0, baseVisualShapeIndex=visual)
        return body


@contextlib.contextmanager
def silenced() -> Iterator[None]:
    """Keep what C code prints off standard output and error.

    The simulator prints tens of kilobytes of warnings past Python's streams.
    """
    _flush()
    saved = {number: os.dup(number) for number in (1, 2)}
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for number in saved:
        os.dup2(nowhere, number)
    os.close(nowhere)
    try:
        yield
    finally:
        _flush()
        for number, copy in saved.items():
            os.dup2(copy, number)
            os.close(copy)


def _flush() -> None:
    """Print what Python and C have not printed yet."""
    sys.stdout.flush()
    sys.stderr.flush()
    ctypes.CDLL(None).fflush(None)


def start_simulator() -> tuple[Any, Any]:
    """Start a PyBullet server without a window; return it and the package of robot models."""
    try:
        import icub_models
        import pybullet
        from pybullet_utils import bullet_client
    except ImportError as error:
        raise CdmisfaError(
            f"the icub scene needs the package {error.name}, which is not installed: "
            "use Python 3.11 and `pip install pybullet icub-models`; "
            "recordings and the oscillatory scene work without it"
        ) from error
    return bullet_client.BulletClient(pybullet.DIRECT), icub_models
