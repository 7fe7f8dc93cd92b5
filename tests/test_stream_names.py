"""A stream has one name, whatever the way it came, so that modules of one know the other."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from camera_files import START_MS, pictures, write_images
from conftest import Cdmisfa
from hypothesis import given
from hypothesis import strategies as st

from cdmisfa.core.names import stream_name, stream_names

TOPICS = ("/camera/left/image_raw", "/camera/right é/image_raw")
NAMES = ("camera_left_image_raw", "camera_right_e_image_raw")
BOTH = ("--topic", TOPICS[0], "--topic", TOPICS[1])
QUICK = ("--max-iterations", "3", "--no-rerun", "--set", "learner.tau=10")


def write_log(folder: Path) -> Path:
    images = [[(START_MS + 20 * i, p) for i, p in enumerate(pictures(50, s))] for s in range(2)]
    return write_images(folder / "robot.mcap", dict(zip(TOPICS, images, strict=True)))


def recorded(cdmisfa: Cdmisfa, folder: Path) -> Path:
    log = write_log(folder)
    assert cdmisfa("convert", log, *BOTH, "-o", folder / "rec").code == 0
    return folder / "rec"


def exported(cdmisfa: Cdmisfa, folder: Path, form: str) -> Path:
    done = cdmisfa("export", recorded(cdmisfa, folder), "--to", form, "-o", folder / form)
    assert done.code == 0, done.err
    return folder / form


def each(folder: Path) -> list[Path]:
    return sorted(folder.iterdir())


WAYS: dict[str, Callable[[Cdmisfa, Path], list[object]]] = {
    "log": lambda run, at: [write_log(at), *BOTH],
    "pattern of topics": lambda run, at: [write_log(at), "--topic", "/camera/*"],
    "recording": lambda run, at: [recorded(run, at)],
    "files of a recording": lambda run, at: each(recorded(run, at)),
    "views as logs": lambda run, at: [*each(recorded(run, at)), "--size", "8x6"],
    "folders of pictures": lambda run, at: [*each(exported(run, at, "images")), "--rate", "50"],
    "videos": lambda run, at: each(exported(run, at, "mp4")),
    "dataset": lambda run, at: [exported(run, at, "lerobot"), "--topic", "observation.images.*"],
}


@pytest.mark.parametrize("way", WAYS)
def test_what_is_learned_from_has_one_name(cdmisfa: Cdmisfa, tmp_path: Path, way: str) -> None:
    done = cdmisfa("learn", *WAYS[way](cdmisfa, tmp_path), *QUICK, "-o", tmp_path / "run", "--json")
    assert done.code == 0, done.err
    assert done.json["undecided"] == list(NAMES)
    assert json.loads((tmp_path / "run" / "run.json").read_text())["streams"] == list(NAMES)


@pytest.mark.parametrize(
    ("said", "name"),
    [
        ("/camera/left/image_raw", "camera_left_image_raw"),
        ("/view/left", "left"),
        ("observation.images.left", "left"),
        ("observation.state", "observation.state"),
        ("view_left", "view_left"),
        ("../../etc", "etc"),
        (".hidden", "hidden"),
        ("é ü", "e_u"),
        ("左", "左"),
        ("/view/", "view"),
        ("", "stream"),
        ("\x1b[31m/cam", "31m_cam"),
        ("x" * 300, "x" * 64),
    ],
)
def test_a_name_is_one_of_a_file(said: str, name: str) -> None:
    assert stream_name(said) == name == stream_name(name)


@given(st.lists(st.text(), max_size=6))
def test_names_are_distinct_and_stay_as_they_are(said: list[str]) -> None:
    names = stream_names(said)
    assert len(set(names)) == len(names) == len(said)
    assert all(stream_name(name) == name for name in map(stream_name, said))
    assert not any("/" in name or name.startswith(".") or not name for name in names)
