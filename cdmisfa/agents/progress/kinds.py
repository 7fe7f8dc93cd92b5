"""The kinds of frames of a source, images and vectors, and the modules that apply to each."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from cdmisfa import kernels
from cdmisfa.agents.inputs import count_inputs
from cdmisfa.agents.progress.config import ProgressConfig
from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.blocks import PIXEL, FrameKind, SourceSpec
from cdmisfa.core.expansion import expanded_size
from cdmisfa.modules import Module


class StreamInputs(NamedTuple):
    """How frames of one kind become inputs of the features."""

    expansion: str
    size: int
    scale: float

    @classmethod
    def of(cls, shape: tuple[int, ...], dtype: str, config: ProgressConfig) -> Self:
        """Return how frames of a shape and type become inputs."""
        # With more products than whitened components the slow features are lost among them: a sine
        # mixed with noise is learned from frames of 4 values, and not of 7 (decision 0032 of
        # docs/project/decisions.md).
        few = expanded_size("quadratic", math.prod(shape)) <= config.components
        expansion = config.expansion or ("quadratic" if few else "none")
        scale = PIXEL if dtype == "uint8" else 1.0
        return cls(expansion, count_inputs(expansion, shape), scale)


class FrameKinds:
    """The kinds of frames of the streams; a module applies only to streams of its own kind.

    Attributes:
        slow: number of slow outputs of a signal, which come first.
        outputs: number of outputs J of a signal; streams with fewer have NaN for the rest.
        most_inputs: largest number of inputs of a kind.
    """

    def __init__(self, spec: SourceSpec, config: ProgressConfig) -> None:
        self._kinds = [spec.kind(stream) for stream in range(len(spec.streams))]
        self._inputs = {kind: StreamInputs.of(*kind, config) for kind in spec.every_kind}
        self.most_inputs = max(inputs.size for inputs in self._inputs.values())
        self.slow = min(config.outputs, self.most_inputs)
        self.outputs = self.slow + min(config.principal, config.components, self.most_inputs)

    def inputs(self, stream: int) -> StreamInputs:
        """Return how frames of a stream become inputs."""
        return self._inputs[self._kinds[stream]]

    def stack(self, modules: Sequence[Module]) -> None:
        """Stack the weights of the modules of each kind, so that one pass computes all outputs."""
        self._count, by_kind = len(modules), dict[FrameKind, list[int]]()
        for i, module in enumerate(modules):
            by_kind.setdefault(self._kinds[module.stream_index], []).append(i)
        self._stacks: dict[FrameKind, tuple[list[int], FloatArray, FloatArray]] = {}
        for kind, indices in by_kind.items():
            phi = np.concatenate([modules[i].phi for i in indices])
            offsets = [kernels.mean_output(modules[i].phi, modules[i].mean) for i in indices]
            self._stacks[kind] = indices, phi, np.concatenate(offsets)

    def modules_for(self, stream: int) -> list[int]:
        """Return the indices of the modules that apply to a stream."""
        stack = self._stacks.get(self._kinds[stream])
        return [] if stack is None else stack[0]

    def module_outputs(self, stream: int, frames: NDArray[Any]) -> FloatArray:
        """Return (M, n, J) outputs of all modules on inputs (n, I) of a stream, else NaN."""
        y = np.full((self._count, len(frames), self.outputs), np.nan)
        if (stack := self._stacks.get(self._kinds[stream])) is not None:
            indices, phi, offset = stack
            outputs = kernels.outputs(phi, offset, frames).reshape(len(frames), len(indices), -1)
            y[indices] = self.spread(outputs, self.inputs(stream)).transpose(1, 0, 2)
        return y

    def spread(self, values: FloatArray, inputs: StreamInputs) -> FloatArray:
        """Return (..., j) values of the outputs of a kind as (..., J), with NaN for the missing."""
        if values.shape[-1] == self.outputs:
            return values
        slow = min(self.slow, inputs.size)
        whole = np.full((*values.shape[:-1], self.outputs), np.nan)
        whole[..., :slow] = values[..., :slow]
        whole[..., self.slow : self.slow + values.shape[-1] - slow] = values[..., slow:]
        return whole
