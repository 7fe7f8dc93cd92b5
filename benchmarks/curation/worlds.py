"""What recordings show: worlds as they usually are, and events that are planted in them.

A course is made by its seed, frame by frame; an event shows another course for a while, or the same
one otherwise.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image, ImageFilter

from cdmisfa.core.arrays import ByteArray
from cdmisfa.studies.arena import cameras
from cdmisfa.studies.arena.pictures import HEIGHT, WIDTH, Footage, pixels, stateless, wandering
from cdmisfa.studies.arena.streams import STREAMS
from recorder.cameras.stepped import gray_picture, make_environment
from recorder.images.pixels import shrink
from recorder.world.icub.world import silenced


@dataclass(frozen=True, slots=True)
class Course:
    """What happens, by a seed.

    Attributes:
        draw: frames [start, stop) of the course of a seed, (stop - start, HEIGHT, WIDTH).
    """

    draw: Callable[[int, int, int], ByteArray]

    def __call__(self, seed: int, start: int, stop: int) -> ByteArray:
        """Its frames."""
        return self.draw(seed, start, stop)


EPISODE = 100
"""Frames of an episode of a task."""


Camera = Callable[[np.random.Generator, Footage], Footage]

EPISODE = 100
"""Frames of an episode of a task."""


@dataclass(frozen=True, slots=True)
class World:
    """What a camera sees.

    Attributes:
        about: in words.
        usual: its course.
        events: by their names, in words and what is shown instead while one lasts: another course,
            or the usual one seen by another camera.
    """

    about: str
    usual: Course
    events: Mapping[str, tuple[str, Course | Camera]]


def shown(world: World, seed: int, frames: int, event: str = "", at: range = range(0)) -> ByteArray:
    """A recording of a world, with an event at some of its frames."""
    found = world.usual(seed, 0, frames)
    if event:
        other: Any = world.events[event][1]
        if isinstance(other, Course):
            found[at.start : at.stop] = other(seed, at.start, at.stop)
        else:
            plain = stateless(found[at.start : at.stop].copy())
            found[at.start : at.stop] = other(np.random.default_rng((seed, 1)), plain).frames
    return found


def of_arena(name: str) -> Course:
    """A stream of the arena."""

    def draw(seed: int, start: int, stop: int) -> ByteArray:
        return np.array(STREAMS[name].make(np.random.default_rng(seed), stop).frames[start:])

    return Course(draw)


# Simulated scenes.


def table(*, things: int = 3, light: float = 1.0, memory: float = 25) -> Course:
    """Things that go about on a table.

    Args:
        things: how many; the last of four stands still.
        light: of how much there is usually.
        memory: frames of their motion's, see `wandering`.
    """

    def draw(seed: int, start: int, stop: int) -> ByteArray:
        import pybullet
        from pybullet_utils import bullet_client

        found = np.empty((stop - start, HEIGHT, WIDTH), np.uint8)
        with silenced():
            world = bullet_client.BulletClient(pybullet.DIRECT)
        shape = world.createVisualShape(
            pybullet.GEOM_BOX, halfExtents=(0.9, 0.9, 0.02), rgbaColor=(0.6, 0.5, 0.4, 1)
        )
        world.createMultiBody(baseVisualShapeIndex=shape)
        bodies = []
        for i in range(things):
            gray = (0.2, 0.9, 0.4, 0.1)[i]
            kind = pybullet.GEOM_BOX if i % 2 else pybullet.GEOM_SPHERE
            how = {"halfExtents": (0.1,) * 3} if i % 2 else {"radius": 0.12}
            shape = world.createVisualShape(kind, rgbaColor=(gray,) * 3 + (1,), **how)
            bodies.append(world.createMultiBody(baseVisualShapeIndex=shape))
        rng = np.random.default_rng(seed)
        ways = [
            0.7 * np.sin(np.stack([wandering(rng, stop + 1000, memory) for _ in "xy"], axis=1))
            for _ in range(3)
        ]
        ways.append(np.tile(rng.uniform(-0.7, 0.7, 2), (stop + 1000, 1)))
        view = world.computeViewMatrixFromYawPitchRoll((0, 0, 0), 2.4, 30, -40, 0, 2)
        lens = world.computeProjectionMatrixFOV(45, WIDTH / HEIGHT, 0.1, 10)
        lit = {"lightAmbientCoeff": 0.6 * light, "lightDiffuseCoeff": 0.35 * light}
        for t in range(start, stop):
            for body, way in zip(bodies, ways, strict=False):
                world.resetBasePositionAndOrientation(body, (*way[t], 0.12), (0, 0, 0, 1))
            seen = world.getCameraImage(
                WIDTH, HEIGHT, view, lens, renderer=world.ER_TINY_RENDERER, **lit
            )[2]
            picture = np.reshape(seen, (HEIGHT, WIDTH, 4))[:, :, :3].astype(np.uint8)
            found[t - start] = gray_picture(picture)
        world.disconnect()
        return found

    return Course(draw)


# Gymnasium's tasks and games.


def task(name: str, begin: Callable[..., Any], policy: Callable[..., Any], hold: int = 1) -> Course:
    """A task in episodes of equal length, whatever becomes of it in them.

    Args:
        name: of the environment.
        begin: the state of an episode's beginning, from a generator.
        policy: the action at a state, from the state, a generator and the frame of the episode.
        hold: steps for each frame.
    """

    def draw(seed: int, start: int, stop: int) -> ByteArray:
        rng = np.random.default_rng(seed)
        found = np.empty((stop - start, HEIGHT, WIDTH), np.uint8)
        with contextlib.closing(make_environment(name)) as made:
            world = made.unwrapped
            world.reset(seed=seed)
            for t in range(stop):
                if t % EPISODE == 0:
                    world.reset()
                    world.state = begin(rng)
                for _ in range(hold):
                    world.step(policy(world.state, rng, t % EPISODE))
                    world.steps_beyond_terminated = None
                if t >= start:
                    found[t - start] = shrink(gray_picture(world.render()), HEIGHT, WIDTH)
        return found

    return Course(draw)


def _upright(rng: np.random.Generator) -> Any:
    return np.array([rng.uniform(-1, 1), 0, rng.uniform(-0.1, 0.1), 0])


def _balanced(state: Any, rng: np.random.Generator, t: int) -> int:
    return int(0.3 * state[0] + 0.6 * state[1] + 8 * state[2] + 2 * state[3] + rng.normal() > 0)


def _hanging_up(rng: np.random.Generator) -> Any:
    return np.array([rng.uniform(-0.3, 0.3), rng.uniform(-0.5, 0.5)])


def _held(state: Any, rng: np.random.Generator, t: int) -> Any:
    angle = (state[0] + np.pi) % (2 * np.pi) - np.pi
    return np.clip([-10 * angle - 2 * state[1] + rng.normal()], -2, 2)


def _let_go(state: Any, rng: np.random.Generator, t: int) -> Any:
    return rng.uniform(-0.5, 0.5, 1)


def _failing(state: Any, rng: np.random.Generator, t: int) -> int:
    return int(rng.integers(2))


def game(name: str, *, mode: int = 0, difficulty: int = 0, hold: int = 4) -> Course:
    """An Atari game, played at random."""

    def draw(seed: int, start: int, stop: int) -> ByteArray:
        rng = np.random.default_rng(seed)
        found = np.empty((stop - start, HEIGHT, WIDTH), np.uint8)
        made = make_environment(
            f"ALE/{name}-v5", obs_type="rgb", frameskip=3, mode=mode, difficulty=difficulty
        )
        with contextlib.closing(made) as world:
            seen, _ = world.reset(seed=seed)
            for t in range(stop):
                if t % hold == 0:
                    action = int(rng.integers(world.action_space.n))
                seen, _, ended, cut, _ = world.step(action)
                if ended or cut:
                    seen, _ = world.reset()
                if t >= start:
                    found[t - start] = shrink(gray_picture(seen), HEIGHT, WIDTH)
        return found

    return Course(draw)


def lake(size: int, *, another: bool = False, hold: int = 5) -> Course:
    """Cells over which one goes at random, a step in some frames.

    Args:
        size: cells a side.
        another: other cells are holes.
        hold: frames of a step.
    """

    def draw(seed: int, start: int, stop: int) -> ByteArray:
        from gymnasium.envs.toy_text.frozen_lake import generate_random_map

        rng = np.random.default_rng(seed)
        cells = generate_random_map(size, p=0.8, seed=1) if another else None
        found = np.empty((stop - start, HEIGHT, WIDTH), np.uint8)
        known: dict[Any, ByteArray] = {}  # drawing takes long, and few differ
        with contextlib.closing(make_environment("FrozenLake8x8-v1", desc=cells)) as world:
            at, _ = world.reset(seed=seed)
            for t in range(stop):
                if t % hold == 0:
                    at, _, ended, cut, _ = world.step(int(rng.integers(4)))
                    if ended or cut:
                        at, _ = world.reset()
                if t >= start:
                    key = int(at), world.unwrapped.lastaction
                    if key not in known:
                        known[key] = shrink(gray_picture(world.render()), HEIGHT, WIDTH)
                    found[t - start] = known[key]
        return found

    return Course(draw)


def patch(rng: np.random.Generator, plain: Footage) -> Footage:
    """A small bright square that goes through the picture, an eighth of its width."""
    frames, side = plain.frames.copy(), WIDTH // 8
    n = len(frames)
    row = rng.integers(HEIGHT - side)
    for t, frame in enumerate(frames):
        left = round((WIDTH - side) * t / n)
        frame[row : row + side, left : left + side] = 230
    return stateless(frames)


def dim(rng: np.random.Generator, plain: Footage) -> Footage:
    """The light goes down by 40 %, and comes back."""
    n = len(plain.frames)
    light = 1 - 0.4 * np.clip(4 * np.minimum(np.arange(n), np.arange(n)[::-1]) / n, 0, 1)
    return stateless(pixels(plain.frames * light[:, None, None]))


def covered(rng: np.random.Generator, plain: Footage) -> Footage:
    """Something dark passes close to the camera."""
    n = len(plain.frames)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    middle = np.linspace(-WIDTH / 4, 1.25 * WIDTH, n)[:, None, None]
    hidden = (x - middle) ** 2 + (y - HEIGHT / 2) ** 2 < (WIDTH / 5) ** 2
    return stateless(pixels(np.where(hidden, 20, plain.frames)))


def blurred(rng: np.random.Generator, plain: Footage) -> Footage:
    """The lens is out of focus."""
    soft = [Image.fromarray(f).filter(ImageFilter.GaussianBlur(2)) for f in plain.frames]
    return stateless(np.array([np.asarray(one) for one in soft]))


def stuck(rng: np.random.Generator, plain: Footage) -> Footage:
    """The camera gives the same picture again and again."""
    return stateless(np.repeat(plain.frames[:1], len(plain.frames), axis=0))


def shaken(rng: np.random.Generator, plain: Footage) -> Footage:
    """The camera is shaken, by as much as four pixels."""
    for _ in range(4):
        plain = cameras.shake(rng, plain)
    return plain


TUNED: Mapping[str, World] = {
    "table": World(
        "three things that go about on a table, simulated",
        table(),
        {
            "object": ("a fourth thing is there", table(things=4)),
            "light": ("there is less light", table(light=0.7)),
            "fast": ("they move five times as fast", table(memory=5)),
        },
    ),
    "cartpole": World(
        "a pole that is balanced, in episodes",
        task("CartPole-v1", _upright, _balanced),
        {
            "failing": ("an episode fails", task("CartPole-v1", _upright, _failing)),
            "light": ("the light goes down, and comes back", dim),
        },
    ),
    "freeway": World(
        "an Atari game, played at random",
        game("Freeway"),
        {
            "level": ("another level of the game", game("Freeway", mode=4)),
            "object": ("something small goes through", patch),
        },
    ),
}
"""What constants may be tuned on."""

REPORTED: Mapping[str, World] = {
    "legs": World(
        "the legs of a robot that move at random, simulated",
        of_arena("cheetah"),
        {
            "turned": ("the camera is turned by 12 degrees", cameras.SIDES["turned"]),
            "covered": ("something dark passes close to the camera", covered),
        },
    ),
    "pendulum": World(
        "a pendulum that is balanced, in episodes",
        task("Pendulum-v1", _hanging_up, _held),
        {
            "failing": ("an episode fails", task("Pendulum-v1", _hanging_up, _let_go)),
            "blurred": ("the lens is out of focus", blurred),
        },
    ),
    "breakout": World(
        "an Atari game, played at random",
        game("Breakout"),
        {
            "level": ("another level of the game", game("Breakout", mode=12)),
            "stuck": ("the camera gives the same picture again and again", stuck),
        },
    ),
    "lake": World(
        "one who goes at random over a frozen lake of 8 by 8 cells",
        lake(8),
        {
            "level": ("another lake", lake(8, another=True)),
            "fast": ("he goes five times as fast", lake(8, hold=1)),
        },
    ),
    "photograph": World(
        "a camera that moves over a photograph",
        of_arena("hopper"),
        {
            "shaken": ("the camera is shaken", shaken),
            "object": ("something small goes through", patch),
        },
    ),
}
"""What is reported, with kinds of events and of noise that nothing was tuned on."""

WORLDS: Mapping[str, Mapping[str, World]] = {"tuned": TUNED, "reported": REPORTED}

NOISES: Mapping[str, Sequence[str]] = {
    "tuned": ("noise", "gaussian-0.1", "speckle"),
    "reported": ("pink", "shot", "salt", "shuffled", "jumping"),
}
"""Streams of the arena, of which each set of recordings has two."""
