"""Behaviour cloning from images: pixels, principal components and outputs of modules as inputs."""

from __future__ import annotations

import warnings
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from itertools import repeat
from typing import Any, NamedTuple

import numpy as np
from sklearn.exceptions import ConvergenceWarning
from sklearn.neural_network import MLPRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from threadpoolctl import threadpool_limits

from benchmarks import trajectories
from benchmarks.report import save
from benchmarks.trajectories import Features, Images, interval
from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.processes import run_all
from recorder.cameras.stepped import gray_image, make_environment
from recorder.images.pixels import shrink

EPISODES, DEMONSTRATIONS = 200, (10, 50, 200)
"""Episodes from whose images features are learned; how many of them have actions to clone."""

TRIALS = 5
"""Episodes in which a cloned policy is judged."""

DISTURBED = 0.25
"""Share of the demonstrator's actions that are replaced, so that it shows how to recover."""

UPDATES, BATCH = 1500, 200
"""Most updates of the cloned network, and the images of each."""

# Action from -1 to 1 for the present image (1, height, width) and the state.
Policy = Callable[[Images, FloatArray], float]


class Task(NamedTuple):
    """A task: longest episode, size of images, demonstrator, its action from one of -1 to 1."""

    steps: int
    size: tuple[int, int]
    demonstrator: Callable[[FloatArray], float]
    action: Callable[[float], Any]


class Episode(NamedTuple):
    """Images and the demonstrator's actions of an episode, and the sum of its rewards."""

    images: Images
    actions: FloatArray
    total: float


def swing_up(state: FloatArray) -> float:
    """Return the torque that pumps energy into Pendulum, and holds it upright."""
    cosine, sine, speed = state
    if cosine > 0.9:
        return float(np.clip(-5 * np.arctan2(sine, cosine) - speed, -1, 1))
    return float(np.sign(speed * (15 - speed**2 / 2 - 15 * cosine)) or 1)


def balance(state: FloatArray) -> float:
    """Return the push that keeps the pole of CartPole upright."""
    return float(np.sign(state @ (0.1, 0.3, 3.0, 1.0)))


TASKS = {
    "CartPole-v1": Task(100, (24, 36), balance, lambda push: int(push > 0)),
    "MountainCarContinuous-v0": Task(
        150, (24, 36), lambda state: np.sign(state[1]) or 1.0, lambda push: [push]
    ),
    "Pendulum-v1": Task(100, (28, 28), swing_up, lambda torque: [2 * torque]),
}


def play(world: Any, seed: int, policy: Policy, disturbed: float = 0) -> Episode:
    """Play an episode of a task, with a share of the actions replaced by random ones."""
    task, rng = TASKS[world.spec.id], np.random.default_rng(seed)
    state, _ = world.reset(seed=seed)
    images, actions, total, over = [], [], 0.0, False
    while not over:
        world.unwrapped.last_u = None  # Pendulum would draw its last torque
        images.append(shrink(gray_image(world.render()), *task.size))
        actions.append(policy(images[-1][None], state))
        done = rng.uniform(-1, 1) if rng.random() < disturbed else actions[-1]
        state, reward, ended, cut, _ = world.step(task.action(float(np.clip(done, -1, 1))))
        total, over = total + float(reward), ended or cut
    return Episode(np.stack(images), np.array(actions), total)


def with_change(y: FloatArray) -> FloatArray:
    """Return features of consecutive images beside their changes since the image before."""
    return np.concatenate([y, np.diff(y, axis=0, prepend=y[:1])], axis=1).astype(np.float32)


def clone(features: Sequence[FloatArray], actions: Sequence[FloatArray], seed: int) -> Any:
    """Return a network that imitates the actions of episodes from features (n, J) of each."""
    x, y = np.concatenate([with_change(y) for y in features]), np.concatenate(actions)
    epochs = UPDATES * BATCH // len(x)
    how: dict[str, Any] = {"batch_size": BATCH, "max_iter": epochs, "random_state": seed}
    network = MLPRegressor(hidden_layer_sizes=(64, 64), early_stopping=True, **how)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        return make_pipeline(StandardScaler(), network).fit(x, y)


def cloned(network: Any, features: Features) -> Policy:
    """Return the policy of a network for one episode."""
    last: list[FloatArray] = []

    def act(images: Images, state: FloatArray) -> float:
        last[:] = [*last[-1:], features(images)]
        return float(network.predict(with_change(np.concatenate(last))[-1:])[0])

    return act


def inputs(episodes: Sequence[Images]) -> dict[str, Features | None]:
    """Return features that policies see; None if the learner rejects the images."""
    module = trajectories.learn_module(episodes)
    mean, whitening = trajectories.components(episodes, 64)
    return {
        "pixels": trajectories.rows,
        "8 components": trajectories.linear(mean, whitening[:8]),
        "16 components": trajectories.linear(mean, whitening[:16]),
        "batch SFA, 16 of 64": trajectories.slow_features(episodes, (mean, whitening), 16),
        "module": module.transform if module else None,
    }


def measure(work: tuple[str, int]) -> list[tuple[str, int, str, float]]:
    """Return task, demonstrations, input and score of each cloned policy of a task and a seed.

    The score is 0 for random actions and 1 for the demonstrator.
    """
    name, seed = work
    world = make_environment(name, max_episode_steps=TASKS[name].steps)
    trials = [1_000_000 + 1000 * seed + trial for trial in range(TRIALS)]

    def shown(images: Images, state: FloatArray) -> float:
        return float(TASKS[name].demonstrator(state))

    def mean(policies: Iterable[Policy], disturbed: float = 0) -> float:
        pairs = zip(trials, policies, strict=False)
        return float(np.mean([play(world, *pair, disturbed).total for pair in pairs]))

    results = []
    with threadpool_limits(1):
        episodes = [play(world, 1000 * seed + n, shown, DISTURBED) for n in range(EPISODES)]
        best, worst = mean(repeat(shown)), mean(repeat(shown), 1)
        for title, features in inputs([episode.images for episode in episodes]).items():
            if features is None:
                results += [(name, count, title, np.nan) for count in DEMONSTRATIONS]
                continue
            seen = [features(episode.images) for episode in episodes]
            for count in DEMONSTRATIONS:
                network = clone(seen[:count], [e.actions for e in episodes[:count]], seed)
                reached = mean(cloned(network, features) for _ in trials)
                results.append((name, count, title, (reached - worst) / (best - worst)))
    return results


def main(*, quick: bool = False) -> None:
    """Measure, and write results/policies.json."""
    seeds = 2 if quick else 10
    scores = defaultdict[tuple[str, int], dict[str, list[float]]](lambda: defaultdict(list))
    work = [(name, seed) for seed in range(seeds) for name in TASKS]
    outcomes = dict(run_all(measure, work, jobs=2))
    for index in range(len(work)):
        for name, count, title, score in outcomes[index]:
            scores[name, count][title].append(score)
    titles = list(next(iter(scores.values())))
    rows, paired = [], []
    for case, by in sorted(scores.items()):
        rows.append([*case, *(interval(by[title], 2) for title in titles)])
        gains = [np.subtract(by["module"], by[title]) for title in titles[:-1]]
        paired.append([*case, *(interval([*gain], 2) for gain in gains)])
    head = ["task", "demonstrations"]
    note = (
        "A network with two layers of 64 units imitates a demonstrator, a quarter of whose actions "
        f"are replaced by random ones, in the first 10, 50 or 200 of {EPISODES} episodes. It sees "
        "features of the last two images, learned from the images of all. The score, from the "
        f"rewards of {TRIALS} episodes, is 0 for random actions and 1 for the demonstrator. Means "
        f"and 95 % intervals of {seeds} seeds; the second table has paired differences."
    )
    tables = [([*head, *titles], rows), ([*head, *(f"against {t}" for t in titles[:-1])], paired)]
    save("policies", "Behaviour cloning from images", note, tables)
