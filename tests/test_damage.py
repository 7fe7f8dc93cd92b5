"""Every kind of damage, in every format, under every command: exit codes and messages."""

from __future__ import annotations

import re
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_files import pictures, write_cameras, write_pictures, write_video
from conftest import Cdmisfa, Outcome
from message_files import STEP, every, write_mcap, write_table
from test_foreign import cdr

from recorder.images.messages import MessageKind
from recorder.mcap.reader import LogReader

COUNT = 40
COMMANDS = {
    "info": "info LOG --json",
    "verify": "verify LOG --json",
    "learn": "learn LOG --set learner.tau=10 --max-iterations 1",
    "convert": "convert LOG -o OUT",
    "recover": "recover FILE -o OUT.mcap",
    "view": "view LOG --save OUT.rrd",
}

FORMATS = {
    "recording": ("rec", "x1.mcap"),
    "ROS 2": ("cam.mcap", ""),
    "ROS 2, no checksums": ("bare.mcap", ""),
    "ROS 1": ("cameras.bag", ""),
    "MP4": ("film.mp4", ""),
    "PNG": ("png", "3.png"),
    "CSV": ("t.csv", ""),
    "Parquet": ("t.parquet", ""),
    "npz": ("a.npz", ""),
}
"""Each with its file or folder, and the file in it that is damaged."""


def flip(data: bytes, at: int) -> bytes:
    return data[:at] + bytes([data[at] ^ 0xFF]) + data[at + 1 :]


Damage = Callable[[bytes, Any, int], bytes]

DAMAGES: dict[str, Damage] = {
    "none": lambda data, chunk, end: data,
    "empty": lambda data, chunk, end: b"",
    "another format": lambda data, chunk, end: b"hello" * 99,
    "cut at the start": lambda data, chunk, end: data[:20],
    "cut in the middle": lambda data, chunk, end: data[: len(data) // 2],
    "cut at the end": lambda data, chunk, end: data[:-1],
    "bit flip": lambda data, chunk, end: flip(data, len(data) // 2),
    "cut between chunks": lambda data, chunk, end: data[: chunk.offset],
    "cut in a chunk": lambda data, chunk, end: data[: chunk.data_end - 9],
    "no summary": lambda data, chunk, end: data[:end],
    "no footer": lambda data, chunk, end: data[:-37],
    "chunk": lambda data, chunk, end: flip(data, chunk.data_end - 9),
    "head of a chunk": lambda data, chunk, end: flip(data, chunk.offset + 1),
    "message index": lambda data, chunk, end: flip(data, chunk.data_end + 20),
    "data end": lambda data, chunk, end: flip(data, end - 1),
    "summary": lambda data, chunk, end: flip(data, end + 30),
    "footer": lambda data, chunk, end: flip(data, len(data) - 24),
}
"""Given the bytes, and of an MCAP file its last chunk but one and the place of its summary."""

EMPTY, NO_MCAP = "it is empty: record or copy it again", "not an MCAP file"
WITHIN = "cut short: the file ends within the record"
NO_END = "cut short: the end of the file and its index are missing"
ALL_THERE = "cut short: part of its summary is missing, but no message is"
BAD = "its CRC does not match"
FEW = "cut short: the file ends within the record|no message can be recovered"
BARE = "it has no checksums, so that changed bytes cannot be noticed"
HEAD = "it is not the chunk in the summary|the length of a chunk contradicts its data"
NO_PNG = "its JPEG or PNG is damaged|it does not begin as a PNG|its PNG is cut short"
INDEX = "index contradicts its messages|other messages than the summary|data section: " + BAD

TABLE: dict[str, dict[str, tuple[str, str, str]]] = {
    # Damage: exit codes of COMMANDS, "-" where one does not apply; the state, with that of the
    # checksums of MCAP files; words of each message, or of one of several.
    "recording": {
        "none": ("0 0 0 - 0 0", "whole ok", ""),
        "empty": ("3 3 3 - 3 3", "damaged bad", EMPTY),
        "another format": ("3 3 3 - 3 3", "damaged bad", NO_MCAP),
        "cut at the start": ("3 3 3 - 3 3", "cut short unchecked", FEW),
        "cut in the middle": ("3 3 0 - 3 0", "cut short unchecked", WITHIN),
        "cut at the end": ("3 3 0 - 0 0", "cut short unchecked", ALL_THERE),
        "cut between chunks": ("3 3 0 - 3 0", "cut short unchecked", NO_END),
        "cut in a chunk": ("3 3 0 - 3 0", "cut short unchecked", WITHIN),
        "no summary": ("3 3 0 - 0 0", "cut short unchecked", ALL_THERE),
        "no footer": ("3 3 0 - 0 0", "cut short unchecked", ALL_THERE),
        "chunk": ("3 3 3 - 3 3", "damaged bad", "its zstd data is damaged"),
        "head of a chunk": ("3 3 3 - 0 3", "damaged bad", HEAD),
        "message index": ("3 3 3 - 0 3", "damaged bad", INDEX),
        "data end": ("3 3 3 - 3 3", "damaged bad", f"data section: {BAD}"),
        "summary": ("3 3 3 - 0 3", "damaged bad", f"summary: {BAD}"),
        "footer": ("3 3 3 - 0 3", "damaged bad", "footer: it points outside of the file"),
    },
    "ROS 2": {
        "none": ("0 0 0 0 0 0", "whole ok", ""),
        "empty": ("3 3 3 3 3 3", "damaged bad", EMPTY),
        "another format": ("3 3 3 3 3 3", "damaged bad", NO_MCAP),
        "cut at the start": ("3 3 3 3 3 3", "cut short unchecked", FEW),
        "cut between chunks": ("3 3 0 0 3 0", "cut short unchecked", NO_END),
        "cut in a chunk": ("3 3 0 0 3 0", "cut short unchecked", WITHIN),
        "no summary": ("3 3 0 0 0 0", "cut short unchecked", ALL_THERE),
        "chunk": ("3 3 3 3 3 3", "damaged bad", "its zstd data is damaged"),
        "head of a chunk": ("3 3 3 3 0 3", "damaged bad", HEAD),
        "message index": ("3 3 3 3 0 3", "damaged bad", INDEX),
        "data end": ("3 3 3 3 3 3", "damaged bad", f"data section: {BAD}"),
        "summary": ("3 3 3 3 0 3", "damaged bad", f"summary: {BAD}"),
        "footer": ("3 3 3 3 0 3", "damaged bad", "footer: it points outside of the file"),
    },
    "ROS 2, no checksums": {
        "none": ("0 0 0 0 0 0", "whole absent", BARE),
        "cut between chunks": ("3 3 0 0 3 0", "cut short absent", NO_END),
        "cut in a chunk": ("3 3 0 0 3 0", "cut short absent", WITHIN),
    },
    "ROS 1": {
        "none": ("0 0 0 0 - 0", "whole", ""),
        "empty": ("3 3 3 3 - 3", "damaged", "rosbags cannot read it"),
        "another format": ("3 3 3 3 - 3", "damaged", "rosbags cannot read it"),
        "cut at the start": ("3 3 3 3 - 3", "damaged", "rosbags cannot read it"),
        "cut in the middle": ("3 3 3 3 - 3", "damaged", "rosbags cannot read it"),
        "cut at the end": ("3 3 3 3 - 3", "damaged", "rosbags cannot read it"),
    },
    "MP4": {
        "none": ("0 0 0 0 - 0", "whole", ""),
        "empty": ("3 3 3 3 - 3", "damaged", "FFmpeg cannot read it"),
        "another format": ("3 3 3 3 - 3", "damaged", "FFmpeg cannot read it"),
        "cut in the middle": ("3 3 3 3 - 3", "damaged", "cut short: the file ends at byte"),
        "cut at the end": ("3 3 0 0 - 0", "cut short", "the file ends at byte"),
    },
    "PNG": {
        "none": ("0 0 0 0 - 0", "whole", ""),
        "empty": ("3 3 3 3 - 3", "damaged", NO_PNG),
        "another format": ("3 3 3 3 - 3", "damaged", NO_PNG),
        "cut at the start": ("3 3 3 3 - 3", "damaged", NO_PNG),
        "cut in the middle": ("3 3 3 3 - 3", "damaged", "its PNG is cut short"),
        "cut at the end": ("3 3 3 3 - 3", "damaged", "its PNG is cut short"),
        "bit flip": ("3 3 3 3 - 3", "damaged", "its PNG is damaged"),
    },
    "CSV": {  # a text has no end and no checksum
        "none": ("0 0 0 0 - 0", "whole", ""),
        "empty": ("3 3 3 3 - 3", "damaged", "PyArrow cannot read it"),
        "another format": ("3 3 3 3 - 3", "damaged", "PyArrow cannot read it"),
        "cut in the middle": ("3 3 3 3 - 3", "damaged", "has 1 cell, but the first line has"),
        "cut at the end": ("0 0 0 0 - 0", "whole", ""),
        "bit flip": ("0 3 3 3 - 3", "damaged", "which is not a number"),
    },
    "Parquet": {
        "none": ("0 0 0 0 - 0", "whole", ""),
        "empty": ("3 3 3 3 - 3", "damaged", "PyArrow cannot read it"),
        "another format": ("3 3 3 3 - 3", "damaged", "PyArrow cannot read it"),
        "cut at the start": ("3 3 3 3 - 3", "damaged", "PyArrow cannot read it"),
        "cut in the middle": ("3 3 3 3 - 3", "damaged", "PyArrow cannot read it"),
        "cut at the end": ("3 3 3 3 - 3", "damaged", "PyArrow cannot read it"),
        "bit flip": ("3 3 3 3 - 3", "damaged", "PyArrow cannot read it"),
    },
    "npz": {
        "none": ("0 - 0 0 - 0", "", ""),
        "empty": ("3 - 3 3 - 3", "", "is not a file of NumPy arrays"),
        "another format": ("3 - 3 3 - 3", "", "is not a file of NumPy arrays"),
        "cut at the start": ("3 - 3 3 - 3", "", "is not a file of NumPy arrays"),
        "cut in the middle": ("3 - 3 3 - 3", "", "is not a file of NumPy arrays"),
        "cut at the end": ("3 - 3 3 - 3", "", "is not a file of NumPy arrays"),
        "bit flip": ("3 - 3 3 - 3", "", "is not a file of NumPy arrays"),
    },
}
NOT_MCAP = [name for name in FORMATS if name not in ("recording", "ROS 2", "ROS 2, no checksums")]


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from cdmisfa.cli import run

    folder = tmp_path_factory.mktemp("logs")
    record = ("record", "oscillatory", "--frames", "300", "--set", "record.chunk_size=1024", "-o")
    assert run([*record, str(folder / "rec")]) == 0
    size = {"height": 12, "width": 16, "encoding": "mono8", "big": 0, "step": 16}
    images = [cdr(**size, data=image.tobytes()) for image in pictures(COUNT)]  # type: ignore[arg-type]
    kind = MessageKind("sensor_msgs/msg/Image", "cdr")
    for name, crcs in (("cam.mcap", True), ("bare.mcap", False)):
        options = {"profile": "ros2", "enable_crcs": crcs, "enable_data_crcs": crcs}
        write_mcap(folder / name, kind, {"/cam": every(STEP, images)}, **options)
    write_pictures(folder / "png", COUNT)
    columns = {"a": np.arange(COUNT), "b": np.arange(COUNT) % 7}
    write_table(folder / "t.csv", columns)
    write_table(folder / "t.parquet", columns)
    np.savez(folder / "a.npz", a=np.random.default_rng(0).normal(size=(COUNT, 3)))
    return folder


def damaged(logs: Path, folder: Path, format: str, damage: str) -> tuple[Path, Path]:
    """A copy of a log with damage, and the file in it that has it."""
    name, inner = FORMATS[format]
    if format == "ROS 1" and not (logs / name).exists():
        from test_bags import ros1_bag

        ros1_bag(logs)
    if format == "MP4" and not (logs / name).exists():
        write_video(logs / name, pictures(COUNT), codec="libx264", pixels="yuv420p", fps=50)
    copy = shutil.copytree if inner else shutil.copy
    log = Path(copy(logs / name, folder / name))
    file = log / inner if inner else log
    data, chunk, end = file.read_bytes(), None, 0
    if file.suffix == ".mcap":
        with LogReader(file) as reader:
            chunk = reader.segments[-2]
        end = struct.unpack_from("<Q", data, len(data) - 28)[0]
    file.write_bytes(DAMAGES[damage](data, chunk, end))
    return log, file


def said(done: Outcome) -> str:
    """All that a command says of problems, as one line each."""
    if not done.out.startswith("{"):
        return re.sub("  +", ": ", done.out) + done.err  # of a table
    problems = [f"{problem['where']}: {problem['what']}" for problem in done.json["problems"]]
    return "\n".join([*problems, *done.json["notes"], done.err])


@pytest.mark.parametrize(
    ("format", "damage"), [(format, damage) for format in TABLE for damage in TABLE[format]]
)
def test_damage_has_its_exit_code_and_message(
    cdmisfa: Cdmisfa, logs: Path, tmp_path: Path, format: str, damage: str
) -> None:
    codes, state, words = TABLE[format][damage]
    log, file = damaged(logs, tmp_path, format, damage)
    rate = ("--rate", "50") if format in ("PNG", "CSV", "Parquet", "npz") else ()
    topic = ("--topic", "/cam_left") if format == "ROS 1" else ()
    options = {"learn": (*rate, *topic), "convert": (*rate, *topic), "view": rate}
    out = str(tmp_path / "out")
    for (command, line), code in zip(COMMANDS.items(), codes.split(), strict=True):
        if code == "-":
            continue
        line = line.replace("LOG", str(log)).replace("FILE", str(file)).replace("OUT", out)
        done = cdmisfa(*line.split(), *options.get(command, ()))
        assert done.code == int(code), (command, done.out, done.err)
        assert done.err.count("cdmisfa: ") == (done.code != 0 and not done.out), done.err
        if done.code or (words and command != "recover" and code == codes[-1]):
            assert any(word in said(done) for word in words.split("|")), (command, said(done))
            assert file.name in said(done)
        if command == "verify":
            seen = done.json["files"][0]
            assert (seen["state"] if not state.endswith(seen["crc"]) else
                    f"{seen['state']} {seen['crc']}") == state  # fmt: skip
    if (whole := tmp_path / "out.mcap").exists():
        with LogReader(whole) as reader:
            assert sum(len(table) for _, table in reader.tables()) > 0
            assert (reader.complete, reader.warnings) == (True, [])


@pytest.mark.parametrize("format", NOT_MCAP)
def test_only_mcap_is_recovered(cdmisfa: Cdmisfa, logs: Path, tmp_path: Path, format: str) -> None:
    _, file = damaged(logs, tmp_path, format, "none")
    done = cdmisfa("recover", file, "-o", tmp_path / "out.mcap")
    assert (done.code, done.err.count("\n"), file.name in done.err) == (2, 1, True)


def test_recover_names_what_was_lost_and_what_was_repaired(
    cdmisfa: Cdmisfa, logs: Path, tmp_path: Path
) -> None:
    for damage, code, words in (
        ("message index", 0, "rebuilt from its messages"),
        ("head of a chunk", 0, "restored from the summary"),
        ("data end", 3, "all messages are readable, metadata may be wrong"),
    ):
        _, file = damaged(logs, tmp_path, "ROS 2", damage)
        done = cdmisfa("recover", file, "-o", tmp_path / "out.mcap", "--force")
        assert (done.code, words in done.out + done.err) == (code, True), done


def broken_among_whole(folder: Path) -> tuple[Path, Path, Path]:
    """Two logs of one topic each, and an empty one between them."""
    one, bad, two = (folder / f"{name}.mcap" for name in ("one", "bad", "two"))
    write_cameras(one, {"/one": (COUNT, 20)})
    write_cameras(two, {"/two": (COUNT, 20)})
    bad.touch()
    return one, bad, two


def test_one_broken_log_does_not_hide_the_others(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    logs = broken_among_whole(tmp_path)
    for command in ("info", "verify"):
        done = cdmisfa(command, *logs)
        assert (done.code, str(logs[1]) in done.out) == (3, True)
    document = cdmisfa("info", *logs, "--json").json
    assert [file["path"] for file in document["files"]] == [str(log) for log in logs]
    assert [file["state"] for file in document["files"]] == ["unchecked", "damaged", "unchecked"]
    assert [c["topic"] for c in document["files"][2]["channels"]] == ["/two"]
    assert document["problems"] == [{"where": str(logs[1]), "what": EMPTY}]


@pytest.mark.parametrize("topics", [(), ("/one", "/bad", "/two")])
@pytest.mark.parametrize("use", ["learn", "convert"])
def test_what_cannot_be_read_is_left_out_of_the_rest(
    cdmisfa: Cdmisfa, tmp_path: Path, use: str, topics: tuple[str, ...]
) -> None:
    one, bad, two = broken_among_whole(tmp_path)
    chosen = [word for topic in topics for word in ("--topic", topic)]
    how = (*chosen, "-o", tmp_path / "out", "--json")
    how += ("--set", "learner.tau=10", "--no-rerun") if use == "learn" else ()
    assert cdmisfa(use, one, bad, two, *how).code == 3  # and there is nothing
    assert not (tmp_path / "out").exists()
    done = cdmisfa(use, one, bad, two, *how, "--skip-damaged")
    assert done.code == 3
    assert f"warning: {bad}: {EMPTY}: this log is skipped\n" in done.err
    streams = "streams" if use == "learn" else "views"
    assert [own.get("stream", own.get("name")) for own in done.json[streams]] == ["one", "two"]
