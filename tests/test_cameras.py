"""The command line takes other people's camera logs, and says what it made of them."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import numpy as np
import pytest
from camera_files import write_cameras, write_pictures
from conftest import Cdmisfa

SMALL = ("--size", "16x12")
QUICK = ("--max-iterations", "4", "--no-rerun", "--set", "learner.tau=10")


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    """One log with two cameras at one rate, `uneven.mcap` with two at different rates."""
    write_cameras(tmp_path / "a.mcap", {"/cam_left": (60, 20), "/cam_right": (60, 20)})
    write_cameras(tmp_path / "uneven.mcap", {"/cam_left": (90, 20), "/cam_right": (45, 40)})
    return tmp_path


BOTH = ("--topic", "/cam_left", "--topic", "/cam_right")


def test_learning_from_a_log_notes_how_images_became_frames(cdmisfa: Cdmisfa, logs: Path) -> None:
    run = logs / "run"
    done = cdmisfa("learn", logs / "a.mcap", *BOTH, *SMALL, *QUICK, "-o", run)
    assert done.code == 0, done.err
    assert "/cam_left: 60 images, 0 frames repeated, 0 images dropped" in done.err
    source = json.loads((run / "run.json").read_text())["source"]
    assert source["kind"] == "foreign"
    assert source["topics"] == ["/cam_left", "/cam_right"]
    assert source["size"] == [12, 16]
    assert "area average" in source["recipe"]
    assert [len(file["sha256"]) for file in source["files"]] == [64]


def test_the_refusal_prints_a_command_that_works(cdmisfa: Cdmisfa, logs: Path) -> None:
    refused = cdmisfa("learn", logs / "uneven.mcap", *BOTH, *SMALL, *QUICK)
    assert refused.code == 2
    command = shlex.split(refused.err.split("as with: cdmisfa ")[1])
    command[-1] = str(logs / "run")
    done = cdmisfa(*command, *QUICK)
    assert done.code == 0, done.err
    assert "/cam_right: 45 images, 44 frames repeated, 0 images dropped" in done.err
    assert "/cam_left: 90 images, 0 frames repeated, 1 images dropped" in done.err


def test_another_rate_is_refused_until_it_is_said_how(cdmisfa: Cdmisfa, logs: Path) -> None:
    words = ("learn", logs / "a.mcap", *BOTH, *SMALL, *QUICK, "--rate", "25")
    refused = cdmisfa(*words)
    assert refused.code == 2
    assert "50 images a second, not 25" in refused.err
    done = cdmisfa(*words, "--align", "time", "--loop")
    assert done.code == 0, done.err
    assert "30 images dropped" in done.err


def test_one_log_a_camera_needs_no_topic(cdmisfa: Cdmisfa, logs: Path) -> None:
    for name in ("one", "two"):
        write_cameras(logs / f"{name}.mcap", {"/image": (60, 20)})
    files = (logs / "one.mcap", logs / "two.mcap")
    done = cdmisfa("learn", *files, *SMALL, *QUICK, "--json")
    assert done.code == 0, done.err
    assert "two/image: 60 images" in done.err
    assert done.json["iterations"] == 4


def test_pictures_in_folders_are_streams(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    for name in ("left", "right"):
        write_pictures(tmp_path / name, 50)
    words = ("learn", tmp_path / "left", tmp_path / "right", *SMALL, *QUICK)
    refused = cdmisfa(*words)
    assert (refused.code, "--rate" in refused.err) == (2, True)
    done = cdmisfa(*words, "--rate", "30", "--json")
    assert done.code == 0, done.err
    assert done.json["source"]["topics"] == ["left", "right"]


def test_pictures_come_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    from replay.camera_logs.source import ForeignSource

    values = write_pictures(tmp_path / "left", 12)
    frames = ForeignSource(tmp_path / "left", size=(12, 16), rate=10).take(0, 12).frames
    np.testing.assert_array_equal(frames[:, 0, 0], values)


def test_a_resumed_run_equals_one_that_was_not_stopped(cdmisfa: Cdmisfa, logs: Path) -> None:
    words = ("learn", logs / "uneven.mcap", *BOTH, *SMALL, "--align", "time", "--no-rerun")
    words += ("--set", "learner.tau=10", "--json")
    whole = cdmisfa(*words, "--max-iterations", "7", "-o", logs / "whole")
    cdmisfa(*words, "--max-iterations", "3", "-o", logs / "run")
    resumed = cdmisfa(*words, "--max-iterations", "7", "-o", logs / "run", "--resume")
    assert resumed.code == 0, resumed.err
    assert resumed.json["signals_sha256"] == whole.json["signals_sha256"]
    other = cdmisfa(*words, "--rate", "25", "--max-iterations", "9", "-o", logs / "run", "--resume")
    assert (other.code, "source." in other.err) == (2, True)


def test_a_scene_takes_no_camera_options(cdmisfa: Cdmisfa) -> None:
    done = cdmisfa("learn", "oscillatory", "--topic", "/left")
    assert (done.code, "is a scene" in done.err) == (2, True)
    done = cdmisfa("learn", "oscillatory", "--size", "12")
    assert (done.code, "128x48" in done.err) == (2, True)


def test_a_converted_log_is_a_recording_with_the_same_signals(cdmisfa: Cdmisfa, logs: Path) -> None:
    words = (logs / "uneven.mcap", *BOTH, *SMALL, "--align", "time")
    done = cdmisfa("convert", *words, "-o", logs / "rec", "--json")
    assert done.code == 0, done.err
    assert "/cam_right: 45 images, 44 frames repeated, 0 images dropped" in done.err
    assert [(v["name"], v["frames"]) for v in done.json["views"]] == [
        ("cam_left", 89),
        ("cam_right", 89),
    ]
    assert cdmisfa("verify", logs / "rec").code == 0
    assert cdmisfa("info", logs / "rec", "--json").json["kind"] == "recording"
    direct = cdmisfa("learn", *words, *QUICK, "--json")
    converted = cdmisfa("learn", logs / "rec", *QUICK, "--json")
    assert converted.json["signals_sha256"] == direct.json["signals_sha256"]
    again = cdmisfa("convert", *words, "-o", logs / "rec")
    assert (again.code, "--force" in again.err) == (2, True)
    assert cdmisfa("convert", *words, "-o", logs / "rec", "--force").code == 0


def test_topics_become_names_of_files() -> None:
    from replay.camera_logs.names import view_names

    topics = ("/a/image", "/a,image", "../../etc", "/")
    assert view_names(topics) == ("a_image", "a_image-2", "etc", "stream")
    assert view_names(("é", "ü", "l/cam", "左")) == ("e", "u", "l_cam", "左")
    assert view_names(("/cam-2", "/cam", "/cam")) == ("cam-2", "cam-3", "cam-4")
