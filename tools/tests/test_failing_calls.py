"""A call on the disk fails in the middle of a command: one clear line, and nothing worse."""

from __future__ import annotations

import os
import random
import shutil
from pathlib import Path

import pytest

from tools.torture.calls import Call, Refusal, watched
from tools.torture.failing import WAYS, begin, fail
from tools.torture.stories import STORIES, WITH_WORKERS

SAMPLED = {
    "record --resume": 4,
    "learn --resume": 3,
    "convert": 4,
    "sweep": 4,
    "recover": 4,
    "sweep --keep-logs --jobs 2": 2,
}
"""Cases of some stories; `make torture` takes all cases of all."""


@pytest.mark.parametrize("name", SAMPLED)
def test_a_command_goes_on_after_a_call_that_failed(tmp_path: Path, name: str) -> None:
    begun = begin((STORIES | WITH_WORKERS)[name], tmp_path / "begun")
    cases = random.Random(name).sample(list(begun.cases()), SAMPLED[name])
    for number, (way, call) in enumerate(cases):
        fail(begun, way, call, tmp_path / str(number))


def test_a_log_that_cannot_be_read_is_no_log_without_frames(tmp_path: Path) -> None:
    """What the disk does not give for once must not be missing from the recording for ever."""
    begun = begin(STORIES["record --resume"], tmp_path / "begun")
    opened = [n for n, call in enumerate(begun.calls) if call.kind == "open"]
    read = [n for n in opened if begun.calls[n].path.name.endswith((".kept", "recording.json"))]
    assert len(read) >= 6
    for number in read:
        fail(begun, WAYS[0], number, tmp_path / str(number))


def test_every_call_is_seen_and_can_be_refused(tmp_path: Path) -> None:
    seen, done = Refusal(-1), list[Call]()
    with watched(tmp_path, seen, done.append):
        (tmp_path / "folder").mkdir()
        with open(tmp_path / "folder" / "a", "wb") as file:
            file.write(b"12345")
            file.flush()
            file.seek(1)
            file.write(b"x" * 10_000)
        (tmp_path / "folder" / "a").replace(tmp_path / "b")
        (tmp_path / "b").read_bytes()
        (tmp_path / "b").write_text("new")
        shutil.rmtree(tmp_path / "folder")
        (tmp_path / "b").unlink()
    told = [(call.kind, call.path.name, call.at, len(call.data)) for call in done]
    assert told == [
        ("mkdir", "folder", 0, 0),
        ("create", "a", 0, 0),
        ("write", "a", 0, 5),
        ("write", "a", 1, 10_000),
        ("rename", "a", 0, 0),
        ("truncate", "b", 0, 0),
        ("write", "b", 0, 3),
        ("rmdir", "folder", 0, 0),
        ("unlink", "b", 0, 0),
    ]
    for number in range(2):
        with watched(tmp_path, Refusal(number)), pytest.raises(OSError, match="folder"):
            (tmp_path / "folder" / str(number)).mkdir(parents=True)


def test_calls_of_forked_processes_count_with_those_of_their_parent(tmp_path: Path) -> None:
    refusal = Refusal(3, lasting=True)
    with watched(tmp_path, refusal):
        (tmp_path / "a").mkdir()
        if (child := os.fork()) == 0:
            made = []
            for name in ("b", "c", "refused", "refused"):
                try:
                    (tmp_path / name).mkdir()
                    made.append(name)
                except OSError:
                    pass
            os._exit(len(made))
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 2
        with pytest.raises(OSError, match="refused"):
            (tmp_path / "refused").mkdir()
    assert [call.path.name for call in refusal.seen] == ["a", "b", "c", *["refused"] * 3]
    assert {path.name for path in tmp_path.iterdir()} == {"a", "b", "c"}


def test_what_workers_write_can_be_refused(tmp_path: Path) -> None:
    """The log of a trial is written by the process that computes it."""
    begun = begin(WITH_WORKERS["sweep --keep-logs --jobs 2"], tmp_path / "begun")
    assert {"run.mcap.partial", "rows.jsonl"} <= {call.path.name for call in begun.calls}
