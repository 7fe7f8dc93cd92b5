"""The agent's kernels as tests call them: with what the gate, the abstraction and draws say."""

from __future__ import annotations

from typing import Any

import numpy as np

from cdmisfa import kernels
from cdmisfa.agents.agent import NOVEL, OUTCOME, Frozen, as_struct, new_agent, rules
from cdmisfa.core.config import LearnerConfig

STAY = (0.999999, 0.0, 0.0)
"""Draws that explore only while epsilon is 1 or more, and then stay."""


class KernelAgent:
    """An agent that is told what its gate and its abstraction say."""

    def __init__(self, config: LearnerConfig, n: int = 3, first: int = 0) -> None:
        self.config, self.rules = config, rules(config, n)
        self.agent, self.out = new_agent(config, n, first), np.zeros(1, OUTCOME)
        self.struct = as_struct(self.agent, self.rules, self.out)
        self.t = 0

    def think(
        self, xi: Any, known_by: int, draws: tuple[float, ...], y: np.ndarray
    ) -> dict[str, Any]:
        """One iteration with xi, a number or (n,), and y (n, J); its outcome."""
        changes = np.full(len(y), np.nan)
        changes[: np.size(xi)] = xi
        self.out["known_by"] = known_by
        arrays = (np.ascontiguousarray(a, float) for a in (changes, y, draws))
        first, second, third = (kernels.ffi.from_buffer("double[]", a) for a in arrays)
        code = kernels.lib.think(self.struct.pointer, first, second, self.t, third)
        kernels.check(code, "the learner")
        self.t += len(y)
        return dict(zip(OUTCOME.names or (), self.out[0].item(), strict=True))

    def recognise(self, frozen: Frozen, frames: Any, x: Any) -> tuple[int, Any, Any, Any]:
        """What knows a block; outputs, slowness and clustering error of the frozen modules."""
        shown, expanded = kernels.frames_of(frames), kernels.frames_of(x)
        (M, J), n = frozen.band_mean.shape, len(frames)
        outputs = np.empty((M, n, J)), np.empty((M, J)), np.empty(M)
        stack = frozen.struct
        structs = (s.pointer for s in (self.struct, stack, shown, expanded))
        into = (kernels.ffi.from_buffer("double[]", array) for array in outputs)
        kernels.check(kernels.lib.recognise(*structs, *into), "the learner")
        return int(self.out["known_by"][0]), *outputs

    def values(self) -> np.ndarray:
        """The action values, (S, 2)."""
        return kernels.action_values(self.struct)

    @property
    def memory(self) -> dict[str, Any]:
        memory = self.agent.memory
        return dict(zip(memory.dtype.names, memory[0].item(), strict=True))


def recognised(
    y_frozen: np.ndarray, band_mean: np.ndarray, band_sd: np.ndarray, frames: Any = None
) -> tuple[int, np.ndarray]:
    """What knows a block on which modules give (M, n, J), and their slowness (M, J)."""
    M, n, J = y_frozen.shape
    x = y_frozen.transpose(1, 0, 2).reshape(n, M * J)
    clusters = np.zeros((M, 0, 0, n, J)), np.zeros((M, 0, 0))
    frozen = Frozen(np.eye(M * J), np.zeros(M * J), band_mean, band_sd, *clusters)
    if frames is None:
        frames = np.arange(n, dtype=np.float64)[:, None]
    agent = KernelAgent(LearnerConfig(tau=n, outputs=J, components=J), 3)
    known_by, _, eta, _ = agent.recognise(frozen, frames, x)
    return known_by, eta


def is_constant(frames: np.ndarray) -> bool:
    """Whether the gate says that a block carries nothing."""
    none = np.empty((0, 1))
    known_by, _ = recognised(np.empty((0, len(frames), 1)), none, none, frames)
    return known_by != NOVEL
