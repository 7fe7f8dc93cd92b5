"""Blocks in, signals out: what all learners of this package share.

`count_inputs` and `rows_of` check the input of a learner; `signals_of_block` makes the record of
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

# Squares and products of values up to this, and their sums, are finite.
LARGEST_VALUE = 1e100

# An abstraction of more inputs than this (a grey image of 1400 x 1400) is refused.
MAX_INPUTS = 2_000_000


def count_inputs(expansion: str, spec: SourceSpec) -> int:
    """Return the number of inputs after expansion.

    Raises:
        UsageError: there is no such expansion, or there are too many inputs to hold.
    """
    values = math.prod(spec.frame_shape)
    inputs = expanded_size(expansion, values)
    if inputs > MAX_INPUTS:
        made = f"learner.expansion {expansion} makes {inputs:,} inputs of {values:,}"
        raise UsageError(f"{made}, more than {MAX_INPUTS:,}: take smaller frames")
    return inputs


def rows_of(block: Block, spec: SourceSpec, stream: int, tau: int) -> NDArray[Any]:
    """Return the frames of a block as rows, (tau, values).

    Args:
        block: the block that the source returned.
        spec: of that source.
        stream: the stream that the learner asked for.
        tau: the number of frames that it asked for.

    Raises:
        ValueError: the block is of another stream, length, frame shape or type.
        CdmisfaError: it holds a value that would spoil every estimate.
    """
    frames = block.frames
    given = len(frames), block.stream, frames.shape[1:], frames.dtype
    wanted = tau, stream, spec.frame_shape, np.dtype(spec.dtype)
    if given != wanted:
        words = (
            f"{n} frames of stream {s}, {shape} {dtype}" for n, s, shape, dtype in (wanted, given)
        )
        raise ValueError(f"the learner asked for {', not '.join(words)}")
    if frames.dtype.kind == "f" and not (  # also true of NaN; without an array as large as frames
        frames.max(initial=0) <= LARGEST_VALUE and frames.min(initial=0) >= -LARGEST_VALUE
    ):
        finite = np.isfinite(frames).all()
        what = f"larger than {LARGEST_VALUE:g}" if finite else "no finite number"
        where = f"in frames {block.t} to {block.t + tau - 1}"
        raise CdmisfaError(f"stream {spec.streams[stream]} holds a value that is {what} {where}")
    return frames.reshape(tau, -1)


def signals_of_block(
    block: Block, spec: SourceSpec, iteration: int, *, outputs: int, modules: int, **given: Any
) -> BlockSignals:
    """Return the signals of a block; numbers that are not given are NaN.

    Args:
        block: the watched block.
        spec: of its source.
        iteration: from 0.
        outputs: J of the learner's abstraction.
        modules: M, the number of modules saved before.
        given: signals by their names.
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
    return BlockSignals(**{**signals, **given})
