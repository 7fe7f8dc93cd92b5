"""Small files that unpack to gigabytes take 512 MB at most, and one clear line."""

from __future__ import annotations

import multiprocessing
import os
import re
import resource
from collections.abc import Callable
from pathlib import Path

import av
import pytest
from bombs import CAMERAS, METADATA, write_all
from test_modules import learned
from waiting import python

from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError
from cdmisfa.core.learning import Keyframe
from cdmisfa.core.signals import SCHEMA_VERSION
from cdmisfa.core.untrusted import BUDGET, budget
from cdmisfa.experiments.results import results
from cdmisfa.experiments.store import ROWS
from cdmisfa.experiments.sweep import sweep
from recorder.cameras.video import VideoCamera
from recorder.images.videos import most_pixels
from recorder.log.files import RECORDING
from recorder.log.logfile import LogFile
from recorder.log.manifest import read_start
from recorder.mcap.records import MalformedRecord
from replay.camera_logs.opening import open_images
from replay.runs.folders import REQUEST, RUN_JSON, RUN_METADATA, read_run_json
from replay.runs.keyframes import decode_keyframe, encode_keyframe
from replay.runs.log import read_header

OWN = 112
"""Megabytes of a command that has read nothing yet."""

READ_ROWS = """
import sys
from pathlib import Path
from cdmisfa.core.errors import LogDamagedError
from cdmisfa.experiments.results import results
try:
    results(Path(sys.argv[1]))
except LogDamagedError as error:
    print(error)
lines = Path("/proc/self/status").read_text().splitlines()
print(next(line for line in lines if line.startswith("VmHWM")).split()[1])
"""
"""In a process of its own: what tests before it mapped and freed is taken again, unlimited."""


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
    images = open_images(path, None)
    try:
        for row in range(min(images.count, 2)):
            images.image(row)
    finally:
        images.close()


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
    assert [(10 < len(x) < 400, "\n" in x) for x in said] in ([(True, False)], [])
    assert bool(said) == (kind != "video's size")


@pytest.mark.parametrize("kind", [kind for kind in CAMERAS if kind.startswith("video")])
def test_live_video(kind: str, bombs: dict[str, Path]) -> None:
    said, shapes = [], []

    def watch() -> None:
        try:
            for _, image in VideoCamera(f"av:{bombs[kind]}", "cam", timeout=5).pictures():
                shapes.append(image.shape)
        except CdmisfaError as error:
            said.append(str(error))

    assert growth(watch) + OWN < 512
    assert shapes == ([(48, 64)] * 3 if kind == "video's size" else [])
    if kind == "video's pictures":
        assert "a.mp4: images of 0x0, live ones of this kind have 1 to " in said[0]


@pytest.mark.parametrize(
    ("form", "codec", "most"),
    [
        ("yuv420p", "h264", 13_816_530),
        ("yuv420p10le", "hevc", 6_908_265),
        ("yuvj422p", "mjpeg", 36_000_000),
        ("gbrp16le", "rawvideo", 36_000_000),
    ],
)
def test_pictures_of_live_video_fit_into_the_budget(form: str, codec: str, most: int) -> None:
    kind = av.codec.Codec(codec, "r")
    assert most_pixels(av.VideoFormat(form), kind) == most


def test_live_pictures_that_are_too_large_are_refused() -> None:
    camera = VideoCamera("av:lavfi:color=size=8000x5000:rate=25", "cam", timeout=5)
    with pytest.raises(CdmisfaError, match=r"^av:lavfi:color=.*: images of 8000x5000"):
        next(camera.pictures())


@pytest.mark.parametrize("codec", ["mjpeg", "mpeg4"])
def test_live_pictures_of_just_the_limit_are_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, codec: str
) -> None:
    width, height, film = 650, 450, tmp_path / "film.avi"
    with av.open(str(film), "w") as written:
        stream = written.add_stream(codec, rate=25)
        stream.width, stream.height = width, height
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        written.mux(stream.encode(av.VideoFrame(width, height, stream.pix_fmt)))
        written.mux(stream.encode())
    monkeypatch.setattr("recorder.cameras.video.MAX_PIXELS", width * height)
    monkeypatch.setattr("recorder.cameras.video.most_pixels", lambda *_: width * height)
    _, image = next(VideoCamera(f"av:{film}", "cam", timeout=5).pictures())
    assert image.shape == (height, width)


LISTS = b"[" + b"[]," * (1 << 21) + b"[]]"
"""6 MiB of JSON that take some 150."""


def test_documents_of_logs(tmp_path: Path) -> None:
    run = tmp_path / "run.mcap"
    with LogFile(run) as log:
        values = {"schema": str(SCHEMA_VERSION), "spec": LISTS.decode(), "manifest": LISTS.decode()}
        log.add_metadata(RUN_METADATA, values)
    learner, _ = learned("uint8", "none")
    keyframe = encode_keyframe(Keyframe(1, 0, learner.state, {"python": LISTS.decode()}))

    def read() -> None:
        for decode in (lambda: read_header(run), lambda: decode_keyframe(keyframe)):
            with pytest.raises(LogDamagedError, match="JSON, above the limit"):
                decode()

    assert growth(read) < 150


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


@pytest.mark.parametrize("line", [b'{"id":"%d","status":"done","point":{},"a":%b}\n', b"%d%b"])
def test_rows(tmp_path: Path, line: bytes) -> None:
    (tmp_path / REQUEST).write_text('{"trials": []}')
    (tmp_path / ROWS).write_bytes(b"".join(line % (i, LISTS) for i in range(8)))
    command = python("-c", READ_ROWS, tmp_path, check=True)
    said, most = command.stdout.splitlines()
    assert re.search(rf"{ROWS}.*(MiB of memory|remove the line)", said)
    assert int(most) < 512 << 10


@pytest.mark.parametrize("name", [REQUEST, ROWS])
def test_side_files_that_are_none_are_not_waited_for(tmp_path: Path, name: str) -> None:
    (tmp_path / REQUEST).write_text('{"trials": []}')
    (tmp_path / name).unlink(missing_ok=True)
    os.mkfifo(tmp_path / name)
    with pytest.raises(UsageError, match=name):
        results(tmp_path)


def test_a_sweep_that_nobody_could_read_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cdmisfa.experiments.sweep.MAX_LIST", 1000)
    with pytest.raises(UsageError, match="20 trials are more than a folder takes"):
        sweep(["oscillatory"], tmp_path / "out", seeds=range(20))
    assert not (tmp_path / "out").exists()


def test_a_file_of_a_bag_that_is_none_is_not_waited_for(tmp_path: Path) -> None:
    (tmp_path / "metadata.yaml").write_text(METADATA.format(mode="", name="a.db3"))
    os.mkfifo(tmp_path / "a.db3")
    with pytest.raises(UsageError, match=r"a\.db3: no regular file"):
        first_image(tmp_path)


def test_the_budget_ends_with_its_body() -> None:
    before = resource.getrlimit(resource.RLIMIT_DATA)
    with budget(64 << 20), budget():
        bytearray(32 << 20)
        with pytest.raises(MemoryError):
            bytearray(BUDGET)
    bytearray(128 << 20)
    assert resource.getrlimit(resource.RLIMIT_DATA) == before
