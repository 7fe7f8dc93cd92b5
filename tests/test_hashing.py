"""Files are hashed as they were when they were opened, or called changed."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import Any

import pytest

from cdmisfa.core.errors import LogDamagedError
from replay.camera_logs.opening import hashed_log
from replay.storage.hashing import Hashed


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in "ab":
        (tmp_path / f"{name}.png").write_bytes(name.encode() * 5000)
    return tmp_path


def whole(log: Hashed) -> dict[str, Any]:
    log.read(memoryview(bytearray(4096)), lambda count: None)
    return log.whole()


@pytest.mark.parametrize("name", [".", "a.png"])
def test_what_changed_before_it_was_hashed_is_damage(folder: Path, name: str) -> None:
    """The change may have come after it was learned from, and before it was hashed."""
    log = hashed_log(folder / name, [])
    (folder / "a.png").write_bytes(b"b" * 5000)
    os.utime(folder / "a.png", ns=(1, 1))
    for _ in range(2):
        with pytest.raises(LogDamagedError, match="it was changed while it was read; begin again"):
            whole(log)


def test_what_comes_into_a_folder_meanwhile_does_not_count(folder: Path) -> None:
    text = "".join(
        f"{name}.png\0{hashlib.sha256(name.encode() * 5000).hexdigest()}\n" for name in "ab"
    )
    known = {"file": folder.name, "sha256": hashlib.sha256(text.encode()).hexdigest()}
    log = hashed_log(folder, [])
    (folder / "c.png").write_bytes(b"c")
    assert whole(log) == known
    (folder / "d.png").write_bytes(b"d")
    log.confirm()
    assert log.whole() == known
