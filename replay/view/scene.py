"""The iCub scene in 3D: the robot, the table, the objects, and where the head looks.

Poses are in the robot's root frame: x to the back, y to the right, z up. The robot's body is a
model of the package icub-models, shown by Rerun's own loader.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray
from rerun.urdf import UrdfTree

from cdmisfa.core.arrays import FloatArray, IntArray
from cdmisfa.core.errors import CdmisfaError
from recorder.log.scenery import ROAMING, Eye, Gaze, Scenery, Thing
from replay.palette import Rgb, colour, packed_all
from replay.runs.columns import SignalColumns
from replay.runs.log import Batch
from replay.view.columns import Column, Target
from replay.view.labels import label, part

SCENE = "scene"
"""The entity whose frame is the robot's root frame."""

WATCHING = f"{SCENE}/watching"

REACH = 0.6
"""Length of a view's pyramid, metres."""

THIN, THICK = 0.0015, 0.005
"""Radii of the edges of a view's pyramid, and of that of the watched one."""

LIGHT = 0.25
"""Added to the greys of objects: the viewer's background is as dark as they are."""


def _places(values: NDArray[Any]) -> Any:
    """(n, 3) places in their parent's frame."""
    return rr.Transform3D.columns(translation=np.array(values, dtype=np.float32))


class SceneView:
    """Writes the world of a run, or of a recording, into a Rerun recording.

    Args:
        target: where it goes.
        scenery: what stands where.
        every: show where things are at every so many frames.

    Attributes:
        notes: why the robot's body is not shown.
    """

    def __init__(self, target: Target, scenery: Scenery, every: int) -> None:
        self._target, self._every, spec = target, every, target.spec
        self.notes: list[str] = []
        self._watched, self._scenery = -1, scenery
        self._looks: Gaze | None = None
        self._body: UrdfTree | None = None
        self._shown = False
        target.log(SCENE, rr.ViewCoordinates.BRU)
        _write_thing(target, f"{SCENE}/table", scenery.table, at_rest=True)
        self._objects = [
            (thing, Column(target, f"{SCENE}/{thing.name}", encode=_places))
            for thing in scenery.objects
            if set(thing.truth) <= set(spec.truth)
        ]
        for thing, column in self._objects:
            _write_thing(target, column.path, thing)
        self._gazes = [scenery.gaze(name) for name in spec.streams]
        for s, gaze in enumerate(self._gazes):
            if gaze is not None:
                _write_pyramid(target, f"{SCENE}/gaze/{part(spec.streams, s)}", gaze, colour(s))
        try:
            self._body = write_body(target.recording, SCENE, scenery.robot)
        except CdmisfaError as error:
            self.notes.append(str(error))

    def take(self, batch: Batch) -> None:
        """Take what a log holds of some iterations."""
        for columns in batch.signals:
            self._turn(columns)
        for frames, truth in batch.truth:
            self.move(frames, truth)
            self._roam(batch, frames, truth)

    def move(self, at: IntArray, truth: FloatArray) -> None:
        """Put the objects where (n, D) truth says they are at n frames."""
        kept = at % self._every == 0
        at, truth = at[kept], truth[kept]
        for thing, column in self._objects:
            column.add(at, None, thing.places(self._target.spec.truth, truth))

    def _turn(self, columns: SignalColumns) -> None:
        """Turn the head to what is watched."""
        streams = columns["stream"].astype(np.int64)
        turns = np.flatnonzero(np.diff(streams, prepend=self._watched))
        self._watched = int(streams[-1])
        rows: list[tuple[int, int, Gaze, Rgb]] = []
        for i in turns.tolist():
            s, frame, iteration = (int(a[i]) for a in (streams, columns.frames, columns.iterations))
            if (gaze := self._gazes[s]) is not None:
                way = [] if self._looks is None else self._scenery.way(self._looks, gaze)
                first, self._looks = frame - len(way), gaze
                gazes = enumerate([*way, gaze], first)
                rows += [(at, iteration, look, colour(s)) for at, look in gazes]
        self._look(rows)

    def _roam(self, batch: Batch, at: IntArray, truth: FloatArray) -> None:
        """Turn a head that roams, while it is watched, to where the truth says."""
        spec, blocks, (view, yaw) = self._target.spec, batch.blocks, ROAMING
        if view not in spec.streams or yaw not in spec.truth or not len(blocks.starts):
            return
        s, places = spec.streams.index(view), blocks.places(at)
        rows = np.flatnonzero((blocks.streams[places] == s) & (at % self._every == 0))
        yaws, first = truth[:, spec.truth.index(yaw)], self._scenery.gazes[0]
        self._look(
            [
                (
                    int(at[i]),
                    int(blocks.iterations[places[i]]),
                    self._scenery.turned(first, yaws[i]),
                    colour(s),
                )
                for i in rows
            ]
        )

    def _look(self, rows: Sequence[tuple[int, int, Gaze, Rgb]]) -> None:
        """Show where the head looks at frames, in iterations, and the colour of what it watches."""
        if not rows:
            return
        frames, iterations, gazes, rgbs = zip(*rows, strict=True)
        first, self._shown = not self._shown, True
        if first:  # the eyes are the same in every view
            thick = rr.LineStrips3D(pyramid(gazes[0].middle), radii=[THICK])
            self._target.log(f"{WATCHING}/edges", thick)
        when = np.array(frames), np.array(iterations)
        self._target.send(WATCHING, *when, _poses(gazes))
        edges = rr.LineStrips3D.columns(colors=packed_all(rgbs))
        self._target.send(f"{WATCHING}/edges", *when, edges)
        self._pose("neck", NECK, when, [gaze.yaw for gaze in gazes])
        if first:
            for name, angle in {**self._scenery.arms, NECK_PITCH: gazes[0].pitch}.items():
                if angle:
                    self._pose(name, name, (when[0][:1], when[1][:1]), [angle])

    def _pose(self, place: str, name: str, when: tuple[IntArray, IntArray], angles: Any) -> None:
        """Turn a joint of the robot by degrees, at frames, in iterations."""
        joint = None if self._body is None else self._body.get_joint_by_name(name)
        if joint is not None:
            turned = joint.compute_transform_columns([math.radians(angle) for angle in angles])
            self._target.send(f"{SCENE}/{place}", *when, turned)

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


def _write_pyramid(target: Target, path: str, gaze: Gaze, rgb: Rgb) -> None:
    eye = gaze.middle
    placed = rr.Transform3D(translation=eye.place, quaternion=rr.Quaternion(xyzw=eye.turn))
    target.log(path, placed)
    edges = pyramid(eye)
    rgbs = packed_all([rgb] * EDGES)
    target.log(path, rr.LineStrips3D(edges, colors=rgbs, radii=[THIN]))
    end = np.mean(edges[-1][2:4], axis=0)
    name = rr.Points3D(
        [end], labels=[label(gaze.name)], colors=rgbs[:1], radii=[THICK], show_labels=True
    )
    target.log(f"{path}/name", name)


def _write_thing(target: Target, path: str, thing: Thing, *, at_rest: bool = False) -> None:
    """Show what a thing looks like; where it is, only of one that stands still."""
    if at_rest:
        target.log(path, rr.Transform3D(translation=thing.place))
    light = LIGHT if len(set(thing.colour)) == 1 and not at_rest else 0.0
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
    target.log(path, shape)


def _poses(gazes: Sequence[Gaze]) -> Any:
    return rr.Transform3D.columns(
        translation=[gaze.middle.place for gaze in gazes],
        quaternion=[gaze.middle.turn for gaze in gazes],
    )


NECK, NECK_PITCH = "neck_yaw", "neck_pitch"
"""The joints that turn the head to the left, and bend it upwards."""

BODY = "body"
"""The entity of all that it looks like, in that of the scene."""

PACKAGE = "package://iCub/"
"""Prefix of the meshes' names in the models."""


def write_body(recording: rr.RecordingStream, root: str, robot: str) -> UrdfTree:
    """Show a robot that stands upright in the frame of the entity `root`.

    Args:
        recording: where it goes.
        root: the entity, whose frame is the robot's root frame.
        robot: its name in icub-models.

    Returns:
        Its joints.

    Raises:
        CdmisfaError: the package or the model is not there, or it cannot be read.
    """
    model = _model(robot)
    with tempfile.TemporaryDirectory(prefix="cdmisfa-robot-") as folder:
        seen = Path(folder) / model.name
        try:
            _as_seen(model).write(seen)
            tree = UrdfTree.from_file_path(
                seen,
                entity_path_prefix=root,
                static_transform_entity_path=f"{root}/joints",
            )
            tree.log_urdf_to_recording(recording)
        except (OSError, RuntimeError, ValueError, ElementTree.ParseError) as error:
            raise CdmisfaError(f"{model} cannot be shown: {error}") from error
    if tree.get_joint_by_name(NECK) is None:
        raise CdmisfaError(f"{model} has no joint {NECK}")
    stands = rr.Transform3D(parent_frame=f"tf#/{root}", child_frame=tree.root_link().name)
    recording.log(f"{root}/stands", stands, static=True)
    return tree


def _model(robot: str) -> Path:
    try:
        import icub_models
    except ImportError as error:
        raise CdmisfaError(
            "the robot's body is not shown: `pip install icub-models` for it"
        ) from error
    if robot not in icub_models.get_robot_names():
        raise CdmisfaError(f"the robot's body is not shown: icub-models has no {robot[:60]!r}")
    return Path(icub_models.get_model_file(robot))


def _as_seen(model: Path) -> Any:
    """The model as `BODY`, its meshes where they are, and without the shapes that collide."""
    tree: Any = ElementTree.parse(model)
    tree.getroot().set("name", BODY)
    share = next(folder for folder in model.parents if (folder / "robots").is_dir())
    for link in tree.iter("link"):
        for shape in link.findall("collision"):
            link.remove(shape)
    for mesh in tree.iter("mesh"):
        mesh.set("filename", mesh.get("filename", "").replace(PACKAGE, f"{share}/"))
    return tree


def scene_view() -> rrb.View:
    """The world in 3D, seen from in front of the robot."""
    return rrb.Spatial3DView(
        origin=f"/{SCENE}",
        name="The world, and where it looks",
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=rrb.EyeControls3D(
            position=(-1.5, -0.85, 0.72), look_target=(-0.38, 0.0, 0.0), eye_up=(0.0, 0.0, 1.0)
        ),
    )
