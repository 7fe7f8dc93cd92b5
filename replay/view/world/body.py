"""The robot's body: a model of the package icub-models, by Rerun's own loader."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import rerun as rr
from rerun.urdf import UrdfTree

from cdmisfa.core.errors import CdmisfaError

NECK = "neck_yaw"
"""The joint that turns the head to the left."""

BODY = "body"
"""The entity of all that it looks like, in that of the scene."""

PACKAGE = "package://iCub/"
"""How the models name their meshes."""


def write_body(recording: rr.RecordingStream, root: str, robot: str) -> Any:
    """Show a robot that stands upright in the frame of the entity `root`.

    Args:
        recording: where it goes.
        root: the entity, whose frame is the robot's root frame.
        robot: its name in icub-models.

    Returns:
        Its neck's joint, a `rerun.urdf.UrdfJoint`.

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
    neck = tree.get_joint_by_name(NECK)
    if neck is None:
        raise CdmisfaError(f"{model} has no joint {NECK}")
    stands = rr.Transform3D(parent_frame=f"tf#/{root}", child_frame=tree.root_link().name)
    recording.log(f"{root}/stands", stands, static=True)
    return neck


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
