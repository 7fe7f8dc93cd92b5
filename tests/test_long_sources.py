"""Learning from long logs begins before all of them was read; what they are is known at the end."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Cdmisfa
from PIL import Image

from cdmisfa.core.blocks import Block, SeekableSource, description
from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.core.learning import Learner, Sink
from cdmisfa.core.signals import BlockSignals
from cdmisfa.experiments.runs import RunResult, run
from recorder.mcap.reader import LogReader
from replay.camera_logs.source import ForeignSource
from replay.recordings.source import RecordedSource
from replay.runs.compare import told_otherwise
from replay.runs.final import stated_source
from replay.runs.log import read_header
from replay.storage import hashing
from replay.storage.identity import hashed
from replay.view.build import build_view

CONFIG = LearnerConfig(tau=20)
ITERATIONS = 12


@pytest.fixture(autouse=True)
def long(monkeypatch: pytest.MonkeyPatch) -> None:
    """All logs count as long."""
    monkeypatch.setattr(hashing, "AT_ONCE", 0)


@pytest.fixture
def held(monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Event]:
    """No log is hashed before this is set."""
    go, work = threading.Event(), hashing.Hashing._work

    def wait(self: hashing.Hashing) -> None:
        assert go.wait(60)
        work(self)

    monkeypatch.setattr(hashing.Hashing, "_work", wait)
    yield go
    go.set()


@pytest.fixture
def recording(oscillatory_recording: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(oscillatory_recording, tmp_path / "rec"))


class Then(Sink):
    """Does something after a block."""

    def __init__(self, work: Callable[[], object], iteration: int = 0) -> None:
        self._work, self._iteration = work, iteration

    def block(self, block: Block, signals: BlockSignals, learner: Learner) -> None:
        if signals.iteration == self._iteration:
            self._work()

    def event(self, t: int, iteration: int, text: str, level: str = "INFO") -> None:
        pass

    def finish(self) -> None:
        pass


class KilledError(BaseException):
    """Ends a run as a kill does."""


def killed() -> None:
    raise KilledError


def learn(path: Path, out: Path, *sinks: Sink, **how: Any) -> RunResult:
    with_end = {"max_iterations": ITERATIONS, "rerun": False, **how}
    source = RecordedSource(path)
    try:
        return run(source, CONFIG, out, sinks=sinks, **with_end)
    finally:
        source.close()


def damage(path: Path) -> None:
    """Change what only the checksum over all of the data protects: the name of what wrote it."""
    raw = bytearray(path.read_bytes())
    raw[raw.index(b"cdmisfa ")] ^= 1
    path.write_bytes(raw)


def hashing_threads() -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name == "hashing"]


def test_learning_begins_before_a_file_is_hashed_and_ends_as_ever(
    recording: Path, tmp_path: Path, held: threading.Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[Any] = []

    def look() -> None:
        seen.extend(read_header(tmp_path / "run").manifest["source"]["views"])
        assert hashing_threads() == ["hashing"]
        held.set()

    result = learn(recording, tmp_path / "run", Then(look))
    assert hashing_threads() == []
    monkeypatch.setattr(hashing, "AT_ONCE", 2**40)
    before = learn(recording, tmp_path / "before")
    keys = {"name", "frames", "file", "bytes", "sample_sha256"}
    assert [view.keys() for view in seen] == [keys] * 3
    assert len({view["sample_sha256"] for view in seen}) == 3
    one, two = (json.loads((tmp_path / n / "run.json").read_text()) for n in ("run", "before"))
    assert one["source"] == two["source"] == result.source == before.source
    assert result.signals_sha256 == before.signals_sha256
    for view in result.source["views"]:
        whole = (recording / view["file"]).read_bytes()
        assert view["sha256"] == hashlib.sha256(whole).hexdigest()


def pictures(folder: Path, value: int) -> Path:
    folder.mkdir()
    rng = np.random.default_rng(value)
    for number in range(30):
        pixels = rng.integers(0, 256, (6, 8), np.uint8)
        Image.fromarray(pixels).save(folder / f"{number}.png", compress_level=0)
    return folder


def table(path: Path, value: int) -> Path:
    rows = np.random.default_rng(value).integers(10_000, 100_000, (30_000, 3))
    path.write_text("a,b,c\n" + "".join(f"{a},{b},{c}\n" for a, b, c in rows.tolist()))
    return path


def source_of(kind: str, recording: Path, folder: Path, value: int) -> SeekableSource:
    folder.mkdir()
    if kind == "recording":
        return RecordedSource(recording)
    if kind == "pictures":
        return ForeignSource(pictures(folder / "p", value), rate=10)
    return ForeignSource(table(folder / "t.csv", value), rate=10)


@pytest.mark.parametrize("kind", ["recording", "pictures", "table"])
def test_every_kind_of_log_is_known_by_a_sample_and_in_the_end_by_all_of_it(
    kind: str, oscillatory_recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = source_of(kind, oscillatory_recording, tmp_path / "a", 1)
    list_of = "views" if kind == "recording" else "files"
    first, whole = description(source, at_once=True), description(source)
    assert json.loads(json.dumps(first)) == first
    known = [file["sample_sha256"] for file in first.pop(list_of)]
    assert [file.keys() & {"bytes", "sha256"} for file in whole.pop(list_of)] == [{"sha256"}] * len(
        known
    )
    assert first == whole
    source.close()
    monkeypatch.setattr(hashing, "AT_ONCE", 2**40)
    source = source_of(kind, oscillatory_recording, tmp_path / "b", 1)
    assert description(source, at_once=True) == description(source)
    source.close()
    if kind == "recording":
        return
    monkeypatch.setattr(hashing, "AT_ONCE", 0)
    source = source_of(kind, oscillatory_recording, tmp_path / "c", 2)
    other = description(source, at_once=True)["files"]
    source.close()
    assert other[0]["bytes"] == sum(
        f.stat().st_size for f in (tmp_path / "a").rglob("*") if f.is_file()
    )
    assert other[0]["sample_sha256"] != known[0]


@pytest.mark.parametrize("size", [0, 1, 4095, 4096, 4097, 65_536, 10**10])
def test_a_sample_reaches_from_the_first_bytes_to_the_last(size: int) -> None:
    places = hashing.sampled(size)
    assert places == sorted(places)
    assert (places[0], min(places[-1] + hashing.PIECE, size)) == (0, size)


def test_a_log_without_checksums_is_told_from_one_with_the_same_index(tmp_path: Path) -> None:
    from mcap.writer import CompressionType, Writer

    known = []
    for value in range(2):
        data = np.random.default_rng(value).integers(0, 256, 3000, np.uint8).tobytes()
        with (tmp_path / f"{value}.mcap").open("wb") as file:
            writer = Writer(file, compression=CompressionType.NONE, enable_data_crcs=False)
            writer.start()
            channel = writer.register_channel("t", "raw", 0)
            writer.add_message(channel, 0, data, 0)
            writer.finish()  # type: ignore[no-untyped-call]
        with LogReader(tmp_path / f"{value}.mcap") as reader:
            known.append(hashed(reader).at_once())
    assert known[0]["bytes"] == known[1]["bytes"]
    assert known[0]["sample_sha256"] != known[1]["sample_sha256"]


def test_a_killed_run_goes_on_with_its_file_alone(recording: Path, tmp_path: Path) -> None:
    whole = learn(recording, tmp_path / "whole")
    with pytest.raises(KilledError):
        learn(recording, tmp_path / "run", Then(killed, 7), keyframes=4)
    other = shutil.copytree(recording, tmp_path / "other")
    raw = bytearray((other / "x2.mcap").read_bytes())
    raw[10] ^= 1
    (other / "x2.mcap").write_bytes(raw)
    with pytest.raises(UsageError, match=r"source\.views.*sample_sha256"):
        learn(other, tmp_path / "run", resume=True)
    result = learn(recording, tmp_path / "run", resume=True)
    assert result.as_json() | {"run": ""} == whole.as_json() | {"run": ""}
    assert told_otherwise(tmp_path / "run", tmp_path / "whole") == ()


def test_a_finished_run_goes_on_with_all_of_its_file_compared(tmp_path: Path) -> None:
    """A byte that no sample has is another."""
    path = table(tmp_path / "t.csv", 3)

    def learn_table(out: Path, *sinks: Sink, **how: Any) -> RunResult:
        source = ForeignSource(path, rate=10)
        try:
            return run(source, CONFIG, out, sinks=sinks, rerun=False, **how)
        finally:
            source.close()

    with pytest.raises(KilledError):
        learn_table(tmp_path / "killed", Then(killed, 7))
    done = learn_table(tmp_path / "run", max_iterations=5)
    assert told_otherwise(tmp_path / "run", tmp_path / "killed") == ()
    more = learn_table(tmp_path / "run", max_iterations=8, resume=True)
    assert more.source == done.source
    stated = read_header(tmp_path / "run").manifest["source"]["files"]
    assert stated == [{"file": "t.csv", "sha256": done.source["files"][0]["sha256"]}]
    assert stated_source(tmp_path / "killed" / "run.mcap.partial")["files"][0].keys() == {
        "file",
        "bytes",
        "sample_sha256",
    }
    at = hashing.sampled(path.stat().st_size)[3] + hashing.PIECE + 100
    raw = bytearray(path.read_bytes())
    raw[at] = ord("1") if raw[at] != ord("1") else ord("2")
    path.write_bytes(raw)
    with pytest.raises(UsageError, match=r"source\.files.*sha256"):
        learn_table(tmp_path / "run", max_iterations=9, resume=True)
    assert (tmp_path / "run" / "run.mcap").is_file()


def test_a_run_of_before_is_resumed(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hashing, "AT_ONCE", 2**40)
    with pytest.raises(KilledError):
        learn(recording, tmp_path / "run", Then(killed, 7), keyframes=4)
    monkeypatch.setattr(hashing, "AT_ONCE", 0)
    assert learn(recording, tmp_path / "run", resume=True).iterations == ITERATIONS


def test_what_changes_meanwhile_is_damage_and_the_run_is_kept(
    recording: Path, tmp_path: Path
) -> None:
    path, out = recording / "x3.mcap", tmp_path / "run"

    def overwrite() -> None:
        raw = path.read_bytes()
        with path.open("r+b") as file:
            file.write(raw[:20] + bytes([raw[20] ^ 1]))
        os.utime(path, ns=(1, 1))

    with pytest.raises(LogDamagedError, match=r"x3\.mcap"):
        learn(recording, out, Then(overwrite))
    assert sorted(file.name for file in out.iterdir()) == ["run.mcap.partial"]


def test_a_file_that_was_hashed_before_it_changed_is_hashed_again(
    tmp_path: Path, held: threading.Event
) -> None:
    held.set()
    path = table(tmp_path / "t.csv", 4)
    source = ForeignSource(path, rate=10)
    description(source, at_once=True)
    source.hash_meanwhile()
    while source.wait_hashed(10) is not None:
        pass
    os.utime(path, ns=(1, 1))
    assert source.describe()["files"][0]["sha256"]
    with path.open("r+b") as file:
        file.write(b"c")
    with pytest.raises(LogDamagedError, match=r"t\.csv: it was changed while it was read"):
        source.describe()
    source.close()


def test_a_checksum_of_the_data_that_does_not_match_is_told_at_the_end(
    cdmisfa: Cdmisfa, recording: Path, tmp_path: Path
) -> None:
    damage(recording / "x1.mcap")
    words = ("learn", recording, "-o", tmp_path / "run", "--no-rerun", "--max-iterations", "3")
    done = cdmisfa(*words)
    assert (done.code, "x1.mcap: data section: its CRC does not match" in done.err) == (3, True)
    assert not (tmp_path / "run" / "run.json").exists()
    assert cdmisfa("info", tmp_path / "run").code == 0


def test_damage_that_the_hash_finds_ends_learning(
    recording: Path, tmp_path: Path, held: threading.Event
) -> None:
    damage(recording / "x1.mcap")
    learned: list[int] = []

    def hashed_by_now() -> None:
        learned.append(1)
        held.set()
        for thread in threading.enumerate():
            if thread.name == "hashing":
                thread.join(60)

    sinks = [Then(hashed_by_now, iteration) for iteration in range(ITERATIONS)]
    with pytest.raises(LogDamagedError, match=r"x1\.mcap: data section: its CRC does not match"):
        learn(recording, tmp_path / "run", *sinks)
    assert len(learned) == 1
    assert [file.name for file in (tmp_path / "run").iterdir()] == ["run.mcap.partial"]


def test_an_end_waits_for_the_hash_and_says_so(
    cdmisfa: Cdmisfa, recording: Path, tmp_path: Path, held: threading.Event
) -> None:
    threading.Timer(0.3, held.set).start()
    words = ("learn", recording, "-o", tmp_path / "run", "--no-rerun", "--max-iterations", "1")
    done = cdmisfa(*words)
    assert (done.code, "waiting for the SHA-256 of what is learned from" in done.err) == (0, True)


def test_a_second_signal_ends_the_wait_and_the_run_is_resumed(
    recording: Path, tmp_path: Path, held: threading.Event
) -> None:
    def again(done: int, size: int) -> None:
        held.set()
        raise KeyboardInterrupt

    out, stops = tmp_path / "run", iter([False, False, True])
    with pytest.raises(KeyboardInterrupt, match="go on with --resume"):
        learn(recording, out, stop=lambda: next(stops, True), hashing=again)
    assert sorted(file.name for file in out.iterdir()) == ["run.mcap.partial"]
    whole = learn(recording, tmp_path / "whole")
    resumed = learn(recording, out, resume=True)
    assert resumed.as_json() | {"run": ""} == whole.as_json() | {"run": ""}


def test_the_thread_ends_with_its_source(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    begun, told = threading.Event(), hashing.Hashing._tell

    def tell(self: hashing.Hashing, count: int) -> None:
        begun.set()
        while not self._stopped:
            pass
        told(self, count)

    monkeypatch.setattr(hashing.Hashing, "_tell", tell)
    source = RecordedSource(recording)
    source.hash_meanwhile()
    assert begun.wait(60)
    source.close()
    assert hashing_threads() == []
    source.close()


def test_a_view_of_a_killed_run_takes_its_recording_alone(recording: Path, tmp_path: Path) -> None:
    with pytest.raises(KilledError):
        learn(recording, tmp_path / "run", Then(killed, 7))
    build_view(tmp_path / "run", tmp_path / "v.rrd", all_views=recording)
    raw = bytearray((recording / "x1.mcap").read_bytes())
    raw[10] ^= 1
    (recording / "x1.mcap").write_bytes(raw)
    with pytest.raises(UsageError, match="not the recording"):
        build_view(tmp_path / "run", tmp_path / "w.rrd", all_views=recording)
