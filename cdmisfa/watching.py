"""`WatchEnv`: a Gymnasium environment whose actions choose the stream that a learner attends to."""

from __future__ import annotations

from math import isnan
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from cdmisfa.agents.learners import learner_class, open_learner
from cdmisfa.core.blocks import FrameSource, SeekableSource, turn_to
from cdmisfa.core.config import build, load_preset
from cdmisfa.core.errors import LogExhaustedError, UsageError, missing_base
from cdmisfa.core.learning import Learner
from cdmisfa.core.signals import BlockSignals

try:
    from gymnasium import Env
    from gymnasium.error import ResetNeeded
    from gymnasium.spaces import Box, Discrete
except ImportError:
    Env = missing_base("gymnasium", "'cdmisfa[gym]'")  # type: ignore[misc]


class WatchEnv(Env):
    """Learner whose next stream is chosen by the actions of an agent.

    A step is an iteration: the learner learns from a block of the stream that the action names. The
    reward is the learner's own: for the progress learner the fall of the learning error with that
    block, for 2.0 and 1.0 the reward of the paper; 0 if there is none. An episode is a run. It is
    terminated when the learner ends, and truncated after `max_iterations` or at the end of the
    source.

    `info["stream"]` is the stream that the learner itself would choose next. Actions that always
    follow it give the signals of a run with the same learner, source and seed, bit for bit.

    Args:
        source: an open source of frames; `close` closes it. Each episode begins at its present
            frame or, if the source cannot go back, where the previous episode ended.
        algorithm: name of the learner, "progress", "2.0" or "1.0".
        observe: "block" to observe the frames, "outputs" to observe the outputs of the features
            being learned, with 0 for NaN. The first observation is all zeros.
        max_iterations: largest number of steps in an episode.
        settings: configuration keys of the learner, such as `tau=20`.

    Attributes:
        action_space: indices of the streams.
        observation_space: (tau, *frame_shape), or (tau, outputs).
        learner: learner of the episode; None before the first one.
        signals: `BlockSignals` of the last step; None before the first one of an episode.

    Raises:
        UsageError: Gymnasium is missing, or there is no such learner, setting or observation.

    Example:
        >>> from recorder.world.oscillatory import OscillatorySource
        >>> env = WatchEnv(OscillatorySource(), max_iterations=100)
        >>> observation, info = env.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = env.step(info["stream"])
        >>> observation.shape
        (40, 2)
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - as Gymnasium declares it

    def __init__(
        self,
        source: FrameSource,
        algorithm: str = "progress",
        *,
        observe: Literal["block", "outputs"] = "block",
        max_iterations: int | None = None,
        **settings: Any,
    ) -> None:
        entry = learner_class(algorithm)
        preset = getattr(entry, "preset", None)
        base = load_preset(preset)["learner"] if preset else {}
        layers = base, {"algorithm": algorithm}, settings
        self._config = build(entry.configuration, "learner", *layers)
        self._source, self._start, self._observe = source, source.t, observe
        self._max_iterations = max_iterations
        spec = source.spec
        first = open_learner(self._config, spec, 0)
        shape: tuple[int, ...] = (first.tau, len(first.phi))
        pixels = False
        if observe == "block":
            if spec.kinds:
                raise UsageError('the streams differ in shape: set observe="outputs"')
            shape, pixels = (first.tau, *spec.frame_shape), spec.dtype == "uint8"
        low, high, dtype = (0, 255, np.uint8) if pixels else (-np.inf, np.inf, np.float64)
        self.observation_space = Box(low, high, shape, dtype)
        self.action_space = Discrete(len(spec.streams))
        self.learner: Learner | None = None
        self.signals: BlockSignals | None = None
        self._observation: NDArray[Any] = np.zeros(shape, dtype)
        self._stream = 0
        self._ended = True

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[Any], dict[str, Any]]:
        """Begin an episode with a new learner.

        Args:
            seed: seed of the learner; None: draw one.
            options: ignored.

        Returns:
            Zeros, and `info`.
        """
        super().reset(seed=seed)
        seed = int(self.np_random.integers(2**31)) if seed is None else seed
        if isinstance(self._source, SeekableSource):
            self._source.seek(self._start)
        self.learner = open_learner(self._config, self._source.spec, seed)
        self.signals, self._ended = None, False
        self._observation = np.zeros_like(self._observation)
        self._stream = self.learner.stream
        return self._observation.copy(), {"stream": self._stream}

    def step(self, action: Any) -> tuple[NDArray[Any], float, bool, bool, dict[str, Any]]:
        """Learn from a block of a stream.

        Args:
            action: index of the stream.

        Returns:
            The observation, the reward, whether the learner has ended, whether it was stopped, and
            `info`.

        Raises:
            ResetNeeded: no episode has begun.
            ValueError: the stream does not exist.
            LogExhaustedError: the source is shorter than one block.
        """
        learner: Any = self.learner
        if self._ended:
            raise ResetNeeded("no episode has begun, or it has ended: call reset()")
        reward, terminated = 0.0, False
        turn_to(self._source, self._stream, int(action))
        self._stream = int(action)
        learner.watch(self._stream)
        try:
            block = self._source.take(learner.stream, learner.tau)
        except LogExhaustedError:
            if not learner.iteration:
                raise
            truncated = True
        else:
            self.signals = signals = learner.step(block)
            observation = block.frames if self._observe == "block" else np.nan_to_num(signals.y)
            self._observation = np.asarray(observation)
            reward = 0.0 if isnan(signals.reward) else float(signals.reward)
            limit = learner.max_modules
            terminated = bool(learner.over) or (limit is not None and len(learner.modules) >= limit)
            limit = self._max_iterations
            truncated = limit is not None and learner.iteration >= limit
        self._ended = terminated or truncated
        return self._observation.copy(), reward, terminated, truncated, {"stream": learner.stream}

    def close(self) -> None:
        """Close the source."""
        self._source.close()
