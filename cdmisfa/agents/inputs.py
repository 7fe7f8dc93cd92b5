"""Input and output that the learners share.

`count_inputs` and `rows_of` check the input of a learner; `signals_of_block` creates the record of
an iteration for learners that have only some of the signals.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.blocks import Block, SourceSpec
from cdmisfa.core.errors import CdmisfaError, UsageError
from cdmisfa.core.expansion import expanded_size
from cdmisfa.core.signals import DENSE_STREAMS, NO_STATE, SIGNALS, BlockSignals

# Largest absolute value of a frame: squares of such values, and their sums, stay finite in float64.
LARGEST_VALUE = 1e100

# Largest number of inputs, a gray image of 1400 x 1400. A progress learner then takes up to
# 1.1 GB for each candidate.
MAX_INPUTS = 2_000_000


def count_inputs(expansion: str, shape: tuple[int, ...]) -> int:
    """Return the number of inputs after expansion of frames of a shape.

    Raises:
        UsageError: the expansion does not exist, or it makes more than `MAX_INPUTS` inputs.
    """
    values = math.prod(shape)
    inputs = expanded_size(expansion, values)
    if inputs > MAX_INPUTS:
        fact = f"learner.expansion {expansion} makes {inputs:,} inputs of {values:,} values"
        raise UsageError(f"{fact}, more than {MAX_INPUTS:,}: use smaller frames")
    return inputs


def rows_of(block: Block, spec: SourceSpec, stream: int, tau: int) -> NDArray[Any]:
    """Check a block, and return its frames as rows, (tau, values).

    Args:
        block: block of the source.
        spec: properties of the source.
        stream: index of the stream that the learner asked for.
        tau: number of frames that the learner asked for.

    Raises:
        ValueError: the block has a different stream, length, frame shape or type.
        CdmisfaError: the block holds a value that is not finite or above `LARGEST_VALUE`.
    """
    frames = block.frames
    actual = len(frames), block.stream, frames.shape[1:], frames.dtype
    shape, dtype = spec.kind(stream)
    expected = tau, stream, shape, np.dtype(dtype)
    if actual != expected:
        texts = (
            f"{n} frames of stream {s}, {form} {kind}" for n, s, form, kind in (expected, actual)
        )
        raise ValueError(f"the learner asked for {', not '.join(texts)}")
    if frames.dtype.kind == "f" and not (  # also true of NaN; without an array as large as frames
        frames.max(initial=0) <= LARGEST_VALUE and frames.min(initial=0) >= -LARGEST_VALUE
    ):
        finite = np.isfinite(frames).all()
        problem = f"larger than {LARGEST_VALUE:g}" if finite else "not finite"
        place = f"in frames {block.t} to {block.t + tau - 1}"
        raise CdmisfaError(
            f"stream {spec.streams[stream]} holds a value that is {problem} {place}: leave these "
            "frames out, or fill the value in"
        )
    return frames.reshape(tau, -1)


def signals_of_block(
    block: Block, spec: SourceSpec, iteration: int, *, outputs: int, modules: int, **values: Any
) -> BlockSignals:
    """Return the signals of a block; signals without a value are NaN, 0 or False.

    Args:
        block: the block of the iteration.
        spec: properties of the source.
        iteration: number of the iteration, from 0.
        outputs: number of outputs J.
        modules: number of modules M saved before.
        values: values of signals by name.
    """
    n = {"T": len(block), "J": outputs, "M": modules, "S": len(spec.streams), "A": 2}
    signals: dict[str, Any] = {
        "iteration": iteration,
        "t": block.t,
        "log_time": spec.time_ns(block.t),
        "stream": block.stream,
        "next_stream": block.stream,
        "module": modules + 1,
    }
    blank: dict[str, Any] = {"bool": False, "int64": 0, "float64": math.nan}
    for signal in SIGNALS.values():
        value = NO_STATE if signal.name == "state" else blank[signal.dtype]
        shape = tuple(n[dim] for dim in signal.dims)
        signals.setdefault(signal.name, np.full(shape, value) if shape else value)
    if len(spec.streams) > DENSE_STREAMS:
        signals["R"] = np.empty((0, 2, 0))
    return BlockSignals(**{**signals, **values})
