"""Commands warn about a log that is a copy of another, with both names."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import pytest
from camera_files import START_MS, pictures, write_cameras, write_images
from conftest import Cdmisfa

COUNT = 60
LEARN = ("--set", "learner.tau=10", "--max-iterations", "1")


def byte_copy(folder: Path) -> Sequence[Path]:
    one, two = folder / "one.mcap", folder / "two.mcap"
    write_cameras(one, {"/cam": (COUNT, 20)})
    shutil.copy(one, two)
    return one, two


def written_otherwise(folder: Path) -> Sequence[Path]:
    one, two = folder / "one.mcap", folder / "two.mcap"
    write_cameras(one, {"/cam": (COUNT, 20)})
    images = enumerate(pictures(COUNT))
    write_images(two, {"/other": [(START_MS + i * 20, image) for i, image in images]}, "x")
    return one, two


MAKE = (byte_copy, written_otherwise)


@pytest.mark.parametrize("make", MAKE)
@pytest.mark.parametrize("command", ["learn", "convert"])
def test_a_copy_is_told_with_both_names(
    cdmisfa: Cdmisfa, tmp_path: Path, command: str, make: type
) -> None:
    one, two, *how = make(tmp_path)
    out = ("-o", tmp_path / "out", *(LEARN if command == "learn" else ()))
    done = cdmisfa(command, one, two, *how, *out)
    assert done.code == 0, done.err
    (line,) = [line for line in done.err.splitlines() if "as a copy does" in line]
    assert line.startswith(f"warning: {two}: ")
    assert f" of {one}, " in line


def test_cameras_that_differ_are_no_copies(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    """Though they begin and end alike, or are topics of one log."""
    one, two = tmp_path / "one.mcap", tmp_path / "two.mcap"
    write_cameras(one, {"/cam": (COUNT, 20)})
    images = [(START_MS + i * 20, image) for i, image in enumerate(pictures(COUNT))]
    for i in range(20, 40):
        images[i] = (images[i][0], 255 - images[i][1])
    write_images(two, {"/cam": images})
    done = cdmisfa("learn", one, two, *LEARN)
    assert (done.code, "copy" in done.err) == (0, False)


@pytest.mark.parametrize("align", [(), ("--align", "time")])
def test_a_copy_among_parts_is_named_as_the_cause(
    cdmisfa: Cdmisfa, tmp_path: Path, align: tuple[str, ...]
) -> None:
    parts = [tmp_path / f"part-{i}.mcap" for i in range(3)]
    for i, part in enumerate(parts):
        images = list(pictures(3 * COUNT))[i * COUNT : (i + 1) * COUNT]
        start = START_MS + i * COUNT * 20
        write_images(part, {"/cam": [(start + k * 20, image) for k, image in enumerate(images)]})
    assert cdmisfa("learn", *parts, *LEARN).code == 0
    copy = Path(shutil.copy(parts[1], tmp_path / "again.mcap"))
    done = cdmisfa("learn", *parts, copy, *align, *LEARN)
    assert (done.code, done.err.count("\n")) == (2, 1)
    said = f"{copy}: /cam shows the same as /cam of {parts[1]}, as a copy does: leave one out"
    assert done.err == f"cdmisfa: {said}\n"
