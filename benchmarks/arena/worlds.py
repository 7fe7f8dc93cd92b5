"""Streams that other packages show: photographs, simulations, games and recordings."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from importlib.resources import files
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from benchmarks.arena.pictures import HEIGHT, WIDTH, Footage, Rng, stateless, wandering
from cdmisfa.core.arrays import ByteArray
from recorder.cameras.stepped import gray_image, make_environment, play
from recorder.images.pixels import shrink
from recorder.world.icub.world import silenced


def photograph(rng: Rng, n: int, package: str, path: str) -> Footage:
    """A camera that moves over a photograph of a package, four times as large as its view."""
    with Image.open(str(files(package) / path)) as image:
        whole = np.asarray(image.convert("L").resize((4 * WIDTH, 4 * HEIGHT)))
    place = np.stack([0.5 + 0.5 * np.sin(wandering(rng, n, 25)) for _ in "yx"], axis=1)
    corners = np.rint(place * (2 * HEIGHT, 2 * WIDTH)).astype(int)
    seen = (whole[y : y + 2 * HEIGHT, x : x + 2 * WIDTH] for y, x in corners)
    return Footage(np.array([shrink(view, HEIGHT, WIDTH) for view in seen]), place)


def classic(rng: Rng, n: int, name: str, hold: int) -> Footage:
    """A classic control task, each random action held for some frames."""
    task = make_environment(name)
    return _play(task, rng, n, hold, lambda seen: (_framed(task.render()), seen))


def grid(rng: Rng, n: int, name: str, columns: int, rest: int) -> Footage:
    """A world of cells, walked at random.

    Args:
        rng: random generator.
        n: frames.
        name: of the task.
        columns: of its cells.
        rest: observations of each cell.
    """
    task = make_environment(name)
    drawn: dict[Any, ByteArray] = {}  # drawing takes long, and few images differ

    def look(seen: Any) -> tuple[ByteArray, Any]:
        key = int(seen), task.unwrapped.lastaction
        if key not in drawn:
            drawn[key] = _framed(task.render())
        return drawn[key], divmod(int(seen) // rest, columns)

    return _play(task, rng, n, 1, look)


def atari(rng: Rng, n: int, game: str, memory: Sequence[int]) -> Footage:
    """Return an Atari game and, of its memory, the bytes at some addresses."""
    import ale_py
    import gymnasium

    ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)
    gymnasium.register_envs(ale_py)
    task = make_environment(f"ALE/{game}-v5", obs_type="rgb", frameskip=2)
    console = task.unwrapped.ale
    return _play(task, rng, n, 4, lambda seen: (_framed(seen), console.getRAM()[list(memory)]))


def _play(
    task: Any, rng: Rng, n: int, hold: int, look: Callable[[Any], tuple[ByteArray, Any]]
) -> Footage:
    """Act at random; `look` turns an observation into a frame and the state."""
    with contextlib.closing(task):
        pairs = [look(seen) for seen, _, _ in islice(play(task, rng, hold), n)]
    frames, state = zip(*pairs, strict=True)
    return Footage(np.array(frames), np.array(state, float).reshape(n, -1))


def _framed(image: Any) -> ByteArray:
    """Return a colour image, (height, width, 3), as a frame."""
    return shrink(gray_image(image), HEIGHT, WIDTH)


def robot(rng: Rng, n: int, model: str, distance: float) -> Footage:
    """A robot of pybullet_data in the air, whose joints move to random angles; they are the state.

    Args:
        rng: random generator.
        n: frames.
        model: a file of pybullet_data.
        distance: of the camera, in metres.
    """
    import pybullet  # it has wheels for Python 3.11 only
    import pybullet_data
    from pybullet_utils import bullet_client

    path = str(Path(pybullet_data.getDataPath(), model))
    with silenced():
        world = bullet_client.BulletClient(pybullet.DIRECT)
        bodies = (world.loadURDF(path),) if model.endswith(".urdf") else world.loadMJCF(path)
    body = max(bodies, key=world.getNumJoints)  # others are the ground
    about = [world.getJointInfo(body, joint) for joint in range(world.getNumJoints(body))]
    turning = [each for each in about if each[2] == world.JOINT_REVOLUTE]
    sliding = [each[0] for each in about if each[2] == world.JOINT_PRISMATIC]
    joints = [each[0] for each in turning]
    low, high = (np.array([each[k] for each in turning]) for k in (8, 9))
    middle, reach = (low + high) / 2, np.minimum((high - low) / 2, 1.0)
    place = world.getBasePositionAndOrientation(body)
    centre = np.mean([world.getLinkState(body, joint)[0] for joint in joints], axis=0).tolist()
    view = world.computeViewMatrixFromYawPitchRoll(centre, distance, 40, -20, 0, 2)
    lens = world.computeProjectionMatrixFOV(50, WIDTH / HEIGHT, 0.1, 10)
    frames, state = np.empty((n, HEIGHT, WIDTH), np.uint8), np.empty((n, len(joints)))
    for t in range(n):
        if t % 30 == 0:
            angles = (middle + reach * rng.uniform(-1, 1, len(joints))).tolist()
            world.setJointMotorControlArray(
                body, joints, world.POSITION_CONTROL, angles, positionGains=[0.1] * len(joints)
            )
        for _ in range(4):  # steps of 1/240 s
            world.stepSimulation()
        world.resetBasePositionAndOrientation(body, *place)
        for joint in sliding:  # of a body that may go anywhere
            world.resetJointState(body, joint, 0)
        state[t] = [each[0] for each in world.getJointStates(body, joints)]
        seen = world.getCameraImage(WIDTH, HEIGHT, view, lens, renderer=world.ER_TINY_RENDERER)[2]
        frames[t] = _framed(np.reshape(seen, (HEIGHT, WIDTH, 4))[:, :, :3].astype(np.uint8))
    return Footage(frames, state)


def shuffled(rng: Rng, n: int, package: str, path: str) -> Footage:
    """A camera that moves over a photograph, its frames in random order."""
    return stateless(photograph(rng, n, package, path).frames[rng.integers(0, n, n)])
