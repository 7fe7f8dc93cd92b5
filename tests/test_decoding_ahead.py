"""Pictures are decoded in threads before they are asked for: the same frames, the same errors."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from camera_files import encoded, pictures
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from message_files import every, write_mcap

from cdmisfa.core.errors import LogDamagedError
from recorder.images import pixels
from recorder.images.decoding import MessageKind
from replay.camera_logs import stream
from replay.camera_logs.source import ForeignSource

COUNT = 90
BROKEN = (0, 17, 18, 60)


def messages(*broken: int) -> list[bytes]:
    found = []
    for i, image in enumerate(pictures(COUNT)):
        data = encoded(image, "PNG" if i % 3 else "JPEG")
        data = data[: len(data) // 2] if i in broken else data
        found.append(CompressedImage(data=data, format="png").SerializeToString())
    return found


def write(path: Path, *broken: int) -> Path:
    kind = MessageKind("foxglove.CompressedImage", "protobuf")
    write_mcap(path, kind, {"/cam": every(40_000_000, messages(*broken))})
    return path


def folder(path: Path, *broken: int) -> Path:
    path.mkdir()
    for i, image in enumerate(pictures(COUNT)):
        data = encoded(image)
        (path / f"{i}.png").write_bytes(data[: len(data) // 2] if i in broken else data)
    return path


def shown(path: Path, *, salvage: bool = False) -> tuple[list[np.ndarray], list[str], str]:
    """The frames in blocks of 7, what is said of broken ones, and the error that ends it."""
    frames: list[np.ndarray] = []
    with contextlib.closing(ForeignSource(path, salvage=salvage, rate=25)) as source:
        try:
            for left in range(source.frames, 0, -7):
                frames.append(source.take(0, min(left, 7)).frames)
        except LogDamagedError as error:
            return frames, source.salvaged(), str(error)
        return frames, source.salvaged(), ""


@pytest.mark.parametrize("write", [write, folder])
@pytest.mark.parametrize(("broken", "salvage"), [((), False), (BROKEN, True), (BROKEN[1:], False)])
def test_threads_change_no_frame_and_no_error(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    write: Callable[..., Path],
    broken: tuple[int, ...],
    salvage: bool,
) -> None:
    log = write(tmp_path / "log.mcap" if write.__name__ == "write" else tmp_path / "log", *broken)
    found = {}
    for cores in (1, 2, 5):
        monkeypatch.setattr(stream, "CORES", cores)
        found[cores] = shown(log, salvage=salvage)
    frames, said, error = found[1]
    assert (len(frames) == -(-COUNT // 7)) == (salvage or not broken)
    for cores in (2, 5):
        assert found[cores][1:] == (said, error)
        assert len(found[cores][0]) == len(frames)
        assert all(map(np.array_equal, found[cores][0], frames))


def test_few_pictures_are_held_and_each_is_decoded_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream, "CORES", 3)
    waiting: list[int] = []
    begin = stream.Begun.begin

    def counted(self: stream.Begun, row: int, *args: object, **how: object) -> None:
        begin(self, row, *args, **how)  # type: ignore[arg-type]
        waiting.append(len(self._coming))

    monkeypatch.setattr(stream.Begun, "begin", counted)
    frames, _, _ = shown(write(tmp_path / "log.mcap"))
    assert (sum(map(len, frames)), len(waiting)) == (COUNT, COUNT - 1)
    assert max(waiting) <= 2 * 3
    waiting.clear()
    with contextlib.closing(ForeignSource(tmp_path / "log.mcap", align="time", rate=60)) as source:
        while source.t < source.frames - 7:
            source.take_all(7)
    assert len(waiting) < COUNT
    assert max(waiting) <= 2 * 3


def test_large_pictures_are_left_to_one_thread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are decoded within a limit of memory, which is of the whole process."""
    log, limits = write(tmp_path / "log.mcap"), list[int]()
    budget = pixels.budget
    monkeypatch.setattr(pixels, "budget", lambda: limits.append(1) or budget())
    frames = shown(log)[0]
    assert len(limits) < 10
    monkeypatch.setattr(stream, "AT_ONCE", 20)
    assert all(map(np.array_equal, shown(log)[0], frames))
    assert len(limits) > COUNT


def test_warnings_are_as_before_once_no_thread_decodes() -> None:
    good = [encoded(image, "JPEG") for image in pictures(8)]
    before = list(warnings.filters)
    with ThreadPoolExecutor(8) as threads:
        list(threads.map(pixels.compressed_image, good * 50))
    assert warnings.filters == before
