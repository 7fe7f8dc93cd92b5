"""What a learner takes in: the number of its inputs, and the block that it asked for."""

from __future__ import annotations

from numbers import Integral
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.blocks import Block, SourceSpec
from cdmisfa.core.errors import CdmisfaError, UsageError
from cdmisfa.core.expansion import expanded_size

LAST_FRAME = 2**62
"""Frames are numbered up to this: what follows a block has a number of 64 bits, too."""

LARGEST_VALUE = 1e100
"""Squares and products of values up to this, and their sums, are finite."""

MAX_INPUTS = 2_000_000
"""An abstraction of more inputs than this (a grey image of 1400 x 1400) is refused."""


def count_inputs(expansion: str, spec: SourceSpec) -> int:
    """Number of inputs after expansion.

    Raises:
        UsageError: too many to hold, or this is no spec.
    """
    if not isinstance(spec, SourceSpec):
        raise UsageError(f"{type(spec).__name__} given as spec: give the source's, source.spec")
    values = int(np.prod(spec.frame_shape))
    inputs = expanded_size(expansion, values)
    if inputs > MAX_INPUTS:
        raise UsageError(
            f"learner.expansion {expansion} makes {inputs:,} inputs of {values:,}, "
            f"more than {MAX_INPUTS:,}: set learner.expansion=none or take smaller frames"
        )
    return inputs


def rows_of(block: Block, spec: SourceSpec, stream: int, tau: int) -> NDArray[Any]:
    """The frames of a block as rows, (tau, values).

    A block that was not asked for is refused, as is one that would spoil every estimate.

    Args:
        block: as a source gave it.
        spec: of that source.
        stream: the stream that was asked for.
        tau: the frames that were asked for.

    Raises:
        UsageError: it is no block, or of no frame number.
        ValueError: the block is of another stream, length, frame shape or type.
        CdmisfaError: it holds a value that is no finite number.
    """
    if not isinstance(block, Block):
        raise UsageError(
            f"{type(block).__name__} given: a learner takes the blocks of a source, as "
            "source.take(learner.stream, learner.tau) gives them"
        )
    if not isinstance(block.t, Integral) or not 0 <= block.t <= LAST_FRAME:
        raise UsageError(f"a block at frame {block.t!r} given: frames have numbers from 0 on")
    if block.stream != stream or len(block) != tau:
        raise ValueError(
            f"the learner asked for {tau} frames of stream {stream}, "
            f"not {len(block)} of stream {block.stream}"
        )
    shape, dtype = block.frames.shape[1:], block.frames.dtype
    if shape != spec.frame_shape or dtype != spec.dtype:
        raise ValueError(
            f"the learner asked for frames of {spec.frame_shape} {spec.dtype}, not {shape} {dtype}"
        )
    if dtype.kind == "f" and not (  # also true of NaN; without an array as large as the frames
        block.frames.max(initial=0) <= LARGEST_VALUE
        and block.frames.min(initial=0) >= -LARGEST_VALUE
    ):
        finite = np.isfinite(block.frames).all()
        what = f"larger than {LARGEST_VALUE:g}" if finite else "no finite number"
        raise CdmisfaError(
            f"stream {spec.streams[block.stream]} holds a value that is {what} "
            f"in frames {block.t} to {block.t + len(block) - 1}: learn from frames without it"
        )
    return block.frames.reshape(len(block), -1)
