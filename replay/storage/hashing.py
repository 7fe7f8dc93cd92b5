"""What tells logs from others: the SHA-256 of all of their bytes, and of a sample before."""

from __future__ import annotations

import bisect
import hashlib
import itertools
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from cdmisfa.core.errors import CdmisfaError, LogDamagedError
from recorder.mcap.records import Place
from replay.stored import StoredSource

AT_ONCE: Final = 64 * 1024 * 1024
"""Logs of a source with so many bytes in all are hashed before anything else is done."""

PIECE: Final = 4096
"""Bytes of a piece of a sample."""

_PIECES: Final = 16
_MEMORY: Final = 8 * 1024 * 1024
"""Bytes that are hashed at once, for which no lock is held."""

Told = Callable[[int], None]
"""Told of bytes that were hashed; what it raises ends that."""


class Hashed(ABC):
    """A log, and what tells it from others.

    Attributes:
        path: of the log.
        size: bytes that `read` reads.
    """

    path: Place
    size: int

    @abstractmethod
    def at_once(self) -> dict[str, Any]:
        """What is known before it is read, as JSON values.

        Raises:
            CdmisfaError: it cannot be read.
        """

    @abstractmethod
    def read(self, memory: memoryview, told: Told) -> None:
        """Hash it, in whatever thread.

        Raises:
            CdmisfaError: it cannot be read.
        """

    @abstractmethod
    def whole(self) -> dict[str, Any]:
        """What is known once it is read, as JSON values.

        Raises:
            LogDamagedError: it is not what it states.
        """

    @abstractmethod
    def confirm(self) -> None:
        """See that it is still what was read.

        Raises:
            LogDamagedError: it is not.
        """


class HashedBytes(Hashed):
    """A log on this machine."""

    @abstractmethod
    def sample(self) -> str:
        """SHA-256 of a few of its bytes; raises as `at_once`."""

    @abstractmethod
    def sha256(self) -> str:
        """What `read` came to; raises as `whole`."""

    @abstractmethod
    def changed(self) -> bool:
        """Whether it may hold something else than when it was opened."""

    def at_once(self) -> dict[str, Any]:
        return {"file": self.path.name, "bytes": self.size, "sample_sha256": self.sample()}

    def whole(self) -> dict[str, Any]:
        return {"file": self.path.name, "sha256": self.sha256()}

    def confirm(self) -> None:
        """See that it is what was read, by reading it again where it may be something else."""
        if self.changed():
            before = self.sha256()
            self.read(memoryview(bytearray(_MEMORY)), lambda count: None)
            if self.sha256() != before:
                raise self.was_changed()

    def was_changed(self) -> LogDamagedError:
        """What is said of a log that is not what was opened."""
        return LogDamagedError(f"{self.path}: it was changed while it was read; begin again")


class HashedFiles(HashedBytes):
    """A file, or files of a folder with their names.

    Args:
        path: of the file or folder.
        files: those of the folder; None for a file.

    Raises:
        CdmisfaError: they cannot be read.
    """

    def __init__(self, path: Path, files: Iterable[Path] | None = None) -> None:
        self.path: Path = path
        self._is_folder = files is not None
        found = [path] if files is None else sorted(files)
        self._names = [str(file.relative_to(path)) for file in found]
        self._then = self._now()
        self.size = sum(size for size, _ in self._then)
        self._sha256, self._as_opened = "", False

    def sample(self) -> str:
        found = hashlib.sha256()
        if self._is_folder:
            for name, (size, _) in zip(self._names, self._then, strict=True):
                found.update(_name(f"{name}\0{size}\n"))
        starts = list(itertools.accumulate((size for size, _ in self._then), initial=0))
        for place in sampled(self.size):
            number = bisect.bisect_right(starts, place) - 1
            path = self.path / self._names[number]
            try:
                with path.open("rb", buffering=0) as file:
                    file.seek(place - starts[number])
                    found.update(file.read(PIECE))
            except OSError as error:
                raise CdmisfaError(f"{path}: {error.strerror}") from None
        return found.hexdigest()

    def read(self, memory: memoryview, told: Told) -> None:
        if self._is_folder:
            whole = hashlib.sha256()
            for name in self._names:
                whole.update(_name(f"{name}\0{_sha256(self.path / name, memory, told)}\n"))
            self._sha256 = whole.hexdigest()
        else:
            self._sha256 = _sha256(self.path, memory, told)
        # What was changed before the first time may have been learned from as it was.
        self._as_opened = self._as_opened or not self.changed()

    def sha256(self) -> str:
        if not self._as_opened:
            raise self.was_changed()
        return self._sha256

    def changed(self) -> bool:
        return self._now() != self._then

    def _now(self) -> list[tuple[int, int]]:
        """Each file's size and time of change."""
        found = []
        for name in self._names:
            path = self.path / name
            try:
                state = path.stat()
            except OSError as error:
                raise CdmisfaError(f"{path}: {error.strerror}") from None
            found.append((state.st_size, state.st_mtime_ns))
        return found


class _StoppedError(Exception):
    """Nobody waits for it any more."""


class Hashing:
    """Hashes logs: before anything else where they are small, or beside other work.

    Args:
        logs: all of a source.

    Attributes:
        size: bytes to be hashed.
        done: how many of them were.
    """

    def __init__(self, logs: Sequence[Hashed]) -> None:
        self.size, self.done = sum(log.size for log in logs), 0
        self._logs = logs
        self._first: list[dict[str, Any]] | None = None
        self._whole: list[dict[str, Any]] | None = None
        self._thread: threading.Thread | None = None
        self._error: BaseException | None = None
        self._stopped = False

    def at_once(self) -> list[dict[str, Any]]:
        """What is known of each log, all of it where they are small.

        Raises:
            CdmisfaError: a log cannot be read.
        """
        if self.size <= AT_ONCE:
            return self.whole()
        if self._first is None:
            self._first = [log.at_once() for log in self._logs]
        return self._first

    def begin(self) -> None:
        """Hash from now on in a thread, which ends with `close`."""
        if self._whole is None and self._thread is None:
            self._thread = threading.Thread(target=self._work, name="hashing", daemon=True)
            self._thread.start()

    def wait(self, seconds: float) -> bool:
        """Wait so long for the thread; whether it has ended."""
        if self._thread is None:
            return True
        self._thread.join(seconds)
        return not self._thread.is_alive()

    def whole(self) -> list[dict[str, Any]]:
        """What tells each log from others, waited for.

        Raises:
            LogDamagedError: a log is damaged, or is not any more what was opened.
            CdmisfaError: a log cannot be read.
        """
        fresh = self._whole is None and self._thread is None
        if self._whole is None:
            if self._thread is None:
                self._work()
            else:
                self._thread.join()
                self._thread = None
            if (error := self._error) is not None:
                self._error = None
                raise error
            self._whole = [log.whole() for log in self._logs]
        if not fresh:
            for log in self._logs:
                log.confirm()
        return self._whole

    def close(self) -> None:
        """End the thread; harmless when called twice."""
        self._stopped = True
        if self._thread is not None:
            self._thread.join()

    def _work(self) -> None:
        self.done = 0
        memory = memoryview(bytearray(max(min(_MEMORY, self.size), 1)))
        try:
            for log in self._logs:
                log.read(memory, self._tell)
        except BaseException as error:  # of the thread, for who asks
            self._error = error

    def _tell(self, count: int) -> None:
        self.done += count
        if self._stopped:
            raise _StoppedError


class LoggedSource(StoredSource):
    """Frames that logs keep, whose bytes tell it from others."""

    _known: Hashing | None = None

    @abstractmethod
    def _logs(self) -> Sequence[Hashed]:
        """The logs that it is read from."""

    @abstractmethod
    def _described(self, logs: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
        """What the source is, with what is known of each log."""

    def describe(self) -> Mapping[str, Any]:
        """The logs with the SHA-256 of all their bytes, and what was taken of them.

        Raises:
            LogDamagedError: a log is damaged, or not any more the one that was opened.
        """
        return self._described(self._hashing.whole())

    def describe_at_once(self) -> Mapping[str, Any]:
        """See `cdmisfa.core.blocks.LongSource`."""
        return self._described(self._hashing.at_once())

    def hash_meanwhile(self) -> None:
        """See `cdmisfa.core.blocks.LongSource`."""
        self._hashing.begin()

    def wait_hashed(self, seconds: float) -> tuple[int, int] | None:
        """See `cdmisfa.core.blocks.LongSource`."""
        known = self._hashing
        return None if known.wait(seconds) else (known.done, known.size)

    def close(self) -> None:
        """End the hashing."""
        if self._known is not None:
            self._known.close()

    @property
    def _hashing(self) -> Hashing:
        if self._known is None:
            self._known = Hashing(self._logs())
        return self._known


def sampled(size: int) -> list[int]:
    """Where the pieces of a sample begin: evenly from the first bytes to the last.

    Args:
        size: bytes of a log.
    """
    return [max(size - PIECE, 0) * i // (_PIECES - 1) for i in range(_PIECES)]


def _name(text: str) -> bytes:
    return text.encode("utf-8", "surrogateescape")


def _sha256(path: Path, memory: memoryview, told: Told) -> str:
    """SHA-256 of a file, a piece of memory at a time."""
    found = hashlib.sha256()
    try:
        with path.open("rb", buffering=0) as file:
            while count := file.readinto(memory) or 0:
                found.update(memory[:count])
                told(count)
    except OSError as error:
        raise CdmisfaError(f"{path}: {error.strerror}") from None
    return found.hexdigest()
