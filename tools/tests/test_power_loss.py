"""The power fails in the middle of a command: what was on the disk counts."""

from __future__ import annotations

import itertools
import random
from pathlib import Path

import pytest

from tools.torture.calls import Call
from tools.torture.power import (
    GONE,
    NAMES,
    OLD_NAMES,
    SYNCED,
    WRITTEN,
    ZEROS,
    Cut,
    Disk,
    cuts,
    go_on,
    record,
)
from tools.torture.stories import STORIES

OLDER = ("run.before.mcap.partial", "x1.mcap.partial.kept")
"""Logs that are gone on with, until the new ones hold what they do."""

SAMPLED = {"record": 4, "record in parts --resume": 4, "learn": 4, "convert": 4, "sweep": 4}
"""Cases of some stories; `make torture` takes all cases of all."""


def goes_on(found: list[Cut], folder: Path) -> None:
    for number, cut in enumerate(found):
        place = folder / str(number)
        place.mkdir()
        go_on(cut, place)


@pytest.mark.parametrize("name", SAMPLED)
def test_a_command_goes_on_after_a_power_cut(tmp_path: Path, name: str) -> None:
    (tmp_path / "recorded").mkdir()
    found = list(cuts(record(STORIES[name], tmp_path / "recorded")))
    over = [cut for cut in found if cut.over]
    goes_on(random.Random(name).sample(found, SAMPLED[name]) + over, tmp_path)


def test_files_half_written_by_processes_that_are_gone_are_gone_after(tmp_path: Path) -> None:
    (tmp_path / "recorded").mkdir()
    found = list(cuts(record(STORIES["record"], tmp_path / "recorded")))
    left = [cut for cut in found if any(f".{GONE}." in path.name for path in cut.tree)]
    assert left
    goes_on(left[:3], tmp_path)


@pytest.mark.parametrize("name", ["record --resume", "learn --resume"])
def test_what_was_there_before_is_not_given_up_for_what_the_disk_has_not(
    tmp_path: Path, name: str
) -> None:
    (tmp_path / "recorded").mkdir()
    recorded = record(STORIES[name], tmp_path / "recorded")
    gone = [
        number
        for number, call in enumerate(recorded.calls, start=1)
        if call.kind == "unlink" and call.path.name in OLDER
    ]
    left = itertools.product(gone, (SYNCED, ZEROS), (NAMES, OLD_NAMES))
    goes_on([Cut(recorded, *how) for how in left], tmp_path)


def test_a_disk_has_what_was_synced() -> None:
    a, b = Path("out/a"), Path("out/b")
    disk = Disk({Path("out"): None})
    for call in (Call("create", a), Call("write", a, data=b"12"), Call("fsync", a)):
        disk.do(call)
    assert disk.left(SYNCED, NAMES) == {Path("out"): None, a: b"12"}
    assert disk.left(WRITTEN, OLD_NAMES) == {Path("out"): None}
    disk.do(Call("fsync", Path("out")))
    disk.do(Call("write", a, at=2, data=b"34"))
    disk.do(Call("rename", a, b))
    assert disk.left(SYNCED, NAMES) == {Path("out"): None, b: b"12"}
    assert disk.left(ZEROS, OLD_NAMES) == {Path("out"): None, a: b"12\0\0"}
    assert disk.left(WRITTEN, OLD_NAMES) == {Path("out"): None, a: b"1234"}
    for call in (Call("fsync", b), Call("fsync", Path("out")), Call("unlink", b)):
        disk.do(call)
    assert disk.left(SYNCED, OLD_NAMES) == {Path("out"): None, b: b"1234"}
    assert disk.left(WRITTEN, NAMES) == {Path("out"): None}
