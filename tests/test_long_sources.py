"""Identity of logs: a sample when learning begins from long ones, and SHA-256 at the end."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Cdmisfa
from folders import flip
from message_files import write_mcap
from PIL import Image

from cdmisfa.core.blocks import Block, SeekableSource, description
from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.core.learning import Learner, Sink
from cdmisfa.core.signals import BlockSignals
from cdmisfa.experiments.run_folder import RunResult
from cdmisfa.experiments.session import run
from recorder.images.decoding import MessageKind
from recorder.mcap.reader import LogReader
from replay.camera_logs.opening import identity_of
from replay.camera_logs.source import ForeignSource
from replay.recordings.source import RecordedSource
from replay.runs.compare import told_otherwise
from replay.runs.log import read_header
from replay.runs.run import stated_source
from replay.storage import identity
from replay.storage.identity import LogIdentity
from replay.view.build import build_view

CONFIG = LearnerConfig(tau=20)
ITERATIONS = 12


@pytest.fixture(autouse=True)
def long(monkeypatch: pytest.MonkeyPatch) -> None:
    """All logs count as long."""
    monkeypatch.setattr(identity, "AT_ONCE", 0)


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
    flip(path, path.read_bytes().index(b"cdmisfa "))


def test_a_run_begins_with_a_sample_and_ends_with_the_sha256(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[Any] = []

    def look() -> None:
        seen.extend(read_header(tmp_path / "run").manifest["source"]["views"])

    result = learn(recording, tmp_path / "run", Then(look))
    monkeypatch.setattr(identity, "AT_ONCE", 2**40)
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
    make = {"pictures": pictures, "table": table}[kind]
    return ForeignSource(make(folder / "log.csv", value), rate=10)


@pytest.mark.parametrize("kind", ["recording", "pictures", "table"])
def test_every_kind_of_log_is_known_by_a_sample_and_in_the_end_by_all_of_it(
    kind: str, oscillatory_recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = source_of(kind, oscillatory_recording, tmp_path / "a", 1)
    list_of = "views" if kind == "recording" else "files"
    first, whole = description(source, at_once=True), description(source)
    assert json.loads(json.dumps(first)) == first
    samples, files = first.pop(list_of), whole.pop(list_of)
    assert all({"bytes", "sample_sha256"} <= file.keys() for file in samples)
    assert all(file.keys() & {"bytes", "sha256"} == {"sha256"} for file in files)
    assert first == whole
    if kind != "recording":
        (known,) = samples
        parts = (tmp_path / "a").rglob("*")
        assert known["bytes"] == sum(part.stat().st_size for part in parts if part.is_file())
        other = source_of(kind, oscillatory_recording, tmp_path / "b", 2)
        assert description(other, at_once=True)["files"][0]["bytes"] == known["bytes"]
        assert description(other, at_once=True)["files"][0] != known
    monkeypatch.setattr(identity, "AT_ONCE", 2**40)
    assert description(source, at_once=True) == description(source)
    source.close()


@pytest.mark.parametrize("size", [0, 1, 4095, 4096, 4097, 65_536, 10**10])
def test_a_sample_reaches_from_the_first_bytes_to_the_last(size: int) -> None:
    places = identity.sampled(size)
    assert places == sorted(places)
    assert (places[0], min(places[-1] + identity.PIECE, size)) == (0, size)


def test_a_log_without_checksums_is_told_from_one_with_the_same_index(tmp_path: Path) -> None:
    from mcap.writer import CompressionType

    known = []
    for value in range(2):
        data = np.random.default_rng(value).integers(0, 256, 3000, np.uint8).tobytes()
        how = {"compression": CompressionType.NONE, "enable_data_crcs": False}
        path, kind = tmp_path / f"{value}.mcap", MessageKind("", "raw")
        with LogReader(write_mcap(path, kind, {"t": [(0, data)]}, **how)) as reader:
            known.append(LogIdentity(reader).sample())
    assert known[0]["bytes"] == known[1]["bytes"]
    assert known[0]["sample_sha256"] != known[1]["sample_sha256"]


def test_a_killed_run_goes_on_with_its_file_alone(recording: Path, tmp_path: Path) -> None:
    whole = learn(recording, tmp_path / "whole")
    with pytest.raises(KilledError):
        learn(recording, tmp_path / "run", Then(killed, 7), keyframes=4)
    other = shutil.copytree(recording, tmp_path / "other")
    flip(other / "x2.mcap", 10)
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
    at = identity.sampled(path.stat().st_size)[3] + identity.PIECE + 100
    raw = bytearray(path.read_bytes())
    raw[at] = ord("1") if raw[at] != ord("1") else ord("2")
    path.write_bytes(raw)
    with pytest.raises(UsageError, match=r"source\.files.*sha256"):
        learn_table(tmp_path / "run", max_iterations=9, resume=True)
    assert (tmp_path / "run" / "run.mcap").is_file()


def test_a_run_of_before_is_resumed(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(identity, "AT_ONCE", 2**40)
    with pytest.raises(KilledError):
        learn(recording, tmp_path / "run", Then(killed, 7), keyframes=4)
    monkeypatch.setattr(identity, "AT_ONCE", 0)
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


@pytest.mark.parametrize("kind", ["folder", "picture", "table"])
def test_files_are_hashed_as_they_were_opened_or_called_changed(tmp_path: Path, kind: str) -> None:
    folder = pictures(tmp_path / "p", 1)
    path = {"folder": folder, "picture": folder / "0.png"}.get(kind)
    path = path or table(tmp_path / "t.csv", 4)
    file = folder / "0.png" if kind == "folder" else path
    log, changed = (identity_of(path, []) for _ in range(2))
    known = log.whole(lambda count: None)
    (folder / "new.png").write_bytes(b"c")  # what comes into a folder does not count
    os.utime(file, ns=(1, 1))
    assert log.whole(lambda count: None) == known
    with pytest.raises(LogDamagedError, match="it was changed while it was read; begin again"):
        changed.whole(lambda count: None)  # perhaps before it was learned from
    with file.open("r+b") as opened:
        opened.write(b"c")
    with pytest.raises(LogDamagedError, match="it was changed while it was read; begin again"):
        log.whole(lambda count: None)
    assert known["file"] == path.name
    listed = "".join(
        f"{one.name}\0{hashlib.sha256(one.read_bytes()).hexdigest()}\n"
        for one in sorted(pictures(tmp_path / "again", 1).iterdir())
    )
    if kind == "folder":
        assert known["sha256"] == hashlib.sha256(listed.encode()).hexdigest()


def test_a_checksum_of_the_data_that_does_not_match_is_told_at_the_end(
    cdmisfa: Cdmisfa, recording: Path, tmp_path: Path
) -> None:
    damage(recording / "x1.mcap")
    words = ("learn", recording, "-o", tmp_path / "run", "--no-rerun", "--max-iterations", "3")
    done = cdmisfa(*words)
    assert (done.code, "x1.mcap: data section: its CRC does not match" in done.err) == (3, True)
    assert "waiting for the SHA-256 of what is learned from" in done.err
    assert not (tmp_path / "run" / "run.json").exists()
    assert cdmisfa("info", tmp_path / "run", "--json").json["state"] == "cut short"


def test_a_stopped_run_does_nothing_that_takes_as_long_as_its_log_and_is_resumed(
    recording: Path, tmp_path: Path
) -> None:
    def never(done: int, size: int) -> None:
        pytest.fail("it was waited for all of the log")

    out, stops = tmp_path / "run", iter([False, False, True])
    how: dict[str, Any] = {"stop": lambda: next(stops, True), "hashing": never, "rerun": True}
    stopped = learn(recording, out, **how)
    assert (stopped.ended, stopped.iterations) == ("interrupted", 2)
    assert all("sample_sha256" in view for view in stopped.source["views"])
    assert sorted(file.name for file in out.iterdir()) == ["modules.npz", "run.json", "run.mcap"]
    build_view(out, tmp_path / "v.rrd", all_views=recording)
    whole = learn(recording, tmp_path / "whole")
    resumed = learn(recording, out, resume=True)
    assert resumed.as_json() | {"run": ""} == whole.as_json() | {"run": ""}


def test_a_log_that_was_changed_before_a_stop_is_damage(recording: Path, tmp_path: Path) -> None:
    touch, stops = Then(lambda: os.utime(recording / "x1.mcap", ns=(1, 1))), iter([False])
    with pytest.raises(LogDamagedError, match=r"x1\.mcap: it was changed while it was read"):
        learn(recording, tmp_path / "run", touch, stop=lambda: next(stops, True))


def test_a_view_of_a_killed_run_takes_its_recording_alone(recording: Path, tmp_path: Path) -> None:
    with pytest.raises(KilledError):
        learn(recording, tmp_path / "run", Then(killed, 7))
    build_view(tmp_path / "run", tmp_path / "v.rrd", all_views=recording)
    flip(recording / "x1.mcap", 10)
    with pytest.raises(UsageError, match="not the recording"):
        build_view(tmp_path / "run", tmp_path / "w.rrd", all_views=recording)
