"""Logs at URLs: read as the files that they are copies of, and one line where they cannot be."""

from __future__ import annotations

import os
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import Cdmisfa
from web_server import WebServer, serving

from replay.storage.location import COPIES, location, with_urls

fsspec = pytest.importorskip("fsspec")
pytest.importorskip("aiohttp")

QUICK = ("--max-iterations", "6", "--json")


@pytest.fixture
def web() -> Iterator[WebServer]:
    with serving() as web:
        yield web


@pytest.fixture
def views(web: WebServer, oscillatory_recording: Path) -> list[str]:
    """Return the URLs of a recording's views."""
    for file in sorted(oscillatory_recording.glob("*.mcap")):
        web.files[f"/rec/{file.name}"] = file.read_bytes()
    return [web.url(path) for path in web.files]


def test_the_signals_are_those_of_the_files(
    cdmisfa: Cdmisfa, views: list[str], oscillatory_recording: Path, tmp_path: Path
) -> None:
    near = cdmisfa("learn", oscillatory_recording, *QUICK)
    far = cdmisfa("learn", *views, *QUICK, "-o", tmp_path / "run", "--no-rerun")
    assert far.code == 0, far.err
    assert far.json["signals_sha256"] == near.json["signals_sha256"]
    assert far.json["source"] == near.json["source"]
    words = ("learn", "-o", tmp_path / "run", "--resume", "--max-iterations", "9", "--json")
    assert cdmisfa(*words).json["iterations"] == 9
    assert cdmisfa("check", tmp_path / "run").code == 0


def test_damage_is_found_and_named_by_its_url(
    cdmisfa: Cdmisfa, web: WebServer, oscillatory_recording: Path, tmp_path: Path
) -> None:
    data = bytearray((oscillatory_recording / "x1.mcap").read_bytes())
    web.files["/cut.mcap"] = bytes(data[: len(data) * 2 // 3])
    data[len(data) // 2] ^= 1
    web.files["/broken.mcap"] = bytes(data)
    for url in map(web.url, web.files):
        result = cdmisfa("verify", url, "--json")
        assert (result.code, result.json["files"][0]["file"]) == (3, url)
        assert result.json["problems"][0]["where"].startswith(url)
        saved = cdmisfa("recover", url, "-o", tmp_path / "saved.mcap", "--force", "--json")
        assert (saved.code, url in saved.json["lost"][0]["where"]) == (3, True)


def test_what_the_server_does_not_give_is_one_line_with_the_url(
    cdmisfa: Cdmisfa, web: WebServer
) -> None:
    web.files["/short.mcap"], web.missing = bytes(100), 10
    for url, words in (
        (web.url("/none.mcap"), "no such file"),
        (web.url("/short.mcap"), "not completed"),
        ("http://127.0.0.1:9/a.mcap", "Cannot connect"),
    ):
        done = cdmisfa("learn", url)
        assert (done.code, done.err.count("\n"), words in done.err) == (1, 1, True), done.err
        assert done.err.startswith(f"cdmisfa: {url}: ")
        assert url in cdmisfa("info", url, web.url("/other.mcap"), "--json").json["path"]


def test_no_secret_is_printed(cdmisfa: Cdmisfa, web: WebServer) -> None:
    url = web.url("/none.mcap?signature=feed").replace("://", "://me:hidden@")
    done = cdmisfa("info", url)
    assert done.err == f"cdmisfa: {web.url('/none.mcap')}: no such file\n"


def test_a_name_leads_to_no_other_folder(web: WebServer) -> None:
    web.files = {"/evil.mcap": b"x"}
    for path in ("/../../../../evil.mcap", "/a/../../../../evil.mcap"):
        copy = location(web.url(path))
        assert copy.read_bytes() == b"x"
        assert copy.resolve().is_relative_to(Path(os.environ[COPIES]).resolve())


def test_processes_share_one_copy(
    cdmisfa: Cdmisfa, web: WebServer, views: list[str], tmp_path: Path
) -> None:
    words = ("--seeds", "0:4", "--max-iterations", "3", "--jobs", "2", "-o", tmp_path / "sweep")
    assert cdmisfa("sweep", *views, *words).code == 0
    assert sorted(web.requests) == sorted(web.files)
    text = f"{location(views[0])} and {location(views[1]).parent}"
    assert with_urls(text) == f"{views[0]} and {views[1].rpartition('/')[0]}"


def test_memory_holds_a_bounded_part(web: WebServer) -> None:
    web.files["/big"] = bytes(60_000_000)
    tracemalloc.start()
    assert location(web.url("/big")).stat().st_size == 60_000_000
    assert tracemalloc.get_traced_memory()[1] < 24 << 20
    tracemalloc.stop()


def test_the_logs_below_an_s3_prefix_are_a_recording(
    cdmisfa: Cdmisfa, oscillatory_recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from fsspec.implementations.memory import MemoryFileSystem

    class Bucket(MemoryFileSystem):  # type: ignore[misc]
        @classmethod
        def _strip_protocol(cls, path: str) -> str:
            return str(super()._strip_protocol(path.removeprefix("s3:/")))

    files = Bucket()
    files.put(str(oscillatory_recording), "s3://logs/rec", recursive=True)
    files.pipe("s3://logs/rec/notes.txt", b"no log")
    monkeypatch.setattr(fsspec, "filesystem", lambda *_: files)
    near, far = (cdmisfa("learn", p, *QUICK) for p in (oscillatory_recording, "s3://logs/rec"))
    assert far.code == 0, far.err
    assert far.json["signals_sha256"] == near.json["signals_sha256"]
    assert not (location("s3://logs/rec") / "notes.txt").exists()
    assert cdmisfa("info", "s3://logs/rec/x1.mcap").code == 0
