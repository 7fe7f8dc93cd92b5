"""Small files that unpack to gigabytes take 512 MB at most, and one clear line."""

from __future__ import annotations

import multiprocessing
import os
import resource
from collections.abc import Callable
from pathlib import Path

import pytest
from bombs import CAMERAS, write_all

from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError
from cdmisfa.core.untrusted import BUDGET, budget
from cdmisfa.experiments.results import results
from recorder.cameras.video import VideoCamera
from recorder.log.files import RECORDING
from recorder.log.manifest import read_start
from recorder.mcap.records import MalformedRecord
from replay.logs.open_logs import open_stream
from replay.runs.folders import REQUEST, RUN_JSON, read_run_json

pytestmark = pytest.mark.xdist_group("bombs")  # one process makes what all of them share

OWN = 112
"""Megabytes of a command that has read nothing yet."""


def kilobytes(name: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith(name)).split()[1])


def growth(work: Callable[[], object]) -> float:
    """Megabytes that some work takes at most, and lets go of again."""
    Path("/proc/self/clear_refs").write_text("5")
    before = kilobytes("VmRSS")
    work()
    return (kilobytes("VmHWM") - before) / 1024


def first_image(path: Path) -> None:
    with open_stream(path) as stream:
        for row in range(min(stream.count, 2)):
            stream.image(row)


@pytest.fixture(scope="module")
def bombs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """All of them, from a process of its own: what writing takes is not there to be read with."""
    folder = tmp_path_factory.mktemp("bombs")
    writing = multiprocessing.get_context("fork").Process(target=write_all, args=(folder,))
    writing.start()
    writing.join()
    assert writing.exitcode == 0
    return {n: Path((folder / f"{i}.path").read_text()) for i, n in enumerate(CAMERAS)}


@pytest.mark.parametrize("kind", CAMERAS)
def test_camera_logs(kind: str, bombs: dict[str, Path]) -> None:
    before = resource.getrlimit(resource.RLIMIT_DATA)
    said = []

    def read() -> None:
        try:
            first_image(bombs[kind])
        except (CdmisfaError, MalformedRecord) as error:
            said.append(str(error))

    took = growth(read)
    assert took + OWN < 512
    assert resource.getrlimit(resource.RLIMIT_DATA) == before
    assert [(10 < len(x) < 400, "\n" in x) for x in said] == [(True, False)]


def test_live_pictures_that_are_too_large_are_refused() -> None:
    camera = VideoCamera("av:lavfi:color=size=8000x5000:rate=25", "cam")
    with pytest.raises(CdmisfaError, match=r"^av:lavfi:color=.*: images of 8000x5000"):
        next(camera.images())


LISTS = b"[" + b"[]," * (1 << 21) + b"[]]"
"""6 MiB of JSON that take some 150."""


def test_side_files(tmp_path: Path) -> None:
    def read() -> None:
        for name in (REQUEST, RECORDING, RUN_JSON):
            (tmp_path / name).write_bytes(LISTS)
        with pytest.raises(UsageError, match=rf"{RECORDING}: \d+ bytes, above the limit of"):
            read_start(tmp_path)
        assert read_run_json(tmp_path) == {}
        with pytest.raises(LogDamagedError, match=f"{REQUEST} is damaged: run the sweep again"):
            results(tmp_path)
        os.truncate(tmp_path / REQUEST, 1 << 33)
        with pytest.raises(UsageError, match="above the limit"):
            results(tmp_path)

    assert growth(read) + OWN < 512


def test_the_budget_ends_with_its_body() -> None:
    before = resource.getrlimit(resource.RLIMIT_DATA)
    with budget(64 << 20), budget():
        bytearray(32 << 20)
        with pytest.raises(MemoryError):
            bytearray(BUDGET)
    bytearray(128 << 20)
    assert resource.getrlimit(resource.RLIMIT_DATA) == before
