"""Results of ranking as files: a table in Parquet, and a page with images of the worst episodes."""

from __future__ import annotations

from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from cdmisfa.core.errors import CdmisfaError, UsageError
from cdmisfa.core.names import counted
from recorder.log.files import atomic_write
from replay.episodes.ranking import Ranked, column_name
from replay.episodes.reading import open_cameras
from replay.report.figures import data_uri
from replay.report.page import rendered
from replay.report.svg_plot import WIDE, Axis, Plot

TABLE: Final = "episodes.parquet"
PAGE: Final = "episodes.html"

# Episodes on the page: the worst, and typical ones for comparison.
WORST: Final = 20
TYPICAL: Final = 5

# Images of an episode on the page, and their width in pixels: a page must stay below 2 MB.
IMAGES: Final = 5
WIDTH: Final = 160

# Height of a row of the plot of scores, as `.names div` of page.css has it, and its range.
_ROW: Final = 22
_SCORES: Final = (-1.0, 3.0)


def write_ranking(ranked: Ranked, out: Path, title: str) -> None:
    """Write the table and the page into a folder."""
    rows = ranked.rows()
    names = dict.fromkeys(name for row in rows for name in row)
    table = pa.table({name: [row.get(name) for row in rows] for name in names})
    with atomic_write(out / TABLE) as partial:
        pq.write_table(table, partial, compression="zstd")
    order, flagged = ranked.order, ranked.flagged
    good = [i for i in order if ranked.score[i] < 1]
    middle = max(len(good) // 2 - TYPICAL // 2, 0)
    content = {
        "kind": "episodes",
        "title": title,
        "lead": f"{len(flagged)} of {counted(len(order), 'episode')} flagged",
        "worst": [_entry(ranked, i) for i in flagged[:WORST]],
        "hidden": max(len(flagged) - WORST, 0),
        "typical": [_entry(ranked, i) for i in good[middle : middle + TYPICAL]],
        "notes": ranked.notes,
        "removal": ranked.removal(),
        "plot": _plot(ranked),
        "rows": [
            (row["name"], f"{row['score']:.2f}", "; ".join(row["reasons"]))
            for row in (rows[i] for i in order)
        ],
        "frames": {},
    }
    with atomic_write(out / PAGE) as partial:
        partial.write_text(rendered(content), "utf-8")


def _entry(ranked: Ranked, episode: int) -> dict[str, Any]:
    """Return name, reasons and images of an episode, one at the time of its first reason."""
    reasons, log = ranked.reasons(episode), ranked.logs[episode]
    column = reasons[0][1] if reasons else None
    images: list[tuple[str, str, bool]] = []
    with suppress(CdmisfaError, OSError), ExitStack() as opened:
        if not (cameras := open_cameras(log, opened)):
            raise UsageError("the episode has no images")
        camera = cameras.get(column.camera if column else "", next(iter(cameras.values())))
        times = camera.seconds() - camera.seconds()[0]
        rows = {int(row) for row in np.linspace(0, len(times) - 1, IMAGES + 2)[1:-1]}
        moment = -1
        if column is not None and np.isfinite(column.at[episode]):
            moment = int(np.abs(times - column.at[episode]).argmin())
            rows.add(moment)
        for row in sorted(rows):
            image = Image.fromarray(camera.image(row)).convert("RGB")
            image.thumbnail((WIDTH, WIDTH))
            source = data_uri(np.asarray(image), photo=True)
            images.append((f"{times[row]:.1f} s", source, row == moment))
    words = [words for words, _ in reasons]
    about = ", ".join(log.about.values())
    return {"name": log.name, "about": about, "reasons": words, "images": images}


def _plot(ranked: Ranked) -> Plot:
    """Draw the scores of all episodes, one row a column."""
    height = _ROW * len(ranked.columns)
    plot = Plot(
        "Scores of all episodes in each column", Axis(*_SCORES, WIDE), Axis(0, height, height),
        rows=[(column_name(column), "c0") for column in ranked.columns], x_label="score",
    )  # fmt: skip
    plot.marks("saved", [1.0])
    for place in range(len(ranked.columns)):
        values = np.clip(ranked.scores[:, place], *_SCORES)
        level = np.full(len(values), place * _ROW + _ROW / 2 - 2)
        for kind, chosen in (("plain faint", values < 1), ("at", values >= 1)):
            plot.dots(kind, values[chosen], level[chosen])
    return plot
