"""Check what must hold for any bytes that are read as a log.

Only our errors escape, in one line each. No message is returned that a checksum contradicts.
Two ways of reading the same file give the same.
"""

from __future__ import annotations

import contextlib
import tracemalloc
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np

from cdmisfa.core.blocks import Block
from cdmisfa.core.errors import CdmisfaError
from recorder.mcap.reader import LogReader
from recorder.mcap.records import MAX_CHUNK
from replay.integrity.info import describe
from replay.integrity.recover import recover_log
from replay.integrity.verify import check_log
from replay.logs.formats.recording import ViewFile
from replay.open_sources import open_recording

from .mutations import Case, bases

MEMORY = MAX_CHUNK + 32 * 1024 * 1024
"""Most bytes that a small file may make us allocate: a chunk at the limit, and 32 MB."""
_BLOCK = 7


class BrokenPromise(AssertionError):  # noqa: N818 - it names what happened
    """Something that must not happen with any input."""


@contextlib.contextmanager
def _only_our_errors() -> Iterator[None]:
    try:
        yield
    except CdmisfaError as error:
        if "\n" in str(error) or not str(error):
            raise BrokenPromise(f"not one line: {error}") from error


def check(case: Case, path: Path, number: int = 0) -> None:
    """Read a broken log in every way, the slower ones by its number.

    Raise BrokenPromise for what must not happen; whatever escapes is a defect, too.
    """
    path.write_bytes(case.raw)
    with _only_our_errors():
        _read(case, path, skip_damaged=False)
    if number % 2 == 0:
        with _only_our_errors():
            _read(case, path, skip_damaged=True)
    if case.base.startswith("recording"):
        with _only_our_errors():
            _play(case, path, skip_damaged=number % 3 == 0)
    if number % 25 == 0:
        with _only_our_errors():
            describe(path)
        with _only_our_errors():
            check_log(path)
        _recover(path)


def check_memory(case: Case, path: Path) -> None:
    """Read a broken log; raise BrokenPromise when that allocates more than `MEMORY`."""
    tracemalloc.start()
    try:
        check(case, path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    if peak > MEMORY:
        raise BrokenPromise(f"{len(case.raw)} bytes made us allocate {peak}")


@cache
def _truth(base: str) -> frozenset[tuple[int, bytes]]:
    """Return log times and messages of the log that was broken."""
    import tempfile

    with tempfile.NamedTemporaryFile(suffix=".mcap") as file:
        file.write(bases()[base])
        file.flush()
        with LogReader(file.name) as reader:
            return frozenset((m.log_time, m.data) for m in reader.messages())


def _read(case: Case, path: Path, *, skip_damaged: bool) -> None:
    with LogReader(path, skip_damaged=skip_damaged) as reader:
        result = list(reader.messages())
        for attachment in reader.attachments:
            reader.attachment_data(attachment)
        reported = reader.problems or reader.crc_absent() or (skip_damaged and reader.missing)
        if case.trusted and not reported:
            true = _truth(case.base)
            if not all((m.log_time, m.data) in true for m in result):
                raise BrokenPromise("a message was changed, its checksum does not say so")


def _play(case: Case, path: Path, *, skip_damaged: bool) -> None:
    with open_recording([path], skip_damaged=skip_damaged) as source:
        if source.frames > 1000:
            raise BrokenPromise(f"{source.frames} frames in {len(case.raw)} bytes")
        blocks: list[Block] = []
        try:
            while (left := source.frames - sum(map(len, blocks))) > 0:
                blocks.append(source.take(0, min(left, _BLOCK)))
        finally:
            _same_slowly(path, blocks, skip_damaged=skip_damaged)


def _same_slowly(path: Path, blocks: list[Block], *, skip_damaged: bool) -> None:
    """Compare the blocks of a source with what the reader in Python decodes."""
    if not blocks:
        return
    with contextlib.closing(ViewFile(path, skip_damaged=skip_damaged)) as view:
        all_frames = np.concatenate([b.frames for b in blocks])
        all_truth = np.concatenate([b.truth for b in blocks])
        at = 0
        for start, stop in view.ranges:
            n = min(stop - start, len(all_frames) - at)
            if n == 0:
                break
            frames = np.empty((n, *view.facts.frame_shape), view.facts.dtype)
            truth = np.empty((n, len(view.facts.truth)))
            tabled_rows(view, start, frames, truth)
            if frames.tobytes() != all_frames[at : at + n].tobytes():
                raise BrokenPromise("the reader in C gives other frames")
            if truth.tobytes() != all_truth[at : at + n].tobytes():
                raise BrokenPromise("the reader in C gives other ground truth")
            at += n


def tabled_rows(view: ViewFile, start: int, frames: np.ndarray, truth: np.ndarray) -> None:
    """Read as `ViewFile.take` does, by the tables of chunks and without C."""
    outs = (frames.reshape(len(frames), -1).view(np.uint8), truth.view(np.uint8))
    for rows, out in zip(view._channels, outs, strict=False):
        at = 0
        for number, low, n in rows.pieces(start, len(out)):
            table = rows._table(number)
            own = table.select(table.channel == rows._channel.id)
            ends = (own.at + own.size)[low : low + n, None, None]
            places = ends - np.array(rows.places)[:, None] + np.arange(rows.width)
            out[at : at + n] = own.data[places].reshape(n, -1)
            at += n


def _recover(path: Path) -> None:
    saved = path.with_name("saved.mcap")
    with _only_our_errors():
        try:
            recover_log(path, saved, force=True)
        finally:
            saved.with_name("saved.mcap.partial").unlink(missing_ok=True)
        with LogReader(saved) as reader:
            if not reader.complete or reader.problems:
                raise BrokenPromise("a recovered log is not whole")
