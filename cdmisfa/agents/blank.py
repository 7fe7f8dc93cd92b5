"""The signals of an iteration, for learners that have only some of them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from cdmisfa.core.blocks import Block, SourceSpec
from cdmisfa.core.signals import DENSE_STREAMS, NO_STATE, SIGNALS, BlockSignals


def signals_of_block(
    block: Block, spec: SourceSpec, iteration: int, *, outputs: int, modules: int, **said: Any
) -> BlockSignals:
    """The signals of a block; numbers that are not `said` are NaN.

    Args:
        block: that was watched.
        spec: of its source.
        iteration: from 0.
        outputs: J of the learner's abstraction.
        modules: M, those that were saved before.
        said: signals by their names.
    """
    n = {"T": len(block), "J": outputs, "M": modules, "S": len(spec.streams), "A": 2}
    known: dict[str, Any] = {
        "iteration": iteration,
        "t": block.t,
        "log_time": spec.time_ns(block.t),
    }
    known |= {"stream": block.stream, "module": modules + 1, "next_stream": block.stream}
    blank: dict[str, Any] = {"bool": False, "int64": 0, "float64": math.nan}
    for signal in SIGNALS.values():
        value = NO_STATE if signal.name == "state" else blank[signal.dtype]
        shape = tuple(n[dim] for dim in signal.dims)
        known.setdefault(signal.name, np.full(shape, value) if shape else value)
    if len(spec.streams) > DENSE_STREAMS:
        known["R"] = np.empty((0, 2, 0))
    return BlockSignals(**{**known, **said})
