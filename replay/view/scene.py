"""The iCub scene in 3D: the robot, the table, the objects, and where the head looks.

Poses are in the robot's root frame: x to the back, y to the right, z up. The robot's body is a
model of the package icub-models, shown by Rerun's own loader.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from rerun.urdf import UrdfTree

from cdmisfa.core.arrays import FloatArray, IntArray
from cdmisfa.core.errors import CdmisfaError, LogDamagedError
from cdmisfa.core.untrusted import parse_json
from recorder.log.scenery import KIND, ROAMING, Eye, Gaze, Scenery, Thing, scenery_of
from recorder.log.viewlog import CONFIG_NAME
from recorder.mcap.reader import LogReader
from replay.logs.formats.views import first_pose
from replay.palette import Rgb, colour, packed_all
from replay.runs.columns import SignalColumns
from replay.runs.log import Batch, RunHeader
from replay.storage.paths import log_files
from replay.view.image_grid import ImageGridView
from replay.view.writer import Writer, changes, drawable, part

# The entity whose frame is the robot's root frame.
SCENE = "scene"

WATCHING = f"{SCENE}/watching"

# Length of a view's pyramid, metres.
REACH = 0.6

# Radii of the edges of a view's pyramid, and of that of the attended view, metres.
THIN, THICK = 0.0015, 0.005

# Edges of a pyramid: four along its sides, one around its end.
EDGES = 5

# Added to the grays of objects: the viewer's background is as dark as they are.
LIGHT = 0.25

# The joints that turn the head to the left, and bend it upwards.
NECK, NECK_PITCH = "neck_yaw", "neck_pitch"

# The entity of the robot's links, in that of the scene.
BODY = "body"

# Prefix of the meshes' names in the models.
PACKAGE = "package://iCub/"

PRESET = "the run's recording was not found: the 3D scene is that of its preset"


def world_of_run(
    writer: Writer, header: RunHeader, folder: Path, streams: Sequence[int], every: int
) -> tuple[SceneView | ImageGridView | None, list[str]]:
    """Return a run's world, and its uncertain parts.

    Args:
        writer: writer of the Rerun recording.
        header: header of the run's log.
        folder: folder of the run.
        streams: indices of the visible streams.
        every: frames from one pose of the scene to the next.

    Returns:
        The 3D scene if the run's source describes it, else a grid of images; None without images.
    """
    source, notes, scenery = _table(header.manifest.get("source")), list[str](), None
    try:
        if source.get("kind") == KIND:
            scenery = scenery_of(_table(source.get("scene")))
        elif source.get("scene") == KIND:
            scenery = _learned_from(header, folder, str(source.get("config_sha256")))
            if scenery is None:
                scenery = scenery_of(_table(_table(header.manifest.get("config")).get("scene")))
                notes = [PRESET]
    except LogDamagedError as error:
        notes = [str(error)]
    if scenery is not None:
        scene = SceneView(writer, scenery, every)
        return scene, [*notes, *scene.notes]
    if header.spec.images:
        return ImageGridView(writer, streams, by_progress=header.by_progress), notes
    return None, notes


def _learned_from(header: RunHeader, folder: Path, sha256: str) -> Scenery | None:
    """Return the scenery of the recording that a run learned from, where that is still there."""
    named = _table(header.manifest.get("command")).get("source")
    for name in named if isinstance(named, list) else []:
        with contextlib.suppress(CdmisfaError, OSError, ValueError):
            if scenery := scenery_of_recording(log_files(folder / str(name)), sha256):
                return scenery
    return None


def scenery_of_recording(files: Sequence[Path], sha256: str | None = None) -> Scenery | None:
    """Return the scenery of a recording, None of other scenes and recordings.

    Args:
        files: files of the recording.
        sha256: the checksum that its configuration must have.

    Raises:
        LogDamagedError: a file cannot be read.
    """
    data, pose = b"{}", None
    for file in files:  # the first has it, unless they are many
        with LogReader(file) as reader:
            if entries := [entry for entry in reader.attachments if entry.name == CONFIG_NAME]:
                data, pose = bytes(reader.attachment_data(entries[0])), first_pose(reader)
                break
    if sha256 is not None and hashlib.sha256(data).hexdigest() != sha256:
        return None
    try:
        config = _table(_table(parse_json(data)).get("scene"))
    except ValueError as error:
        raise LogDamagedError(f"{file}: its {CONFIG_NAME} is broken ({error})") from error
    return scenery_of(config, None if pose is None else pose.position)


def _table(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


class SceneView:
    """Writes the scene of a run, or of a recording, into a Rerun recording.

    Args:
        writer: writer of the Rerun recording.
        scenery: the robot and the objects around it.
        every: frames from one pose to the next.

    Attributes:
        notes: why the robot's body is not shown.
    """

    def __init__(self, writer: Writer, scenery: Scenery, every: int) -> None:
        self._writer, self._spec, self._every = writer, writer.spec, every
        self._scenery, self._watched, self._is_posed = scenery, -1, False
        self._looks: Gaze | None = None
        self._joints: UrdfTree | None = None
        self.notes: list[str] = []
        writer.log(SCENE, rr.ViewCoordinates.BRU)
        writer.log(f"{SCENE}/table", rr.Transform3D(translation=scenery.table.place))
        writer.log(f"{SCENE}/table", _shape(scenery.table))
        self._objects = [t for t in scenery.objects if set(t.truth) <= set(self._spec.truth)]
        for thing in self._objects:
            writer.log(f"{SCENE}/{thing.name}", _shape(thing, LIGHT))
        gazes = {gaze.name: gaze for gaze in scenery.gazes}
        self._gazes = [gazes.get(name) for name in self._spec.streams]
        for s, gaze in enumerate(self._gazes):
            if gaze is not None:
                self._write_pyramid(s, gaze)
        try:
            self._joints = write_body(writer.recording, scenery.robot)
        except ImportError:
            self.notes = ["the robot's body is not shown: run `pip install icub-models`"]
        except (OSError, RuntimeError, ValueError, ElementTree.ParseError) as error:
            self.notes = [f"the robot's body is not shown: {error}"]

    def take(self, batch: Batch) -> None:
        """Write the messages of some iterations."""
        for columns in batch.signals:
            self._turn(columns)
        for frames, truth in batch.truth:
            self.move(frames, truth)
            self._roam(batch, frames, truth)

    def move(self, frames: IntArray, truth: FloatArray) -> None:
        """Put the objects where (n, D) truth says they are at n frames."""
        drawn = frames % self._every == 0
        frames, truth = frames[drawn], truth[drawn]
        for thing in self._objects:
            places = thing.places(self._spec.truth, truth)
            self._writer.buffer(f"{SCENE}/{thing.name}", (frames, None), places, encode=_places)

    def _turn(self, columns: SignalColumns) -> None:
        """Turn the head to the attended view."""
        streams = columns["stream"]
        poses: list[tuple[int, int, Gaze, Rgb]] = []
        for i in changes(streams, self._watched).tolist():
            s, frame, iteration = (int(a[i]) for a in (streams, columns.frames, columns.iterations))
            if (gaze := self._gazes[s]) is not None:
                way = [] if self._looks is None else self._scenery.way(self._looks, gaze)
                first, self._looks = frame - len(way), gaze
                gazes = enumerate([*way, gaze], first)
                poses += [(at, iteration, look, colour(s)) for at, look in gazes]
        self._watched = int(streams[-1])
        self._look(poses)

    def _roam(self, batch: Batch, frames: IntArray, truth: FloatArray) -> None:
        """Turn a roaming head to its true yaw while its view is attended."""
        blocks, (view, yaw) = batch.blocks, ROAMING
        if view not in self._spec.streams or yaw not in self._spec.truth or not len(blocks.starts):
            return
        s, places = self._spec.streams.index(view), blocks.places(frames)
        drawn = np.flatnonzero((blocks.streams[places] == s) & (frames % self._every == 0))
        yaws, gaze = truth[drawn, self._spec.truth.index(yaw)], self._scenery.gazes[0]
        at = zip(frames[drawn].tolist(), blocks.iterations[places[drawn]].tolist(), strict=True)
        gazes = (self._scenery.turned(gaze, turned) for turned in yaws)
        self._look([(*when, look, colour(s)) for when, look in zip(at, gazes, strict=True)])

    def _look(self, poses: Sequence[tuple[int, int, Gaze, Rgb]]) -> None:
        """Write the direction of the head at frames and iterations, in the color of the view."""
        if not poses:
            return
        frames, iterations, gazes, rgbs = zip(*poses, strict=True)
        at = np.array(frames), np.array(iterations)
        if not self._is_posed:
            self._is_posed = True  # the eyes are the same in every view, and the arms never move
            edges = rr.LineStrips3D(pyramid(gazes[0].middle), radii=[THICK])
            self._writer.log(f"{WATCHING}/edges", edges)
            for name, angle in {**self._scenery.arms, NECK_PITCH: gazes[0].pitch}.items():
                if angle:
                    self._pose(name, name, (at[0][:1], at[1][:1]), [angle])
        turned = rr.Transform3D.columns(
            translation=[gaze.middle.place for gaze in gazes],
            quaternion=[gaze.middle.turn for gaze in gazes],
        )
        self._writer.send(WATCHING, at, turned)
        colours = rr.LineStrips3D.columns(colors=packed_all(rgbs))
        self._writer.send(f"{WATCHING}/edges", at, colours)
        self._pose("neck", NECK, at, [gaze.yaw for gaze in gazes])

    def _pose(
        self, place: str, name: str, at: tuple[IntArray, IntArray], angles: Sequence[float]
    ) -> None:
        """Turn a joint of the robot by degrees."""
        joint = None if self._joints is None else self._joints.get_joint_by_name(name)
        if joint is not None:
            turned = joint.compute_transform_columns([math.radians(angle) for angle in angles])
            self._writer.send(f"{SCENE}/{place}", at, turned)

    def _write_pyramid(self, s: int, gaze: Gaze) -> None:
        """Write where a view looks from, its edges, and its name."""
        path, eye = f"{SCENE}/gaze/{part(self._spec.streams, s)}", gaze.middle
        turn = rr.Quaternion(xyzw=eye.turn)
        self._writer.log(path, rr.Transform3D(translation=eye.place, quaternion=turn))
        edges, rgbs = pyramid(eye), packed_all([colour(s)] * EDGES)
        self._writer.log(path, rr.LineStrips3D(edges, colors=rgbs, radii=[THIN]))
        end, names = [np.mean(edges[-1][2:4], axis=0)], [drawable(self._spec.streams[s])]
        name = rr.Points3D(end, labels=names, colors=rgbs[:1], radii=[THICK], show_labels=True)
        self._writer.log(f"{path}/name", name)


def _places(values: NDArray[Any]) -> Any:
    return rr.Transform3D.columns(translation=np.array(values, dtype=np.float32))


def pyramid(eye: Eye) -> list[list[list[float]]]:
    """Return the edges of what an eye sees, in its own frame."""
    x, y = (REACH * pixels / 2 / eye.focal for pixels in (eye.width, eye.height))
    corners = [[sx * x, sy * y, REACH] for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    return [*([[0.0, 0.0, 0.0], corner] for corner in corners), [*corners, corners[0]]]


def _shape(thing: Thing, light: float = 0.0) -> Any:
    """Return the shape and color of a thing; gray ones are made lighter."""
    light = light if len(set(thing.colour)) == 1 else 0.0
    rgb = [round(255 * min(part + light, 1.0)) for part in thing.colour]
    half = [size / 2 for size in thing.size]
    style: Any = {"colors": [rgb], "fill_mode": rr.components.FillMode.Solid}
    if thing.shape == "cylinder":
        return rr.Cylinders3D(lengths=[thing.size[2]], radii=[half[0]], **style)
    if thing.shape == "sphere":
        return rr.Ellipsoids3D(half_sizes=[half], **style)
    return rr.Boxes3D(half_sizes=[half], **style)


def write_body(recording: rr.RecordingStream, robot: str) -> UrdfTree:
    """Show a robot upright in the frame of the scene, and return its joints.

    Args:
        recording: the recording.
        robot: its name in icub-models.

    Raises:
        ImportError: the package icub-models is not installed.
        OSError, RuntimeError, ValueError, ElementTree.ParseError: it has no such robot, or the
            model cannot be read.
    """
    import icub_models

    if robot not in icub_models.get_robot_names():
        raise ValueError(f"icub-models has no {robot[:60]!r}")
    model = Path(icub_models.get_model_file(robot))
    share = next(folder for folder in model.parents if (folder / "robots").is_dir())
    urdf: Any = ElementTree.parse(model)
    urdf.getroot().set("name", BODY)
    for link in urdf.iter("link"):
        for collision in link.findall("collision"):
            link.remove(collision)
    for mesh in urdf.iter("mesh"):
        mesh.set("filename", mesh.get("filename", "").replace(PACKAGE, f"{share}/"))
    with tempfile.TemporaryDirectory(prefix="cdmisfa-robot-") as folder:
        file, joints = Path(folder) / model.name, f"{SCENE}/joints"
        urdf.write(file)
        tree = UrdfTree.from_file_path(
            file, entity_path_prefix=SCENE, static_transform_entity_path=joints
        )
        tree.log_urdf_to_recording(recording)
    upright = rr.Transform3D(parent_frame=f"tf#/{SCENE}", child_frame=tree.root_link().name)
    recording.log(f"{SCENE}/stands", upright, static=True)
    return tree
