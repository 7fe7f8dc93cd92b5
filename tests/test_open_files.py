"""A recording may have more parts and views than files may be open at first."""

from __future__ import annotations

import functools
import os
import resource
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from waiting import python

from cdmisfa.core.blocks import Block, ClockedSource, SourceSpec, check_request, freeze
from cdmisfa.core.errors import LogDamagedError
from recorder.log.manifest import MAX_NAMED
from recorder.log.messages import RECORDING_METADATA
from recorder.mcap import store
from recorder.mcap.reader import LogReader
from recorder.mcap.store import Store
from recorder.recording import record, record_scene, recorded
from replay.integrity.recover import RepairedStore
from replay.integrity.verify import check_log
from replay.open_sources import open_recording

HERE = Path(__file__).parent
LIMIT = 64
FRAMES = 1250


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("many") / "rec"
    record_scene("oscillatory", folder, frames=FRAMES, split=1.0)
    assert len(list(folder.iterdir())) > LIMIT
    return folder


def limited(*words: str, **options: Any) -> None:
    """Run Python in a process that may have few files open, unless it asks for more."""
    most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    few = functools.partial(resource.setrlimit, resource.RLIMIT_NOFILE, (LIMIT, most))
    done = python(*words, preexec_fn=few, **options)
    assert done.returncode == 0, (words, done.stderr[-600:])


def test_more_parts_than_files_may_be_open_are_read(parts: Path) -> None:
    script = (
        f"import sys; sys.path.append({str(Path(__file__).parent)!r})\n"
        "from contracts.sources import same\n"
        "from recorder.world.oscillatory import OscillatorySource\n"
        "from replay.open_sources import open_recording\n"
        "from replay.integrity.verify import check_log\n"
        "live, source = OscillatorySource(), open_recording(sys.argv[1])\n"
        "for _ in range(2):\n"
        "    source.seek(0), live.seek(0)\n"
        f"    for i in range({FRAMES // 50}): same(source.take(i % 3, 50), live.take(i % 3, 50))\n"
        "source.describe()\n"
        "assert check_log(sys.argv[1]).ok\n"
    )
    limited("-c", script, str(parts))


def test_a_view_on_a_full_disk_ends_with_one_line(tmp_path: Path, oscillatory_run: Path) -> None:
    view = tmp_path / "a.rrd"
    small = functools.partial(resource.setrlimit, resource.RLIMIT_FSIZE, (40_000, 40_000))
    words = ("-m", "cdmisfa", "view", str(oscillatory_run), "--save", str(view))
    done = python(*words, preexec_fn=small)
    assert done.returncode == 1
    assert done.stderr.startswith(f"cdmisfa: {view} cannot be written: ")
    assert (done.stderr.count("\n"), list(tmp_path.iterdir())) == (1, [])


@pytest.mark.parametrize(
    ("kind", "read"),
    [
        (Store, lambda file: file.read(1, 5)),
        (Store, lambda file: file.peek(1, 2)),
        (Store, lambda file: list(file.blocks(0, file.size))),
        (Store, lambda file: file.crc(0, file.size)),
        (RepairedStore, lambda file: file.read(1, 5)),
    ],
)
@pytest.mark.parametrize("left", [0, 3])
def test_a_file_that_became_shorter_is_damage_to_whoever_reads_it(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    kind: type[Store],
    read: Callable[[Any], object],
    left: int,
) -> None:
    monkeypatch.setattr(store, "_BLOCK", 2)
    path = tmp_path / "a.mcap"
    path.write_bytes(b"a.mcap")
    opened = kind(path)
    assert opened.read(3, 20) == b"cap"  # its end is no damage
    os.truncate(path, left)
    with pytest.raises(
        LogDamagedError, match=r"a\.mcap: another program cut it while it was read$"
    ):
        read(opened)


# Files that are written


class ManyViews(ClockedSource):
    """More streams than files may be open."""

    def __init__(self, count: int) -> None:
        names = tuple(f"v{i:04d}" for i in range(count))
        self._spec = SourceSpec(names, (2,), "float64", (), 25.0, 0, 100)

    def take(self, stream: int, n: int) -> Block:
        check_request(self._spec, stream, n)
        values = np.arange(self._t, self._t + n, dtype=np.float64)
        self._t += n
        frames = freeze(np.stack([values, np.full(n, float(stream))], axis=1))
        return Block(stream, self._t - n, frames, freeze(np.zeros((n, 0))))

    def describe(self) -> dict[str, object]:
        return {"kind": "many"}


def test_more_views_than_files_may_be_open_are_recorded_learned_and_checked(tmp_path: Path) -> None:
    record_them = (
        "from test_open_files import ManyViews\n"
        "from recorder.recording import record\n"
        f"record(ManyViews({2 * LIMIT}), 'rec')\n"
    )
    paths = {**os.environ, "PYTHONPATH": os.pathsep.join([*sys.path, str(HERE)])}
    for words in (
        ["-c", record_them],
        ["-m", "cdmisfa", "info", "rec"],
        ["-m", "cdmisfa", "verify", "rec"],
        ["-m", "cdmisfa", "learn", "rec", "--max-iterations", "1", "--set", "learner.tau=20"],
    ):
        limited(*words, cwd=tmp_path, env=paths)


def stated(folder: Path, view: str) -> dict[str, str]:
    with LogReader(folder / f"{view}.mcap") as reader:
        (record,) = (r for r in reader.metadata if r.name == RECORDING_METADATA)
        return dict(record.metadata)


def test_each_of_many_views_names_only_itself(tmp_path: Path) -> None:
    few, many, more = (tmp_path / name for name in ("few", "many", "more"))
    for folder, count in ((few, MAX_NAMED), (many, MAX_NAMED + 1), (more, MAX_NAMED + 50)):
        record(ManyViews(count), folder, frames=5)
    assert stated(few, "v0001")["streams"].split(",") == list(ManyViews(MAX_NAMED).spec.streams)
    assert "stream_count" not in stated(few, "v0001")
    facts = stated(more, "v0007")
    assert (facts["streams"], facts["stream_count"], facts["stream_index"]) == ("", "150", "7")
    one, other = (folder / "v0007.mcap" for folder in (many, more))
    assert one.stat().st_size == other.stat().st_size < (few / "v0007.mcap").stat().st_size
    for folder in (few, many, more):
        with open_recording(folder) as source:
            assert source.spec.streams == ManyViews(len(list(folder.iterdir()))).spec.streams
            (config,) = LogReader(folder / "v0000.mcap").attachments
            assert config.name == "config.json"
        assert check_log(folder).ok
        assert len(recorded(folder)) == len(list(folder.iterdir()))


def test_a_missing_one_of_many_views_is_noticed(tmp_path: Path) -> None:
    record(ManyViews(MAX_NAMED + 3), tmp_path, frames=5)
    for number in (17, 99):
        (tmp_path / f"v{number:04d}.mcap").unlink()
    (problem,) = check_log(tmp_path).problems
    expected = "2 files of the recording's views 0 to 102 are missing, the first of view 17"
    assert problem.what == expected
    assert not recorded(tmp_path)
