"""Identity of a log: SHA-256 of all of its bytes, or of a sample of them before all are read."""

from __future__ import annotations

import bisect
import hashlib
import itertools
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Final

from cdmisfa.core.errors import CdmisfaError, LogDamagedError
from cdmisfa.core.untrusted import check_regular
from recorder.mcap.reader import LogReader
from replay.stored import StoredSource

AT_ONCE: Final = 64 * 1024 * 1024
"""Logs of a source with so many bytes in all are hashed before anything else is done."""

PIECE: Final = 4096
"""Bytes of a piece of a sample."""

_PIECES: Final = 16
_BLOCK: Final = 1 << 20

Counted = Callable[[int], None]
"""Told how many more bytes were hashed."""

Told = Callable[[int, int], None]
"""Told how many bytes were hashed, and how many there are."""


class Identity(ABC):
    """What identifies a log.

    Attributes:
        path: of the log.
        size: bytes that `whole` reads.
    """

    path: Path
    size: int

    @abstractmethod
    def sample(self) -> dict[str, Any]:
        """What is known before all of it is read, as JSON values.

        Raises:
            LogDamagedError: it is not any more what was opened.
            CdmisfaError: it cannot be read.
        """

    @abstractmethod
    def whole(self, counted: Counted) -> dict[str, Any]:
        """What is known once all of it is read, as JSON values.

        Raises:
            LogDamagedError: it is damaged, or not any more what was opened.
            CdmisfaError: it cannot be read.
        """


class FilesIdentity(Identity):
    """Identity of a file, or of files of a folder with their names.

    Args:
        path: of the file or folder.
        files: those of the folder; None for a file.

    Raises:
        CdmisfaError: they cannot be read.
    """

    _sha256: str | None = None

    def __init__(self, path: Path, files: Iterable[Path] | None = None) -> None:
        self.path = path
        self._files = [path] if files is None else sorted(files)
        self._names = [] if files is None else [str(f.relative_to(path)) for f in self._files]
        for file in self._files:
            check_regular(file)
        self._then = self._now()
        self.size = sum(size for size, _ in self._then)

    def sample(self) -> dict[str, Any]:
        found = self._sample()
        if self._changed():
            raise self._was_changed()
        return {"file": self.path.name, "bytes": self.size, "sample_sha256": found}

    def whole(self, counted: Counted) -> dict[str, Any]:
        if self._sha256 is None:
            found = self.sha256(counted)
            if self._changed():
                raise self._was_changed()
            self._sha256 = found
        elif self._changed() and self.sha256(counted) != self._sha256:
            raise self._was_changed()
        return {"file": self.path.name, "sha256": self._sha256}

    def _was_changed(self) -> LogDamagedError:
        return LogDamagedError(f"{self.path}: it was changed while it was read; begin again")

    def _sample(self) -> str:
        """Return the SHA-256 of a few of the bytes."""
        found = hashlib.sha256()
        sizes = [size for size, _ in self._then]
        for name, size in zip(self._names, sizes, strict=False):
            found.update(_encoded(f"{name}\0{size}\n"))
        starts = list(itertools.accumulate(sizes, initial=0))[:-1]
        for place in sampled(self.size):
            number = bisect.bisect_right(starts, place) - 1
            found.update(next(_blocks(self._files[number], place - starts[number], PIECE), b""))
        return found.hexdigest()

    def sha256(self, counted: Counted) -> str:
        """Return the SHA-256 of all bytes, read now; raises as `whole`."""
        each = []
        for file in self._files:
            found = hashlib.sha256()
            for block in _blocks(file):
                found.update(block)
                counted(len(block))
            each.append(found.hexdigest())
        if not self._names:
            return each[0]
        listed = "".join(f"{name}\0{one}\n" for name, one in zip(self._names, each, strict=True))
        return hashlib.sha256(_encoded(listed)).hexdigest()

    def _changed(self) -> bool:
        """Return whether it may hold something else than when it was opened."""
        return self._now() != self._then

    def _now(self) -> list[tuple[int, int]]:
        """Each file's size and time of change."""
        found = []
        for path in self._files:
            try:
                state = path.stat()
            except OSError as error:
                raise CdmisfaError(f"{path}: {error.strerror}") from None
            found.append((state.st_size, state.st_mtime_ns))
        return found


class LogIdentity(FilesIdentity):
    """A log in a file, whose sample holds all from its data end record on."""

    def __init__(self, reader: LogReader) -> None:
        self.path, self.size = reader.path, reader.size
        self._reader = reader

    def _sample(self) -> str:
        found = hashlib.sha256()
        for place in sampled(self.size):
            found.update(self._reader.file.read(place, PIECE))
        for block in self._reader.tail():
            found.update(block)
        return found.hexdigest()

    def sha256(self, counted: Counted) -> str:
        return self._reader.sha256(counted)

    def _changed(self) -> bool:
        return self._reader.file.changed()


class LoggedSource(StoredSource):
    """A source of frames in logs, identified by their bytes.

    Attributes:
        to_judge: whether its last frames are held out where nothing is said; see `hold_out`.
        left_out: a line for each log that could not be read, and is no part of it.
        copies: a line for each stream that shows the same as one of another log.
        notes: a line for each thing that was chosen where it was not said.
        warnings: what the user should know.
    """

    to_judge: ClassVar[bool] = False
    left_out: tuple[str, ...] = ()
    copies: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    _identities: Sequence[Identity] | None = None

    @abstractmethod
    def _logs(self) -> Sequence[Identity]:
        """The logs that it is read from."""

    @abstractmethod
    def _described(self, logs: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
        """What the source is, with what is known of each log."""

    def pixels(self, stream: int) -> str:
        """The format of pixels that a stream's messages state, "" where they state none."""
        return ""

    def scene(self) -> Mapping[str, str]:
        """What was recorded, where the logs say so."""
        return {}

    def describe(self, told: Told = lambda done, size: None) -> Mapping[str, Any]:
        """The logs with the SHA-256 of all their bytes, and what was taken of them.

        Args:
            told: of the bytes that were hashed and of all of them, where they are many.

        Raises:
            LogDamagedError: a log is damaged, or not any more the one that was opened.
        """
        logs = self._known_logs()
        size, done = sum(log.size for log in logs), 0

        def counted(count: int) -> None:
            nonlocal done
            done += count
            if size > AT_ONCE:
                told(done, size)

        return self._with_centre([log.whole(counted) for log in logs])

    def describe_at_once(self) -> Mapping[str, Any]:
        """See `cdmisfa.core.blocks.LongSource`."""
        logs = self._known_logs()
        if sum(log.size for log in logs) <= AT_ONCE:
            return self.describe()
        return self._with_centre([log.sample() for log in logs])

    def _with_centre(self, logs: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
        described = self._described(logs)
        return described if self.centre == "run" else {**described, "centre": self.centre}

    def _known_logs(self) -> Sequence[Identity]:
        if self._identities is None:
            self._identities = self._logs()
        return self._identities


def file_sha256(path: Path) -> str:
    """SHA-256 of a file.

    Raises:
        CdmisfaError: it cannot be read.
    """
    return FilesIdentity(path).sha256(lambda count: None)


def sampled(size: int) -> list[int]:
    """Where the pieces of a sample begin: evenly from the first bytes to the last.

    Args:
        size: bytes of a log.
    """
    return [max(size - PIECE, 0) * i // (_PIECES - 1) for i in range(_PIECES)]


def _blocks(path: Path, start: int = 0, size: int = _BLOCK) -> Iterator[bytes]:
    """The bytes of a file from a place on."""
    try:
        with path.open("rb", buffering=0) as file:
            file.seek(start)
            while block := file.read(size):
                yield block
    except OSError as error:
        raise CdmisfaError(f"{path}: {error.strerror}") from None


def _encoded(text: str) -> bytes:
    return text.encode("utf-8", "surrogateescape")
