"""The command line takes other people's camera logs, and says what it made of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from camera_files import write_cameras, write_images, write_pictures
from conftest import Cdmisfa
from message_files import write_mcap

from recorder.images.messages import MessageKind

SMALL = ("--size", "16x12")
QUICK = ("--max-iterations", "4", "--no-rerun", "--set", "learner.tau=10")


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    """One log with two cameras at one rate, `uneven.mcap` with two at different rates."""
    write_cameras(tmp_path / "a.mcap", {"/cam_left": (60, 20), "/cam_right": (60, 20)})
    write_cameras(tmp_path / "uneven.mcap", {"/cam_left": (90, 20), "/cam_right": (45, 40)})
    return tmp_path


BOTH = ("--topic", "/cam_left", "--topic", "/cam_right")


NO_IMAGES = "it has no images; for numbers use --field"
REFUSED = {
    "learn oscillatory --topic /left": "is a scene: --topic is for logs and cameras",
    "learn pictures": "--rate",
    "learn a.mcap --topic /cam_* --rate 25": "50 images per second, not 25",
    "learn a.mcap --topic /cam_* --start 12 --end 5": "--end 5 is before --start 12",
    "learn uneven.mcap --topic /cam_*": "align them by time with --align time --rate 50",
    "view apart.mcap --save v.rrd": ("the streams do not overlap in time: choose one with --topic"),
    "learn joints.mcap": NO_IMAGES,
    "view joints.mcap --save v.rrd": "it has no images",
}


@pytest.mark.parametrize(("words", "why"), REFUSED.items())
def test_what_cannot_be_taken_is_refused_in_one_line(
    words: str, why: str, cdmisfa: Cdmisfa, logs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(logs)
    write_pictures(logs / "pictures", 5)
    (logs / "t.csv").write_text("s,a\n0,1\n1,2\n2,3\n")
    write_mcap(logs / "joints.mcap", MessageKind("j", "json"), {"/joints": [(1, b"{}")]})
    image = np.zeros((16, 16), np.uint8)
    apart = {"/late": [(20_000 + 100 * i, image) for i in range(20)]}
    apart["/early"] = [(100 * i, image) for i in range(25)]
    write_images(logs / "apart.mcap", apart)
    refused = cdmisfa(*words.split())
    assert (refused.code, why in refused.err) == (2, True), refused.err
    assert refused.err.count("\n") == 1


def test_the_refusal_names_options_that_work(cdmisfa: Cdmisfa, logs: Path) -> None:
    uneven = logs / "uneven.mcap"
    refused = cdmisfa("learn", uneven, *BOTH, *SMALL, *QUICK)
    assert refused.code == 2
    options = refused.err.split(" with ")[1].split()
    learn = ("learn", uneven, *BOTH, *SMALL, *options, *QUICK, "-o", logs / "run")
    for words in (learn, ("export", uneven, "--to", "images", "-o", logs / "out")):
        done = cdmisfa(*words)
        assert done.code == 0, done.err
        assert "cam_right: 45 images, 44 frames repeated, 0 images dropped" in done.err
        assert "cam_left: 90 images, 0 frames repeated, 1 images dropped" in done.err


def test_pictures_come_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    from folders import external

    values = write_pictures(tmp_path / "left", 12)
    frames = external(tmp_path / "left", size=(12, 16), rate=10).take(0, 12).frames
    np.testing.assert_array_equal(frames[:, 0, 0], values)
