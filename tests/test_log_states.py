"""A log in one state gets one word, and one exit code, from every command."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import pytest
from camera_files import write_cameras
from conftest import Cdmisfa

from recorder.mcap.reader import LogReader

COUNT = 120
CUT, NO_CHECKSUMS = "cut short: ", "it has no checksums, nothing vouches for its bytes"

STATES = {
    # the state, its checksums, and what is said of it
    "whole": ("whole", "ok", ""),
    "checksums of chunks alone": ("whole", "ok", ""),
    "no checksums": ("whole", "absent", NO_CHECKSUMS),
    "cut in a chunk": ("cut short", "unchecked", CUT),
    "cut between chunks": ("cut short", "unchecked", CUT),
    "cut without checksums": ("cut short", "absent", CUT),
    "cut in a chunk without checksums": ("cut short", "absent", CUT),
    "no summary": ("cut short", "unchecked", CUT),
    "cut before any message": ("cut short", "unchecked", CUT),
    "damaged chunk": ("damaged", "bad", "its CRC does not match: damaged"),
    "damaged data end": ("damaged", "bad", "data section: its CRC does not match: damaged"),
    "damaged summary": ("damaged", "bad", "summary: its CRC does not match: damaged"),
    "empty": ("damaged", "bad", "empty, nothing was written"),
    "no log": ("damaged", "bad", "not an MCAP file"),
}
UNREADABLE = ("empty", "no log")
NOTHING = "cut before any message"
"""State in which there is nothing that the others could use."""

USES = {
    "learn": "learn LOG --set learner.tau=10 --max-iterations 1",
    "convert": "convert LOG -o OUT",
    "view": "view LOG --save OUT.rrd",
    "export": "export LOG --to images -o OUT",
}


def flipped(data: bytes, at: int) -> bytes:
    return data[:at] + bytes([data[at] ^ 0xFF]) + data[at + 1 :]


def in_state(path: Path, state: str) -> Path:
    """A log of images in one of `STATES`."""
    write_cameras(path, {"/cam": (COUNT, 20)}, enable_crcs=False, enable_data_crcs=False)
    without = path.read_bytes()
    write_cameras(path, {"/cam": (COUNT, 20)}, enable_crcs=True, enable_data_crcs=True)
    data = path.read_bytes()
    write_cameras(path, {"/cam": (COUNT, 20)}, enable_crcs=True, enable_data_crcs=False)
    chunks_alone = path.read_bytes()
    path.write_bytes(data)
    with LogReader(path) as reader:
        first, *_, last = reader.segments
    summary = struct.unpack_from("<Q", data, len(data) - 28)[0]
    path.write_bytes(
        {
            "whole": data,
            "checksums of chunks alone": chunks_alone,
            "no checksums": without,
            "cut in a chunk": data[: last.data_offset + last.stored // 2],
            "cut between chunks": data[: last.offset],
            "cut without checksums": without[: last.offset],
            "cut in a chunk without checksums": without[: last.data_offset + 99],
            "no summary": data[:summary],
            "cut before any message": data[: first.offset + 20],
            "damaged chunk": flipped(data, last.data_offset + last.stored // 2),
            "damaged data end": flipped(data, summary - 1),
            "damaged summary": flipped(data, summary + 30),
            "empty": b"",
            "no log": b"hello" * 99,
        }[state]
    )
    return path


@pytest.mark.parametrize("state", STATES)
def test_commands_that_judge_a_log_agree(cdmisfa: Cdmisfa, tmp_path: Path, state: str) -> None:
    path = in_state(tmp_path / "log.mcap", state)
    word, crc, said = STATES[state]
    code = 0 if word == "whole" else 3
    done = cdmisfa("verify", path)
    assert (done.code, f"{path}: {word}\n" in done.out) == (code, True)
    assert said in re.sub("  +", ": ", done.out)  # of a table
    done = cdmisfa("verify", path, "--json")
    assert (done.code, done.json["ok"], done.json["state"]) == (code, word == "whole", word)
    assert [(file["crc"], file["state"]) for file in done.json["files"]] == [(crc, word)]
    done = cdmisfa("info", path)
    assert (done.code, said in done.out + done.err) == (code, True)
    if state not in UNREADABLE:  # images in messages are decoded by verify alone
        seen = word.replace("whole", "unchecked")
        said = word.replace("whole", "contents unchecked")
        assert f"{path}: foreign, {said}, checksums {crc}\n" in done.out
        done = cdmisfa("info", path, "--json")
        assert (done.code, done.json["state"], done.json["crc"]) == (code, seen, crc)


def broken_among_whole(folder: Path) -> tuple[Path, Path, Path]:
    """Two logs of one topic each, and one between them that is none."""
    one, two = folder / "one.mcap", folder / "two.mcap"
    write_cameras(one, {"/one": (COUNT, 20)})
    write_cameras(two, {"/two": (COUNT, 20)})
    return one, in_state(folder / "bad.mcap", "empty"), two


def test_one_broken_log_does_not_hide_the_others(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    logs = broken_among_whole(tmp_path)
    for command in ("info", "verify"):
        done = cdmisfa(command, *logs)
        assert (done.code, str(logs[1]) in done.out) == (3, True)
    assert "/two" in cdmisfa("info", *logs).out
    document = cdmisfa("info", *logs, "--json").json
    assert [file["path"] for file in document["files"]] == [str(log) for log in logs]
    assert [file["state"] for file in document["files"]] == ["unchecked", "damaged", "unchecked"]
    assert [c["topic"] for c in document["files"][2]["channels"]] == ["/two"]
    assert document["problems"] == [{"where": str(logs[1]), "what": "empty, nothing was written"}]


@pytest.mark.parametrize("topics", [(), ("/one", "/bad", "/two")])
@pytest.mark.parametrize("use", ["learn", "convert"])
def test_what_cannot_be_read_is_left_out_of_what_is_salvaged(
    cdmisfa: Cdmisfa, tmp_path: Path, use: str, topics: tuple[str, ...]
) -> None:
    one, bad, two = broken_among_whole(tmp_path)
    chosen = [word for topic in topics for word in ("--topic", topic)]
    how = (*chosen, "-o", tmp_path / "out", "--json")
    how += ("--set", "learner.tau=10", "--no-rerun") if use == "learn" else ()
    assert cdmisfa(use, one, bad, two, *how).code == 3  # and there is nothing
    assert not (tmp_path / "out").exists()
    done = cdmisfa(use, one, bad, two, *how, "--salvage")
    assert done.code == 3
    assert f"warning: {bad}: empty, nothing was written: this log is left out\n" in done.err
    streams = "streams" if use == "learn" else "views"
    assert [own.get("stream", own.get("name")) for own in done.json[streams]] == ["one", "two"]


@pytest.mark.parametrize("use", USES)
@pytest.mark.parametrize("state", STATES)
def test_commands_that_use_a_log_say_the_same(
    cdmisfa: Cdmisfa, tmp_path: Path, state: str, use: str
) -> None:
    """What is damaged is not used; of what is cut short all that is there, which is said."""
    path = in_state(tmp_path / "log.mcap", state)
    word, crc, said = STATES[state]
    words = USES[use].replace("LOG", str(path)).replace("OUT", str(tmp_path / "out"))
    done = cdmisfa(*words.split())
    assert done.code == (3 if word == "damaged" or state == NOTHING else 0), done.err
    assert said in done.err
    assert (NO_CHECKSUMS in done.err) == (crc == "absent")
    if said and done.code == 0:
        assert f"warning: {path}: {said}" in done.err


@pytest.mark.parametrize("state", STATES)
def test_what_can_be_read_is_recovered_to_a_whole_log(
    cdmisfa: Cdmisfa, tmp_path: Path, state: str
) -> None:
    path, out = in_state(tmp_path / "log.mcap", state), tmp_path / "out.mcap"
    lost = state.startswith("cut") or state in ("damaged chunk", "damaged data end", *UNREADABLE)
    assert cdmisfa("recover", path, "-o", out).code == (3 if lost else 0)
    if state not in (*UNREADABLE, NOTHING):
        assert cdmisfa("verify", out, "--json").json["state"] == "whole"
