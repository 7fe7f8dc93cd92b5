"""Pictures are decoded in threads before they are asked for: the same frames, the same errors."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from camera_files import encoded, pictures
from folders import external
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from message_files import every, write_mcap

from cdmisfa.core.errors import LogDamagedError
from recorder.images import compressed
from recorder.images.messages import MessageKind
from replay.logs import images as ahead

COUNT = 90
BROKEN = (0, 17, 18, 21, 60)


def messages(*broken: int) -> list[bytes]:
    result = []
    for i, image in enumerate(pictures(COUNT)):
        data = encoded(image, "PNG" if i % 3 else "JPEG")
        data = data[: len(data) // 2] if i in broken else data
        result.append(CompressedImage(data=data, format="png").SerializeToString())
    return result


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


def shown(path: Path, *, skip_damaged: bool = False) -> tuple[list[np.ndarray], list[str], str]:
    """The frames in blocks of 7, what is said of broken ones, and the error that ends it."""
    frames: list[np.ndarray] = []
    with contextlib.closing(external(path, skip_damaged=skip_damaged, rate=25)) as source:
        try:
            for left in range(source.frames, 0, -7):
                frames.append(source.take(0, min(left, 7)).frames)
        except LogDamagedError as error:
            return frames, source.skipped_damage(), str(error)
        return frames, source.skipped_damage(), ""


@pytest.mark.parametrize("write", [write, folder])
@pytest.mark.parametrize(
    ("broken", "skip_damaged"), [((), False), (BROKEN, True), (BROKEN[1:], False)]
)
def test_threads_change_no_frame_and_no_error(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    write: Callable[..., Path],
    broken: tuple[int, ...],
    skip_damaged: bool,
) -> None:
    log = write(tmp_path / "log.mcap" if write.__name__ == "write" else tmp_path / "log", *broken)
    result = {}
    for cores in (1, 2, 5):
        monkeypatch.setattr(ahead, "CORES", cores)
        result[cores] = shown(log, skip_damaged=skip_damaged)
    frames, said, error = result[1]
    assert (len(frames) == -(-COUNT // 7)) == (skip_damaged or not broken)
    for cores in (2, 5):
        assert result[cores][1:] == (said, error)
        assert len(result[cores][0]) == len(frames)
        assert all(map(np.array_equal, result[cores][0], frames))


def test_few_pictures_are_held_and_each_is_decoded_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ahead, "CORES", 3)
    waiting: list[int] = []
    begin = ahead.Images._begin

    def counted(self: ahead.Images) -> None:
        before = len(self._pending)
        begin(self)
        waiting.extend(range(before + 1, len(self._pending) + 1))

    monkeypatch.setattr(ahead.Images, "_begin", counted)
    frames, _, _ = shown(write(tmp_path / "log.mcap"))
    assert (sum(map(len, frames)), len(waiting)) == (COUNT, COUNT - 1)
    assert max(waiting) <= 2 * 3
    waiting.clear()
    with contextlib.closing(external(tmp_path / "log.mcap", align="time", rate=60)) as source:
        while source.t < source.frames - 7:
            source.take_all(7)
    assert len(waiting) < COUNT
    assert max(waiting) <= 2 * 3


def two(path: Path, *broken: int) -> Path:
    kind = MessageKind("foxglove.CompressedImage", "protobuf")
    shown = messages(*broken)
    write_mcap(path, kind, {"/a": every(40_000_000, shown), "/b": every(40_000_000, shown[::-1])})
    return path


def anyhow(path: Path) -> list[np.ndarray | str]:
    """What is asked for without a plan: either stream, both at once, other places."""
    result: list[np.ndarray | str] = []
    order = np.random.default_rng(0)
    with contextlib.closing(external(path, ["/a", "/b"], loop=True, rate=25)) as source:
        for what in order.integers(0, 6, 60).tolist():
            n = int(order.integers(1, 20))
            try:
                if what == 0:
                    source.seek(int(order.integers(0, 3 * COUNT)))
                elif what < 3:
                    result += [block.frames for block in source.take_all(n)]
                else:
                    result.append(source.take(what % 2, n).frames)
            except LogDamagedError as error:
                result.append(str(error))
                source.seek(source.t + n)
    return result


@pytest.mark.parametrize("broken", [(), (5, 30, 31)])
def test_whatever_is_asked_for_next_frames_and_errors_are_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, broken: tuple[int, ...]
) -> None:
    log, held = two(tmp_path / "log.mcap", *broken), []
    pop = ahead.Images.pop
    monkeypatch.setattr(
        ahead.Images,
        "pop",
        lambda self, place: (held.append(len(self._pending)), pop(self, place))[1],
    )
    monkeypatch.setattr(ahead, "CORES", 1)
    expected = anyhow(log)
    assert any(isinstance(one, str) for one in expected) == bool(broken)
    for cores in (2, 3):
        monkeypatch.setattr(ahead, "CORES", cores)
        held.clear()
        for one, other in zip(anyhow(log), expected, strict=True):
            np.testing.assert_array_equal(one, other)
        assert max(held) <= 2 * cores


def test_large_pictures_are_left_to_one_thread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are decoded within a limit of memory, which is of the whole process."""
    monkeypatch.setattr(ahead, "CORES", 2)
    log, limits = write(tmp_path / "log.mcap"), list[int]()
    budget = compressed.budget
    monkeypatch.setattr(compressed, "budget", lambda: limits.append(1) or budget())
    frames = shown(log)[0]
    assert len(limits) < 10
    monkeypatch.setattr(ahead, "MAX_THREAD_PIXELS", 20)
    assert all(map(np.array_equal, shown(log)[0], frames))
    assert len(limits) > COUNT
