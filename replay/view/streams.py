"""What the progress learner tells of each stream, as lines and marks in the stream's colour."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from cdmisfa.core.signals import SIGNALS
from replay.palette import colour, darker
from replay.runs.columns import SignalColumns
from replay.runs.log import RunHeader
from replay.view.columns import Column, power_of_ten
from replay.view.labels import part

WATCHED = ("learning_error", "tested", "fitted", "change")
"""Signals of the stream that is watched; each stream has its line through its own blocks."""

POWERS = {"change": "log_change"}
"""Those drawn as powers of ten, with their entities: they fall through several."""

HARDLY_WATCHED = 1000.0
"""Interest from which on a stream promises most because it was hardly watched: it has no line."""

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
    `/streams/interest/<stream>` holds the values of all iterations in which it was watched enough.
    """
    for s in shown:
        own, place = columns["stream"] == s, part(names, s)
        frames, iterations = columns.times()
        for name in WATCHED if own.any() else ():
            rgb = darker(colour(s)) if name in DIM else colour(s)
            label = f"{SIGNALS[name].symbol} {names[s]}"
            values = np.where(np.isnan(columns["tested"][own]), np.nan, columns[name][own])
            if name in POWERS:
                values = power_of_ten(values)
            line(f"streams/{POWERS.get(name, name)}/{place}", [label], rgbs=[rgb]).add(
                frames[own], iterations[own], values
            )
        interest = columns["interest"][:, s]
        promised = np.where(interest < HARDLY_WATCHED, interest, np.nan)
        line(f"streams/interest/{place}", [names[s]], rgbs=[colour(s)]).add(
            frames, iterations, promised
        )


def thresholds(header: RunHeader) -> dict[str, tuple[str, float]]:
    """Label and value of the lines below which a stream is learned, by entity."""
    if header.settled is None:
        return {}
    change, error = header.settled
    return {
        "streams/settled": ("settled below", math.log10(change)),
        "streams/threshold": ("learned below", error),
    }
