"""What is written takes only names that are free, a file's, or its own kind's."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import Cdmisfa
from test_cli import assert_one_line

from cdmisfa.experiments.documents import write_json
from recorder.recording import record_scene
from recorder.world.oscillatory import OscillatoryConfig


def _socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as bound:
        bound.bind(str(path))


SPECIAL: dict[str, Callable[[Path], None]] = {
    "link to a device": lambda path: path.symlink_to("/dev/null"),
    "pipe": os.mkfifo,
    "socket": _socket,
}


def looks(path: Path) -> tuple[int, int]:
    return os.lstat(path).st_mode, os.lstat(path).st_ino


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, oscillatory_run: Path) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("made")
    record_scene("oscillatory", folder / "rec", frames=60)
    return {"rec": folder / "rec", "run": oscillatory_run}


@pytest.mark.parametrize(
    "words",
    [
        "export RUN -o OUT.csv",
        "view RUN --save OUT.rrd",
        "recover REC/x1.mcap -o OUT.mcap",
        "record oscillatory --frames 20 -o OUT",
        "learn oscillatory --no-rerun --max-iterations 2 -o OUT",
    ],
)
@pytest.mark.parametrize("kind", SPECIAL)
def test_force_replaces_files_only(
    cdmisfa: Cdmisfa, made: dict[str, Path], tmp_path: Path, words: str, kind: str
) -> None:
    out = next(word for word in words.split() if word.startswith("OUT"))
    SPECIAL[kind](tmp_path / out)
    before = looks(tmp_path / out)
    places = {"RUN": str(made["run"]), "REC": str(made["rec"]), "OUT": str(tmp_path / "OUT")}
    for name, place in places.items():
        words = words.replace(name, place)
    assert_one_line(cdmisfa(*words.split(), "--force"), 2, "is a device, pipe or socket")
    assert looks(tmp_path / out) == before
    assert os.listdir(tmp_path) == [out]


OVERLAP = """
import sys
from pathlib import Path
from recorder.log.files import atomic_write
with atomic_write(Path(sys.argv[1])) as partial:
    partial.write_text(sys.argv[2])
    print(flush=True)
    input()
"""


def test_two_processes_write_one_name(tmp_path: Path) -> None:
    """Each writes a temporary file; the last one to end replaces the file."""
    path = tmp_path / "a.csv"

    def writer(text: str) -> subprocess.Popen[str]:
        words = [sys.executable, "-c", OVERLAP, str(path), text]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        process = subprocess.Popen(words, text=True, **pipes)  # type: ignore[call-overload]
        assert process.stdout.readline()
        return process  # type: ignore[no-any-return]

    writers = [writer("one"), writer("two")]
    for process in writers:
        process.communicate("\n")
        assert process.returncode == 0
    assert path.read_text() == "two"
    killed = writer("three")
    killed.kill()
    killed.communicate()
    assert len(list(tmp_path.iterdir())) == 2
    write_json(path, {})
    assert list(tmp_path.iterdir()) == [path]


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_force_leaves_nothing_of_another_recording(tmp_path: Path) -> None:
    made = tmp_path / "a"
    record_scene("oscillatory", made, frames=60)
    (made / "x9.mcap").write_bytes((made / "x3.mcap").read_bytes())
    (made / "x3.mcap").rename(made / "x3.mcap.partial")
    (made / "notes.mcap").write_text("mine" * 20)
    other = OscillatoryConfig(seed=3)
    record_scene("oscillatory", made, other, frames=60, views=["x1"], force=True)
    assert names(made) == {"x1.mcap", "notes.mcap"}


def test_a_run_and_a_recording_do_not_share_a_folder(
    cdmisfa: Cdmisfa, made: dict[str, Path], tmp_path: Path
) -> None:
    before = names(made["rec"]), names(made["run"])
    learn = ("learn", "oscillatory", "--no-rerun", "--max-iterations", 2, "-o", made["rec"])
    assert_one_line(cdmisfa(*learn, "--force"), 2, "x1.mcap does not belong to a run")
    record = ("record", "oscillatory", "--frames", 20, "-o")
    for word in ("--force", "--resume"):
        assert_one_line(cdmisfa(*record, made["run"], word), 2, "does not belong to a recording")
    assert (names(made["rec"]), names(made["run"])) == before
    (tmp_path / "letter.txt").write_text("mine")
    assert_one_line(cdmisfa(*record, tmp_path, "--resume"), 2, "has no recording to resume")
    assert names(tmp_path) == {"letter.txt"}


@pytest.mark.parametrize(
    ("words", "leftover"),
    [
        ("record oscillatory --frames 20", "recording.json.4194305.partial"),
        ("learn oscillatory --max-iterations 2 --no-rerun", "run.mcap.partial"),
    ],
)
def test_a_command_that_was_killed_before_its_first_byte_is_repeated(
    cdmisfa: Cdmisfa, tmp_path: Path, words: str, leftover: str
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / leftover).touch()
    assert cdmisfa(*words.split(), "-o", out).code == 0
    assert not list(out.glob("*.partial"))
    done = cdmisfa(*words.split(), "-o", out)
    assert (done.code, "exists" in done.err) == (2, True)
