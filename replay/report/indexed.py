"""An index of many logs as a page: when what was recorded, what is broken or double."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.clock import NANOSECONDS
from cdmisfa.core.names import counted
from replay.report.drawing import WIDE, Axis, Label, Plot, beside, data_uri, number, reduced, sheet
from replay.report.page import rendered
from replay.report.panels import LANE, PIXELS, ROOM

LANES: Final = 24
"""Topics that have a lane of their own, those of which there is most."""

BREAKS: Final = 40
"""Times without any log that are left out, the longest."""

BREAK: Final = 6
"""How wide one is drawn."""

DATES: Final = 6
"""Dates that are written."""

MARKED: Final = ("broken", "double")
"""Lanes of what is wrong, and the classes of their colours."""

Times = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Recorded:
    """When streams were recorded, nanoseconds.

    Attributes:
        topics: (n,) what each is.
        starts: (n,) when it begins.
        ends: (n,) when it ends.
        marks: of each of `MARKED` which streams are so, (n,).
        untimed: streams of which that is not known.
    """

    topics: NDArray[Any]
    starts: Times
    ends: Times
    marks: Mapping[str, NDArray[np.bool_]]
    untimed: int


def report_of_index(
    title: str,
    lead: str,
    recorded: Recorded,
    kinds: Sequence[Sequence[Any]],
    cards: Sequence[Mapping[str, Any]],
    shown: str,
    lists: Sequence[tuple[str, Sequence[Any], int]],
) -> str:
    """The page of an index.

    Args:
        title: of the page.
        lead: what there is in all.
        recorded: when what was recorded.
        kinds: what there is, a row a kind of log, as indexed.html has them.
        cards: logs with their first pictures: `name`, `text`, `pictures`.
        shown: which these are.
        lists: of logs: a title, rows, and how many more there are.
    """
    names, counts = np.unique(recorded.topics, return_counts=True)
    order = np.argsort(-counts, kind="stable")
    lanes = names[order[:LANES]].tolist()
    more = len(names) - len(lanes)
    return rendered(
        {
            "kind": "indexed",
            "title": title,
            "lead": lead,
            "lanes": _lanes(recorded, lanes) if len(recorded.starts) else None,
            "untimed": counted(recorded.untimed, "stream") if recorded.untimed else "",
            "more": counted(more, "more topic") if more else "",
            "kinds": kinds,
            "cards": [{**card, "picture": _picture(card["pictures"])} for card in cards],
            "shown": shown,
            "lists": lists,
            "frames": {},
        }
    )


def _picture(pictures: Sequence[Any]) -> str:
    small = [reduced(picture, PIXELS) for picture in pictures]
    return data_uri(sheet(small, len(small), 2), photo=True) if small else ""


def folded(starts: Times, ends: Times) -> tuple[Times, FloatArray]:
    """Moments, and their places from 0 to `WIDE`, between which time is even.

    The longest times without any log, `BREAKS` at most, are as short as `BREAK`.

    Args:
        starts: (n,) of what was recorded, n above 0.
        ends: (n,).
    """
    order = np.argsort(starts, kind="stable")
    begins, reached = starts[order], np.maximum.accumulate(ends[order])
    pauses = begins[1:] - reached[:-1]
    long = np.flatnonzero(pauses > (reached[-1] - begins[0]) / 100)
    cut = np.sort(long[np.argsort(-pauses[long], kind="stable")[:BREAKS]])
    moments = np.stack([begins[[0, *(cut + 1)]], reached[[*cut, -1]]], axis=1)
    lengths = np.maximum(np.diff(moments, axis=1)[:, 0], 1).astype(np.float64)
    lengths *= (WIDE - BREAK * len(cut)) / lengths.sum()
    left = np.cumsum(lengths) - lengths + BREAK * np.arange(len(lengths))
    return moments.reshape(-1), np.stack([left, left + lengths], axis=1).reshape(-1)


def _lanes(recorded: Recorded, topics: Sequence[str]) -> Plot:
    moments, places = folded(recorded.starts, recorded.ends)
    low, high = (np.interp(t, moments, places) for t in (recorded.starts, recorded.ends))
    rows = [(topic, recorded.topics == topic) for topic in topics]
    marked = [(name, mark) for name, mark in recorded.marks.items() if mark.any()]
    names = beside(topics, range(len(topics))) + [(name, name, name) for name, _ in marked]
    height = LANE * len(names)
    plot = Plot(
        Axis(0, WIDE, WIDE),
        Axis(0, height + LANE, height + LANE),
        "When each topic was recorded",
        names=names,
    )
    for i, (_, own) in enumerate(rows + marked):
        top, tall = LANE * i, LANE - ROOM
        plot.path("lane", f"M0 {top}h{WIDE}v{tall}H0z")
        spans = (f"M{a} {top}H{b}v{tall}H{a}z" for a, b in _covered(low[own], high[own]))
        plot.path(f"fill {names[i][1]}", "".join(spans))
    for place in places[1:-1:2] + BREAK / 2:
        plot.path("saved", f"M{number(place)} 0v{height}")
    last = -float(WIDE)
    for moment, place in zip(moments[::2].tolist(), places[::2].tolist(), strict=True):
        if place - last >= WIDE / DATES and place < WIDE * (1 - 2 / DATES):
            across = f"{number(place / WIDE * 100)}%"
            plot.labels.append(Label(across, f"{height + 14}", _date(moment)))
            last = place
    plot.labels.append(Label("100%", f"{height + 14}", _date(int(moments[-1])), "end"))
    return plot


def _date(moment: int) -> str:
    return f"{datetime.fromtimestamp(moment // NANOSECONDS, UTC):%Y-%m-%d %H:%M}"


def _covered(low: FloatArray, high: FloatArray) -> list[tuple[int, int]]:
    """The places, in whole numbers, at which there is anything, as ranges [start, stop)."""
    edges = np.zeros(int(WIDE) + 2, np.int64)
    first = np.minimum(low, WIDE - 1).astype(np.int64)
    np.add.at(edges, first, 1)
    np.add.at(edges, np.maximum(np.ceil(high).astype(np.int64), first + 1), -1)
    there = np.diff((np.cumsum(edges) > 0).astype(np.int8), prepend=0)
    starts, stops = np.flatnonzero(there == 1).tolist(), np.flatnonzero(there == -1).tolist()
    return list(zip(starts, stops, strict=True))
