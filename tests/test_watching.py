"""Learning as an environment of Gymnasium."""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from waiting import python

from cdmisfa.agents.learners import open_learner
from cdmisfa.agents.progress.config import ProgressConfig
from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.errors import LogExhaustedError
from cdmisfa.core.signals import SignalsHash
from cdmisfa.experiments.loop import Digest, learn_blocks
from cdmisfa.watching import WatchEnv
from recorder.cameras.stepped import ArraySource
from recorder.world.oscillatory import OscillatorySource

EXAMPLES = Path(__file__).parents[1] / "examples"

SETTINGS: dict[str, dict[str, Any]] = {
    "progress": {},
    "2.0": {"delta": 0.01, "warm_up": 5},
    "1.0": {"delta": 0.01, "warm_up": 5},
}
LEARNED = {
    "progress": ProgressConfig(),
    "2.0": LearnerConfig(**SETTINGS["2.0"]),
    "1.0": LearnerConfig(algorithm="1.0", **SETTINGS["1.0"]),
}


def pictures(n: int = 400) -> dict[str, Any]:
    rng = np.random.default_rng(1)
    return {name: rng.integers(0, 256, (n, 6, 8), dtype=np.uint8) for name in ("left", "right")}


def environment(what: str, **options: Any) -> WatchEnv:
    source = ArraySource(pictures(2000)) if what == "pictures" else OscillatorySource()
    return WatchEnv(source, **options)


@pytest.mark.parametrize("what", ["numbers", "pictures"])
@pytest.mark.parametrize("observe", ["block", "outputs"])
@pytest.mark.parametrize("algorithm", LEARNED)
def test_gymnasiums_own_checks_pass(what: str, observe: Any, algorithm: str) -> None:
    if what == "pictures":  # they go on where they are, so that no two episodes are the same
        with environment(what, algorithm=algorithm, observe=observe, expansion="none") as env:
            seen, _ = env.reset(seed=1)
            assert env.observation_space.contains(seen)
            assert env.observation_space.contains(env.step(0)[0])
        return
    with warnings.catch_warnings(), environment(what, algorithm=algorithm, observe=observe) as env:
        warnings.filterwarnings("ignore", ".*alternative render modes|.*infinity")
        check_env(env)


@pytest.mark.parametrize("algorithm", LEARNED)
def test_our_policy_gives_the_signals_of_a_run(algorithm: str) -> None:
    digest, source = Digest(), OscillatorySource()
    learner = open_learner(LEARNED[algorithm], source.spec, 7)
    ended = learn_blocks(source, learner, [digest], max_iterations=400)
    env = WatchEnv(OscillatorySource(), algorithm, max_iterations=400, **SETTINGS[algorithm])
    for _ in range(2):  # an episode begins anew
        reported, over = SignalsHash(), False
        _, info = env.reset(seed=7)
        while not over:
            _, reward, terminated, truncated, info = env.step(info["stream"])
            signals: Any = env.signals
            assert reward == np.nan_to_num(signals.reward)
            reported.add(signals)
            over = terminated or truncated
        assert reported.hexdigest() == digest.hexdigest()
        assert truncated == (ended == "max_iterations")


def test_observations_are_what_was_watched() -> None:
    arrays, env = pictures(), WatchEnv(ArraySource(pictures()), tau=20)
    seen, _ = env.reset(seed=0)
    assert not seen.any()
    np.testing.assert_array_equal(env.step(1)[0], arrays["right"][:20])
    seen = env.step(0)[0]
    np.testing.assert_array_equal(seen, arrays["left"][20:40])
    seen[:] = 0  # is the caller's
    outputs = WatchEnv(OscillatorySource(), observe="outputs")
    outputs.reset(seed=0)
    for _ in range(5):
        seen = outputs.step(0)[0]
    signals: Any = outputs.signals
    np.testing.assert_array_equal(seen, np.nan_to_num(signals.y))
    assert seen.any()


def test_where_the_source_ends_it_is_truncated() -> None:
    env = WatchEnv(ArraySource(pictures(100)), tau=40)
    env.reset(seed=0)
    steps = [env.step(0) for _ in range(3)]
    assert [truncated for _, _, _, truncated, _ in steps] == [False, False, True]
    assert steps[2][1] == 0.0
    np.testing.assert_array_equal(steps[2][0], steps[1][0])
    with pytest.raises(ResetNeeded, match="call reset"):
        env.step(0)
    env.reset(seed=0)
    with pytest.raises(LogExhaustedError, match="20 of 40 frames are left"):
        env.step(0)


def test_the_example_of_ppo_runs(tmp_path: Path) -> None:
    """With a stand-in that chooses at random, for stable-baselines3 brings gigabytes."""
    (tmp_path / "stable_baselines3.py").write_text(
        "class PPO:\n"
        "    def __init__(self, policy, env, *, n_steps, batch_size, seed, verbose):\n"
        "        self.env = env\n"
        "    def learn(self, steps):\n"
        "        self.env.action_space.seed(0)\n"
        "    def predict(self, seen):\n"
        "        assert self.env.observation_space.contains(seen)\n"
        "        return self.env.action_space.sample(), None\n"
    )
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(tmp_path), str(EXAMPLES.parent)]),
    }
    done = python(EXAMPLES / "ppo.py", check=True, env=environment)
    assert [line.partition(":")[0] for line in done.stdout.splitlines()] == ["PPO", "the learner"]
