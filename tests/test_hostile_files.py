"""What is read beside the logs is never endless, never huge, and refused in one line."""

from __future__ import annotations

import json
import math
import os
import shutil
import socket
import zipfile
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_files import write_pictures
from conftest import Cdmisfa
from test_modules import with_width

from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError
from cdmisfa.core.signals import SCHEMA_VERSION
from cdmisfa.experiments.results import results
from cdmisfa.experiments.store import ROWS, read_trial_rows
from cdmisfa.modules import Module
from recorder.log.logfile import LogFile
from recorder.mcap.reader import LogReader
from replay.integrity.info import describe
from replay.logs.formats.images import MAX_IMAGE, image_files
from replay.runs.folders import REQUEST, RUN_METADATA, read_run_json
from replay.runs.log import header_in, read_header
from replay.runs.modules import load_modules, save_modules
from replay.storage.arrays import stored_arrays


def test_a_huge_picture_is_refused_unread(tmp_path: Path) -> None:
    write_pictures(tmp_path / "pictures", 3)
    with (tmp_path / "pictures" / "2.png").open("r+b") as file:
        file.truncate(MAX_IMAGE + 1)
    with pytest.raises(CdmisfaError, match=r"2\.png: \d+ bytes.*limit"):
        image_files(tmp_path / "pictures")


@pytest.mark.parametrize(
    ("make", "why"),
    [
        (os.mkfifo, "not a regular file"),
        (lambda path: path.symlink_to("/dev/zero"), "not a regular file"),
        (lambda path: (path.touch(), os.truncate(path, 1 << 33)), "above the limit"),
    ],
)
def test_no_device_and_no_huge_file_is_read_of_a_run(
    tmp_path: Path, make: Callable[[Path], object], why: str
) -> None:
    for name in ("run.json", "modules.npz"):
        make(tmp_path / name)
    assert read_run_json(tmp_path) == {}
    with pytest.raises(UsageError, match=why):
        load_modules(tmp_path)


def test_facts_of_a_run_that_make_no_sense_are_left_out_or_damage(
    cdmisfa: Cdmisfa, tmp_path: Path, oscillatory_run: Path
) -> None:
    run = shutil.copytree(oscillatory_run, tmp_path / "run")
    facts = read_run_json(run)
    result = {**facts["result"], "held_out": {"frames": [math.inf, 9], "modules": []}}
    text = json.dumps({**facts, "result": result}).replace("Infinity", "1e999")
    (run / "run.json").write_text(text)
    assert cdmisfa("info", run, "--json").json["held_out"] is None
    with LogReader(run / "run.mcap") as reader:
        record = next(r for r in reader.metadata if r.name == RUN_METADATA)
        record.metadata["manifest"] = "7"
        with pytest.raises(LogDamagedError, match="is broken"):
            header_in(reader)


def test_compressed_modules_are_refused(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "modules.npz", module1_phi=np.zeros(10**6))
    with pytest.raises(LogDamagedError, match="compressed"):
        load_modules(tmp_path)


@pytest.mark.parametrize("shape", ["(10**9, 10**9)", "(4000000000000,)", "(-1,)", "(" * 3000])
def test_an_array_that_says_it_is_larger_than_its_file_is_refused(
    tmp_path: Path, shape: str
) -> None:
    shape = shape.replace("10**9", str(10**9))
    head = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    array = b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head
    with zipfile.ZipFile(tmp_path / "modules.npz", "w") as archive:
        archive.writestr("module1_index.npy", array)
    with pytest.raises(LogDamagedError, match=r"modules\.npz"):
        load_modules(tmp_path)


def damaged(whole: bytes, rng: np.random.Generator) -> bytes:
    """A file that is cut, or of which something was flipped, zeroed, doubled or left out."""
    at, n = sorted(rng.integers(0, len(whole) + 1, 2))
    data = bytearray(whole)
    match rng.integers(6):
        case 0:
            return bytes(data[:at])
        case 1:
            data[at : at + 8] = bytes(len(data[at : at + 8]))
        case 2:
            data[at:at] = data[at:n]
        case 3:
            del data[at : at + (n - at) % 64 + 1]
        case _:
            for place in rng.integers(0, len(data) * 8, rng.integers(1, 4)):
                data[place // 8] ^= 1 << place % 8
    return bytes(data)


def stated(module: Module) -> list[Any]:
    """All that a module states, with the bytes of arrays."""
    values = (getattr(module, field.name) for field in fields(module))
    return [value.tobytes() if isinstance(value, np.ndarray) else value for value in values]


def test_damaged_modules_are_the_same_or_an_error(tmp_path: Path) -> None:
    path = tmp_path / "modules.npz"
    save_modules(path, [replace(with_width(2), index=index) for index in (1, 2, 3)])
    whole, rng = path.read_bytes(), np.random.default_rng(1)
    first = [stated(module) for module in load_modules(path)]
    loaded = 0
    for number in range(1500):
        path.write_bytes(damaged(whole, rng))
        try:
            result = load_modules(path)
        except LogDamagedError:
            continue
        loaded += 1
        assert [stated(module) for module in result] == first, number
    assert loaded < 750


@pytest.mark.parametrize(
    "listed",
    [
        *([["a", "<f8", shape]] for shape in ([10**9, 10**9], [-1], [0.5], ["x"], [1] * 99, [1])),
        *([["a", kind, [1]]] for kind in ("|O", [["b", "|O"]], [[]], "(" * 3000, None)),
        *([3], 3),
    ],
)
def test_arrays_that_are_not_in_their_bytes_are_refused(listed: object) -> None:
    with pytest.raises(ValueError):  # noqa: PT011 - whichever of its checks refuses them
        stored_arrays(listed, bytes(16))


DEEP = "[" * 100_000


def test_deep_json_is_damage(tmp_path: Path) -> None:
    run = tmp_path / "run"
    run.mkdir()
    with LogFile(run / "run.mcap") as log:
        values = {"schema": str(SCHEMA_VERSION), "spec": DEEP, "manifest": DEEP}
        log.add_metadata(RUN_METADATA, values)
    with pytest.raises(LogDamagedError, match=r"run\.mcap"):
        read_header(run)
    describe(run / "run.mcap")
    (tmp_path / REQUEST).write_text(DEEP)
    with pytest.raises(LogDamagedError, match=REQUEST):
        results(tmp_path)
    (tmp_path / ROWS).write_text(DEEP + "\n")
    with pytest.raises(LogDamagedError, match=ROWS):
        list(read_trial_rows(tmp_path))


WAYS = ("info", "verify", "learn", "convert -o out", "export -o out --to images")
"""Commands that take any log."""


def make_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(str(path))


NO_FILES = {
    "device": lambda path: path.symlink_to("/dev/zero"),
    "fifo": os.mkfifo,
    "socket": make_socket,
    "broken link": lambda path: path.symlink_to("nothing"),
    "link to itself": lambda path: path.symlink_to(path),
}


@pytest.mark.parametrize("name", ["a.mcap", "a.mp4", "a.csv", "a"])
@pytest.mark.parametrize("kind", NO_FILES)
def test_what_is_no_file_is_refused_by_every_command(
    cdmisfa: Cdmisfa, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    NO_FILES[kind](Path(name))
    for way in WAYS:
        command, *options = way.split()
        done = cdmisfa(command, name, *options)
        assert (done.code, done.err.count("\n"), name in done.err) == (2, 1, True), (way, done.err)
