"""How something was begun: kept relative to its folder, read as far as it makes sense."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from cdmisfa.core.errors import UsageError
from recorder.log.begun import (
    RECORDING,
    Begun,
    keep_recording,
    read_recording,
)


def test_paths_move_with_the_folder_and_other_words_stay(tmp_path: Path) -> None:
    words = (str(tmp_path / "logs" / "a.mcap"), "icub", "s3://bucket/b.mcap")
    values = Begun(words, {"seed": 7}).as_json(tmp_path / "run", names=("icub",))
    assert values == {"source": ["./../logs/a.mcap", "icub", "s3://bucket/b.mcap"], "seed": 7}
    moved = Begun.from_json(json.loads(json.dumps(values)), tmp_path / "new" / "run")
    assert moved is not None
    assert moved.source == (str(tmp_path / "new" / "logs" / "a.mcap"), *words[1:])
    assert moved.options == {"seed": 7}


@pytest.mark.parametrize("values", [None, [], "x", {}, {"source": "icub"}, {"source": None}])
def test_what_does_not_say_how_it_began_is_none(values: object) -> None:
    assert Begun.from_json(values, Path()) is None


def test_a_recording_keeps_what_its_unfinished_views_shall_be(tmp_path: Path) -> None:
    first = {"seed": 1, "frames": {"a": 5, "b": 5}, "split": {"a": "5s", "b": "5s"}}
    keep_recording(tmp_path, ["a", "b"], Begun(("icub",), first))
    longer = Begun(("icub",), {"seed": 1, "frames": {"a": 9}, "split": {}})
    keep_recording(tmp_path, ["a"], longer)
    begun = read_recording(tmp_path)
    assert begun.source == ("icub",)
    assert begun.options == {"seed": 1, "frames": {"a": 9, "b": 5}, "split": {"b": "5s"}}
    keep_recording(tmp_path, ["a"])
    assert read_recording(tmp_path).options["frames"] == {"b": 5}
    keep_recording(tmp_path, ["b"])
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
    begun = read_recording(tmp_path)
    assert (begun.source, dict(begun.options)) == ((), {"frames": {}, "split": {}})


def test_a_disk_that_does_not_take_it_is_named(tmp_path: Path) -> None:
    values: dict[str, Any] = {"frames": {"a": 1}, "split": {}}
    (tmp_path / "nowhere").write_text("a file")
    with pytest.raises(UsageError, match="nowhere is a file: name a folder"):
        keep_recording(tmp_path / "nowhere", ["a"], Begun((), values))
