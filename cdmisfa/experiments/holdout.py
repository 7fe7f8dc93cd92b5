"""Modules judged on the last frames of a log, which the learner does not see."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.blocks import FrameSource
from cdmisfa.core.errors import UsageError
from cdmisfa.core.expansion import expand
from cdmisfa.experiments.sources import OF_CAMERAS, Configuration
from cdmisfa.features.following import batch_outputs, following_slowness
from cdmisfa.modules import Module
from replay.stored_source import StoredSource

# Frames that are in memory at once.
PIECE = 256


# Default share of a camera log that is held out.
HOLDOUT = 0.1

# Fewest frames that estimate the slowness of an output; of a shorter share none are held out.
FEWEST = 200


class _StoppedError(Exception):
    """The user stops the run."""


def hold_out(source: FrameSource, configuration: Configuration) -> None:
    """Keep the last frames of a log from the progress learner, which is judged on them at its end.

    Args:
        source: the source of the run.
        configuration: its `input.holdout` is the share; without one `HOLDOUT`, where possible.

    Raises:
        UsageError: a share is given, and nothing can be held out.
    """
    share = None if configuration.inputs is None else configuration.inputs.holdout
    if share == 0.0:
        return
    by_progress = configuration.learner.algorithm == OF_CAMERAS
    logged = isinstance(source, StoredSource) and source.to_judge
    if not by_progress or not logged or source.spec.length is None:
        if share is not None:
            raise UsageError(
                "input.holdout is for camera logs that the progress learner learns from once: "
                "leave it out, or leave out --loop and --algorithm"
            )
        return
    assert isinstance(source, StoredSource)
    count = int(source.frames * (HOLDOUT if share is None else share))
    if count >= FEWEST:
        source.hold_out(count)
    else:
        few = f"{count} of {source.frames} frames are too few to judge on: none are held out"
        source.notes = (*source.notes, f"{few} (input.holdout)")


def judged(
    source: FrameSource,
    modules: Sequence[Module],
    components: int,
    stop: Callable[[], bool] = lambda: False,
) -> dict[str, Any] | None:
    """Judge each module by the slowness of its outputs on the frames that were held out.

    The result has beside them the slowness of batch SFA with as many outputs on the same frames;
    batch SFA is fitted to the frames of the module's stream that the run used.

    Args:
        source: as the learner left it.
        modules: the learned modules.
        components: whitening components of the learner, and of batch SFA.
        stop: called before every piece; true ends it without a result.

    Returns:
        The frames [start, stop) held out and those fitted to, and for each module its slowness and
        batch SFA's, (J,) each, as JSON values. Empty if nothing was held out, None if stopped.

    Raises:
        LogDamagedError: the log is damaged there.
    """
    if not isinstance(source, StoredSource) or not source.held_out:
        return {}
    fitted = source.first_frame, source.t
    judged_on = source.end, source.end + source.held_out
    rows: dict[int, dict[str, Any]] = {}
    try:
        for stream in sorted({module.stream_index for module in modules}):
            ours = [module for module in modules if module.stream_index == stream]
            pieces = functools.partial(_pieces, source, ours[0], stop)
            count, outputs = fitted[1] - fitted[0], len(ours[0].phi)
            phi, mean, _ = batch_outputs(pieces(*fitted), count, components, outputs)
            weights = [(module.phi, module.mean) for module in ours]
            *slow, of_batch = following_slowness(pieces(*judged_on), [*weights, (phi, mean)])
            for module, slowness in zip(ours, slow, strict=True):
                rows[module.index] = {
                    "module": module.index,
                    "stream": module.stream,
                    "slowness": slowness.tolist(),
                    "of_batch": of_batch.tolist(),
                }
    except _StoppedError:
        return None
    return {
        "frames": list(judged_on),
        "fitted": list(fitted),
        "modules": [rows[index] for index in sorted(rows)],
    }


def _pieces(
    source: StoredSource, module: Module, stop: Callable[[], bool], start: int, end: int
) -> Iterator[tuple[NDArray[Any], bool]]:
    """Yield the frames [start, end) of a module's stream, expanded, and whether a gap precedes."""
    after = start
    for block in source.pieces(module.stream_index, start, end, PIECE):
        if stop():
            raise _StoppedError
        x = block.frames.reshape(len(block), -1)
        if np.isfinite(x).all():  # a learner skips other blocks, too
            yield expand(module.expansion, x), block.t != after
            after = block.t + len(block)
