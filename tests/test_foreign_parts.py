"""Camera logs in parts are one stream; a conversion that was stopped goes on."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_files import HEIGHT, WIDTH, pictures, write_images
from folders import external

from cdmisfa.core.errors import LogDamagedError, UsageError

SIZE = (HEIGHT, WIDTH)


def write_part(path: Path, rows: range, topics: tuple[str, ...] = ("/left", "/right")) -> None:
    """Some of the images of each topic, 20 ms apart from the first of all on."""
    images = {}
    for seed, topic in enumerate(topics):
        every = enumerate(pictures(rows.stop, seed))
        images[topic] = [(1000 + 20 * i, image) for i, image in every if i in rows]
    write_images(path, images, "ros2")


@pytest.fixture
def parts(tmp_path: Path) -> list[Path]:
    """Twelve parts of ten images of each topic, in the folder of a rosbag2."""
    folder = tmp_path / "bag"
    folder.mkdir()
    files = [folder / f"bag_{i}.mcap" for i in range(12)]
    for i, file in enumerate(files):
        write_part(file, range(10 * i, 10 * i + 10))
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
    return files


def test_the_parts_of_a_bag_are_one_stream(parts: list[Path]) -> None:
    source = external(parts[0].parent, ["/right", "/left"], size=SIZE)
    assert (source.spec.length, source.spec.fps) == (120, 50.0)
    np.testing.assert_array_equal(source.take(1, 120).frames, list(pictures(120, 0)))
    source.seek(35)
    np.testing.assert_array_equal(source.take(0, 50).frames, list(pictures(120, 1))[35:85])
    assert "joined from 12 logs" in source.warnings[0]
    assert len(source.describe()["files"][0]["sha256"]) == 64
    source.close()


def test_files_that_follow_one_another_are_parts_of_one_topic(parts: list[Path]) -> None:
    named = [parts[i] for i in (2, 0, 1)]
    source = external(named, ["/left"], size=SIZE)
    assert source.spec.streams == ("left",)
    np.testing.assert_array_equal(source.take(0, 30).frames, list(pictures(30, 0)))
    apart = external(named, ["/left"], size=SIZE, align="index")
    assert len(apart.spec.streams) == 3


def test_files_at_the_same_time_stay_streams(parts: list[Path]) -> None:
    write_part(parts[0].parent / "other.mcap", range(5, 15))
    both = [parts[0], parts[0].parent / "other.mcap"]
    with pytest.raises(UsageError, match="--align"):
        external(both, ["/left"], size=SIZE)
    assert len(external(both, ["/left"], size=SIZE, align="time").spec.streams) == 2


def test_a_part_that_was_cut_before_its_first_message_is_left_out_and_said(
    parts: list[Path],
) -> None:
    os.truncate(parts[3], 42)
    options: dict[str, Any] = {"size": SIZE, "align": "time", "rate": 50}
    with external(parts[0].parent, ["/r*"], **options) as source:
        assert source.alignment["right"]["messages"] == 110
        assert f"{parts[3]}: " in source.warnings[1]
        assert source.warnings[1].endswith("before the first message: skipped")
    for part in parts:
        os.truncate(part, 42)
    with pytest.raises(LogDamagedError, match="before the first message"):
        external(parts[0].parent, ["/right"], size=SIZE)
