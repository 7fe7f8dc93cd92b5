"""Learning as an environment of Gymnasium: actions are streams to watch, rewards are curiosity."""

from __future__ import annotations

from math import isnan
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from cdmisfa.agents.learners import learner_class, open_learner
from cdmisfa.core.blocks import FrameSource, SeekableSource, turn_to
from cdmisfa.core.config import build, load_preset
from cdmisfa.core.errors import LogExhaustedError, UsageError
from cdmisfa.core.learning import Learner
from cdmisfa.core.signals import BlockSignals

try:
    from gymnasium import Env
    from gymnasium.error import ResetNeeded
    from gymnasium.spaces import Box, Discrete
except ImportError:

    class Env:  # type: ignore[no-redef]
        def __new__(cls, *_: Any, **__: Any) -> Self:
            raise UsageError(
                f"{cls.__name__} needs Gymnasium, which is missing: pip install 'cdmisfa[gym]'"
            )


class WatchEnv(Env):
    """A learner whose streams are chosen from outside.

    A step is an iteration: the learner learns from a block of the stream that the action names. The
    reward is the learner's own: the fall of the learning error with that block of the progress
    learner, the paper's of 2.0 and 1.0; 0 where there is none. An episode is a run. It is
    terminated when the learner ends by itself, and truncated after `max_iterations` or where the
    source ends.

    `info["stream"]` is what the learner itself would watch next. Actions that always follow it give
    the signals of a run of the same learner, source and seed, to the bit.

    Args:
        source: an open source of frames; `close` closes it. Each episode begins where it is now,
            or, with one that cannot go back, where the one before ended.
        algorithm: the learner's name, "progress", "2.0" or "1.0".
        observe: "block": the frames watched; "outputs": those of what is being learned there,
            NaN as 0. Zeros before the first step.
        max_iterations: steps of an episode at most.
        settings: keys of the learner, `tau=20`; see docs/reference/configuration.md.

    Attributes:
        action_space: the streams' indices.
        observation_space: (tau, *frame_shape), or (tau, outputs).
        learner: the episode's; None before the first.
        signals: of the last step (docs/reference/signals.md); None before the first of an episode.

    Raises:
        UsageError: Gymnasium is missing, or there is no such learner, setting or observation.

    Example:
        >>> from recorder.world.oscillatory import OscillatorySource
        >>> env = WatchEnv(OscillatorySource(), max_iterations=100)
        >>> seen, info = env.reset(seed=0)
        >>> seen, reward, terminated, truncated, info = env.step(info["stream"])
        >>> seen.shape
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
        self._most = max_iterations
        spec = source.spec
        first = open_learner(self._config, spec, 0)
        shape: tuple[int, ...] = (first.tau, len(first.phi))
        pixels = False
        if observe == "block":
            shape, pixels = (first.tau, *spec.frame_shape), spec.dtype == "uint8"
        low, high, dtype = (0, 255, np.uint8) if pixels else (-np.inf, np.inf, np.float64)
        self.observation_space = Box(low, high, shape, dtype)
        self.action_space = Discrete(len(spec.streams))
        self.learner: Learner | None = None
        self.signals: BlockSignals | None = None
        self._seen: NDArray[Any] = np.zeros(shape, dtype)
        self._watched = 0
        self._ended = True

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[Any], dict[str, Any]]:
        """Begin an episode with a learner that has learned nothing.

        Args:
            seed: of the learner's random choices; by default drawn.
            options: none.

        Returns:
            Zeros, and `info`.
        """
        super().reset(seed=seed)
        seed = int(self.np_random.integers(2**31)) if seed is None else seed
        if isinstance(self._source, SeekableSource):
            self._source.seek(self._start)
        self.learner = open_learner(self._config, self._source.spec, seed)
        self.signals, self._seen, self._ended = None, np.zeros_like(self._seen), False
        self._watched = self.learner.stream
        return self._seen.copy(), {"stream": self._watched}

    def step(self, action: Any) -> tuple[NDArray[Any], float, bool, bool, dict[str, Any]]:
        """Watch a stream for a block, and learn from it.

        Args:
            action: the stream's index.

        Returns:
            What was seen, the reward, whether the learner has ended, whether it was stopped, and
            `info`.

        Raises:
            ResetNeeded: there is no episode.
            ValueError: there is no such stream.
            LogExhaustedError: the source has not enough for a single block.
        """
        learner: Any = self.learner
        if self._ended:
            raise ResetNeeded("there is no episode, or it is over: call reset()")
        reward, terminated = 0.0, False
        turn_to(self._source, self._watched, int(action))
        self._watched = int(action)
        learner.watch(self._watched)
        try:
            block = self._source.take(learner.stream, learner.tau)
        except LogExhaustedError:
            if not learner.iteration:
                raise
            truncated = True
        else:
            self.signals = signals = learner.step(block)
            shown = block.frames if self._observe == "block" else np.nan_to_num(signals.y)
            self._seen = np.asarray(shown)
            reward = 0.0 if isnan(signals.reward) else float(signals.reward)
            most = learner.max_modules
            terminated = bool(learner.over) or (most is not None and len(learner.modules) >= most)
            truncated = self._most is not None and learner.iteration >= self._most
        self._ended = terminated or truncated
        return self._seen.copy(), reward, terminated, truncated, {"stream": learner.stream}

    def close(self) -> None:
        """Close the source."""
        self._source.close()
