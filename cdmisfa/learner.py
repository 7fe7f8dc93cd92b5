"""`CuriousLearner`: blocks in, signals out.

The learner knows neither where its blocks come from nor where its signals go. The same
blocks give the same signals, bit for bit.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.agent import OUTCOME, begin_abstraction, has_gap, mean_change, new_agent, rules, think
from cdmisfa.blocks import Block, SourceSpec
from cdmisfa.config import LearnerConfig
from cdmisfa.expansion import expanded_size, quadratic
from cdmisfa.gate import CONSTANT, is_constant, verdict
from cdmisfa.incsfa import IncSFA, project
from cdmisfa.modules import Module
from cdmisfa.signals import BlockSignals

Float = NDArray[np.float64]

POLICY_KEY, WEIGHTS_KEY = 1, 2
"""Spawn keys of the learner's two random generators, beneath the run's seed."""


class CuriousLearner:
    """The paper's agent: adaptive abstraction, gating system and curiosity-driven learner.

    Example:
        >>> from cdmisfa.streams import OscillatorySource
        >>> source = OscillatorySource()
        >>> learner = CuriousLearner(LearnerConfig(), source.spec, seed=0)
        >>> signals = learner.step(source.take(learner.stream, learner.tau))
        >>> signals.y.shape
        (100, 1)
    """

    def __init__(self, config: LearnerConfig, spec: SourceSpec, seed: int) -> None:
        self.config = config
        self.spec = spec
        self.seed = seed
        self.modules: list[Module] = []
        self._n_inputs = expanded_size(config.expansion, int(np.prod(spec.frame_shape)))
        self._scale = 1.0 / 255.0 if spec.dtype == "uint8" else 1.0
        self._policy_rng = np.random.Generator(
            np.random.PCG64(np.random.SeedSequence(seed, spawn_key=(POLICY_KEY,)))
        )
        n_streams = len(spec.streams)
        first = int(self._policy_rng.random() * n_streams)
        self._rules = rules(config, n_streams)
        self._agent = new_agent(config, n_streams, first)
        self._out = np.zeros(1, OUTCOME)
        self._freeze()
        self._sfa = self._new_abstraction()

    @property
    def tau(self) -> int:
        """Frames the learner wants in each block."""
        return self.config.tau

    @property
    def stream(self) -> int:
        """Stream the learner wants to watch next."""
        return int(self._agent.memory["stream"][0])

    @property
    def iteration(self) -> int:
        """Iterations so far."""
        return int(self._agent.memory["iteration"][0])

    @property
    def epsilon(self) -> float:
        """Probability of a random action in the last iteration."""
        return float(self._agent.memory["epsilon"][0])

    @property
    def policy(self) -> NDArray[np.int64]:
        """The policy being learned, (S,): 0 stay, 1 switch."""
        return self._agent.policy.copy()

    @property
    def phi(self) -> Float:
        """Weights of the adaptive abstraction, (J, I)."""
        return self._sfa.phi

    @property
    def exhausted(self) -> bool:
        """Whether exploration has ended long ago and still nothing converged."""
        return bool(self._agent.memory["idle"][0] > self.config.patience)

    def step(self, block: Block) -> BlockSignals:
        """One iteration: look at tau frames, learn, and decide what to watch next.

        Args:
            block: tau frames of the stream the learner asked for.

        Raises:
            ValueError: the block is of another stream or length.
        """
        if block.stream != self.stream or len(block) != self.tau:
            raise ValueError(
                f"the learner asked for {self.tau} frames of stream {self.stream}, "
                f"not {len(block)} of stream {block.stream}"
            )
        agent = self._agent
        frames = block.frames.reshape(len(block), -1)
        x = quadratic(frames) if self.config.expansion == "quadratic" else frames
        outputs, count = self.config.outputs, len(self.modules)
        y_frozen = project(self._frozen_phi, self._frozen_offset, x)
        y_frozen = np.ascontiguousarray(
            y_frozen.reshape(len(block), count, outputs).transpose(1, 0, 2)
        )
        eta_frozen = np.empty((count, outputs))
        known_by = verdict(y_frozen, self._band_mean, self._band_sd, eta_frozen)
        if is_constant(frames, self._scale):
            known_by = CONSTANT
        y = np.full((len(block), outputs), np.nan)
        xi = np.nan
        if known_by == 0:
            gap = has_gap(agent, block.stream, block.t)
            xi = mean_change(self._sfa.update(x, gap))
            phi = self._sfa.phi
            y = project(phi, phi @ self._sfa.mean, x)
        think(
            agent,
            self._rules,
            self._out,
            known_by,
            xi,
            y,
            block.t + len(block),
            self._policy_rng.random(3),
        )
        signals = self._signals(block, y, y_frozen, eta_frozen, known_by)
        if self._out["saved"][0]:
            self._save(signals)
        return signals

    def _signals(
        self, block: Block, y: Float, y_frozen: Float, eta_frozen: Float, known_by: int
    ) -> BlockSignals:
        agent = self._agent
        novel = known_by == 0
        out: dict[str, Any] = dict(zip(OUTCOME.names or (), self._out[0].item(), strict=True))
        n_rewards = max(int(agent.memory["rewards"][0]), 1)
        return BlockSignals(
            iteration=self.iteration - 1,
            t=block.t,
            log_time=self.spec.time_ns(block.t),
            y=y,
            y_frozen=y_frozen,
            eta=agent.eta.copy(),
            eta_dot=agent.eta_dot.copy(),
            variance=agent.recent_square - agent.recent_mean**2,
            eta_inst=agent.eta_inst.copy() if novel else np.full(len(agent.eta), np.nan),
            gate_mean=agent.gate_mean.copy(),
            gate_sd=np.sqrt(agent.gate_variance),
            eta_inst_frozen=eta_frozen,
            band_mean=self._band_mean,
            band_sd=self._band_sd,
            R=agent.dense / n_rewards,
            Q=agent.Q.copy(),
            policy=agent.policy.copy(),
            **out,
        )

    def _save(self, signals: BlockSignals) -> None:
        module = Module(
            index=len(self.modules) + 1,
            stream=signals.stream,
            iteration=signals.iteration,
            phi=self._sfa.phi.copy(),
            mean=self._sfa.mean.copy(),
            band_mean=signals.gate_mean,
            band_sd=signals.gate_sd,
            eta=signals.eta,
            policy=signals.policy,
        )
        self.modules.append(module)
        self._freeze()
        begin_abstraction(self._agent, self._rules.epsilon_start)
        self._sfa = self._new_abstraction()

    def _freeze(self) -> None:
        """Stack the frozen modules' rows, so that one matrix product serves all of them."""
        outputs = self.config.outputs
        shape = (len(self.modules), outputs)
        self._frozen_phi = np.array([m.phi for m in self.modules]).reshape(-1, self._n_inputs)
        self._frozen_offset = np.array([m.phi @ m.mean for m in self.modules]).reshape(-1)
        self._band_mean = np.array([m.band_mean for m in self.modules]).reshape(shape)
        self._band_sd = np.array([m.band_sd for m in self.modules]).reshape(shape)

    def _new_abstraction(self) -> IncSFA:
        key = (WEIGHTS_KEY, len(self.modules))
        seed = np.random.SeedSequence(self.seed, spawn_key=key)
        return IncSFA(self.config, self._n_inputs, np.random.Generator(np.random.PCG64(seed)))
