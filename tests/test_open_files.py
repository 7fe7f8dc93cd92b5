"""However many parts a recording has, only a few of their files are open at once."""

from __future__ import annotations

import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from cdmisfa.core.errors import LogDamagedError
from recorder.log.split import Split
from recorder.recording import record_scene
from replay.recordings.source import RecordedSource
from replay.storage import store
from replay.storage.store import FileStore

LIMIT = 64
FRAMES = 1250


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("many") / "rec"
    record_scene("oscillatory", folder, frames=FRAMES, split=Split(seconds=1))
    assert len(list(folder.iterdir())) > LIMIT
    return folder


def test_more_parts_than_files_may_be_open_are_read(parts: Path) -> None:
    script = (
        "import sys\n"
        "from replay.recordings.source import RecordedSource\n"
        "from replay.integrity.verify import check_log\n"
        "source = RecordedSource(sys.argv[1])\n"
        f"for _ in range({FRAMES // 50}): source.take(1, 50)\n"
        "source.describe()\n"
        "assert check_log(sys.argv[1]).ok\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, str(parts)],
        capture_output=True,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (LIMIT, LIMIT)),
    )
    assert done.returncode == 0, done.stderr[-600:]


def test_closed_parts_are_opened_again_with_the_same_frames(
    parts: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = RecordedSource(parts).take(1, FRAMES).frames
    monkeypatch.setattr(store, "OPEN_FILES", 2)
    source = RecordedSource(parts)
    read = [source.take(1, 50).frames for _ in range(FRAMES // 50)]
    assert np.array_equal(np.concatenate(read), whole)


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    monkeypatch.setattr(store, "OPEN_FILES", 1)
    files = [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    for path in files:
        path.write_bytes(path.name.encode())
    return files


def test_a_file_that_is_being_written_stays_open(files: list[Path]) -> None:
    """Its size and time change, so another in its place could not be told from it."""
    files[0] = files[0].rename(f"{files[0]}.partial")
    one, two = map(FileStore, files)
    assert two.read(0, 1) == b"b"
    files[0].unlink()
    files[0].write_bytes(b"another")
    assert one.read(0, 6) == b"a.mcap"
    assert not one.is_at(files[0])


@pytest.mark.parametrize("there", [False, True])
def test_a_file_that_was_replaced_is_not_read_on(files: list[Path], there: bool) -> None:
    one, two = map(FileStore, files)
    assert two.read(0, 1) == b"b"
    files[0].unlink()
    if there:
        files[0].write_bytes(b"z")
    with pytest.raises(LogDamagedError, match=r"a\.mcap: .*while it was read"):
        one.read(0, 6)


def test_a_closed_file_stays_closed(files: list[Path]) -> None:
    one = FileStore(files[0])
    one.close()
    one.close()
    with pytest.raises(ValueError, match="is closed"):
        one.read(0, 1)
