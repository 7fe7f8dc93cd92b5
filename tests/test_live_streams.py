"""Live streams by their words: what PyAV opens, simulated tasks, robots, arrays; on loopback."""

from __future__ import annotations

import contextlib
import functools
import http.server
import json
import re
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import foxglove
import numpy as np
import pytest
from camera_files import HEIGHT, WIDTH, encoded, write_video
from conftest import Cdmisfa
from contracts.sources import ForwardContract
from foxglove.channels import CompressedImageChannel, RawImageChannel
from foxglove.messages import CompressedImage, RawImage
from live_cameras import Robot
from rtsp_camera import RATE, rtsp_camera
from waiting import Clock, started, wait_for

from cdmisfa import ArraySource, GymSource
from cdmisfa.core.blocks import FrameSource
from cdmisfa.core.errors import UsageError
from recorder.cameras.video import VideoCamera
from recorder.cameras.words import live_names, open_live
from recorder.images.options import InputOptions
from replay.open_sources import open_recording

TEST = "av:lavfi:testsrc=size=160x120:rate=30"


def test_streams_are_named_after_what_they_are() -> None:
    words = {
        "camera:/dev/video0": "video0",
        "rtsp://user:secret@robot:554/left": "left",
        "rtsp://user:secret@robot": "robot",
        "http://robot/cam/front.mjpg": "front",
        "tcp://robot:9000": "robot_9000",
        "av:lavfi:testsrc=size=160x120:rate=30": "lavfi_testsrc",
        "gym:Pendulum-v1": "Pendulum-v1",
        "foxglove://robot:8765/cam/left": "cam_left",
        "rtsp://robot/Küche_vorne": "Kuche_vorne",
        "rtsp://robot/K%C3%BCche": "Kuche",
        "foxglove://robot:8765/küche/left": "kuche_left",
        "camera:/dev/video1": "video1",
        "av:/data/video0": "video0-2",
        "foxglove://robot:8765/front-2": "front-2",
        "foxglove://robot:8765/front": "front-3",
        "foxglove://127.0.0.1:8765/view/right": "right",
        "foxglove://robot/camera/center%20e/image_raw": "camera_center_e_image_raw",
        "av:films/stereo.mp4": "stereo",
    }
    assert live_names(list(words)) == tuple(words.values())


class TestGym(ForwardContract):
    def open(self) -> FrameSource:
        return GymSource(["CartPole-v1", "Pendulum-v1"], seed=3, size=(24, 32))


class TestArrays(ForwardContract):
    def open(self) -> FrameSource:
        frames = np.random.default_rng(0).integers(0, 255, (100, 6, 8), np.uint8)
        return ArraySource({"array": frames, "iterator": (255 - frame for frame in frames)})


def test_numbers_that_are_not_finite_are_refused_with_their_frame() -> None:
    source = ArraySource({"numbers": iter([np.zeros(2), np.array([0.0, np.nan])])})
    with pytest.raises(UsageError, match="frame 1 of numbers has NaN or infinity"):
        source.take(0, 2)


def test_a_task_shows_its_observations_and_actions_as_truth() -> None:
    with GymSource(["CartPole-v1"], size=(24, 32)) as source:
        observed = [f"CartPole_v1_{i}" for i in range(4)]
        assert source.spec.truth == (*observed, "action_CartPole_v1_0", "begins_CartPole_v1")
        assert source.spec.fps == 50
        block = source.take(0, 200)
    # the cart moves by its velocity times 0.02 s, within an episode
    position, velocity = block.truth[:-1, 0], block.truth[:-1, 1]
    moved = block.truth[1:, 0] - position
    assert np.median(np.abs(moved - 0.02 * velocity)) < 1e-6
    # 1 pushes the cart to the right and makes it faster, 0 slower; an episode begins at rest
    pushed, begins = block.truth[:-1, 4], block.truth[:, 5] == 1
    within = ~begins[1:]
    np.testing.assert_array_equal((np.diff(block.truth[:, 1]) > 0)[within], pushed[within] == 1)
    assert begins.sum() > 3
    assert np.abs(block.truth[begins][1:, :4]).max() <= 0.05


def learned_twice(cdmisfa: Cdmisfa, place: Path, *words: str) -> dict[str, Any]:
    """What a run says of itself that learned from live streams, and again from their recording."""
    options = ["--set", "learner.tau=20", "--max-iterations", "3", "--json"]
    live = cdmisfa("learn", *words, "--record", place / "rec", "-o", place / "run", *options)
    assert live.code == 0, live.err
    again = cdmisfa("learn", place / "rec", *options).json
    assert again["signals_sha256"] == live.json["signals_sha256"]
    stated = json.loads((place / "run" / "run.json").read_text())["config"]["record"]
    with open_recording(place / "rec") as source:
        assert (stated["fps"], stated["start_ns"]) == (source.spec.fps, source.spec.start_ns)
    return {**live.json, "said": live.err}


def test_pictures_of_ffmpeg_are_recorded_and_learned_from(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    words = [TEST, TEST.replace("testsrc", "testsrc2"), "--size", "32x24"]
    assert "lavfi_testsrc: " in learned_twice(cdmisfa, tmp_path, *words)["said"]
    refused = cdmisfa("check", tmp_path / "run")
    assert refused.code == 2
    assert f"{TEST} is a live stream, which cannot go back" in refused.err
    assert cdmisfa("check", tmp_path / "run", "--source", tmp_path / "rec").code == 0


def write_clip(clip: Path) -> Path:
    """Twenty pictures, 25 a second; the k-th has the grey k."""
    write_video(clip, (np.full((HEIGHT, WIDTH), k, np.uint8) for k in range(20)))
    return clip


def test_a_video_plays_at_its_own_pace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    monkeypatch.setattr("recorder.cameras.video.time", clock)
    camera = VideoCamera(f"av:{write_clip(tmp_path / 'clip.mkv')}", "clip")
    shown = [(clock.now, age, int(image[0, 0])) for age, image in camera.images()]
    assert [grey for _, _, grey in shown] == list(range(20))
    assert [age for _, age, _ in shown] == [0] * 20
    assert np.diff([now for now, _, _ in shown]) == pytest.approx(1 / 25, abs=1e-3)


def test_a_video_is_recorded_until_it_ends(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    clip = write_clip(tmp_path / "clip.mkv")
    done = cdmisfa("record", f"av:{clip}", "-o", str(tmp_path / "rec"), "--size", "64x48")
    assert re.search(r"ended at frame \d+: clip ended$", done.err, re.MULTILINE)
    with open_recording(tmp_path / "rec") as source:
        assert source.spec.fps == 25
        (held,) = source.coverage().values()
        shown = [block.frames[:, 0, 0].tolist() for block in source.take_all(source.frames)]
        greys = [grey for stretch in shown for grey in stretch]
    assert greys == sorted(greys)  # which are late depends on how busy the machine is
    assert (held[0][0], greys[0], greys[-1]) == (0, 0, 19)


class Motion(http.server.BaseHTTPRequestHandler):
    """A web camera: MJPEG without end, but each connection breaks after 20 images."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        self.end_headers()
        with contextlib.suppress(OSError):
            for k in range(20):
                data = encoded(gray(5 * k), "JPEG")
                head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n"
                self.wfile.write(head.encode() + b"\r\n" + data + b"\r\n")
                time.sleep(0.04)

    def log_message(self, *args: Any) -> None:
        pass


@pytest.fixture
def web_camera() -> Iterator[str]:
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Motion) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}/stream.mjpg"
        server.shutdown()
        thread.join()


def test_a_web_camera_that_breaks_is_connected_to_anew(web_camera: str) -> None:
    said: list[str] = []
    options = InputOptions(size=(48, 64), rate=25)
    with open_live([web_camera], options, say=said.append) as source:
        blocks = [block for _ in range(3) for block in source.take_all(25)]
    assert said[0] == "stream is lost: Input/output error: reconnecting"
    assert len(blocks) >= 2
    assert source.alignment["stream"]["missing"] > 0  # type: ignore[attr-defined]


def gray(k: int) -> np.ndarray[Any, Any]:
    return np.full((48, 64), k % 256, np.uint8)


def raw_image(k: int) -> RawImage:
    return RawImage(width=64, height=48, encoding="mono8", step=64, data=gray(k).tobytes())


@pytest.fixture
def robot() -> Iterator[Robot]:
    """It has two topics of images and one of something else."""
    in_json = functools.partial(foxglove.Channel, message_encoding="json")
    with (
        contextlib.closing(Robot()) as robot,
        robot.showing(RawImageChannel, "/cam/left", raw_image),
        robot.showing(
            CompressedImageChannel,
            "/cam/right",
            lambda k: CompressedImage(format="png", data=encoded(gray(k))),
        ),
        robot.showing(in_json, "/words", lambda k: {"k": k}),
    ):
        yield robot


def test_distances_of_a_running_robot_are_shown_as_asked_for(robot: Robot) -> None:
    data = np.tile(np.array([0, 1, 2, 3, 9], "<f4"), (4, 1)).tobytes()
    image = RawImage(width=5, height=4, encoding="32FC1", step=20, data=data)
    words = [f"{robot.address}/depth"]
    with robot.showing(RawImageChannel, "/depth", lambda _: image):
        with open_live(words, InputOptions(range=(1, 3))) as source:
            assert source.take(0, 2).frames[1, 0].tolist() == [0, 0, 128, 255, 255]
            assert source.describe()["range_metres"] == [1, 3]
        with pytest.raises(UsageError, match=r"add --set input\.range"):
            open_live(words, InputOptions())


def test_images_and_numbers_of_a_running_robot_are_recorded_and_learned_from(
    cdmisfa: Cdmisfa, tmp_path: Path, robot: Robot
) -> None:
    words = [f"{robot.address}/cam/left", f"{robot.address}/cam/right", "--size", "64x48"]
    run = learned_twice(cdmisfa, tmp_path / "images", *words)
    assert run["source"]["rate"] == pytest.approx(50, rel=0.3)
    with open_recording(tmp_path / "images" / "rec") as source:
        assert source.spec.streams == ("cam_left", "cam_right")
        shown = source.take(0, 20).frames
        assert (shown == shown[:, :1, :1]).all()
        assert (np.diff(shown[:, 0, 0].astype(int)) % 256 <= 3).all()
    run = learned_twice(cdmisfa, tmp_path / "k", f"{robot.address}/words", "--field", "k")
    assert run["source"]["fields"] == ["k"]
    with open_recording(tmp_path / "k" / "rec") as source:
        assert (np.diff(source.take(0, 20).frames[:, 0]) <= 3).all()
    words = [f"{robot.address}/words", f"{robot.address}/cam/left", "--size", "32x24"]
    run = learned_twice(cdmisfa, tmp_path / "both", *words)
    assert "words: 1 number" in run["said"]
    assert run["source"]["size"] == [[1], [24, 32]]
    run = learned_twice(cdmisfa, tmp_path / "part", TEST, words[0], "--field", "k")
    assert run["source"]["size"][1] == [1]
    with pytest.raises(UsageError, match="there is no z: it has k"):
        open_live([f"{robot.address}/words"], InputOptions(fields=("z",)))


def test_a_topic_that_comes_later_is_waited_for(robot: Robot) -> None:
    words, connected = [f"{robot.address}/cam/late"], list[str]()
    threading.Timer(0.5, connected.append, ["now"]).start()
    with (
        robot.showing(RawImageChannel, "/cam/late", raw_image, after=connected),
        open_live(words, InputOptions()) as source,
    ):
        assert source.take(0, 2).frames.shape == (2, 48, 64)


REFUSED = {
    "learn av:nothing.mkv": "av:nothing.mkv cannot be opened",
    "learn camera:/dev/nothing": "/dev/nothing: this device does not exist",
    f"record {TEST} -o x --field z": "has images: --field is for logs and foxglove:// streams",
    "learn gym:CartPole-v1 --set input.range=0,1": "input.range is for logs and foxglove://",
    "record rtsp://me:secret@127.0.0.1:9/x -o x": "rtsp://127.0.0.1:9/x cannot",
    "record gym:Nothing-v0 -o x": "gym:Nothing-v0 cannot be created",
    f"convert {TEST} -o x": "is a live stream: record it with cdmisfa record",
}


@pytest.mark.parametrize(("words", "why"), REFUSED.items())
def test_what_cannot_be_is_refused_in_one_line(
    cdmisfa: Cdmisfa, tmp_path: Path, words: str, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    refused = cdmisfa(*words.split())
    assert (refused.code, refused.err.count("\n")) == (2, 1)
    assert why in refused.err
    assert "secret" not in refused.err
    assert not list(tmp_path.iterdir())


def ended(rec: Path, number: int, least: int) -> tuple[int, str]:
    """The exit code and words of a recording that is sent a signal once it has some bytes."""
    partial = rec / "lavfi_testsrc.mcap.partial"
    with started("record", TEST, "-o", rec) as process:
        wait_for(lambda: partial.exists() and partial.stat().st_size > least, 60, process)
        time.sleep(0.3)
        process.send_signal(number)
        _, said = process.communicate(timeout=60)
    return process.returncode, said


def test_ctrl_c_finishes_a_recording_of_cameras(tmp_path: Path) -> None:
    code, said = ended(tmp_path / "rec", signal.SIGINT, 0)
    assert code == 0, said
    with open_recording(tmp_path / "rec") as source:
        assert source.frames > 3
    assert (tmp_path / "rec" / "lavfi_testsrc.mcap").exists()


def test_a_recording_of_cameras_that_was_killed_can_be_read_and_not_resumed(
    cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    ended(tmp_path / "rec", signal.SIGKILL, 8000)
    assert cdmisfa("info", str(tmp_path / "rec"), "--json").json["complete"] is False
    refused = cdmisfa("record", "-o", str(tmp_path / "rec"), "--resume")
    assert refused.code == 2
    assert "a recording of live streams cannot be resumed" in refused.err
    cdmisfa("recover", str(tmp_path / "rec"), "-o", str(tmp_path / "saved"))
    with open_recording(tmp_path / "saved") as source:
        assert source.frames > 0


def test_a_network_camera_shows_what_it_sees_at_its_own_rate() -> None:
    with rtsp_camera(100) as word, open_live([word], InputOptions()) as source:
        assert source.spec.streams == ("left",)
        assert source.spec.fps == RATE
        frames = source.take(0, 20).frames
    assert frames.shape == (20, 48, 64)
    bars = frames.astype(float).mean(axis=1).argmax(axis=1)
    moved = np.diff(bars) % 56
    assert moved.max() < 28  # forward: a picture that is late comes twice, and none goes back
    assert moved.sum() > 10
