"""How a recording was started: stored in its folder, read as far as it makes sense."""

from __future__ import annotations

from pathlib import Path

import pytest

from cdmisfa.core.errors import UsageError
from recorder.log.files import RECORDING
from recorder.log.manifest import RecordingStart, read_start, store_start


def test_a_recording_stores_what_its_unfinished_views_shall_be(tmp_path: Path) -> None:
    first = RecordingStart("icub", 1, {"a": 5, "b": 5}, {"a": "5s", "b": "5s"})
    store_start(tmp_path, ["a", "b"], first)
    store_start(tmp_path, ["a"], RecordingStart("icub", 1, {"a": 9}))
    assert read_start(tmp_path) == RecordingStart("icub", 1, {"a": 9, "b": 5}, {"b": "5s"})
    store_start(tmp_path, ["a"])
    assert read_start(tmp_path).frames == {"b": 5}
    store_start(tmp_path, ["b"])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "noted",
    [
        "{",
        "[]",
        "7",
        '{"frames": 3}',
        '{"frames": {"a": true, "b": -1, "c": "x"}, "split": {"a": 3}, "scene": 4, "seed": -1}',
        '{"frames": {}, "seed": 1e300}',
    ],
)
def test_what_makes_no_sense_in_it_is_passed_over(tmp_path: Path, noted: str) -> None:
    (tmp_path / RECORDING).write_text(noted)
    assert read_start(tmp_path) == RecordingStart()


def test_a_folder_that_is_a_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "nowhere").write_text("a file")
    with pytest.raises(UsageError, match="nowhere is a file: name a folder"):
        store_start(tmp_path / "nowhere", ["a"], RecordingStart("", None, {"a": 1}))
