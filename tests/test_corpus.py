"""An index of many logs: what it says, how it is kept up to date, and what breaks it not."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from camera_files import pictures, write_images, write_pictures, write_video
from conftest import Cdmisfa

from cdmisfa.core.errors import LogDamagedError, UsageError
from replay.corpus import index as indexing
from replay.corpus.index import index_logs, read_index
from replay.corpus.index_rows import SCHEMA
from replay.integrity.listing import INDEX, find_logs

ROOT = Path(__file__).parents[1]

Rows = list[dict[str, Any]]


@pytest.fixture
def corpus(tmp_path: Path, oscillatory_recording: Path, oscillatory_run: Path) -> Path:
    """A recording, a run, a log of others, pictures, arrays, and three files that are broken."""
    folder = tmp_path / "logs"
    shutil.copytree(oscillatory_recording, folder / "night" / "one")
    shutil.copytree(oscillatory_run, folder / "runs" / "first")
    frames = ((50 * i, image) for i, image in enumerate(pictures(20, 9)))
    write_images(folder / "robot.mcap", {"/camera": frames})
    write_pictures(folder / "seen", 5)
    np.save(folder / "joints.npy", np.zeros((30, 7)))
    whole = (folder / "night" / "one" / "x1.mcap").read_bytes()
    (folder / "torn.mcap").write_bytes(whole[: len(whole) // 2])
    (folder / "text.mcap").write_text("no log")
    (folder / "empty.mcap").touch()
    return folder


def rows_of(folder: Path) -> Rows:
    rows: Rows = read_index(folder / INDEX).to_pylist()
    return rows


def row(folder: Path, path: str, topic: str | None = None) -> dict[str, Any]:
    result = [r for r in rows_of(folder) if r["path"] == path and topic in (None, r["topic"])]
    assert len(result) == 1 or topic is None, result
    return result[0]


class TestRows:
    def test_each_stream_is_a_row_of_what_its_summary_says(self, corpus: Path) -> None:
        made = index_logs([corpus])
        assert (made.logs, made.files, made.read, made.kept, made.broken) == (8, 10, 10, 0, 3)
        view = row(corpus, "night/one/x1.mcap", "/view/x1")
        size = (corpus / "night" / "one" / "x1.mcap").stat().st_size
        assert view == {
            **view,
            "log": "night/one",
            "kind": "recording",
            "schema": "cdmisfa.Vector",
            "shape": "2",
            "messages": 2000,
            "rate": 50.0,
            "seconds": 39.98,
            "gaps": 0,
            "bytes": size,
            "compression": "zstd",
            "crc": "unchecked",
            "state": "unchecked",
            "seed": 0,
            "problem": None,
            "deep": False,
        }
        camera = row(corpus, "robot.mcap")
        assert (camera["kind"], camera["log"], camera["messages"]) == ("foreign", "robot.mcap", 20)
        assert (camera["shape"], camera["gaps"]) == (None, None)
        assert row(corpus, "seen")["messages"] == 5
        assert (row(corpus, "joints.npy")["shape"], row(corpus, "joints.npy")["messages"]) == (
            "7",
            30,
        )

    def test_what_is_broken_is_a_row_that_says_why(self, corpus: Path) -> None:
        index_logs([corpus])
        wrong = {r["path"]: (r["state"], r["problem"]) for r in rows_of(corpus) if r["problem"]}
        assert wrong.keys() == {"torn.mcap", "text.mcap", "empty.mcap"}
        assert wrong["torn.mcap"][0] == "cut short"
        assert wrong["text.mcap"] == (
            "damaged",
            "not an MCAP file (its first bytes are not MCAP's)",
        )
        torn = row(corpus, "torn.mcap", "/view/x1")
        assert 900 < torn["messages"] < 1100  # what can be read of it counts

    def test_deep_finds_damage_that_no_summary_shows(self, corpus: Path) -> None:
        log = corpus / "night" / "one" / "x2.mcap"
        data = bytearray(log.read_bytes())
        data[len(data) // 3] ^= 0xFF
        log.write_bytes(data)
        index_logs([corpus])
        assert row(corpus, "night/one/x2.mcap", "/view/x2")["problem"] is None
        made = index_logs([corpus], deep=True)
        assert made.read == 10
        broken = row(corpus, "night/one/x2.mcap", "/view/x2")
        assert (broken["crc"], broken["state"]) == ("bad", "damaged")
        assert "CRC" in broken["problem"]
        assert row(corpus, "night/one/x1.mcap", "/view/x1")["crc"] == "ok"
        assert row(corpus, "robot.mcap")["shape"] == "12x16"
        assert index_logs([corpus]).read == 0  # what is known deeply stays known

    def test_jobs_and_order_change_nothing(self, corpus: Path, tmp_path: Path) -> None:
        index_logs([corpus], tmp_path / "one.parquet")
        later = corpus / "robot.mcap"
        aside = tmp_path / "robot.mcap"
        later.rename(aside)
        index_logs([corpus], tmp_path / "two.parquet")
        aside.rename(later)
        index_logs([corpus], tmp_path / "two.parquet", jobs=2)
        one, two = (read_index(tmp_path / f"{name}.parquet") for name in ("one", "two"))
        assert one.to_pylist() == two.to_pylist()


class TestUpToDate:
    def test_only_what_is_new_or_changed_is_read(
        self, corpus: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        index_logs([corpus])
        before = (corpus / INDEX).stat().st_mtime_ns
        assert index_logs([corpus]).read == 0
        assert (corpus / INDEX).stat().st_mtime_ns == before  # not even written
        shutil.copytree(corpus / "night" / "one", corpus / "night" / "two")
        os.utime(corpus / "robot.mcap", ns=(1, 1))
        (corpus / "text.mcap").unlink()
        opened: list[str] = []
        read_rows = indexing.read_rows
        monkeypatch.setattr(
            indexing,
            "read_rows",
            lambda logs, deep: opened.extend(log.path for log in logs) or read_rows(logs, deep),
        )
        made = index_logs([corpus])
        assert opened == [*(f"night/two/x{i}.mcap" for i in (1, 2, 3)), "robot.mcap"]
        assert (made.read, made.kept, made.gone, made.files) == (4, 8, ["text.mcap"], 12)


class TestBadInput:
    def test_links_in_circles_end(self, corpus: Path) -> None:
        (corpus / "night" / "up").symlink_to(corpus)
        (corpus / "self").symlink_to(corpus / "self")
        (corpus / "lost.mcap").symlink_to("nowhere")
        names = [Path(log.file).name for log in find_logs([corpus])]
        assert len(names) == 11
        assert [log.problem for log in find_logs([corpus]) if log.file.endswith("lost.mcap")] == [
            "cannot be read: No such file or directory"
        ]

    def test_what_is_no_index_is_left_alone(self, corpus: Path, tmp_path: Path) -> None:
        other = tmp_path / "other.parquet"
        pq.write_table(pa.table({"a": [1]}), other)
        before = other.read_bytes()
        with pytest.raises(UsageError, match="is not an index"):
            index_logs([corpus], other)
        assert other.read_bytes() == before
        other.write_bytes(before[:-9])
        with pytest.raises(LogDamagedError, match="delete it and index again"):
            index_logs([corpus], other)
        with pytest.raises(UsageError, match=r"robot.mcap is not an index of version"):
            read_index(corpus / "robot.mcap")

    def test_what_was_read_is_kept_when_it_is_stopped(
        self, corpus: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(indexing, "BATCH", 4)
        made = index_logs([corpus], stop=lambda: True)
        assert (made.stopped, made.read, made.files) == (True, 4, 4)
        made = index_logs([corpus])
        assert (made.stopped, made.read, made.kept) == (False, 6, 4)
        index_logs([corpus], deep=True, stop=lambda: True)
        assert len({r["path"] for r in rows_of(corpus)}) == 10  # the rest is as it was


class TestSummary:
    def test_info_and_verify_show_every_log_that_it_lists(
        self, cdmisfa: Cdmisfa, corpus: Path
    ) -> None:
        for name in ("torn.mcap", "text.mcap", "empty.mcap"):
            (corpus / name).unlink()
        shutil.copytree(corpus / "night" / "one", corpus / "night" / "two")
        late = ((4_000_000 + 50 * i, image) for i, image in enumerate(pictures(20, 9)))
        write_images(corpus / "late.mcap", {"/camera": late})
        write_video(corpus / "film.mkv", pictures(26))
        (corpus / "t.csv").write_text("a,b\n1,2\n3,4\n")
        assert cdmisfa("index", corpus).code == 0
        listed = {str(corpus / row["path"]) for row in rows_of(corpus)}
        document = cdmisfa("info", corpus, "--json").json
        assert {file["path"] for file in document["files"]} == listed
        checked = cdmisfa("verify", corpus, "--json").json
        assert (checked["ok"], {file["file"] for file in checked["files"]}) == (True, listed)
        out = cdmisfa("info", corpus).out
        seconds = dict.fromkeys(("robot.mcap", "late.mcap"), 0.95) | {"film.mkv": 1.0}
        for name, each in seconds.items():
            assert re.search(rf"{name}: external log, .*, {each:.3f} s$", out, re.MULTILINE)
        parts = ("night/one", "runs")
        one, run = (cdmisfa("info", corpus / p, "--json").json["seconds"] for p in parts)
        total = 2.9 + 2 * one + run
        assert document["seconds"] == pytest.approx(total)
        assert re.search(rf"^9 logs, \d+ messages, {total:.3f} s in all$", out, re.MULTILINE)
        assert f"{corpus / 't.csv'}, {corpus / 'seen'}: no times: learn and convert need" in out

    def test_it_says_how_much_there_is_and_what_is_broken(
        self, cdmisfa: Cdmisfa, corpus: Path
    ) -> None:
        shutil.copytree(corpus / "night" / "one", corpus / "night" / "two")
        done = cdmisfa("index", corpus)
        assert done.code == 0
        assert "recording     3" in done.out  # the torn one is the third
        assert "external log  3" in done.out  # named as by info
        assert "robot.mcap: external log, " in cdmisfa("info", corpus / "robot.mcap").out
        assert "text.mcap: not an MCAP file" in done.out
        document = cdmisfa("index", corpus, "--json").json
        assert document["broken"] == len(document["problems"]) == 3
        kinds = {kind["kind"]: kind for kind in document["kinds"]}
        recordings = kinds["recording"]
        assert (recordings["files"], recordings["streams"]) == (3 + 3 + 1, 2 * (3 + 3 + 1))
        files = [*(corpus / "night").rglob("*.mcap"), corpus / "torn.mcap"]
        assert recordings["bytes"] == sum(file.stat().st_size for file in files)
        assert 2 * 39.98 < recordings["seconds"] < 3 * 39.98
        assert (kinds["run"]["logs"], kinds["not read"]["logs"]) == (1, 2)


def test_the_reference_names_every_column() -> None:
    page = (ROOT / "docs" / "reference" / "files.md").read_text("utf-8")
    assert set(SCHEMA.names) <= set(re.findall(r"`(\w+)`", page))
