"""Simulated robot episodes with planted faults: a Kuka arm, two cameras, two tasks, AV1.

An episode is a video of each camera and an .npz with states and actions; `dataset` assembles
some of them to a LeRobot dataset of layout v2.1.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, Final, NamedTuple

import numpy as np
from PIL import Image, ImageFilter

FPS, WIDTH, HEIGHT = 25, 160, 120

# Faults of the world, which is simulated with them, and faults of the record of a good episode.
SIMULATED: Final = ("moved", "dim", "object", "fail", "idle")
RECORDED: Final = ("frozen", "repeated", "black", "bright", "blur", "occluder", "swapped", "cast",
                   "lag", "stuck", "noise", "jump", "short")  # fmt: skip
FAULTS: Final = (*SIMULATED, *RECORDED)


class Episode(NamedTuple):
    """Images of each camera (T, height, width, 3), states and actions (T, n), and a lag (s)."""

    images: dict[str, np.ndarray]
    state: np.ndarray
    action: np.ndarray
    lag: float = 0.0


class World:
    """A table with a Kuka arm that carries things by suction.

    Args:
        task: one of `tasks`.
        session: number of the session; cameras, light and table differ a little between them.
    """

    tasks: ClassVar[tuple[str, ...]] = ("stack", "draw")
    cameras: ClassVar[tuple[str, str]] = ("front", "top")
    home: ClassVar[Sequence[float]] = (0, 0.5, 0, -1.4, 0, 1.2, 0)
    tip: ClassVar[int] = 6

    def __init__(self, task: str, session: int = 0) -> None:
        import pybullet

        self.p, self.task, self.things = pybullet, task, list[int]()
        pybullet.connect(pybullet.DIRECT)
        pybullet.setGravity(0, 0, -9.8)
        rng = np.random.default_rng([session, 99])
        self.moved = rng.normal(0, 0.02, (2, 3)) if session else np.zeros((2, 3))
        self.light = 1 + (rng.normal(0, 0.06) if session else 0)
        self._scene()
        self.arm = pybullet.loadURDF(self._urdf(), useFixedBase=True)

    def _urdf(self) -> str:
        import pybullet_data

        return f"{pybullet_data.getDataPath()}/kuka_iiwa/model.urdf"

    def _scene(self) -> None:
        self._box([0.5, 0.6, 0.02], [0.5, 0, -0.02], [0.75, 0.72, 0.68])
        self._box([2, 2, 0.02], [0, 0, -0.7], [0.3, 0.33, 0.4])
        self._box([0.02, 2, 1], [-0.6, 0, 0.3], [0.5, 0.6, 0.55])
        self._box([0.06, 0.1, 0.05], [0.85, 0.4, 0.05], [0.2, 0.3, 0.6])
        self._box([0.04, 0.04, 0.12], [0.2, -0.45, 0.12], [0.55, 0.2, 0.3])

    def _eyes(self) -> list[tuple[Any, Any, Any]]:
        """Return where each camera is, what it looks at, and its upward direction."""
        return [([1.25, 0.5, 0.75], [0.5, 0.0, 0.1], [0, 0, 1]),
                ([0.5, -0.7, 1.05], [0.5, 0, 0], [0, 0, 1])]  # fmt: skip

    def _box(self, half: Sequence[float], at: Sequence[float], color: Sequence[float],
             mass: float = 0) -> int:  # fmt: skip
        p = self.p
        shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=half)
        visual = p.createVisualShape(p.GEOM_BOX, halfExtents=half, rgbaColor=[*color, 1])
        return int(p.createMultiBody(mass, shape, visual, at))

    def episode(self, rng: np.random.Generator, fault: str = "") -> Episode:
        """Simulate an episode."""
        p, arm = self.p, self.arm
        for thing in self.things:
            p.removeBody(thing)
        joints = range(len(self.home))
        home = np.array(self.home) + rng.normal(0, 0.03, len(joints))
        for joint, angle in enumerate(home):
            p.resetJointState(arm, joint, angle)
        start = np.array(p.getLinkState(arm, self.tip, computeForwardKinematics=True)[0])
        plan, carried = self._plan(rng, fault, start)
        path = self._path(rng, plan, start, fault)
        count = len(path)
        turn, when = np.zeros((2, 3)), count
        if fault == "moved":
            turn[rng.integers(2)] = rng.normal(0, 1, 3) * [0.02, 0.045, 0.045]
            when = int(rng.choice([0, rng.uniform(0.3, 0.7)]) * count)
        dim = rng.choice([0.55, 0.7, 1.3]) if fault == "dim" else 1.0
        dark = int(rng.uniform(0, 0.6) * count)
        ambient = 0.55 * self.light + rng.normal(0, 0.008)
        images = {name: np.empty((count, HEIGHT, WIDTH, 3), np.uint8) for name in self.cameras}
        state, action = np.empty((2, count, len(joints) + 1))
        held, lens = None, p.computeProjectionMatrixFOV(42, WIDTH / HEIGHT, 0.1, 5)
        down = p.getQuaternionFromEuler([np.pi, 0, np.pi])
        for t, (place, suction) in enumerate(path):
            angles = p.calculateInverseKinematics(arm, self.tip, place, down, maxNumIterations=40)
            action[t] = [*angles, suction]
            p.setJointMotorControlArray(
                arm, joints, p.POSITION_CONTROL, angles, forces=[300] * len(joints),
                positionGains=[0.12] * len(joints),
            )  # fmt: skip
            for _ in range(10):
                p.stepSimulation()
            tip = np.array(p.getLinkState(arm, self.tip)[0])
            if carried is not None and suction and held is None:
                near = np.linalg.norm(np.array(p.getBasePositionAndOrientation(carried)[0]) - tip)
                if near < 0.12:
                    held = p.createConstraint(arm, self.tip, carried, -1, p.JOINT_FIXED, [0] * 3,
                                              [0, 0, 0.07], [0] * 3)  # fmt: skip
            if held is not None and not suction:
                p.removeConstraint(held)
                held = None
            state[t] = [*(s[0] for s in p.getJointStates(arm, joints)), float(held is not None)]
            level = dim if t >= dark else 1.0
            for number, (eye, at, up) in enumerate(self._eyes()):
                at = at + self.moved[number] + (turn[number] if t >= when else 0)
                view = p.computeViewMatrix(eye + self.moved[number], at, up)
                raw = p.getCameraImage(
                    WIDTH, HEIGHT, view, lens, shadow=0, lightDirection=[1, 0.6, 2],
                    lightAmbientCoeff=ambient * level, lightDiffuseCoeff=0.4 * level,
                    lightSpecularCoeff=0.03, renderer=p.ER_TINY_RENDERER,
                    flags=p.ER_NO_SEGMENTATION_MASK,
                )[2]  # fmt: skip
                pixels = np.reshape(raw, (HEIGHT, WIDTH, 4))[..., :3]
                noisy = pixels + rng.normal(0, 2, pixels.shape)
                images[self.cameras[number]][t] = noisy.clip(0, 255)
        if held is not None:
            p.removeConstraint(held)
        state[:, :-1] += rng.normal(0, 0.001, (count, len(joints)))
        return Episode(images, state.astype(np.float32), action.astype(np.float32))

    def _plan(self, rng: np.random.Generator, fault: str, start: np.ndarray) -> Any:
        """Place the things of the task; return way points (place, suction, seconds) and a thing."""
        wrong, missing = fault == "object", fault == "object" and rng.random() < 0.4
        color = [0.1, 0.6, 0.85] if wrong else [0.85, 0.35, 0.1]
        up, self.things, carried = np.array([0, 0, 1.0]), [], None
        a = np.array([rng.uniform(0.42, 0.6), rng.uniform(-0.3, -0.1), 0.03])
        b = np.array([rng.uniform(0.42, 0.6), rng.uniform(0.1, 0.28), 0.03])
        miss = rng.choice([-1, 1]) * np.array([0, rng.uniform(0.1, 0.16), 0]) * (fault == "fail")
        if self.task == "stack":
            if not missing:
                carried = self._box([0.03] * 3, a, color, 0.05)
                self.things.append(carried)
            self.things.append(self._box([0.045] * 3, b + up * 0.015, [0.2, 0.2, 0.25]))
            grip, drop = a + up * 0.07 + miss, b + up * 0.17
            plan = [(grip + up * 0.15, 0, 1.2), (grip, 0, 0.8), (grip, 1, 0.3),
                    (grip + up * 0.22, 1, 0.8), (drop + up * 0.08, 1, 1.2), (drop, 1, 0.5),
                    (drop, 0, 0.3), (drop + up * 0.15, 0, 0.6), (start, 0, 1.0)]  # fmt: skip
        else:
            middle = np.array([rng.uniform(0.48, 0.58), rng.uniform(-0.1, 0.1), 0.1])
            radius = rng.uniform(0.07, 0.1) * (0.4 if fault == "fail" else 1)
            sheet = [0.85, 0.5, 0.5] if wrong else [0.95, 0.95, 0.98]
            if not missing:
                self.things.append(self._box([0.15, 0.2, 0.001], [0.55, 0, 0.001], sheet))
            angles = np.linspace(0, 2 * np.pi, 17) + rng.uniform(0, 2 * np.pi)
            circle = middle + radius * np.stack([np.cos(angles), np.sin(angles), 0 * angles], 1)
            plan = [(circle[0] + up * 0.12, 0, 1.2), (circle[0], 0, 0.7)]
            plan += [(place, 0, 0.25) for place in circle[1:]]
            plan += [(circle[-1] + up * 0.15, 0, 0.7), (start, 0, 1.0)]
        return plan, carried

    def _path(self, rng: np.random.Generator, plan: Any, start: np.ndarray, fault: str) -> Any:
        """Return places and suction at each frame along way points, with pauses and detours."""
        pace, last, path = np.exp(rng.normal(0, 0.12)), start, [(start, 0.0)] * rng.integers(3, 12)
        for place, suction, seconds in plan:
            target = place + rng.normal(0, 0.005, 3)
            steps = max(int(FPS * seconds * pace * np.exp(rng.normal(0, 0.12))), 2)
            u = (1 - np.cos(np.pi * np.linspace(0, 1, steps + 1)[1:])) / 2
            path += [(last + (target - last) * q, suction) for q in u]
            path += [(target, suction)] * (int(FPS * rng.uniform(0.2, 0.8)) * (rng.random() < 0.1))
            last = target
        path += [(last, 0.0)] * rng.integers(4, 15)
        return [(start, 0.0)] * len(path) if fault == "idle" else path


def spoil(episode: Episode, fault: str, rng: np.random.Generator) -> Episode:
    """Return a good episode with a fault of its record, in one camera or in its states."""
    images = {name: frames.copy() for name, frames in episode.images.items()}
    state, action, count = episode.state.copy(), episode.action.copy(), len(episode.state)
    camera = [*images][rng.integers(2)]
    f = images[camera]
    length = int(FPS * rng.uniform(1, 2.5))
    at = int(rng.uniform(0.15, 0.8) * max(count - length, 1))
    part = slice(at, at + length)
    if fault == "frozen":
        f[part] = f[at]
    elif fault == "repeated":
        rows = np.arange(count)
        often = rng.random() < 0.5
        same = rows % 2 == 1 if often else rng.random(count) < 0.35
        f[:] = f[np.maximum.accumulate(np.where(same & (rows > 0), 0, rows))]
    elif fault == "black":
        f[at : at + rng.integers(3, 12)] = rng.integers(0, 6)
    elif fault == "bright":
        f[part] = (f[part] * rng.uniform(1.5, 2.5)).clip(0, 255)
    elif fault == "blur":
        _blur(f[at if rng.random() < 0.5 else 0 :], rng.uniform(1.2, 2.5), rng)
    elif fault == "occluder":
        _occlude(f[part if rng.random() < 0.7 else slice(None)], rng)
    elif fault == "swapped":
        images = dict(zip(images, reversed(images.values()), strict=True))
    elif fault == "cast":
        f[:] = (f * (1 + rng.choice([-1, 1]) * np.array([0.18, 0, -0.18]))).clip(0, 255)
    elif fault == "lag":
        late = int(rng.integers(5, 13))
        images = {n: v[:-late] for n, v in images.items()}
        return Episode(images, state[late:], action[late:], late / FPS)
    elif fault == "stuck":
        joints = slice(None) if rng.random() < 0.5 else rng.integers(0, 6)
        state[part, joints] = state[at, joints]
    elif fault == "noise":
        state[:, :-1] += rng.normal(0, rng.uniform(0.008, 0.03), state[:, :-1].shape)
    elif fault == "jump":
        for _ in range(rng.integers(1, 4)):
            state[rng.integers(count), rng.integers(len(state[0]) - 1)] += rng.choice(
                [-1, 1]
            ) * rng.uniform(0.3, 1)
    elif fault == "short":
        keep = int(count * rng.uniform(0.25, 0.55))
        images = {name: v[:keep] for name, v in images.items()}
        state, action = state[:keep], action[:keep]
    return Episode(images, state, action)


def _blur(frames: np.ndarray, sigma: float, rng: np.random.Generator) -> None:
    for row, image in enumerate(frames):
        soft = np.asarray(Image.fromarray(image).filter(ImageFilter.GaussianBlur(sigma)), float)
        frames[row] = (soft + rng.normal(0, 1.5, soft.shape)).clip(0, 255)


def _occlude(frames: np.ndarray, rng: np.random.Generator) -> None:
    """Draw a bar across the images that sways, as a cable or an arm before the camera."""
    shade, angle = rng.integers(20, 200, 3), rng.uniform(0, np.pi)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    thick, middle = rng.uniform(9, 20), rng.uniform(-25, 25)
    for row in range(len(frames)):
        sway = middle + 5 * np.sin(0.15 * row)
        off = (x - WIDTH / 2) * np.cos(angle) + (y - HEIGHT / 2) * np.sin(angle) - sway
        mask = np.abs(off) < thick
        frames[row][mask] = (shade + rng.normal(0, 2, (int(mask.sum()), 3))).clip(0, 255)


def encode(frames: np.ndarray, file: Path) -> None:
    """Write a video with LeRobot's settings: AV1, crf 30, a key frame every two frames."""
    import av

    settings = {"crf": "30", "g": "2", "preset": "10", "svtav1-params": "lp=1"}
    with av.open(str(file), "w") as out:
        stream = out.add_stream("libsvtav1", rate=FPS, options=settings)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for image in frames:
            out.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        out.mux(stream.encode())
    if os.geteuid() == 0:  # SVT-AV1 gives threads of root real-time priority, this one too
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def make_pool(
    folder: Path, kind: type[World], task: str, seed: int, good: int, each: int, session: int = 0
) -> None:
    """Simulate `good` episodes and `each` of every fault of a task; write pool.json at the end."""
    folder.mkdir(parents=True, exist_ok=True)
    world, pool = kind(task, session), list[dict[str, Any]]()

    def put(name: str, episode: Episode, fault: str, base: str) -> None:
        for camera, frames in episode.images.items():
            encode(frames, folder / f"{name}.{camera}.mp4")
        np.savez(folder / f"{name}.npz", state=episode.state, action=episode.action)
        row = {"name": name, "fault": fault, "base": base, "task": task, "lag": episode.lag}
        pool.append(row)

    key = [seed, kind.tasks.index(task), session]
    spoiled = [(k * 7 % good, fault) for k, fault in enumerate(RECORDED * each)]
    for number in range(good):
        episode = world.episode(np.random.default_rng([*key, number]))
        put(f"{task}{session}-{number:03d}", episode, "", "")
        for place, (base, fault) in enumerate(spoiled):
            if base == number:
                rng = np.random.default_rng([*key, number, place])
                name = f"{task}{session}-{number:03d}-{fault}"
                put(name, spoil(episode, fault, rng), fault, f"{task}{session}-{number:03d}")
    for place, fault in enumerate(SIMULATED * each):
        episode = world.episode(np.random.default_rng([*key, good + place]), fault)
        put(f"{task}{session}-{fault}{place:03d}", episode, fault, "")
    world.p.disconnect()
    (folder / "pool.json").write_text(json.dumps(pool))


def dataset(out: Path, episodes: Sequence[dict[str, Any]], cameras: Sequence[str]) -> None:
    """Assemble episodes of pools to a LeRobot dataset of layout v2.1.

    Args:
        out: folder to write.
        episodes: rows of pool.json, each with the folder of its `pool`.
        cameras: cameras of the dataset.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    lines, total = [], 0
    (out / "data/chunk-000").mkdir(parents=True)
    (out / "meta").mkdir()
    for number, episode in enumerate(episodes):
        place = Path(episode["pool"]) / episode["task"]
        name = f"episode_{number:06d}"
        with np.load(place / f"{episode['name']}.npz") as numbers:
            state, action = numbers["state"], numbers["action"]
        count = len(state)
        table = {
            "observation.state": list(state), "action": list(action),
            "timestamp": np.arange(count, dtype=np.float32) / FPS,
            "frame_index": np.arange(count), "episode_index": np.full(count, number),
            "index": np.arange(total, total + count), "task_index": np.zeros(count, int),
        }  # fmt: skip
        pq.write_table(pa.table(table), out / f"data/chunk-000/{name}.parquet")
        for camera in cameras:
            video = out / f"videos/chunk-000/observation.images.{camera}/{name}.mp4"
            video.parent.mkdir(parents=True, exist_ok=True)
            os.link(place / f"{episode['name']}.{camera}.mp4", video)
        lines.append({"episode_index": number, "tasks": ["a task"], "length": count})
        total += count
    numbers_feature = {"dtype": "float32", "shape": [state.shape[1]], "names": None}
    name = "episode_{episode_index:06d}"
    video_feature = {"dtype": "video", "shape": [HEIGHT, WIDTH, 3], "names": None}
    info = {
        "codebase_version": "v2.1", "robot_type": "simulated", "total_episodes": len(lines),
        "total_frames": total, "total_tasks": 1, "chunks_size": 1000, "fps": FPS,
        "data_path": f"data/chunk-{{episode_chunk:03d}}/{name}.parquet",
        "video_path": f"videos/chunk-{{episode_chunk:03d}}/{{video_key}}/{name}.mp4",
        "features": {"observation.state": numbers_feature, "action": numbers_feature}
        | {f"observation.images.{camera}": video_feature for camera in cameras},
    }  # fmt: skip
    tasks = [{"task_index": 0, "task": "a task"}]
    (out / "meta/tasks.jsonl").write_text("".join(json.dumps(task) + "\n" for task in tasks))
    (out / "meta/info.json").write_text(json.dumps(info))
    (out / "meta/episodes.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
