"""Broken logs and other inputs, and all that ever broke something; `make fuzz` has more."""

from __future__ import annotations

from collections import Counter
from itertools import islice
from pathlib import Path
from random import Random
from typing import Any

import pytest

from cdmisfa.core.errors import LogDamagedError
from recorder.mcap.chunks import Chunks
from recorder.mcap.data_section import DataSection
from recorder.mcap.reader import LogReader
from recorder.mcap.records import Segment
from tools.fuzz import decoders, guided, logs, mutations, oracle

CASES = 10_000
BATCHES = 20


@pytest.mark.parametrize("batch", range(BATCHES))
def test_no_broken_log_breaks_a_promise(tmp_path: Path, batch: int) -> None:
    for number in range(batch, CASES, BATCHES):
        case = mutations.mutated(number)
        try:
            oracle.check(case, tmp_path / "log.mcap", number)
        except Exception as error:
            pytest.fail(f"case {number} ({case.base}): {type(error).__name__}: {error}")


def test_little_memory_is_asked_for(tmp_path: Path) -> None:
    for number in range(0, CASES, 500):
        oracle.check_memory(mutations.mutated(number), tmp_path / "log.mcap")


def test_what_once_broke_the_reader_does_so_no_more(tmp_path: Path) -> None:
    for path in logs.KEPT.glob("*.mcap"):
        for number in range(6):
            oracle.check(logs.kept(path), tmp_path / "log.mcap", number)


def test_the_cases_reach_every_corner_of_the_reader(tmp_path: Path) -> None:
    """Neither all refused nor all whole, and never the same twice."""
    path, outcomes, files = tmp_path / "log.mcap", Counter[str](), set()
    for number in range(600):
        case = mutations.mutated(number)
        assert mutations.mutated(number).raw == case.raw
        files.add(case.raw)
        path.write_bytes(case.raw)
        try:
            with LogReader(path) as reader:
                outcomes["read" if len(list(reader.messages())) else "empty"] += 1
        except LogDamagedError as error:
            outcomes["in chunk" if ": chunk at byte" in str(error) else "outside"] += 1
    assert len(files) > 550
    assert all(outcomes[where] > 15 for where in ("read", "in chunk", "outside")), outcomes


def test_a_reader_that_believes_everything_is_found_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unchecked(self: Chunks, segment: Segment) -> Any:
        segment_crc, segment.crc = segment.crc, 0
        try:
            return original(self, segment)
        finally:
            segment.crc = segment_crc

    original = Chunks._records
    monkeypatch.setattr(Chunks, "_records", unchecked)
    monkeypatch.setattr(DataSection, "check", lambda *_: None)

    def hunt() -> None:
        for number in range(300, 400):
            oracle.check(mutations.mutated(number), tmp_path / "log.mcap")

    with pytest.raises(oracle.BrokenPromise, match="checksum"):
        hunt()


def test_a_job_goes_on_where_it_was_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    seen: list[int] = []
    monkeypatch.setattr(logs, "STATE", tmp_path)
    monkeypatch.setattr(logs, "EVERY", 5)

    def examine(number: int, path: Path) -> str | None:
        if number == 12 and number not in seen:
            seen.append(number)
            raise KeyboardInterrupt
        seen.append(number)
        return "wrong" if number == 3 else None

    monkeypatch.setattr(logs, "examine", examine)
    with pytest.raises(KeyboardInterrupt):
        logs.main(["--cases", "20"])
    assert logs.main(["--cases", "20"]) == 1
    assert sorted(set(seen)) == list(range(20))
    assert seen.count(9) == 1
    assert "1 found" in capsys.readouterr().out


@pytest.mark.parametrize("name", decoders.available())
def test_what_is_decoded_may_be_anything(tmp_path: Path, name: str) -> None:
    rng, whole = Random(name), decoders.seeds(name)
    for data in whole:
        decoders.DECODERS[name].read(written(tmp_path, name, data))
    text = decoders.DECODERS[name].text
    for _ in range(10 if name == "lerobot" else 60):
        data = decoders.mutated(rng, rng.choice(whole), rng.choice(whole), text=text)
        decoders.check(name, data, tmp_path / "case")


def written(folder: Path, name: str, data: bytes) -> Path:
    place = folder / "whole"
    place.mkdir(exist_ok=True)
    path = place / decoders.DECODERS[name].name
    path.write_bytes(data)
    return path


def test_what_once_broke_a_decoder_does_so_no_more(tmp_path: Path) -> None:
    for path in logs.KEPT.glob("*/*"):
        decoders.check(path.parent.name.replace("-", " "), path.read_bytes(), tmp_path / "c")


def test_inputs_that_go_a_new_way_lead_further() -> None:
    """A fault behind four conditions is found, as each is a new way; by chance it is not."""

    def check(data: bytes) -> None:
        if len(data) < 12 or data[0] % 4 != 1:
            return
        if data[4] % 8 != 3:
            return
        if data[8] % 8 != 5:
            return
        if data[11] % 8 == 6:
            raise KeyError("found")

    def broken(ours: tuple[str, ...]) -> bool:
        cases = guided.guided(check, [b"." * 16], Random(4), text=False, ours=ours)
        return any(isinstance(broke, KeyError) for _, _, broke in islice(cases, 3000))

    assert broken((__file__,))
    assert not broken(())
