"""A recording that is still being written, as a source that waits for its frames."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from cdmisfa.core.blocks import Block, ClockedSource, check_request
from cdmisfa.core.errors import CdmisfaError, LogDamagedError, LogExhaustedError, UsageError
from recorder.log.manifest import read_start
from recorder.mcap.store import PARTIAL
from replay.recordings.source import RecordedSource
from replay.storage.opening import log_files

POLL: Final = 0.1
"""Seconds between polls of the files."""


class ReplacedError(CdmisfaError):
    """Another recording took the place of the one that was followed."""

    exit_code = 3


class FollowedSource(ClockedSource):
    """The views of a recording that grows while it is read.

    A recorder hands over whole seconds of frames; a block that is not there yet is waited
    for, until the recorder finishes its files. One that is resumed writes its unfinished files
    again: they are gone on with once they are known to hold every frame that was taken.

    Args:
        path: the recording's folder, which may not be there yet.
        timeout: seconds without a new frame after which the recorder is taken for gone.
        stop: asked while waiting; true ends the wait as if the recording had ended.

    Attributes:
        stop: as given; it may be replaced.
        warnings: none, for what is missing may still come.
    """

    warnings: tuple[str, ...] = ()

    def __init__(
        self,
        path: str | Path,
        *,
        timeout: float = 60.0,
        stop: Callable[[], bool] = lambda: False,
    ) -> None:
        """Wait for the first frames of every view.

        Raises:
            UsageError: no recording came.
            LogDamagedError: what is there is damaged.
        """
        if Path(path).is_file():
            raise UsageError(f"{path}: a recording is followed by its folder, this is a file")
        self.stop = stop
        self._path = Path(path)
        self._timeout = timeout
        self._blocks: list[tuple[int, int, int]] = []
        self._sha256 = hashlib.sha256()
        self._seen: object = None
        self._source: RecordedSource | None = None
        self._identity: object = None
        self._wait(lambda: self._reaches(0), "frame 0")
        self.gaps = self._now.gaps
        self._t = self._now.t
        self._spec = replace(self._now.spec, length=None)

    @property
    def finished(self) -> bool:
        """Whether the recorder has finished every file."""
        return any(self._path.glob("*.mcap")) and not any(self._path.glob(f"*.mcap{PARTIAL}*"))

    @property
    def turns(self) -> tuple[tuple[int, ...], ...]:
        """See `RecordedSource`."""
        return self._now.turns

    @property
    def taken(self) -> str:
        """SHA-256 of the blocks that were taken, in their order."""
        return self._sha256.hexdigest()

    def take(self, stream: int, n: int) -> Block:
        """The n frames that a view shows at t .. t+n-1, waited for; moves t by n.

        With gaps the next n that follow one another; moves t behind them. Each file holds its
        view's frames in their order, so that later ones change nothing about that.

        Raises:
            LogExhaustedError: the recording ended, or its recorder is gone; t stays.
            LogDamagedError: a chunk is damaged; t stays.
            ReplacedError: another recording took its place; t stays.
            ValueError: no such stream, or n < 1.
        """
        check_request(self._spec, stream, n)
        self._wait(lambda: self._shows(stream, n), f"frame {self._t + n - 1}")
        self._now.seek(self._t)
        block = self._now.take(stream, n)
        self._note(block)
        self._t = block.t + n
        return block

    def take_all(self, n: int) -> tuple[Block, ...]:
        """What every view shows in the next n frames, a block for each unbroken stretch.

        A frame that a view lacks is known to be of a gap once it has a later one.

        Raises:
            As for `take`.
        """
        if not self.gaps:
            return super().take_all(n)
        check_request(self._spec, 0, n)
        self._wait(lambda: self._all_reach(self._t + n), f"frame {self._t + n - 1}")
        self._now.seek(self._t)
        blocks = self._now.take_all(n)
        for block in blocks:
            self._note(block)
        self._t += n
        return blocks

    def spans(self, stream: int, start: int, stop: int) -> list[tuple[int, int]]:
        """See `SeekableSource`; of a view with gaps those that are there by now."""
        return self._now.spans(stream, start, stop)

    def seek(self, t: int) -> None:
        """Move the clock to frame t, waiting until it is there.

        Raises:
            LogExhaustedError: the recording ended before it, or its recorder is gone.
            ReplacedError: another recording took its place.
            ValueError: t lies before the recording's first frame.
        """
        self._wait(lambda: self._reaches(t), f"frame {t}")
        self._now.seek(t)
        self._t = t

    def describe(self) -> Mapping[str, Any]:
        """What was recorded, and once frames were taken, the files that they were taken from.

        A file that still grows is named by its first `bytes`, and their SHA-256.
        """
        views: list[dict[str, Any]] = [{"name": name} for name in self._spec.streams]
        if self._blocks:
            views = self._now.describe_files()
        return {"kind": "recording", **self._now.scene(), "followed": True, "views": views}

    def close(self) -> None:
        if self._source is not None:
            self._source.close()

    @property
    def _now(self) -> RecordedSource:
        if self._source is None:
            raise LogExhaustedError(f"{self._path}: it was given up before its first frame")
        return self._source

    def _reaches(self, end: int) -> bool:
        """Whether the frames before an end are there, and the recording is."""
        source = self._source
        return source is not None and source.first_frame + source.frames >= end

    def _shows(self, stream: int, n: int) -> bool:
        """Whether the next n frames of a view that follow one another are there."""
        if not self.gaps:
            return self._reaches(self._t + n)
        source = self._now
        end = source.first_frame + source.frames
        there = source.spans(stream, self._t, end) if self._t < end else []
        return any(high - low >= n for low, high in there)

    def _all_reach(self, end: int) -> bool:
        """Whether every view has a frame right before an end, or behind."""
        source, views = self._now, range(len(self._spec.streams))
        last = source.first_frame + source.frames
        return end <= last and all(source.spans(view, end - 1, last) for view in views)

    def _note(self, block: Block) -> None:
        self._blocks.append((block.stream, block.t, len(block)))
        _add(self._sha256, block)

    def _wait(self, there: Callable[[], bool], what: str) -> None:
        """Poll the files until something is there, they are finished, or the timeout is over."""
        if there():
            return
        deadline = time.monotonic() + self._timeout
        while not self.stop():
            finished = self.finished
            before = self._frames()
            error = self._look()
            if there():
                return
            if finished:
                if error is not None:
                    raise error
                return
            if self._frames() > before:
                deadline = time.monotonic() + self._timeout
            if time.monotonic() >= deadline:
                if self._source is None and error is not None:
                    raise error
                raise LogExhaustedError(
                    f"{self._path}: {what} did not come within {self._timeout:g} s of the last; "
                    "if its recorder still works wait longer with --follow-timeout"
                )
            time.sleep(POLL)
        raise LogExhaustedError(f"{self._path}: stopped while waiting for {what}")

    def _frames(self) -> int:
        return self._source.frames if self._source is not None else 0

    def _look(self) -> CdmisfaError | None:
        """Read what was added to the files; return why that is not possible (yet)."""
        try:
            seen = [(path, _state(path)) for path in log_files(self._path)]
            if seen == self._seen:
                return None
            # A file that was given its name between two steps is found by a second look.
            if self._source is None or not (self._source.refresh() or self._source.refresh()):
                self._go_on_with(RecordedSource(self._path))
            elif _identity(self._source) != self._identity:
                raise self._replaced()
        except (UsageError, LogDamagedError) as error:
            return error
        except OSError:  # renamed between two looks
            return None
        self._seen = seen
        return None

    def _go_on_with(self, found: RecordedSource) -> None:
        """Read from now on what was opened anew, in place of what is not there any more."""
        before = self._source
        try:
            self._check(found)
        except BaseException:
            found.close()
            raise
        self._source, self._identity = found, _identity(found)
        if before is not None:
            before.close()

    def _check(self, found: RecordedSource) -> None:
        """Refuse files that are not all there yet, or do not hold what was taken.

        Raises:
            UsageError: more may come.
            LogDamagedError: more may come, or a chunk is damaged.
            ReplacedError: they are of another recording.
        """
        absent = read_start(self._path).frames.keys() - set(found.spec.streams)
        if absent or not found.refresh():
            raise UsageError(f"{self._path}: its files are not all there yet")
        if self._source is not None and _identity(found) != self._identity:
            raise self._replaced()
        if found.first_frame + found.frames < max((t + n for _, t, n in self._blocks), default=0):
            raise LogDamagedError(f"{self._path}: it lacks frames that it had before")
        again = hashlib.sha256()
        for stream, t, n in self._blocks:
            found.seek(t)
            _add(again, found.take(stream, n))
        if again.digest() != self._sha256.digest():
            raise self._replaced()

    def _replaced(self) -> ReplacedError:
        return ReplacedError(
            f"{self._path}: another recording took the place of the one that was followed: "
            "learn from it in another run, or anew with --force"
        )


def _identity(source: RecordedSource) -> tuple[object, ...]:
    return replace(source.spec, length=None), source.scene(), source.first_frame


def _add(sha256: Any, block: Block) -> None:
    sha256.update(f"{block.stream} {block.t} {len(block)}\n".encode())
    sha256.update(block.frames)
    sha256.update(block.truth)


def _state(path: object) -> tuple[int, ...]:
    """What of a file changes when it is written or replaced."""
    found = os.stat(str(path))
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns
