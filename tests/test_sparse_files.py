"""Files of a terabyte that are all holes: each command refuses them in one line, unread."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from bombs import database, ros1_chunks, table_of_pictures
from camera_files import pictures, write_cameras, write_pictures, write_video
from conftest import Cdmisfa
from message_files import write_table

TERABYTE = 1 << 40


def a_log(folder: Path) -> Path:
    write_cameras(folder / "a.mcap", {"/cam": (60, 100)})
    return folder / "a.mcap"


def a_part(folder: Path) -> Path:
    write_cameras(folder / "a.mcap", {"/cam": (60, 100)})
    shutil.copy(folder / "a.mcap", folder / "b.mcap")
    return folder / "b.mcap"


def a_video(ending: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        write_video(folder / f"a.{ending}", pictures(45), codec="mpeg4", pixels="yuv420p")
        return folder / f"a.{ending}"

    return write


def a_table(ending: str) -> Callable[[Path], Path]:
    return lambda folder: write_table(folder / f"a.{ending}", {"a": list(range(99))})


def a_picture(folder: Path) -> Path:
    write_pictures(folder / "pictures", 3)
    return folder / "pictures" / "1.png"


def a_database(folder: Path) -> Path:
    database(folder / "a.db3", b"message")
    return folder / "a.db3"


def of_a_dataset(name: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        table_of_pictures(folder / "set", 100)
        return folder / "set" / name

    return write


CAMERAS: dict[str, tuple[Callable[[Path], Path], Callable[[Path], Path]]] = {
    # what is all holes, and what is named in a command, given that
    "a log": (a_log, lambda file: file),
    "one of two logs": (a_part, lambda file: file.parent),
    **{f"{e} video": (a_video(e), lambda file: file) for e in ("mp4", "mkv", "avi")},
    **{f"{e} table": (a_table(e), lambda file: file) for e in ("csv", "parquet")},
    "a picture": (a_picture, lambda file: file.parent),
    "ROS 1 bag": (ros1_chunks(100), lambda file: file),
    "ROS 2 bag": (a_database, lambda file: file),
    "document of a dataset": (of_a_dataset("meta/info.json"), lambda file: file.parents[1]),
}


@pytest.mark.parametrize("kind", CAMERAS)
def test_camera_logs(tmp_path: Path, cdmisfa: Cdmisfa, kind: str) -> None:
    write, named = CAMERAS[kind]
    file = write(tmp_path)
    os.truncate(file, TERABYTE)
    for words in ("info", "verify", "learn --rate 10 -o out", "convert --rate 10 -o out --salvage"):
        command, *options = words.replace("out", str(tmp_path / "out")).split()
        failed = cdmisfa(command, named(file), *options)
        assert (failed.code, failed.err.count("\n")) == (2, 1), (words, failed)
        assert f"{file}: {TERABYTE} bytes, " in failed.err
        assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["x1.mcap", "notes"])
def test_recordings(
    tmp_path: Path, cdmisfa: Cdmisfa, oscillatory_recording: Path, name: str
) -> None:
    shutil.copytree(oscillatory_recording, tmp_path / "rec")
    (tmp_path / "rec" / name).touch()
    os.truncate(tmp_path / "rec" / name, TERABYTE)
    for words in ("info", "verify", "learn -o out --max-iterations 2"):
        command, *options = words.replace("out", str(tmp_path / "out")).split()
        done = cdmisfa(command, tmp_path / "rec", *options)
        assert done.code == (2 if name == "x1.mcap" else 0), done


@pytest.mark.parametrize(
    ("name", "words", "code"),
    [
        ("modules.npz", "verify RUN", 3),
        ("modules.npz", "view RUN --save out.rrd", 2),
        ("run.json", "verify RUN", 3),
        ("run.mcap", "verify RUN", 2),
        ("run.mcap", "at RUN 5", 2),
        ("run.mcap", "export RUN -o out.csv", 2),
        ("run.mcap", "recover RUN/run.mcap -o out.mcap", 2),
        ("other.rrd", "view RUN/other.rrd --screenshot out.png", 2),
    ],
)
def test_runs(
    tmp_path: Path, cdmisfa: Cdmisfa, oscillatory_run: Path, name: str, words: str, code: int
) -> None:
    shutil.copytree(oscillatory_run, tmp_path / "run")
    (tmp_path / "run" / name).write_bytes(b"x") if name == "other.rrd" else None
    os.truncate(tmp_path / "run" / name, TERABYTE)
    run, out = str(tmp_path / "run"), str(tmp_path / "out")
    ended = cdmisfa(*words.replace("RUN", run).replace("out", out).split())
    assert ended.code == code, ended
    assert name in ended.out + ended.err


def test_holes_of_a_small_file_are_damage(tmp_path: Path, cdmisfa: Cdmisfa) -> None:
    """What is small enough to be read to its end is looked at, holes or not."""
    file = a_log(tmp_path)
    os.truncate(file, 3 << 30)
    assert cdmisfa("info", file).code == 3
