"""What was learned, judged on the last frames of a log, which the learner was not shown."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.blocks import FrameSource
from cdmisfa.core.errors import UsageError
from cdmisfa.core.expansion import expand
from cdmisfa.features.following import batch_outputs, following_slowness
from cdmisfa.modules import Module
from replay.storage.identity import LoggedSource
from replay.stored import StoredSource

PIECE = 256
"""Frames that are held at once."""


HOLDOUT = 0.1
"""Share of a camera log that is held out by default."""

FEWEST = 200
"""Frames that tell how slow an output is; where fewer would be held out, none are."""


class _StoppedError(Exception):
    """The run is to end."""


def hold_out(source: FrameSource, share: float | None, *, judged: bool) -> None:
    """Keep the last frames of a camera log from what learns, which is judged on them at its end.

    Args:
        source: what it learns from.
        share: of the frames; None for `HOLDOUT` where there is something to hold out.
        judged: whether the learner is one that is judged.

    Raises:
        UsageError: a share is given, and nothing can be held out.
    """
    if share == 0.0:
        return
    logged = source if isinstance(source, LoggedSource) and source.to_judge else None
    if not judged or logged is None or logged.spec.length is None:
        if share is not None:
            raise UsageError(
                "input.holdout is for camera logs that the progress learner learns from once: "
                "leave it out, or leave out --loop and --algorithm"
            )
        return
    count = int(logged.frames * (HOLDOUT if share is None else share))
    if count >= FEWEST:
        logged.hold_out(count)
    else:
        said = f"{count} of {logged.frames} frames are too few to judge on: none are held out"
        logged.notes = (*logged.notes, f"{said} (input.holdout)")


def judged(
    source: FrameSource,
    modules: Sequence[Module],
    components: int,
    stop: Callable[[], bool] = lambda: False,
) -> dict[str, Any] | None:
    """How slow the outputs of each module are on the frames that were held out.

    Beside them stands what batch SFA, with as many outputs, gives on the same frames; it is fitted
    to the frames of the module's stream that the run went over.

    Args:
        source: as the learner left it.
        modules: what was learned.
        components: of the learner, and of batch SFA.
        stop: asked before every piece; true ends it without a result.

    Returns:
        The frames [start, stop) held out and those fitted to, and for each module its slowness and
        batch SFA's, (J,) each, as JSON values. Nothing where nothing was held out, None where it
        was stopped.

    Raises:
        LogDamagedError: the log is damaged there.
    """
    if not isinstance(source, StoredSource) or not source.held_out:
        return {}
    fitted = source.first_frame, source.t
    held = source.end, source.end + source.held_out
    rows: dict[int, dict[str, Any]] = {}
    try:
        for stream in sorted({module.stream_index for module in modules}):
            own = [module for module in modules if module.stream_index == stream]
            rows |= _of_stream(source, own, components, fitted, held, stop)
    except _StoppedError:
        return None
    return {
        "frames": list(held),
        "fitted": list(fitted),
        "modules": [rows[index] for index in sorted(rows)],
    }


def _of_stream(
    source: StoredSource,
    modules: Sequence[Module],
    components: int,
    fitted: tuple[int, int],
    held: tuple[int, int],
    stop: Callable[[], bool],
) -> dict[int, dict[str, Any]]:
    """The rows of the modules of one stream, by their index."""

    def pieces(span: tuple[int, int]) -> Iterator[tuple[NDArray[Any], bool]]:
        after = span[0]
        for block in source.pieces(modules[0].stream_index, *span, PIECE):
            if stop():
                raise _StoppedError
            x = block.frames.reshape(len(block), -1)
            if not np.isfinite(x).all():
                continue  # as a learner does not take them either
            yield expand(modules[0].expansion, x), block.t != after
            after = block.t + len(block)

    outputs = len(modules[0].phi)
    batch = batch_outputs(pieces(fitted), fitted[1] - fitted[0], components, outputs)
    each = [(module.phi, module.mean) for module in modules] + [batch[:2]]
    slow = following_slowness(pieces(held), each)
    return {
        module.index: {
            "module": module.index,
            "stream": module.stream,
            "slowness": own.tolist(),
            "of_batch": slow[-1].tolist(),
        }
        for module, own in zip(modules, slow, strict=False)
    }
