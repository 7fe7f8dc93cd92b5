"""How the frames of a log are used: repeated to learn from, or held out to evaluate modules."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.blocks import FrameSource
from cdmisfa.core.errors import UsageError
from cdmisfa.core.expansion import expand
from cdmisfa.experiments.sources import CAMERA_LEARNER, PASSES, Configuration
from cdmisfa.features.following import batch_outputs, following_slowness
from cdmisfa.modules import SLOW, Module
from replay.stored_source import StoredSource

# Frames that are read at once. It limits memory and does not change the result.
PIECE = 256

# Default share of a camera log that is held out. Set by hand: a larger share leaves fewer frames to
# learn from.
HOLDOUT = 0.1

# Smallest number of held out frames, for an estimate of slowness; below it none are held out. Set
# by hand.
MIN_HELD_OUT = 200


class _StoppedError(Exception):
    """Request of the user to stop the run."""


def arrange_frames(
    source: FrameSource, configuration: Configuration, passes: int | None = None
) -> None:
    """Hold out the last frames of a log, and let the run read the others several times.

    Modules of the progress learner are evaluated on the frames that are held out. A run reads the
    others again until each stream is decided.

    Args:
        source: the source of the run.
        configuration: its key `input.holdout` is the share that is held out; None: `HOLDOUT`, if
            possible.
        passes: number of passes; None: `PASSES` for the progress learner on logs and arrays, but
            not on recordings of a scene; else 1.

    Raises:
        UsageError: a share is set, and nothing can be held out; or a number of passes is set, and
            the source does not end or cannot go back.
    """
    share = None if configuration.inputs is None else configuration.inputs.holdout
    by_progress = configuration.learner.algorithm == CAMERA_LEARNER
    finite = isinstance(source, StoredSource) and source.spec.length is not None
    if passes is not None and not finite:
        raise UsageError("--passes is for logs and arrays, without --loop: remove one of them")
    if share and not (finite and by_progress and getattr(source, "to_judge", False)):
        raise UsageError(
            "input.holdout needs logs from which the progress learner learns: remove it, or remove "
            "--loop and --algorithm"
        )
    if not isinstance(source, StoredSource) or not finite:
        return
    count = 0
    if by_progress and source.to_judge and share != 0.0:
        count = int(source.frames * (share or HOLDOUT))
        if count < MIN_HELD_OUT:
            few = f"{count} of {source.frames} frames are too few to test on"
            source.notes = (*source.notes, f"{few}: none are held out (input.holdout)")
            count = 0
    source.hold_out(count)
    source.repeat(passes or (PASSES if by_progress and configuration.streams else 1))


def evaluate(
    source: FrameSource,
    modules: Sequence[Module],
    components: int,
    stop: Callable[[], bool] = lambda: False,
) -> dict[str, Any] | None:
    """Compute the slowness of each module's slow outputs on the frames that were held out.

    For comparison the result has the slowness of batch SFA with as many outputs on the same frames;
    batch SFA is fitted to the frames of the module's stream that the run used.

    Args:
        source: the source, as the learner left it.
        modules: the saved modules.
        components: number of whitened components of the learner, and of batch SFA.
        stop: called before every piece; True ends the evaluation without a result.

    Returns:
        As JSON values: the ranges [start, stop) of the frames held out and of those fitted, and for
        each module its slowness and that of batch SFA, (J,) each. Empty if nothing was held out,
        None if stopped.

    Raises:
        LogDamagedError: the log is damaged there.
    """
    if not isinstance(source, StoredSource) or not source.held_out:
        return {}
    fitted = source.first_frame, min(source.t, source.end)
    held_out = source.end, source.end + source.held_out
    rows: dict[int, dict[str, Any]] = {}
    try:
        for stream in sorted({module.stream_index for module in modules}):
            of_stream = [module for module in modules if module.stream_index == stream]
            pieces = functools.partial(_pieces, source, of_stream[0], stop)
            count, outputs = fitted[1] - fitted[0], of_stream[0].kinds.count(SLOW)
            phi, mean, _ = batch_outputs(pieces(*fitted), count, components, outputs)
            weights = [(module.phi[:outputs], module.mean) for module in of_stream]
            *by_module, by_batch = following_slowness(pieces(*held_out), [*weights, (phi, mean)])
            for module, slowness in zip(of_stream, by_module, strict=True):
                rows[module.index] = {
                    "module": module.index,
                    "stream": module.stream,
                    "slowness": slowness.tolist(),
                    "of_batch": by_batch.tolist(),
                }
    except _StoppedError:
        return None
    in_order = [rows[index] for index in sorted(rows)]
    return {"frames": list(held_out), "fitted": list(fitted), "modules": in_order}


def _pieces(
    source: StoredSource, module: Module, stop: Callable[[], bool], start: int, end: int
) -> Iterator[tuple[NDArray[Any], bool]]:
    """Yield the frames [start, end) of a module's stream, expanded, and whether a gap precedes."""
    after = start
    for block in source.pieces(module.stream_index, start, end, PIECE):
        if stop():
            raise _StoppedError
        x = block.frames.reshape(len(block), -1)
        if np.isfinite(x).all():  # the learner does not learn from other blocks either
            yield expand(module.expansion, x), block.t != after
            after = block.t + len(block)
