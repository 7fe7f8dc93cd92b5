"""What a sweep found: mean and standard deviation over seeds at each point of its grid."""

from __future__ import annotations

import csv
import io
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.experiments.statistics import MeanSd, summary
from cdmisfa.experiments.store import DONE, FAILED, ROWS, read_rows
from replay.runs.folders import REQUEST, read_request

SCHEMA = 1

NOTHING = summary([])
"""A measure that a point does not have."""


@dataclass(frozen=True, slots=True)
class PointResult:
    """One point of the grid.

    Attributes:
        point: the grid's keys and this point's values.
        trials: how many were asked for.
        done: how many of them the measures are about.
        failed: how many of them failed.
        missing: how many were not computed yet.
        measures: mean and SD over those that are done, by name.
        orders: how often which streams were learned in which order, the most frequent first.
    """

    point: Mapping[str, str]
    trials: int
    done: int
    failed: int
    missing: int
    measures: Mapping[str, MeanSd]
    orders: Mapping[str, int]


def results(folder: Path) -> list[PointResult]:
    """The points of a sweep as it was requested last, in the grid's order.

    Raises:
        UsageError: the folder holds no sweep.
        LogDamagedError: its files are damaged.
    """
    path = folder / REQUEST
    if not path.is_file():
        raise UsageError(f"{folder} holds no {REQUEST}: name the folder of a sweep")
    trials = read_request(folder)
    rows = {row["id"]: row for row in read_rows(folder)}
    points: dict[tuple[tuple[str, str], ...], list[Any]] = {}
    for number, point in trials:
        points.setdefault(tuple(point.items()), []).append(rows.get(number))
    try:
        return [_point(dict(key), found) for key, found in points.items()]
    except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
        raise LogDamagedError(
            f"{folder / ROWS}: a row is no trial's result ({error}): remove the file and run the "
            "sweep again"
        ) from error


def _point(point: Mapping[str, str], rows: Sequence[Mapping[str, Any] | None]) -> PointResult:
    found = [row["result"] for row in rows if row is not None and row["status"] == DONE]
    measures = {
        "modules": summary([len(r["modules"]) for r in found]),
        "iterations": summary([r["iterations"] for r in found]),
    }
    for k in range(max((len(r["modules"]) for r in found), default=0)):
        saved = [r["modules"][k] for r in found if len(r["modules"]) > k]
        measures[f"iteration_{k + 1}"] = summary([m["iteration"] for m in saved])
        measures[f"eta_{k + 1}"] = summary([m["eta"][0] for m in saved])
    orders = Counter(" ".join(m["stream"] for m in r["modules"]) for r in found)
    return PointResult(
        point=point,
        trials=len(rows),
        done=len(found),
        failed=sum(row is not None and row["status"] == FAILED for row in rows),
        missing=sum(row is None for row in rows),
        measures=measures,
        orders=dict(orders.most_common()),
    )


def as_json(points: Sequence[PointResult]) -> dict[str, Any]:
    """The results as one JSON document."""
    return {"schema": SCHEMA, "points": [asdict(point) for point in points]}


def measure_names(points: Sequence[PointResult]) -> list[str]:
    """Every measure that some point has, in order."""
    return list(dict.fromkeys(name for p in points for name in p.measures))


def as_csv(points: Sequence[PointResult]) -> str:
    """A line a point; two columns a measure, empty where there is no number."""
    names = measure_names(points)
    keys = list(points[0].point) if points else []
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    columns = [f"{name}_{part}" for name in names for part in ("mean", "sd")]
    writer.writerow([*keys, "trials", "done", "failed", *columns, "order", "order_count"])
    for p in points:
        cells: list[Any] = [*p.point.values(), p.trials, p.done, p.failed]
        for name in names:
            found = p.measures.get(name, NOTHING)
            cells += ["" if math.isnan(v) else repr(v) for v in (found.mean, found.sd)]
        order, count = next(iter(p.orders.items()), ("", 0))
        writer.writerow([*cells, order, count])
    return text.getvalue()


def as_table(points: Sequence[PointResult]) -> tuple[list[str], list[list[str]]]:
    """Head and rows for a person: mean ± SD, and the most frequent order with its share."""
    names = measure_names(points)
    keys = list(points[0].point) if points else []
    head = [*keys, "done", "failed", *names, "order"]
    rows = []
    for p in points:
        order, count = next(iter(p.orders.items()), ("", 0))
        shown = f"{order} ({count}/{p.done})" if order else ""
        cells = [_cell(p.measures.get(name, NOTHING)) for name in names]
        rows.append([*p.point.values(), f"{p.done}/{p.trials}", str(p.failed), *cells, shown])
    return head, rows


def as_latex(points: Sequence[PointResult]) -> str:
    """A booktabs table with the columns of `as_table`."""
    head, rows = as_table(points)
    lines = [
        r"\begin{tabular}{" + "l" * len(head) + "}",
        r"\toprule",
        _latex_line(head),
        r"\midrule",
        *map(_latex_line, rows),
        r"\bottomrule",
        r"\end{tabular}",
    ]
    return "\n".join(lines) + "\n"


def _cell(found: MeanSd) -> str:
    if not found.n:
        return ""
    return f"{found.mean:.4g}" if math.isnan(found.sd) else f"{found.mean:.4g} ± {found.sd:.2g}"


def _latex_line(cells: Sequence[str]) -> str:
    special = {"_": r"\_", "%": r"\%", "&": r"\&", "#": r"\#", "$": r"\$", "±": r"$\pm$"}
    escaped = ["".join(special.get(c, c) for c in cell) for cell in cells]
    return " & ".join(escaped) + r" \\"
