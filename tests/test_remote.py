"""Logs on a web server: the same signals from few bytes, and one line where it fails."""

from __future__ import annotations

import sys
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from camera_files import write_cameras
from conftest import Cdmisfa
from mcap.writer import CompressionType, Writer
from mcap_files import (
    CHANNEL,
    HEADER,
    MAGIC,
    MESSAGE,
    channel,
    finish,
    message,
    record,
    text,
    variant,
    variants,
)
from web_server import WebServer, serving

from cdmisfa.core.errors import CdmisfaError, LogDamagedError
from recorder.mcap.reader import LogReader
from replay.camera_logs.source import ForeignSource
from replay.recordings.source import RecordedSource
from replay.storage.location import Url, location
from replay.storage.opening import open_store
from replay.storage.remote import RemoteStore

pytest.importorskip("aiohttp")

QUICK = ("--max-iterations", "6", "--json")


@pytest.fixture(scope="module")
def server() -> Iterator[WebServer]:
    with serving() as web:
        yield web


@pytest.fixture
def web(server: WebServer) -> WebServer:
    server.files = {}
    server.reset()
    return server


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("replay.storage.servers.FIRST_WAIT", 0.02)


@pytest.fixture
def views(web: WebServer, oscillatory_recording: Path) -> list[str]:
    """URLs of the recording's views."""
    for file in sorted(oscillatory_recording.glob("*.mcap")):
        web.files[f"/rec/{file.name}"] = file.read_bytes()
    return [web.url(path) for path in web.files]


def write_noise(path: Path, topics: tuple[str, ...], count: int, size: int) -> None:
    """A log with chunks of one topic each in turn, that nothing can compress."""
    random = np.random.default_rng(3)
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=5 * size, compression=CompressionType.NONE)
        writer.start()
        channels = [writer.register_channel(topic, "", 0) for topic in topics]
        for i in range(count):
            for number, channel in enumerate(channels):
                for k in range(5):
                    time = (5 * i + k) * 10_000_000 + number
                    writer.add_message(channel, time, random.bytes(size), time)
        writer.finish()


def test_the_signals_are_those_of_the_files(
    cdmisfa: Cdmisfa, views: list[str], oscillatory_recording: Path, tmp_path: Path
) -> None:
    near = cdmisfa("learn", oscillatory_recording, *QUICK)
    far = cdmisfa("learn", *views, *QUICK, "-o", tmp_path / "run", "--no-rerun")
    assert far.code == 0, far.err
    assert far.json["signals_sha256"] == near.json["signals_sha256"]
    view = far.json["source"]["views"][0]
    assert (view["url"], len(view["index_sha256"])) == (views[0], 64)
    assert view["bytes"] == (oscillatory_recording / view["file"]).stat().st_size
    words = ("learn", *views, "-o", tmp_path / "run", "--resume", "--max-iterations", "9", "--json")
    assert cdmisfa(*words).json["iterations"] == 9


def test_what_is_in_a_log_is_said_from_few_bytes(
    cdmisfa: Cdmisfa, web: WebServer, tmp_path: Path
) -> None:
    write_noise(tmp_path / "a.mcap", ("/left", "/right"), 1000, 5000)
    web.files["/a.mcap"] = (tmp_path / "a.mcap").read_bytes()
    near = cdmisfa("info", tmp_path / "a.mcap", "--json").json
    far = cdmisfa("info", web.url("/a.mcap"), "--json").json
    assert far["channels"] == near["channels"]
    assert (far["chunks"], far["complete"]) == (near["chunks"], True)
    assert (far["crc"], near["crc"]) == ("unchecked", "ok")
    assert len(web.files["/a.mcap"]) > 50_000_000
    assert web.sent < 0.01 * len(web.files["/a.mcap"])


def test_the_chunks_of_other_topics_are_left_where_they_are(web: WebServer, tmp_path: Path) -> None:
    write_noise(tmp_path / "a.mcap", ("/left", "/right"), 100, 5000)
    web.files["/a.mcap"] = (tmp_path / "a.mcap").read_bytes()
    with LogReader(open_store(web.url("/a.mcap"))) as reader:
        assert reader.by_index
        edges, _ = web.sent, web.reset()
        taken = [m.data for m in reader.messages({"/left"})]
    with LogReader(tmp_path / "a.mcap") as reader:
        assert taken == [m.data for m in reader.messages({"/left"})]
    assert edges < 200_000
    assert web.sent < 1.02 * sum(map(len, taken)) + 100_000


def test_small_chunks_that_touch_are_asked_for_together(web: WebServer, tmp_path: Path) -> None:
    write_noise(tmp_path / "a.mcap", ("/a",), 400, 5000)
    web.files["/a.mcap"] = (tmp_path / "a.mcap").read_bytes()
    with LogReader(open_store(web.url("/a.mcap"))) as reader:
        web.reset()
        assert sum(len(m.data) for m in reader.messages()) == 10_000_000
    assert len(web.asked) < 16
    assert max(web.asked) < (1 << 20) + 30_000
    assert web.sent < 1.01 * len(web.files["/a.mcap"])


def test_a_short_run_reads_only_the_beginning(web: WebServer, tmp_path: Path) -> None:
    write_cameras(tmp_path / "a.mcap", {"/left": (8000, 20), "/right": (8000, 20)})
    web.files["/a.mcap"] = (tmp_path / "a.mcap").read_bytes()
    near = ForeignSource(tmp_path / "a.mcap", ["/left"], size=(12, 16))
    far = ForeignSource(web.url("/a.mcap"), ["/left"], size=(12, 16))
    web.reset()
    np.testing.assert_array_equal(far.take(0, 100).frames, near.take(0, 100).frames)
    assert web.sent < 0.1 * len(web.files["/a.mcap"])
    far.seek(6000)
    near.seek(6000)
    np.testing.assert_array_equal(far.take(0, 100).frames, near.take(0, 100).frames)
    assert web.sent < 0.2 * len(web.files["/a.mcap"])
    far.close()


def test_every_variant_of_the_format_gives_the_same_messages(
    web: WebServer, tmp_path: Path
) -> None:
    chosen = [v for i, v in enumerate(variants()) if i % 7 == 0]
    for kind, features in chosen:
        data = variant(kind, features, "zstd")
        (tmp_path / "a.mcap").write_bytes(data)
        web.files["/a.mcap"] = data
        far_store = open_store(web.url("/a.mcap"))
        with LogReader(tmp_path / "a.mcap") as near, LogReader(far_store) as far:
            assert list(far.messages()) == list(near.messages()), (kind, features)
            assert far.metadata == near.metadata
            assert far.attachments == near.attachments
            assert far.complete == near.complete


def test_cut_logs_are_said_to_be_cut_and_saved(
    cdmisfa: Cdmisfa, web: WebServer, oscillatory_recording: Path, tmp_path: Path
) -> None:
    data = (oscillatory_recording / "x1.mcap").read_bytes()
    web.files["/x1.mcap"] = data[: len(data) * 2 // 3]
    (tmp_path / "x1.mcap").write_bytes(web.files["/x1.mcap"])
    url = web.url("/x1.mcap")
    near, far = (cdmisfa("info", p, "--json").json for p in (tmp_path / "x1.mcap", url))
    assert far["channels"] == near["channels"]
    assert not far["complete"]
    assert cdmisfa("verify", url).code == 3
    learned = cdmisfa("learn", url, *QUICK)
    assert (learned.code, "sends less than the log" in learned.err) == (3, True), learned
    assert cdmisfa("learn", url, "--salvage", *QUICK).code == 0
    saved = cdmisfa("recover", url, "-o", tmp_path / "saved.mcap", "--json")
    assert saved.code == 3
    assert url in saved.json["lost"][0]["where"]
    assert cdmisfa("verify", tmp_path / "saved.mcap").code == 0


def test_damage_in_a_chunk_is_found_when_it_is_read(
    cdmisfa: Cdmisfa, web: WebServer, views: list[str]
) -> None:
    with LogReader(open_store(views[0])) as reader:
        segment = reader.segments[len(reader.segments) // 2]
    broken = bytearray(web.files["/rec/x1.mcap"])
    broken[segment.data_offset + segment.stored // 2] ^= 1
    web.files["/rec/x1.mcap"] = bytes(broken)
    with RecordedSource(views) as source:
        source.take(0, 10)
        source.seek(0)
        with pytest.raises(LogDamagedError, match=r"x1\.mcap: chunk at byte"):
            source.take(0, 2000)
    found = cdmisfa("verify", views[0], "--json")
    assert found.code == 3
    assert found.json["problems"][0]["where"].startswith(views[0])


def test_a_summary_that_lies_about_a_chunk_is_caught(web: WebServer, tmp_path: Path) -> None:
    write_noise(tmp_path / "a.mcap", ("/left",), 20, 500)
    data = bytearray((tmp_path / "a.mcap").read_bytes())
    with LogReader(tmp_path / "a.mcap") as reader:
        first = reader.segments[0]
    place = data.index(int.to_bytes(first.offset, 8, "little"), first.stop)
    data[place - 16] ^= 1  # when its first message was
    data[-12:-8] = bytes(4)  # no checksum of the summary
    web.files["/a.mcap"] = bytes(data)
    with (
        LogReader(open_store(web.url("/a.mcap"))) as reader,
        pytest.raises(LogDamagedError, match="not the chunk that the summary names"),
    ):
        list(reader.messages())


def test_a_log_that_is_not_there_is_one_line(cdmisfa: Cdmisfa, web: WebServer) -> None:
    for url, code, words in (
        (web.url("/none.mcap"), 2, "404 Not Found"),
        ("http://127.0.0.1:9/a.mcap", 1, "Cannot connect"),
    ):
        done = cdmisfa("learn", url)
        assert (done.code, done.err.count("\n"), words in done.err) == (code, 1, True), done.err
    web.files["/empty.mcap"] = b""
    web.files["/text.mcap"] = b"no log at all"
    for path in ("/empty.mcap", "/text.mcap"):
        assert cdmisfa("info", web.url(path)).code == 3


def test_memory_holds_a_bounded_part(web: WebServer) -> None:
    web.files["/big"] = bytes(60_000_000)
    store = RemoteStore(Url(web.url("/big")))
    tracemalloc.start()
    for at in range(0, store.size, 1 << 20):
        assert len(store.read_at(at, 1 << 20)) == min(1 << 20, store.size - at)
    assert tracemalloc.get_traced_memory()[1] < 24 << 20
    tracemalloc.stop()
    store.close()


def test_a_run_on_a_server_is_looked_at_and_not_learned_from(
    cdmisfa: Cdmisfa, web: WebServer, oscillatory_run: Path, tmp_path: Path
) -> None:
    web.files["/runs/a/run.mcap"] = (oscillatory_run / "run.mcap").read_bytes()
    url = web.url("/runs/a/run.mcap")
    done = cdmisfa("learn", url)
    assert (done.code, "is a run, not a recording" in done.err) == (2, True), done.err
    assert cdmisfa("view", url, "--save", tmp_path / "a.rrd").code == 0
    assert (tmp_path / "a.rrd").stat().st_size > 1000
    for source, out in ((url, "far.csv"), (oscillatory_run, "near.csv")):
        assert cdmisfa("export", source, "-o", tmp_path / out).code == 0
    assert (tmp_path / "far.csv").read_bytes() == (tmp_path / "near.csv").read_bytes()


def test_runs_on_a_server_are_compared(
    cdmisfa: Cdmisfa, web: WebServer, oscillatory_run: Path, tmp_path: Path
) -> None:
    web.files["/runs/a/run.mcap"] = (oscillatory_run / "run.mcap").read_bytes()
    url = web.url("/runs/a/run.mcap")
    same = cdmisfa("compare", oscillatory_run, url, "--json")
    assert (same.code, same.json["identical"]) == (0, True), same
    assert [row["run"] for row in same.json["runs"]] == [oscillatory_run.name, "a"]
    missing = cdmisfa("compare", oscillatory_run, web.url("/none/run.mcap"))
    assert (missing.code, "/none/run.mcap: the server answers 404" in missing.err) == (2, True)
    assert "http:/1" not in missing.err


def test_camera_logs_on_a_server_are_converted(
    cdmisfa: Cdmisfa, web: WebServer, tmp_path: Path
) -> None:
    write_cameras(tmp_path / "a.mcap", {"/left": (60, 20), "/right": (60, 20)})
    web.files["/a.mcap"] = (tmp_path / "a.mcap").read_bytes()
    both = ("--topic", "/left", "--topic", "/right", "--size", "16x12")
    words = ("--max-iterations", "3", "--set", "learner.tau=10", "--json")
    near = cdmisfa("learn", tmp_path / "a.mcap", *both, *words)
    done = cdmisfa("convert", web.url("/a.mcap"), *both, "-o", tmp_path / "rec")
    assert done.code == 0, done.err
    far = cdmisfa("learn", tmp_path / "rec", *words)
    assert far.json["signals_sha256"] == near.json["signals_sha256"]


@pytest.mark.parametrize(
    ("address", "shown", "name"),
    [
        (
            "https://me:secret@host/rec/a%20b.mcap?X-Amz-Signature=feed",
            "https://host/rec/a%20b.mcap",
            "a b.mcap",
        ),
        ("https://host/..%2F..%2Fevil.mcap", None, ".._.._evil.mcap"),
        ("s3://bucket/a%2Fb/..", None, "log"),
    ],
)
def test_a_url_shows_no_secrets_and_names_a_file(
    address: str, shown: str | None, name: str
) -> None:
    url = location(address)
    assert (str(url), url.name) == (shown or address, name)
    assert (url.stem, url.suffix) == (Path(name).stem, Path(name).suffix)


def test_without_the_packages_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "fsspec", None)
    with pytest.raises(CdmisfaError, match=r"pip install 'cdmisfa\[cloud\]'"):
        LogReader(open_store("https://127.0.0.1/a.mcap"))


def test_messages_outside_chunks_are_found_by_a_walk(web: WebServer) -> None:
    data = MAGIC + record(HEADER, text("") + text("tests")) + record(CHANNEL, channel(schema_id=0))
    data += record(MESSAGE, message(1, 0, 7, 7, b"x"))
    web.files["/a.mcap"] = finish(data)
    with LogReader(open_store(web.url("/a.mcap"))) as reader:
        assert not reader.by_index
        assert [m.data for m in reader.messages()] == [b"x"]
