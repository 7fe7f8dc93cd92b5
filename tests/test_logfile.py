"""Log files: whole when they have their name, readable whatever happens before."""

import resource
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader, make_reader

from cdmisfa.core.errors import LogWriteError, UsageError
from recorder.log.files import locked_folder, partial_path, refuse_taken
from recorder.log.logfile import LogFile

SECOND = 1_000_000_000


def open_log(path: Path, **options: Any) -> tuple[LogFile, int]:
    log = LogFile(path, library="test", **options)
    return log, log.add_channel("/x", log.add_schema("X", "jsonschema", b"{}"), encoding="json")


def readable(path: Path) -> list[int]:
    """Sequence numbers mcap's own reader gets out of a log, whole or torn."""
    numbers = []
    with path.open("rb") as file:
        reader = NonSeekingReader(file, validate_crcs=True)
        try:
            for _, _, message in reader.iter_messages(log_time_order=False):
                numbers.append(message.sequence)
        except EndOfFile:
            pass
    return numbers


def test_a_finished_log_has_its_name_index_and_checksums(tmp_path):
    path = tmp_path / "a.mcap"
    with open_log(path)[0] as log:
        channel = log.add_channel("/y", 0, encoding="json", metadata={"unit": "m"})
        log.add_metadata("m", {"key": "value"})
        log.add_attachment("config.json", "application/json", b"{}", log_time=5)
        for i in range(200):
            log.write(channel, i * SECOND // 50, b"{}", i)
        assert log.partial.exists()
        assert not path.exists()
    assert not log.partial.exists()
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert [m.sequence for _, _, m in reader.iter_messages()] == list(range(200))
        assert summary.statistics.message_count == 200
        assert len(summary.chunk_indexes) == 4
        assert {c.topic for c in summary.channels.values()} == {"/x", "/y"}
        assert [(a.name, a.create_time, a.log_time) for a in reader.iter_attachments()] == [
            ("config.json", 0, 5)
        ]
    assert readable(path) == list(range(200))


@given(st.lists(st.tuples(st.integers(0, SECOND), st.binary(max_size=300)), max_size=60))
def test_what_goes_in_comes_out(tmp_path_factory, steps):
    path = tmp_path_factory.mktemp("log") / "a.mcap"
    sent, now = [], 0
    log, channel = open_log(path)
    for i, (step, data) in enumerate(steps):
        now += step
        log.write(channel, now, data, i)
        sent.append((now, data, i))
    log.finish()
    with path.open("rb") as file:
        got = [
            (m.log_time, m.data, m.sequence)
            for _, _, m in make_reader(file, validate_crcs=True).iter_messages()
        ]
    assert got == sent


def test_an_unfinished_log_lacks_at_most_a_second(tmp_path):
    log, channel = open_log(tmp_path / "a.mcap")
    for i in range(490):
        log.write(channel, i * SECOND // 50, b"{}", i)
        held = len(readable(log.partial))
        assert i + 1 - held <= 50
    assert readable(log.partial) == list(range(450))
    log.abandon()
    assert readable(log.partial) == list(range(490))


def test_an_exception_leaves_a_readable_partial(tmp_path):
    log, channel = open_log(tmp_path / "a.mcap")

    def fail() -> None:
        with log:
            log.write(channel, 0, b"{}", 7)
            raise RuntimeError("boom")

    with pytest.raises(RuntimeError, match="boom"):
        fail()
    assert readable(log.partial) == [7]
    assert not log.path.exists()
    with pytest.raises(LogWriteError, match="closed"):
        log.write(channel, 1, b"{}", 8)


@pytest.mark.parametrize("left", ["a.mcap", "a.mcap.partial"])
def test_nothing_is_overwritten_without_force(tmp_path, left):
    (tmp_path / left).write_bytes(b"precious")
    with pytest.raises(UsageError, match=f"{left}.*--force"):
        LogFile(tmp_path / "a.mcap")
    assert (tmp_path / left).read_bytes() == b"precious"
    with LogFile(tmp_path / "a.mcap", force=True):
        pass
    assert readable(tmp_path / "a.mcap") == []
    assert not partial_path(tmp_path / "a.mcap").exists()


def test_a_write_that_failed_is_named_once_and_for_all(tmp_path):
    log, channel = open_log(tmp_path / "a.mcap", compression="none")

    def fill() -> None:
        for i in range(1000):
            log.write(channel, i * SECOND // 50, b"x" * 200, i)

    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, hard))
    try:
        with pytest.raises(LogWriteError, match=r"a\.mcap\.partial.*File too large.*free") as first:
            fill()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    for attempt in (lambda: log.write(channel, 10**12, b"", 5000), log.flush, log.finish):
        with pytest.raises(LogWriteError) as again:
            attempt()
        assert str(again.value) == str(first.value)
    log.abandon()
    held = readable(log.partial)
    assert held == list(range(len(held)))
    assert 50 <= len(held) < 200
    assert not log.path.exists()


def test_a_full_disk_is_an_error_and_not_a_loss(tmp_path, monkeypatch):
    monkeypatch.setattr("recorder.log.files.refuse_special", lambda _: None)
    (tmp_path / "a.mcap.partial").symlink_to("/dev/full")
    log = LogFile(tmp_path / "a.mcap", force=True)
    with pytest.raises(LogWriteError, match="No space left"):
        log.add_metadata("m", {"a": "b"})
    log.abandon()
    assert not (tmp_path / "a.mcap").exists()


def test_a_folder_that_cannot_be_locked_or_replaced_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="missing cannot be opened as a folder: No such"):
        locked_folder(tmp_path / "missing").__enter__()
    with pytest.raises(UsageError, match=r"is a folder: choose another name$"):
        refuse_taken(tmp_path, force=False)
