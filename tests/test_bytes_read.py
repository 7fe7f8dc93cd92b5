"""How much of a log is read: little to open it, all of it once to verify it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from camera_files import write_images
from mcap.writer import CompressionType
from waiting import python

from cdmisfa.core.blocks import Block, SourceSpec
from cdmisfa.core.errors import LogDamagedError
from recorder.config import RecordConfig
from recorder.log.manifest import RecordingSpec
from recorder.log.viewlog import ViewLog
from replay.integrity.verify import check_log
from replay.open_sources import open_recording

FRAMES = 2000


@pytest.fixture(scope="module")
def noise(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of pictures that cannot be compressed, 25 MB."""
    folder = tmp_path_factory.mktemp("noise")
    spec = SourceSpec(("left",), (96, 128), "uint8", ("x",), 50.0, 10**18)
    log = ViewLog(folder, "left", RecordingSpec("plain", 0, spec, {}), RecordConfig())
    frames = np.random.default_rng(0).integers(0, 256, (FRAMES, 96, 128), np.uint8)
    log.write(Block(0, 0, frames, np.zeros((FRAMES, 1))))
    log.finish()
    return folder / "left.mcap"


def share_read(path: Path, work: str) -> float:
    """Bytes that a process reads to do something with a recording, of those it has."""
    script = (
        "import sys\n"
        "from pathlib import Path\n"
        "from replay.integrity.info import describe\n"
        "from replay.integrity.verify import check_log\n"
        "from replay.open_sources import open_recording\n"
        "from recorder.mcap.reader import LogReader\n"
        f"def work(path): {work}\n"
        "def read(): return int(Path('/proc/self/io').read_text().split()[1])\n"
        "work(sys.argv[2])\n"  # imports what it needs
        "before = read()\n"
        "work(sys.argv[1])\n"
        "print(read() - before)\n"
    )
    other = path.with_name("other")
    if not other.exists():
        other.mkdir()
        (other / "left.mcap").write_bytes(path.read_bytes())
    done = python("-c", script, path, other / "left.mcap", check=True)
    return int(done.stdout) / path.stat().st_size


@pytest.mark.skipif(not Path("/proc/self/io").exists(), reason="counts what Linux counts")
@pytest.mark.parametrize(
    ("work", "most"),
    [
        ("LogReader(path).close()", 0.01),
        ("open_recording(path).close()", 0.05),  # looks at one chunk's layout
        ("open_recording(path).describe()", 1.05),
        ("describe(path)", 1.05),
        ("check_log(path)", 1.05),
    ],
)
def test_no_byte_is_read_without_need(noise: Path, work: str, most: float) -> None:
    assert share_read(noise, work) <= most


@pytest.mark.skipif(not Path("/proc/self/io").exists(), reason="counts what Linux counts")
@pytest.mark.parametrize("chunk", [20_000, 4_000_000])
@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.ZSTD])
def test_images_of_an_external_log_are_decoded_as_it_is_read(
    tmp_path: Path, chunk: int, compression: CompressionType
) -> None:
    path, random = tmp_path / "left.mcap", np.random.default_rng(0)
    frames = random.integers(0, 256, (2, 300, 96, 128), np.uint8)
    topics = {
        f"/{i}": [(20 * t, image) for t, image in enumerate(own)] for i, own in enumerate(frames)
    }
    write_images(path, topics, chunk_size=chunk, compression=compression)
    assert path.stat().st_size > 7_000_000
    assert share_read(path, "check_log(path)") <= 1.05


def test_a_changed_fact_is_found_by_who_reads_all(noise: Path, tmp_path: Path) -> None:
    path = tmp_path / "left.mcap"
    path.write_bytes(noise.read_bytes().replace(b"plain", b"plane", 1))
    assert open_recording(path).scene()["scene"] == "plane"
    with pytest.raises(LogDamagedError, match="data section"):
        open_recording(path).describe()
    assert not check_log(path).ok
