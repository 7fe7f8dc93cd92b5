"""What the robot's two eyes see of the plain scene.

Only the watched view is rendered. The table never changes, so each eye draws it once; a frame
draws only the objects and puts them in front of that picture by depth: six times as fast.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import ByteArray, FloatArray
from recorder.world.icub.config import EyesConfig
from recorder.world.icub.matrices import Matrix, eye_matrix, grey, perspective
from recorder.world.icub.world import World


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

    def look(self, view: int, t: int, positions: FloatArray, yaw: Sequence[float]) -> ByteArray:
        """What a view shows from frame t on, (n, height, width of both eyes).

        Args:
            view: number of the view.
            t: no matter here: only where the objects are makes a difference.
            positions: (n, objects, ...) of the objects, see `World.place`.
            yaw: of the head at each frame, degrees; in a plain scene a view has one.
        """
        del t, yaw
        frames = np.empty((len(positions), *self.shape), np.uint8)
        for frame, places in zip(frames, positions, strict=True):
            self._world.place(places)
            self._see(view, frame)
        return frames

    def _see(self, view: int, out: ByteArray) -> None:
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
