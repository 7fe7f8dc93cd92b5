"""The gate: what a learner's frozen modules know, in one stack."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cdmisfa import kernels
from cdmisfa.agents.agent import Agent
from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.modules import Module

NOVEL: int = kernels.lib.NOVEL
"""Verdict: no frozen module knows the block. Positive verdicts are the module's index."""

CONSTANT: int = kernels.lib.CONSTANT
"""Verdict: the block carries nothing to learn."""


class Frozen(NamedTuple):
    """All frozen modules in one stack, so that one pass over a block serves them all.

    Attributes:
        phi: (M J, I) weights.
        offset: (M J,) phi times the mean.
        band_mean: (M, J) centres of the bands of known slowness.
        band_sd: (M, J) their standard deviations.
        centres: (M, S, C, n, J) clusters; (M, 0, 0, n, J) but for CD-MISFA 1.0.
        counts: (M, S, C).
    """

    phi: FloatArray
    offset: FloatArray
    band_mean: FloatArray
    band_sd: FloatArray
    centres: FloatArray
    counts: FloatArray

    @property
    def struct(self) -> kernels.Struct:
        """The stack as the kernels take it."""
        arrays = {n: kernels.pointer(n, a, a.shape) for n, a in self._asdict().items()}
        sizes = {"modules": len(self.band_mean), "inputs": self.phi.shape[1]}
        return kernels.Struct("frozen", sizes, arrays)


def stacked(modules: Sequence[Module], agent: Agent, n_inputs: int) -> Frozen:
    """The modules of an agent whose abstractions have I = `n_inputs`."""
    count, outputs = len(modules), len(agent.eta)
    return Frozen(
        phi=np.array([m.phi for m in modules]).reshape(count * outputs, n_inputs),
        offset=np.array([kernels.mean_output(m.phi, m.mean) for m in modules]).reshape(-1),
        band_mean=np.array([m.band_mean for m in modules]).reshape(count, outputs),
        band_sd=np.array([m.band_sd for m in modules]).reshape(count, outputs),
        centres=np.array([m.centres for m in modules]).reshape(count, *agent.centres.shape),
        counts=np.array([m.counts for m in modules]).reshape(count, *agent.counts.shape),
    )
