"""Health of streams: planted faults are reported at their times, and nothing else is."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from camera_files import write_images
from conftest import Cdmisfa

from replay.logs.health import COLUMNS, Health

RATE, COUNT = 20, 240
FAULTS = ("frozen", "ends frozen", "repeated", "black", "saturated")


def images(fault: str = "", noise: float = 2, motion: float = 1) -> Iterator[np.ndarray]:
    """12 s of a square that moves over a textured wall, (48, 64) uint8."""
    random = np.random.default_rng(3)
    wall, last, phase = random.uniform(60, 180, (48, 64)), None, 0.0
    for i in range(COUNT):
        time, image = i / RATE, wall + noise * random.normal(size=wall.shape)
        rests = fault == "rests" and 5 <= time < 8
        phase += 0 if rests else motion / RATE
        top, left = int(16 + 15 * np.sin(phase)), int(24 + 23 * np.sin(1.3 * phase))
        image[top : top + 16, left : left + 16] = 230
        image = np.where((fault == "black" and 5 <= time < 7), 3 + image % 2, image)
        image = np.where((fault == "saturated" and 5 <= time < 7), 255, image)
        still = (fault == "frozen" and 5 <= time < 8) or (fault == "ends frozen" and time >= 9)
        if last is None or not (still or (fault == "repeated" and i % 10 == 9)):
            last = np.clip(image, 0, 255).astype(np.uint8)
        yield last


def health(stream: Iterator[np.ndarray]) -> Health:
    """Measure images."""
    measured = Health()
    for i, image in enumerate(stream):
        measured.add(100 + i / RATE, lambda image=image: image)
    return measured


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_of_a_camera_is_measured_and_no_other(fault: str) -> None:
    columns = health(images(fault)).columns()
    seconds = 3.0 if "frozen" in fault else 0.0
    start = {"frozen": 5.0, "ends frozen": 9.0}.get(fault)
    share = {"repeated": 0.1}.get(fault, seconds / 12)
    empty = [1 / 6 if fault == name else 0.0 for name in ("black", "saturated")]
    assert list(columns)[:5] == list(COLUMNS)[:5]
    assert [*columns.values()][:2] == [seconds, start]
    assert [*columns.values()][2:5] == pytest.approx([share, *empty], abs=1e-4)
    assert columns["black_pixels"] == pytest.approx(empty[0], abs=0.01)


@pytest.mark.parametrize("noise", [0, 2])
@pytest.mark.parametrize("motion", [0, 0.2, 1])
@pytest.mark.parametrize("fault", ["", "rests"])
def test_intact_images_are_not_remarkable(fault: str, motion: float, noise: float) -> None:
    assert health(images(fault, noise, motion)).remark() == ""


def test_without_noise_a_freeze_shows_by_the_jump_behind_it() -> None:
    measured = health(images("frozen", noise=0))
    assert measured.remark().startswith("frozen for 3.0 s at 5.0 s; 25.0 % of the images")


@pytest.mark.parametrize("noise", [0, 2])
def test_a_codec_that_alternates_is_not_frozen_but_a_frozen_image_in_it(noise: float) -> None:
    def coded(stream: Iterator[np.ndarray]) -> Iterator[np.ndarray]:
        """Every second image is coarser, as with a key frame every two images."""
        for i, image in enumerate(stream):
            yield image if i % 2 else image // 12 * 12

    assert health(coded(images(noise=noise))).remark() == ""
    frozen = health(coded(images("frozen", noise))).columns()
    assert frozen["frozen_seconds"] == pytest.approx(3, abs=0.11)


def test_verify_and_the_index_have_the_columns_of_each_stream(
    cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    topics = {"/front": images("frozen"), "/side": images()}
    timed = {name: [(50 * i, x) for i, x in enumerate(stream)] for name, stream in topics.items()}
    path = write_images(tmp_path / "two.mcap", timed)
    done = cdmisfa("verify", path)
    line = f"{path}: /front: frozen for 3.0 s at 5.0 s; 25.0 % of the images are repeated"
    assert (done.code, done.out.splitlines()[-1]) == (0, line)
    assert "/side" not in done.out
    (file,) = json.loads(cdmisfa("verify", path, "--json").out)["files"]
    assert [stream["frozen_seconds"] for stream in file["streams"]] == [3.0, 0.0]
    assert cdmisfa("index", path.parent, "--deep").code == 0
    import pyarrow.parquet as pq

    rows = pq.read_table(path.parent / "corpus.parquet").to_pylist()
    assert [{name: row[name] for name in ("topic", *COLUMNS)} for row in rows] == file["streams"]


def test_words_are_black_where_they_have_no_data(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    from camera_files import RAW, raw
    from message_files import write_mcap

    depth = [np.full((48, 64, 2), 9, np.uint8) * (i > 20) for i in range(60)]
    messages = [(i * 50_000_000, raw(image, "16UC1")) for i, image in enumerate(depth)]
    path = write_mcap(tmp_path / "depth.mcap", RAW, {"/depth": messages})
    (file,) = json.loads(cdmisfa("verify", path, "--json").out)["files"]
    assert file["streams"][0]["black"] == 0.35


def test_a_recording_and_the_sample_logs_are_not_remarkable(
    cdmisfa: Cdmisfa, oscillatory_recording: Path
) -> None:
    for place in ("sample_logs/icub", "sample_logs/oscillatory", oscillatory_recording):
        assert cdmisfa("verify", place).out == f"{place}: whole\n"
    streams = json.loads(cdmisfa("verify", "sample_logs/icub", "--json").out)["files"][0]["streams"]
    assert streams[0]["frozen_seconds"] == 0
