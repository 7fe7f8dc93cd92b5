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
from folders import external, flip
from PIL import Image

from cdmisfa.core.blocks import Block, SeekableSource, description
from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.core.learning import Learner, Sink
from cdmisfa.core.signals import BlockSignals
from cdmisfa.experiments.run_folder import RunResult
from cdmisfa.experiments.session import run_session
from replay import stored_source
from replay.open_sources import open_recording
from replay.runs.compare import different_settings
from replay.runs.log import read_header

CONFIG = LearnerConfig(tau=20)
ITERATIONS = 12


@pytest.fixture(autouse=True)
def long(monkeypatch: pytest.MonkeyPatch) -> None:
    """All logs count as long."""
    monkeypatch.setattr(stored_source, "AT_ONCE", 0)


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
    source = open_recording(path)
    try:
        return run_session(source, CONFIG, out, sinks=sinks, **with_end)
    finally:
        source.close()


def test_a_run_begins_with_a_sample_and_ends_with_the_sha256(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[Any] = []

    def look() -> None:
        seen.extend(read_header(tmp_path / "run").manifest["source"]["views"])

    result = learn(recording, tmp_path / "run", Then(look))
    monkeypatch.setattr(stored_source, "AT_ONCE", 2**40)
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
        return open_recording(recording)
    make = {"pictures": pictures, "table": table}[kind]
    return external(make(folder / "log.csv", value), rate=10)


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
    monkeypatch.setattr(stored_source, "AT_ONCE", 2**40)
    assert description(source, at_once=True) == description(source)
    source.close()


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
    assert different_settings(tmp_path / "run", tmp_path / "whole") == ()


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
    whole = learn(recording, tmp_path / "whole")
    resumed = learn(recording, out, resume=True)
    assert resumed.as_json() | {"run": ""} == whole.as_json() | {"run": ""}
