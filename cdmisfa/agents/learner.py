"""`CuriousLearner`: the paper's learners, CD-MISFA 2.0 and 1.0.

The learner takes blocks and returns signals; it knows neither the source of the blocks nor the use
of the signals. The same blocks give the same signals, bit for bit.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa import kernels
from cdmisfa.agents.agent import (
    OUTCOME,
    as_struct,
    begin_abstraction,
    frozen_modules,
    new_agent,
    rules,
)
from cdmisfa.agents.inputs import count_inputs, rows_of
from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.blocks import PIXEL, Block, SourceSpec, freeze
from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.errors import UsageError
from cdmisfa.core.expansion import expand
from cdmisfa.core.learning import LearnerState, overwrite
from cdmisfa.core.signals import NO_STATE, BlockSignals
from cdmisfa.features.incsfa import IncrementalFeature
from cdmisfa.modules import Module

# Spawn keys of the two random generators under the run's seed. Another value changes every run.
POLICY_KEY, WEIGHTS_KEY = 1, 2


class CuriousLearner:
    """The paper's learner: features being learned, a gate of saved modules, and a curious agent.

    Args:
        config: the configuration.
        spec: the streams and frames of the source.
        seed: seed of the random generators.

    Attributes:
        modules: the saved modules.
        events: events of the last iteration, one line each.
        scale: factor from a frame's values to the learner's: 1/255 for pixels, else 1.
        policy_rng: generator of three draws in each iteration, whether or not they are used.
        rules: values of the configuration that the agent uses.
        agent: memory of the agent; changed in place.
        abstraction: the features being learned.
        frozen: the saved modules in one stack.
        out: (1,) of `OUTCOME`, the outcome of the last iteration.

    Example:
        >>> from recorder.world.oscillatory import OscillatorySource
        >>> source = OscillatorySource()
        >>> learner = CuriousLearner(LearnerConfig(), source.spec, seed=0)
        >>> signals = learner.step(source.take(learner.stream, learner.tau))
        >>> signals.y.shape
        (100, 1)
    """

    configuration = LearnerConfig

    def __init__(self, config: LearnerConfig, spec: SourceSpec, seed: int) -> None:
        self.config, self.spec, self.seed = config, spec, seed
        self.modules: list[Module] = []
        self.events: tuple[str, ...] = ()
        if spec.kinds:
            raise UsageError(
                f"{' and '.join(spec.streams)} have frames of different kinds, but learner "
                f"{config.algorithm} takes one kind: add --algorithm progress"
            )
        self._n_inputs = inputs = count_inputs(config.expansion, spec.frame_shape)
        if config.components > inputs:
            limit = f"more than the {inputs} inputs: set it to at most {inputs}"
            raise UsageError(f"learner.components is {config.components}, {limit}")
        self.scale = PIXEL if spec.dtype == "uint8" else 1.0
        draws = np.random.SeedSequence(seed, spawn_key=(POLICY_KEY,))
        self.policy_rng = np.random.Generator(np.random.PCG64(draws))
        n_streams = len(spec.streams)
        first = int(self.policy_rng.random() * n_streams)
        self.rules = rules(config, n_streams)
        self.agent = new_agent(config, n_streams, first)
        self.out = np.zeros(1, OUTCOME)
        self._agent = as_struct(self.agent, self.rules, self.out)
        # Signals that only the progress learner has.
        scalars = ("change", "tested", "fitted", "learning_error", "typical", "regret")
        self._progress_signals: dict[str, Any] = dict.fromkeys(scalars, math.nan)
        self._progress_signals["interest"] = freeze(np.full(n_streams, np.nan))
        self._progress_signals["state"] = freeze(np.full(n_streams, NO_STATE))
        self._stack_modules()
        self.abstraction = self._new_abstraction()

    @property
    def tau(self) -> int:
        """Number of frames in each block."""
        return self.config.tau

    @property
    def stream(self) -> int:
        """Index of the stream of the next block."""
        return int(self.agent.memory["stream"][0])

    def watch(self, stream: int) -> None:
        """Take the next block from `stream` instead of the stream that the agent chose."""
        memory = self.agent.memory[0]
        if stream != memory["stream"]:
            memory["stream"] = stream
            memory["last_action"] = stream != memory["last_stream"]

    @property
    def iteration(self) -> int:
        """Number of iterations done."""
        return int(self.agent.memory["iteration"][0])

    @property
    def epsilon(self) -> float:
        """Probability of a random action in the last iteration."""
        return float(self.agent.memory["epsilon"][0])

    @property
    def policy(self) -> NDArray[np.int64]:
        """(S,) the policy being learned: 0 stay, 1 switch."""
        return self.agent.policy.copy()

    @property
    def phi(self) -> FloatArray:
        """(J, I) weights of the features being learned, a copy."""
        return self.abstraction.phi.copy()

    @property
    def arithmetic(self) -> int:
        """Version of the kernels; see `arithmetic_of`."""
        return kernels.ARITHMETIC

    @property
    def over(self) -> str:
        """Reason to end: "nothing_left" after `patience` iterations without exploration."""
        return "nothing_left" if self.agent.memory["idle"][0] > self.config.patience else ""

    @property
    def max_modules(self) -> int:
        """Number of modules after which a run ends by default: one for each stream."""
        return len(self.spec.streams)

    @property
    def state(self) -> LearnerState:
        """A copy of the learner's state."""
        return LearnerState(
            arrays={name: array.copy() for name, array in self._arrays().items()},
            modules=tuple(self.modules),
            policy_rng=self.policy_rng.bit_generator.state,
        )

    def restore(self, state: LearnerState) -> None:
        """Restore the state of a learner with the same configuration, spec and seed.

        Raises:
            ValueError: an array is missing or has a different shape or type.
        """
        self.modules = [
            dataclasses.replace(module, expansion=self.config.expansion, scale=self.scale)
            for module in state.modules
        ]
        self._stack_modules()
        self.abstraction = self._new_abstraction()
        overwrite(self._arrays(), state.arrays)
        self.policy_rng.bit_generator.state = dict(state.policy_rng)

    def step(self, block: Block) -> BlockSignals:
        """Do one iteration: learn from a block if it is novel, and choose the next stream.

        Args:
            block: `tau` frames of the stream `stream`.

        Raises:
            ValueError: the block has a different stream, length, frame shape or type.
            CdmisfaError: the block holds a value that is not finite.
        """
        frames = rows_of(block, self.spec, self.stream, self.tau)
        raw = x = kernels.frames_of(frames)
        expanded = expand(self.config.expansion, frames)
        if expanded is not frames:
            x = kernels.frames_of(expanded, self._n_inputs)
        uniforms, kernel = self.policy_rng.random(3), self.abstraction.kernel
        results = kernels.iterate(self._agent, self._frozen, kernel, raw, x, block.t, uniforms)
        signals = self._signals(block, *results)
        self.events = ()
        if self.out["saved"][0]:
            self.save_abstraction()
            module = self.modules[-1]
            self.events = (
                f"module {module.index} saved on stream {module.stream}, "
                f"policy {module.policy.tolist()}",
            )
        return signals

    def repeat(
        self,
        raw: kernels.Struct,
        x: kernels.Struct,
        uniforms: FloatArray,
        swap_below: float = -1.0,
        curves: kernels.Struct | None = None,
    ) -> int:
        """Iterate on periodic streams as `step` does, without creating the signals.

        It returns when a module is ready to be saved, when epsilon falls below `swap_below`, when
        the learner is over, or after n iterations.

        Args:
            raw: for each stream one period of frames and the first tau frames again.
            x: the same frames, expanded.
            uniforms: (n, 3) draws of n iterations.
            swap_below: value of epsilon to return at.
            curves: record that receives the signals of each iteration; None for no record.

        Returns:
            Number of iterations done.
        """
        kernel = self.abstraction.kernel
        agent, frozen = self._agent, self._frozen
        return kernels.iterations(agent, frozen, kernel, raw, x, uniforms, swap_below, curves)

    def summary(self) -> dict[str, Any]:
        """Return the learner's part of a run's result, as JSON values."""
        return {"final_policy": self.agent.policy.tolist(), "epsilon": self.epsilon}

    def _arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of the state, by name; not copies."""
        parts: dict[str, Any] = {"agent": self.agent, "abstraction": self.abstraction.state}
        return {
            f"{part}.{name}": array
            for part, arrays in parts.items()
            for name, array in zip(arrays._fields, arrays, strict=True)
        }

    def _signals(
        self,
        block: Block,
        y: FloatArray,
        y_frozen: FloatArray,
        eta_frozen: FloatArray,
        roc_error_frozen: FloatArray,
    ) -> BlockSignals:
        agent = self.agent
        out: dict[str, Any] = dict(zip(OUTCOME.names or (), self.out[0].item(), strict=True))
        scale = agent.memory["scale"][0]
        return BlockSignals(
            iteration=self.iteration - 1,
            t=block.t,
            log_time=self.spec.time_ns(block.t),
            y=y,
            y_frozen=y_frozen,
            eta=agent.eta.copy(),
            eta_dot=agent.eta_dot.copy(),
            variance=agent.recent_square - agent.recent_mean * agent.recent_mean,
            eta_inst=agent.eta_inst.copy() if out["novel"] else np.full(len(agent.eta), np.nan),
            gate_mean=agent.gate_mean.copy(),
            gate_sd=np.sqrt(agent.gate_variance),
            eta_inst_frozen=eta_frozen,
            band_mean=self.frozen.band_mean.copy(),
            band_sd=self.frozen.band_sd.copy(),
            roc_error_frozen=roc_error_frozen,
            R=agent.dense / (scale or 1.0),
            Q=kernels.action_values(self._agent),
            policy=agent.policy.copy(),
            **out,
            **self._progress_signals,
        )

    def save_abstraction(self) -> None:
        """Save the features that are ready as a module, and begin new features."""
        agent, memory = self.agent, self.agent.memory[0]
        self.modules.append(
            Module(
                index=len(self.modules) + 1,
                stream=self.spec.streams[int(memory["last_stream"])],
                stream_index=int(memory["last_stream"]),
                iteration=int(memory["iteration"]) - 1,
                phi=self.abstraction.phi.copy(),
                mean=self.abstraction.mean.copy(),
                band_mean=agent.gate_mean.copy(),
                band_sd=np.sqrt(agent.gate_variance),
                eta=agent.eta.copy(),
                policy=agent.policy.copy(),
                expansion=self.config.expansion,
                scale=self.scale,
                frame_shape=self.spec.frame_shape,
                centres=agent.centres.copy(),
                counts=agent.counts.copy(),
            )
        )
        self._stack_modules()
        begin_abstraction(self.agent, self.rules.epsilon_start)
        self.abstraction = self._new_abstraction()

    def _stack_modules(self) -> None:
        self.frozen = frozen_modules(self.modules, self.agent, self._n_inputs)
        self._frozen = self.frozen.struct

    def _new_abstraction(self) -> IncrementalFeature:
        seed = np.random.SeedSequence(self.seed, spawn_key=(WEIGHTS_KEY, len(self.modules)))
        rng = np.random.Generator(np.random.PCG64(seed))
        return IncrementalFeature(self.config, self._n_inputs, rng)
