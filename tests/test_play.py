"""A recording that is played: in its own time, to Rerun and as a robot that others record."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import threading
import time
import urllib.request
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urljoin

import numpy as np
import pytest
from camera_files import pictures, write_cameras
from conftest import Cdmisfa
from view_data import View
from waiting import Clock, started

from cdmisfa.core.errors import UsageError
from recorder.cameras.foxglove import FoxgloveCamera
from recorder.cameras.stepped import ArraySource
from recorder.recording import record
from replay.camera_logs.options import CameraOptions
from replay.inputs import Logged
from replay.playing import feed
from replay.playing.as_robot import play_as_robot
from replay.playing.feed import (
    DueMessage,
    Feed,
    Playback,
    Played,
    Topic,
    opened_messages,
    paced,
)
from replay.recordings.source import RecordedSource
from replay.viewer.broadcast import Broadcast
from replay.viewer.web import DATA

FRAMES, FPS = 21, 8.0  # of so few a second that a busy machine is not late by a tick
TOPIC = Topic("/x", "json", "", "", b"")


def told(*seconds: float) -> list[DueMessage]:
    return [DueMessage(10**18 + round(s * 1e9), TOPIC, str(s).encode()) for s in seconds]


def feed_of(items: list[DueMessage]) -> Feed[DueMessage]:
    return Feed(items[0].time_ns, items[-1].time_ns, lambda: items)


def played_at(
    items: list[DueMessage], rate: float = 1.0, over: float = 0.0
) -> tuple[list[float], Played]:
    clock, played = Clock(over), Played()
    pace = paced(feed_of(items), Playback(rate), played, now=clock.monotonic, sleep=clock.sleep)
    times = [clock.now - 100 for _ in pace]
    return times, played


@pytest.mark.parametrize("rate", [1.0, 2.0, 0.5])
def test_each_message_comes_when_it_is_due(rate: float) -> None:
    at = [0, 0.02, 0.5, 0.5, 97.5]
    times, played = played_at(told(*at), rate)
    np.testing.assert_allclose(times, np.array(at) / rate, atol=1e-9)
    assert (played.count, played.seconds) == (5, 97.5)


def test_waits_that_are_too_long_add_up_to_no_drift() -> None:
    times, played = played_at(told(*np.arange(1000) / 50), over=0.003)
    late = np.array(times) - np.arange(1000) / 50
    assert late.min() > -1e-9
    assert late.max() < 0.0031
    assert played.behind < 0.0031


def test_a_loop_begins_again_a_step_after_the_end() -> None:
    feed = feed_of(told(0, 0.5, 0.5, 1))
    at_once = Playback(1e12, loop=True)
    endless = paced(feed, at_once, Played())
    since = [next(endless)[0] / 1e9 for _ in range(9)]
    assert since == [0, 0.5, 0.5, 1, 1.5, 2, 2, 2.5, 3]
    assert [s for s, _ in paced(feed, Playback(1e12), Played())][-1] == 10**9
    assert list(paced(Feed(0, 0, list), at_once, Played())) == []


def views() -> dict[str, np.ndarray[Any, Any]]:
    return {name: np.stack(list(pictures(FRAMES, k))) for k, name in enumerate(("left", "right"))}


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("played") / "rec"
    record(ArraySource(views(), fps=FPS), folder)
    return folder


@contextlib.contextmanager
def robot(path: Path, rate: float, wait: int = 1) -> Iterator[tuple[int, list[Played]]]:
    """A recording played as a robot in a thread: its port, and what was played in the end."""
    pytest.importorskip("foxglove")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    said, over = threading.Event(), threading.Event()
    done: list[Played] = []
    how = Playback(rate, stop=over.is_set)

    def play() -> None:
        done.append(play_as_robot([path], how, port=port, say=lambda line: said.set(), wait=wait))

    thread = threading.Thread(target=play)
    thread.start()
    assert said.wait(20)
    try:
        yield port, done
    finally:
        over.set()
        thread.join()


@pytest.mark.parametrize("rate", [1, 2])
def test_what_is_played_is_recorded_as_it_was(
    cdmisfa: Cdmisfa, recording: Path, tmp_path: Path, rate: int
) -> None:
    shown = views()
    with robot(recording, wait=2, rate=rate) as (port, played):
        words = [f"foxglove://127.0.0.1:{port}/view/{name}" for name in shown]
        options = ("--size", "16x12", "--rate", FPS * rate, "--lost", "end", "--hold", 5)
        done = cdmisfa("record", *words, *options, "-o", tmp_path / "rec")
    assert done.code == 0, done.err
    assert (played[0].count, played[0].seconds) == (2 * FRAMES, (FRAMES - 1) / FPS)
    with RecordedSource(tmp_path / "rec") as source:
        assert source.spec.fps == FPS * rate
        assert source.frames >= FRAMES - 1
        for stream, name in enumerate(shown):  # at each tick the picture of this tick
            source.seek(source.first_frame)
            block = source.take(stream, FRAMES - 1)
            np.testing.assert_array_equal(block.frames, shown[name][: FRAMES - 1])


def test_messages_keep_their_bytes_and_times(recording: Path) -> None:
    websockets = pytest.importorskip("websockets.sync.client")
    with opened_messages([recording], Playback()) as feed:
        expected = list(feed.items())
    assert [told.topic.name for told in expected[:2]] == ["/view/left", "/view/right"]
    with robot(recording, rate=1) as (port, _):
        camera = FoxgloveCamera(f"foxglove://127.0.0.1:{port}/view/right", "right", timeout=20)
        server = websockets.connect(
            f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"], proxy=None
        )
        with server as connection:
            number, *_ = camera._find(connection)
            wanted = [{"id": 1, "channelId": number}]
            connection.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
            seen = [m for m in connection if isinstance(m, bytes) and m[0] == 1]
    found = [(int.from_bytes(m[5:13], "little"), m[13:]) for m in seen]
    assert found == [(t.time_ns, t.data) for t in expected if t.topic.name == "/view/right"]


def test_what_every_file_tells_is_played_once(oscillatory_recording: Path) -> None:
    with opened_messages([oscillatory_recording], Playback()) as feed:
        names = [told.topic.name for told in feed.items()]
    assert names.count("/truth") == names.count("/view/x1") == 2000
    assert len(feed.topics) == 4


def test_logs_that_are_no_mcap_files_are_played_frame_by_frame(tmp_path: Path) -> None:
    from PIL import Image

    shown = views()
    for name, images in shown.items():
        (tmp_path / name).mkdir()
        for i, image in enumerate(images[:5]):
            Image.fromarray(image).save(tmp_path / name / f"{i:03}.png")
    folders = [tmp_path / "left", tmp_path / "right"]
    with (
        pytest.raises(UsageError, match="left tells no rate: set one with --fps"),
        opened_messages(folders, Playback()),
    ):
        pass
    with opened_messages(folders, Playback(fps=25)) as feed:
        first, again = list(feed.items()), list(feed.items())
    assert first == again
    assert [topic.name for topic in feed.topics] == ["/view/left", "/view/right"]
    assert [told.topic.schema_name for told in first] == ["foxglove.RawImage"] * 10
    assert shown["right"][4].tobytes() in first[-1].data
    assert (feed.start, feed.stop) == (first[0].time_ns, first[-1].time_ns)


def test_others_logs_are_played_as_they_are(tmp_path: Path) -> None:
    write_cameras(tmp_path / "log.mcap", {"/a": (3, 40), "/b": (2, 60)})
    with opened_messages([tmp_path / "log.mcap"], Playback()) as feed:
        order = [(told.topic.name, told.time_ns // 10**6 - 1000) for told in feed.items()]
    assert order == [("/a", 0), ("/b", 0), ("/a", 40), ("/b", 60), ("/a", 80)]


def test_topics_are_played_as_they_are_and_fields_as_numbers(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    write_cameras(path, {"/a": (3, 40), "/b": (2, 60)})
    with opened_messages([path], Playback()) as feed:
        every = [told for told in feed.items() if told.topic.name == "/b"]
    with opened_messages([path], Playback(cameras=CameraOptions(topics=("/b*",)))) as feed:
        assert list(feed.items()) == every
    with (
        pytest.raises(UsageError, match="no topic /c; it has: /a, /b"),
        opened_messages([path], Playback(cameras=CameraOptions(topics=("/b", "/c")))),
    ):
        pass
    (tmp_path / "t.csv").write_text("stamp,a\n0,1\n1,2\n2,n/a\n3,4\n")
    said: list[str] = []
    cameras = CameraOptions(time="stamp", fields=("a",))

    def about(source: Logged) -> None:
        said.extend(source.warnings)

    with opened_messages([tmp_path / "t.csv"], Playback(cameras=cameras, about=about)) as feed:
        told = list(feed.items())
    assert [(each.topic.schema_name, each.time_ns // 10**9) for each in told] == [
        ("cdmisfa.Vector", second) for second in (0, 1, 2)
    ]
    assert ["line 4 is left out: a holds no number" in line for line in said] == [True]


def test_the_viewer_is_handed_every_frame(recording: Path, tmp_path: Path) -> None:
    from replay.playing.in_rerun import play_in_rerun

    taken: list[bytes] = []

    def watch(broadcast: Broadcast) -> None:
        def read() -> None:
            with urllib.request.urlopen(urljoin(broadcast.address, DATA)) as answer:
                taken.append(answer.read())

        threads.append(threading.Thread(target=read))
        threads[0].start()

    threads: list[threading.Thread] = []
    begin = time.monotonic()
    played = play_in_rerun([recording], Playback(rate=8), announce=watch)
    assert time.monotonic() - begin > (FRAMES - 1) / FPS / 8
    threads[0].join()
    assert (played.count, played.seconds) == (FRAMES, (FRAMES - 1) / FPS)
    shown: dict[str, list[tuple[int, bytes]]] = defaultdict(list)
    for number, piece in enumerate(taken[0].split(b"RRF2\0")[1:]):  # each is whole
        file = tmp_path / f"{number}.rrd"
        file.write_bytes(b"RRF2\0" + piece)
        for entity, columns in View(file).rows.items():
            if "Image:buffer" in columns:
                rows = zip(columns["frame"], columns["Image:buffer"], strict=True)
                shown[entity] += [(t, bytes(row[0])) for t, row in rows]
    for (name, images), entity in zip(views().items(), sorted(shown), strict=True):
        assert entity.endswith(name)
        assert shown[entity] == [(t, image.tobytes()) for t, image in enumerate(images)]


def test_play_in_the_command_line(cdmisfa: Cdmisfa, recording: Path) -> None:
    done = cdmisfa("play", recording, "--rate", 20)
    assert (done.code, done.out) == (0, f"played {FRAMES} frames, 2.50 s of the recording\n")
    assert "live view http://127.0.0.1:" in done.err
    robot = cdmisfa("play", recording, "--to", "foxglove", "--wait", 0, "--port", 0, "--rate", 20)
    assert (robot.code, robot.out) == (
        0,
        f"played {2 * FRAMES} messages, 2.50 s of the recording\n",
    )
    assert robot.err.startswith("playing at ws://127.0.0.1:")


def test_a_port_that_is_taken_is_said(cdmisfa: Cdmisfa, recording: Path) -> None:
    pytest.importorskip("foxglove")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        done = cdmisfa("play", recording, "--to", "foxglove", "--port", port)
    assert (done.code, done.err.count("\n")) == (1, 1)
    assert f"no robot at port {port}" in done.err
    assert "--port" in done.err


@pytest.mark.parametrize(("loop", "code"), [(["--loop"], 0), ([], 130)])
def test_ctrl_c_ends_it_cleanly(recording: Path, loop: list[str], code: int) -> None:
    pytest.importorskip("foxglove")
    words = ("play", recording, "--to", "foxglove", "--wait", 0, "--port", 0, *loop)
    with started(*words, "--rate", 0.5) as process:
        assert process.stderr is not None
        assert "playing at" in process.stderr.readline()
        time.sleep(0.3)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=30)
    assert (process.returncode, err) == (code, "")
    assert out.startswith("played ")


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
@pytest.mark.parametrize("to", ["rerun", "foxglove"])
def test_a_signal_while_the_log_is_opened_ends_it(
    cdmisfa: Cdmisfa,
    recording: Path,
    monkeypatch: pytest.MonkeyPatch,
    to: str,
    number: signal.Signals,
    code: int,
) -> None:
    def opening(path: object) -> None:
        os.kill(os.getpid(), number)
        time.sleep(30)
        raise AssertionError("it was opened on")

    monkeypatch.setattr(feed, "refuse_what_is_no_log", opening)
    monkeypatch.setattr(feed, "open_to_look", lambda *paths: opening(paths))
    done = cdmisfa("play", recording, "--to", to)
    assert (done.code, done.out) == (code, "")
    assert done.err.endswith("cdmisfa: interrupted\n")
