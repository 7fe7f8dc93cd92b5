"""The iCub scene in 3D: the robot, the table, the objects, and where it looks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from cdmisfa.core.blocks import SourceSpec
from cdmisfa.core.errors import CdmisfaError
from recorder.log.scenery import Eye, Gaze, Scenery, Thing
from replay.palette import Rgb, colour, packed_all
from replay.runs.columns import SignalColumns
from replay.view.columns import Column, time_columns
from replay.view.labels import label, part
from replay.view.world.body import write_body

SCENE = "scene"
"""The entity whose frame is the robot's root frame."""

WATCHING = f"{SCENE}/watching"

REACH = 0.6
"""How far the pyramid of a view reaches, metres."""

THIN, THICK = 0.0015, 0.005
"""Radii of the edges of a view's pyramid, and of that of the watched one."""

LIGHT = 0.25
"""What is added to the greys of objects: the viewer's background is as dark as they are."""


def _places(values: NDArray[Any]) -> Any:
    """(n, 3) places in their parent's frame."""
    return rr.Transform3D.columns(translation=np.array(values, dtype=np.float32))


class SceneView:
    """Writes the world of a run, or of a recording, into a Rerun recording.

    Args:
        recording: where it goes.
        spec: what the source delivers.
        scenery: what stands where.
    """

    def __init__(self, recording: rr.RecordingStream, spec: SourceSpec, scenery: Scenery) -> None:
        self._recording, self._spec, self._scenery = recording, spec, scenery
        self._watched, self._turned = -1, False
        self._neck: Any = None
        recording.log(SCENE, rr.ViewCoordinates.BRU, static=True)
        _write_thing(recording, f"{SCENE}/table", scenery.table, at_rest=True)
        self._objects = [
            (thing, Column(recording, spec, f"{SCENE}/{thing.name}", encode=_places))
            for thing in scenery.objects
            if set(thing.truth) <= set(spec.truth)
        ]
        for thing, column in self._objects:
            _write_thing(recording, column.path, thing)
        self._gazes = [scenery.gaze(name) for name in spec.streams]
        for s, gaze in enumerate(self._gazes):
            if gaze is not None:
                _write_pyramid(recording, f"{SCENE}/gaze/{part(spec.streams, s)}", gaze, colour(s))

    def stand(self) -> str | None:
        """Show the robot's body, and return what to say where that cannot be."""
        try:
            self._neck = write_body(self._recording, SCENE, self._scenery.robot)
        except CdmisfaError as error:
            return str(error)
        return None

    def move(self, at: NDArray[np.int64], truth: NDArray[np.float64]) -> None:
        """Put the objects where (n, D) truth says they are at n frames."""
        for thing, column in self._objects:
            column.add(at, None, thing.places(self._spec.truth, truth))

    def turn(self, columns: SignalColumns) -> None:
        """Turn the head to what is watched."""
        streams = columns["stream"].astype(np.int64)
        turns = np.flatnonzero(np.diff(streams, prepend=self._watched))
        self._watched = int(streams[-1])
        places = [(i, gaze) for i in turns if (gaze := self._gazes[streams[i]]) is not None]
        if not places:
            return
        at = np.array([i for i, _ in places])
        gazes = [gaze for _, gaze in places]
        if not self._turned:  # the eyes are the same in every view
            self._turned = True
            thick = rr.LineStrips3D(pyramid(gazes[0].middle), radii=[THICK])
            self._recording.log(f"{WATCHING}/edges", thick, static=True)
        times = time_columns(self._spec, columns.frames[at], columns.iterations[at])
        rgbs = [colour(int(s)) for s in streams[at]]
        self._recording.send_columns(WATCHING, times, _poses(gazes))
        self._recording.send_columns(
            f"{WATCHING}/edges", times, rr.LineStrips3D.columns(colors=packed_all(rgbs))
        )
        if self._neck is not None:
            turned = self._neck.compute_transform_columns([math.radians(g.yaw) for g in gazes])
            self._recording.send_columns(f"{SCENE}/neck", times, turned)

    def flush(self) -> None:
        """Hand over what waits."""
        for _, column in self._objects:
            column.flush()


EDGES = 5
"""Edges of a pyramid: four along its sides, one around its end."""


def pyramid(eye: Eye) -> list[list[list[float]]]:
    """The edges of what an eye sees, in its own frame."""
    x, y = (REACH * pixels / 2 / eye.focal for pixels in (eye.width, eye.height))
    corners = [[sx * x, sy * y, REACH] for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    return [*([[0.0, 0.0, 0.0], corner] for corner in corners), [*corners, corners[0]]]


def _write_pyramid(recording: rr.RecordingStream, path: str, gaze: Gaze, rgb: Rgb) -> None:
    eye = gaze.middle
    placed = rr.Transform3D(translation=eye.place, quaternion=rr.Quaternion(xyzw=eye.turn))
    recording.log(path, placed, static=True)
    edges = pyramid(eye)
    rgbs = packed_all([rgb] * EDGES)
    recording.log(path, rr.LineStrips3D(edges, colors=rgbs, radii=[THIN]), static=True)
    end = np.mean(edges[-1][2:4], axis=0)
    name = rr.Points3D(
        [end], labels=[label(gaze.name)], colors=rgbs[:1], radii=[THICK], show_labels=True
    )
    recording.log(f"{path}/name", name, static=True)


def _write_thing(
    recording: rr.RecordingStream, path: str, thing: Thing, *, at_rest: bool = False
) -> None:
    """Show what a thing looks like; where it is, only of one that stands still."""
    if at_rest:
        recording.log(path, rr.Transform3D(translation=thing.place), static=True)
    light = 0.0 if at_rest else LIGHT
    rgb = [round(255 * min(part + light, 1.0)) for part in thing.colour]
    solid = rr.components.FillMode.Solid
    half = [size / 2 for size in thing.size]
    shape: Any
    if thing.shape == "cylinder":
        shape = rr.Cylinders3D(
            lengths=[thing.size[2]], radii=[half[0]], colors=[rgb], fill_mode=solid
        )
    elif thing.shape == "sphere":
        shape = rr.Ellipsoids3D(half_sizes=[half], colors=[rgb], fill_mode=solid)
    else:
        shape = rr.Boxes3D(half_sizes=[half], colors=[rgb], fill_mode=solid)
    recording.log(path, shape, static=True)


def _poses(gazes: Sequence[Gaze]) -> Any:
    return rr.Transform3D.columns(
        translation=[gaze.middle.place for gaze in gazes],
        quaternion=[gaze.middle.turn for gaze in gazes],
    )
