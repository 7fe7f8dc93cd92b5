"""Broken logs and other inputs, and all that ever broke something; `make fuzz` has more."""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from random import Random
from typing import Any

import pytest

from recorder.mcap import chunks
from recorder.mcap.reader import LogReader
from recorder.mcap.records import Segment
from recorder.mcap.store import Store
from tools.fuzz import decoders, guided, logs, mutations, oracle

CASES = 4_000
BATCHES = 8


@pytest.mark.parametrize("batch", range(BATCHES))
def test_no_broken_log_breaks_a_promise(tmp_path: Path, batch: int) -> None:
    for number in range(batch, CASES, BATCHES):
        case = mutations.mutated(number)
        try:
            oracle.check(case, tmp_path / "log.mcap", number)
            if number % 500 == 0:
                oracle.check_memory(case, tmp_path / "log.mcap")
        except Exception as error:
            pytest.fail(f"case {number} ({case.base}): {type(error).__name__}: {error}")


def test_what_once_broke_the_reader_does_so_no_more(tmp_path: Path) -> None:
    for path in logs.KEPT.glob("*.mcap"):
        for number in range(6):
            oracle.check(logs.kept(path), tmp_path / "log.mcap", number)


def test_a_reader_that_ignores_checksums_is_found_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unchecked(file: Store, segment: Segment) -> Any:
        segment.crc, crc = 0, segment.crc
        try:
            return original(file, segment)
        finally:
            segment.crc = crc

    def check_all() -> None:
        for number in range(800):
            oracle.check(mutations.mutated(number), tmp_path / "log.mcap", 1)

    original = chunks.chunk_records
    monkeypatch.setattr(chunks, "chunk_records", unchecked)
    monkeypatch.setattr(LogReader, "_check_data", lambda *_: None)
    with pytest.raises(oracle.BrokenPromise, match="checksum"):
        check_all()


@pytest.mark.parametrize("name", decoders.DECODERS)
def test_what_is_decoded_may_be_anything(tmp_path: Path, name: str) -> None:
    rng, valid, decoder = Random(name), decoders.seeds(name), decoders.DECODERS[name]
    for data in valid:
        (tmp_path / "valid").mkdir(exist_ok=True)
        (tmp_path / "valid" / decoder.name).write_bytes(data)
        decoder.read(tmp_path / "valid" / decoder.name)
    for _ in range(60):
        data = decoders.mutated(rng, rng.choice(valid), rng.choice(valid), text=decoder.text)
        decoders.check(name, data, tmp_path / "case")


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
        return any(isinstance(broke, KeyError) for _, broke in islice(cases, 3000))

    assert broken((__file__,))
    assert not broken(())
