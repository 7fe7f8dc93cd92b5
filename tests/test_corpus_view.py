"""What an index has as a page: lanes of log time, what is broken or double, first frames."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from camera_files import write_cameras
from conftest import Cdmisfa

from replay.corpus.view import CARDS, index_to_view
from replay.report.indexed import BREAK, BREAKS, LANES, Recorded, folded, report_of_index

pytest.importorskip("duckdb", reason="pip install 'cdmisfa[corpus]'")

HOUR = 3600 * 10**9


def drawn(page: str, kind: str) -> list[str]:
    """What each path of a class draws."""
    return re.findall(rf'<path class="{kind}" d="([^"]*)"', page)


@pytest.fixture
def corpus(cdmisfa: Cdmisfa, tmp_path: Path) -> Path:
    """Two logs, a copy, one that was cut, and a recording of numbers."""
    folder = tmp_path / "logs"
    folder.mkdir()
    write_cameras(folder / "one.mcap", {"/cam": (40, 20), "/other": (30, 20)})
    write_cameras(folder / "two.mcap", {"/cam": (30, 20)})
    whole = (folder / "one.mcap").read_bytes()
    (folder / "copy.mcap").write_bytes(whole)
    (folder / "cut.mcap").write_bytes(whole[:-400])
    assert cdmisfa("record", "oscillatory", "--frames", 50, "-o", folder / "numbers").code == 0
    assert cdmisfa("index", folder).code == 0
    return folder


def test_a_page_shows_when_what_was_recorded_and_what_is_wrong(
    cdmisfa: Cdmisfa, corpus: Path, tmp_path: Path
) -> None:
    done = cdmisfa("view", corpus)
    assert (done.code, done.out) == (0, "")
    assert f"look at {corpus / 'corpus.html'}" in done.err
    page = (corpus / "corpus.html").read_text("utf-8")
    assert "1 broken, 1 there more than once." in page
    assert re.findall(r"<bdi>(.*?)</bdi>", page)[-2:] == ["broken", "double"]
    assert len(drawn(page, "fill broken")) == len(drawn(page, "fill double")) == 1
    assert len(drawn(page, "saved")) == 1  # the logs are of 1970, the recording is of 2016
    assert page.count("data:image/jpeg") == 3  # numbers have no pictures, a copy is left out
    assert "http" not in page.replace("http-equiv", "")
    assert cdmisfa("view", corpus).code == 0
    again = tmp_path / "again.html"
    assert cdmisfa("view", corpus / "corpus.parquet", "--save", again).code == 0
    assert again.read_text("utf-8") == page
    assert cdmisfa("view", corpus, "--save", again).code == 2
    assert cdmisfa("view", corpus, "--save", tmp_path / "view.rrd").code == 2
    for words in (["--web"], ["--at", "3"], ["--screenshot", tmp_path / "x.png"]):
        done = cdmisfa("view", corpus, *words)
        assert done.code == 2
        assert "is many logs, of which a page is made" in done.err
    (corpus / "table.csv").write_text("x\n1\n2\n")
    assert [cdmisfa(what, corpus).code for what in ("index", "view")] == [0, 0]
    page = (corpus / "corpus.html").read_text("utf-8")
    assert '<li class=""><div class="name">table.csv</div>' in page  # no pictures, and not broken


def test_a_recording_and_a_table_stay_what_they_are(
    cdmisfa: Cdmisfa, corpus: Path, tmp_path: Path
) -> None:
    assert cdmisfa("index", corpus / "numbers").code == 0
    assert index_to_view(corpus / "numbers") is None
    pq.write_table(pa.table({"x": [1.0, 2.0]}), tmp_path / "table.parquet")
    assert index_to_view(tmp_path / "table.parquet") is None
    done = cdmisfa("view", corpus / "numbers", "--save", tmp_path / "view.rrd")
    assert (done.code, (tmp_path / "view.rrd").is_file()) == (0, True)


def test_long_pauses_are_left_out_and_time_is_even_else() -> None:
    starts = np.array([0, 2, 1000, 1004], np.int64) * HOUR
    moments, places = folded(starts, starts + 3 * HOUR)
    np.testing.assert_array_equal(moments // HOUR, [0, 5, 1000, 1007])
    hour = (1000 - BREAK) / 12
    np.testing.assert_allclose(places, [0, 5 * hour, 5 * hour + BREAK, 1000])
    many = np.arange(3 * BREAKS, dtype=np.int64) ** 2 * 100 * HOUR
    moments, places = folded(many[::-1], many[::-1] + HOUR)
    assert len(moments) == 2 * (BREAKS + 1)
    assert (np.diff(places) > 0).all()
    one, places = folded(np.array([7]), np.array([7]))  # a moment alone
    np.testing.assert_array_equal(one, [7, 7])
    np.testing.assert_array_equal(places, [0, 1000])


def test_a_hundred_thousand_streams_make_no_large_page() -> None:
    rng, n = np.random.default_rng(0), 100_000
    starts = rng.integers(0, 10**17, n)
    recorded = Recorded(
        np.char.add("/topic/", rng.integers(0, 500, n).astype(str)),
        starts,
        starts + rng.integers(0, 10**12, n),
        {"broken": rng.random(n) < 0.01, "double": np.zeros(n, bool)},
        3,
    )
    page = report_of_index("many", "", recorded, [], [], "", [])
    assert len(page) < 400_000
    assert len(drawn(page, "lane")) == LANES + 1
    assert "And 476 more topics." in page
    assert "3 streams say no time." in page
    assert CARDS <= 24
