"""What the progress learner tells of each stream, as lines and marks in the stream's colour."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from cdmisfa.core.signals import SIGNALS
from replay.palette import Rgb, colour
from replay.runs.columns import SignalColumns
from replay.runs.log import RunHeader
from replay.view.columns import Column
from replay.view.labels import part

WATCHED = ("learning_error", "tested", "fitted", "change")
"""Signals of the stream that is watched; each stream has its line through its own blocks."""

DIM = ("fitted",)
"""Those that are drawn darker, beside others of the same colour."""

Line = Callable[..., Column]
"""What gives the column of an entity: path, labels, number of the first colour."""


def add_streams(
    columns: SignalColumns, names: Sequence[str], shown: Sequence[int], line: Line
) -> None:
    """Take what consecutive iterations tell of each shown stream.

    `/streams/<signal>/<stream>` holds the signal's values where that stream was watched, NaN where
    its candidate was not tested yet, so that no line leads from one candidate to the next.
    `/streams/interest/<stream>` holds the values of all iterations.
    """
    for s in shown:
        own, place = columns["stream"] == s, part(names, s)
        frames, iterations = columns.times()
        for name in WATCHED if own.any() else ():
            rgb = dim(colour(s)) if name in DIM else colour(s)
            label = f"{SIGNALS[name].symbol} {names[s]}"
            values = np.where(np.isnan(columns["tested"][own]), np.nan, columns[name][own])
            line(f"streams/{name}/{place}", [label], rgbs=[rgb]).add(
                frames[own], iterations[own], values
            )
        line(f"streams/interest/{place}", [names[s]], s).add(
            frames, iterations, columns["interest"][:, s]
        )


def thresholds(header: RunHeader) -> dict[str, tuple[str, float]]:
    """Label and value of the lines below which a stream is learned, by entity."""
    if header.settled is None:
        return {}
    change, error = header.settled
    return {
        "streams/settled": ("settled", change),
        "streams/threshold": ("settled + agreement", error),
    }


def dim(rgb: Rgb) -> Rgb:
    """A colour at half its brightness."""
    red, green, blue = (int(value) for value in np.array(rgb) // 2)
    return red, green, blue
