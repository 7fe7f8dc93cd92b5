"""What each module has learned: its output over what it follows in the world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray
from replay.following import Fit, read_outputs
from replay.palette import GREY, colour
from replay.runs.log import Frames
from replay.runs.run import Outline
from replay.view.columns import line_column
from replay.view.labels import label

LEARNED = "learned"

MOST = 6
"""Modules that are shown: the first."""

MOST_FRAMES = 1_000_000
"""Last frames of a run for which it is shown."""

BROAD, NARROW = 4.0, 1.5
"""Widths of the line that is followed, and of the one that follows."""


@dataclass(frozen=True, slots=True)
class Lesson:
    """What a module has learned.

    Attributes:
        title: of its panel.
        entities: of the panel: what is followed, and the output.
        span: the least and the most of both.
    """

    title: str
    entities: tuple[str, ...]
    span: tuple[float, float]


def write_learned(
    recording: rr.RecordingStream,
    log: Path,
    outline: Outline,
    truth: Sequence[Frames],
) -> list[Lesson]:
    """Write each module's output where its stream was watched, and what it follows, everywhere.

    Args:
        recording: where it goes.
        log: of the run.
        outline: the run in short.
        truth: what the world knew at each frame, piece after piece.
    """
    names, spec = outline.names(), outline.header.spec
    if not truth or not outline.saved:
        return []
    frames, values = (np.concatenate(part)[-MOST_FRAMES:] for part in zip(*truth, strict=True))
    iterations, lessons = outline.blocks.iteration(frames), []
    for output in read_outputs(log, outline, MOST, MOST_FRAMES, truth=(frames, values)):
        found = output.best_fit(spec.truth)
        if found is None:
            continue
        followed = found(values[:, found.column])
        said = _everywhere(frames, output.t, output.y)
        root = f"{LEARNED}/{output.module}"
        shown = (
            (f"{root}/followed", found.function, GREY, BROAD, followed),
            (
                f"{root}/output",
                f"module {output.module} on {names[output.stream]}",
                colour(output.stream),
                NARROW,
                said,
            ),
        )
        for path, name, rgb, width, line in shown:
            column = line_column(recording, spec, path, [name], [rgb], width, every_frame=True)
            column.add(frames, iterations, line)
            column.flush()
        both = np.concatenate([followed, output.y])
        lessons.append(
            Lesson(
                _title(output.module, names[output.stream], found),
                tuple(f"/{path}" for path, *_ in shown),
                (float(both.min()), float(both.max())),
            )
        )
    return lessons


def _title(module: int, stream: str, found: Fit) -> str:
    return (
        f"What module {module} has learned: where {label(stream)} is watched, "
        f"its output over {label(found.function)}, |r| = {found.r:.2f}"
    )


def _everywhere(frames: NDArray[np.int64], t: NDArray[np.int64], y: FloatArray) -> FloatArray:
    """An output at all frames: NaN where its stream was not watched."""
    line = np.full(len(frames), np.nan)
    at = np.searchsorted(frames, t)
    there = (at < len(frames)) & (frames[np.minimum(at, len(frames) - 1)] == t)
    line[at[there]] = y[there]
    return line
