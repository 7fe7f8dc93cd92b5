"""Every command takes every kind of log, or says in one line why it does not."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_files import (
    HEIGHT,
    PACKED,
    WIDTH,
    packed,
    pictures,
    write_cameras,
    write_pictures,
    write_video,
)
from conftest import Cdmisfa
from contracts.sources import SourceContract
from folders import external
from message_files import STEP, every, learned_alike, write_mcap, write_table
from PIL import Image
from test_bags import ros1_bag, ros2_bag, ros2_database, ros2_mcap
from test_foreign import raw_json, ros1
from video_packets import FOXGLOVE, foxglove, video
from web_server import serving

from cdmisfa.core.blocks import FrameSource
from recorder.images.messages import MessageKind
from replay.corpus.index import read_index

COUNT = 60
STEP_MS = 20
MESSAGES_OF = ("foxglove", "compressed", "json", "ros1")
BAGS = ("ros2 mcap folder", "bag", "db3", "db3 folder")
PICTURES = ("png folder", "jpeg folder")
FORMATS = (
    *("recording", "run", *(f"{kind} mcap" for kind in MESSAGES_OF), *BAGS, "video", "video mcap"),
    *(*PICTURES, "lerobot", "table", "url", "several", "glob"),
)
COMMANDS = ("info", "verify", "view", "export", "learn", "convert", "record", "index")
REFUSED = {
    ("export", "run"): "is a run, not a recording",
    ("export", "table"): "has streams of numbers: use --to parquet",
    ("learn", "run"): "is a run, not a recording",
    ("convert", "run"): "is a run, not a recording",
    **{("record", kind): "cdmisfa convert" for kind in FORMATS},
}
"""Cells that make no sense, and words of the line that says so."""


def fields(image: np.ndarray) -> dict[str, Any]:
    size = {"height": HEIGHT, "width": WIDTH, "encoding": "mono8", "step": WIDTH}
    return {**size, "big": 0, "data": image.tobytes()}


MESSAGES: dict[str, tuple[MessageKind, Callable[[np.ndarray], bytes]]] = {
    "compressed mcap": (PACKED, packed),
    "json mcap": (MessageKind("foxglove.RawImage", "json"), lambda i: raw_json(**fields(i))),
    "ros1 mcap": (MessageKind("sensor_msgs/Image", "ros1"), lambda i: ros1(**fields(i))),
}


def write_film(path: Path) -> Path:
    write_video(path, pictures(COUNT), codec="libx264", pixels="yuv420p", fps=50)
    return path


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, list[object]]]:
    """Words that name a log of each kind."""
    from cdmisfa.cli import run

    base = tmp_path_factory.mktemp("logs")
    for name in ("ros1", "ros2", "db", "mcap", "jpeg"):
        (base / name).mkdir()
    write_cameras(base / "a.mcap", {"/cam": (COUNT, STEP_MS)})
    write_cameras(base / "part-1.mcap", {"/left": (COUNT, STEP_MS)})
    write_cameras(base / "part-2.mcap", {"/right": (COUNT, STEP_MS)})
    write_pictures(base / "png", COUNT)
    write_table(base / "t.csv", {"a": np.arange(COUNT), "b": np.arange(COUNT) % 7})
    images = list(pictures(COUNT))
    for i, image in enumerate(images):
        Image.fromarray(image).save(base / "jpeg" / f"{i}.jpg")
    for name, (kind, encode) in MESSAGES.items():
        write_mcap(base / name, kind, {"/cam": every(STEP, map(encode, images))})
    packets = (foxglove(packet, "h264") for packet in video("h264"))
    write_mcap(base / "video mcap", FOXGLOVE, {"/cam": every(STEP, packets)})
    rec = str(base / "rec")
    for words in (
        ["convert", str(base / "a.mcap"), "-o", rec],
        ["learn", rec, "-o", str(base / "run"), "--max-iterations", "1", "--no-rerun"],
        ["export", rec, "--to", "lerobot", "-o", str(base / "lerobot/")],
    ):
        assert run(words) == 0
    with serving() as web:
        web.files["/a.mcap"] = (base / "a.mcap").read_bytes()
        yield {
            "recording": [base / "rec"],
            "run": [base / "run"],
            "foxglove mcap": [base / "a.mcap"],
            **{name: [base / name] for name in (*MESSAGES, "video mcap", "lerobot")},
            "ros2 mcap folder": [ros2_mcap(base / "mcap")],
            "bag": [ros1_bag(base / "ros1")],
            "db3": [ros2_database(base / "db")],
            "db3 folder": [ros2_bag(base / "ros2")],
            "video": [write_film(base / "film.mp4")],
            "png folder": [base / "png"],
            "jpeg folder": [base / "jpeg"],
            "table": [base / "t.csv"],
            "url": [web.url("/a.mcap")],
            "several": [base / "part-1.mcap", base / "part-2.mcap"],
            "glob": [base / "part-*.mcap"],
        }


class TestSources(SourceContract):
    """Of every kind of log that is opened otherwise than the others."""

    ends = True

    @pytest.fixture(
        autouse=True,
        params=["foxglove mcap", "bag", "video", "video mcap", "png folder", "table", "several"],
    )
    def _log(self, request: pytest.FixtureRequest, logs: dict[str, list[Any]]) -> None:
        self.kind, self.paths = request.param, logs[request.param]

    def open(self) -> FrameSource:
        topics = ["/cam_*"] if self.kind in BAGS else []
        rate = 50.0 if self.kind in (*PICTURES, "table") else None
        return external(self.paths, topics, rate=rate)


def write_numbers(table: Path, log: Path) -> None:
    """A table with the columns stamp, a and b, and a log of joints in JSON."""
    t = np.arange(200)
    write_table(table, {"stamp": t / 50, "a": np.sin(t / 9), "b": t % 7})
    joints = ({"position": [i, i % 5, 1], "velocity": [0.5, i % 3]} for i in range(200))
    kind = MessageKind("joints", "json", b"{}", "jsonschema")
    write_mcap(log, kind, {"/joint_states": every(STEP, (json.dumps(j).encode() for j in joints))})


def needed(kind: str) -> list[str]:
    """What learning and converting ask for."""
    rate = ["--rate", "50"] if kind in (*PICTURES, "table") else []
    return [*rate, *(["--topic", "/cam_*"] if kind in BAGS else [])]


def command_line(command: str, kind: str, words: list[object], out: Path) -> list[object]:
    """The command, with what every kind of log needs."""
    rate = [] if kind in BAGS else needed(kind)
    return {
        "info": ["info", *words, "--json"],
        "verify": ["verify", *words, "--json"],
        "view": ["view", *words, "--save", out / "view.rrd", *rate],
        "export": ["export", *words, "--to", "images", "-o", out / "images", *rate],
        "learn": ["learn", *words, "--max-iterations", "1", "--json", *needed(kind)],
        "convert": ["convert", *words, "-o", out / "rec", "--json", *needed(kind)],
        "index": ["index", *words, "-o", out / "all.parquet", "--deep", "--jobs", 1, "--json"],
        "record": ["record", *words, "-o", out / "rec", "--frames", "5"],
    }[command]


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_takes_a_log_or_says_why_not(
    command: str, kind: str, logs: dict[str, list[object]], cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    done = cdmisfa(*command_line(command, kind, logs[kind], tmp_path))
    refused = REFUSED.get((command, kind))
    if refused is not None:
        assert done.code == 2
        assert refused in done.err
        assert (done.err[:9], done.err.count("\n")) == ("cdmisfa: ", 1)
        assert not list(tmp_path.iterdir())
        return
    assert done.code == 0, done.err
    streams = 2 if kind in (*BAGS, "several", "glob") else 1
    match command:
        case "info":
            messages = [channel["messages"] for channel in done.json["channels"]]
            assert kind == "run" or messages.count(COUNT) >= streams
        case "verify":
            assert done.json["ok"]
            assert done.json["files"]
        case "view":
            assert (tmp_path / "view.rrd").stat().st_size > 1000
        case "export":
            assert len(list((tmp_path / "images").rglob("*.png"))) == streams * COUNT
        case "learn":
            assert done.json["iterations"] == 1
        case "index":
            rows = read_index(tmp_path / "all.parquet").to_pylist()
            assert [row["problem"] for row in rows if row["problem"]] == []
            images = [row for row in rows if row["messages"] == COUNT]
            assert kind == "run" or len(images) >= streams
            known = [row for row in rows if row["gaps"] in (0, 1)]  # one is in the bags
            assert kind in ("run", "table") or len(known) >= streams
        case "convert":
            assert [view["frames"] for view in done.json["views"]] == [COUNT] * streams


@pytest.mark.parametrize("kind", [k for k in FORMATS if k not in ("recording", "run", "glob")])
def test_a_log_and_its_conversion_are_learned_alike(
    kind: str, logs: dict[str, list[object]], cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    run = learned_alike(cdmisfa, tmp_path, *logs[kind], *needed(kind))
    assert {len(file.get("sha256", "x" * 64)) for file in run["source"]["files"]} == {64}


COMMANDS = """\
info robot.mcap film.mp4
verify robot.mcap film.mp4 pictures
view part-*.mcap --save parts.rrd
export robot.mcap --to images -o pngs
learn robot.mcap --topic /cam* --start 0.2 --end 0:01
convert robot.mcap --topic /cam_left --topic /cam_right --size 8x6 --set input.fit=pad -o rec
learn joints.mcap --topic /joint_states --field position --max-iterations 2
convert joints.mcap --topic /joint_states --field position[0:2] --field velocity -o joints
learn data.csv --set input.time=stamp --field a --field b --max-iterations 2
view data.csv --set input.time=stamp --save data.rrd
"""


def test_commands_take_logs_videos_images_and_numbers(
    cdmisfa: Cdmisfa, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write_cameras(Path("robot.mcap"), dict.fromkeys(("/cam_left", "/cam_right"), (COUNT, STEP_MS)))
    write_cameras(Path("part-1.mcap"), {"/left": (COUNT, STEP_MS)})
    write_cameras(Path("part-2.mcap"), {"/right": (COUNT, STEP_MS)})
    write_pictures(Path("pictures"), COUNT)
    write_film(Path("film.mp4"))
    write_numbers(Path("data.csv"), Path("joints.mcap"))
    for line in COMMANDS.splitlines():
        done = cdmisfa(*line.split())
        assert done.code == 0, (line, done.err)
