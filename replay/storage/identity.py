"""Identity of a log: SHA-256 of all of its bytes, or of a sample of them before all are read."""

from __future__ import annotations

import bisect
import hashlib
import itertools
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Final

from cdmisfa.core.errors import CdmisfaError, LogDamagedError
from cdmisfa.core.untrusted import check_regular
from recorder.mcap.reader import LogReader

# Bytes of a piece of a sample, of which there are `PIECES`.
PIECE: Final = 4096
PIECES: Final = 16

# Bytes that are hashed at a time.
BLOCK: Final = 1 << 20

# Called with the number of bytes that were hashed since the last call.
Counted = Callable[[int], None]


class Identity:
    """Identity of a file, or of files of a folder with their names.

    Args:
        path: the file or folder.
        files: the files of the folder; None for a file.

    Attributes:
        path: the file or folder.
        size: bytes that `whole` reads.

    Raises:
        CdmisfaError: a file cannot be read.
    """

    path: Path
    size: int
    _sha256: str | None = None

    def __init__(self, path: Path, files: Iterable[Path] | None = None) -> None:
        self.path = path
        self._files = [path] if files is None else sorted(files)
        self._names = [] if files is None else [str(f.relative_to(path)) for f in self._files]
        for file in self._files:
            check_regular(file)
        self._state = self._file_states()
        self.size = sum(size for size, _ in self._state)

    def sample(self) -> dict[str, Any]:
        """Return the hash of a few of the bytes, as JSON values.

        Raises:
            LogDamagedError: the log was changed since it was opened.
            CdmisfaError: the log cannot be read.
        """
        sample = self._sample_sha256()
        if self._changed():
            raise self._change_error()
        return {"file": self.path.name, "bytes": self.size, "sample_sha256": sample}

    def whole(self, counted: Counted = lambda count: None) -> dict[str, Any]:
        """Return the hash of all bytes, as JSON values; raises as `sample`, and if damaged."""
        if self._sha256 is None:
            digest = self.sha256(counted)
            if self._changed():
                raise self._change_error()
            self._sha256 = digest
        elif self._changed() and self.sha256(counted) != self._sha256:
            raise self._change_error()
        return {"file": self.path.name, "sha256": self._sha256}

    def sha256(self, counted: Counted = lambda count: None) -> str:
        """Return the SHA-256 of all bytes, read now; raises as `whole`."""
        digests = []
        for file in self._files:
            digest = hashlib.sha256()
            for block in _blocks(file):
                digest.update(block)
                counted(len(block))
            digests.append(digest.hexdigest())
        if not self._names:
            return digests[0]
        lines = (f"{name}\0{one}\n" for name, one in zip(self._names, digests, strict=True))
        return hashlib.sha256(_encoded("".join(lines))).hexdigest()

    def _change_error(self) -> LogDamagedError:
        return LogDamagedError(f"{self.path}: the file changed while it was read; start again")

    def _sample_sha256(self) -> str:
        digest = hashlib.sha256()
        sizes = [size for size, _ in self._state]
        for name, size in zip(self._names, sizes, strict=False):
            digest.update(_encoded(f"{name}\0{size}\n"))
        starts = list(itertools.accumulate(sizes, initial=0))[:-1]
        for place in _sampled(self.size):
            number = bisect.bisect_right(starts, place) - 1
            digest.update(next(_blocks(self._files[number], place - starts[number], PIECE), b""))
        return digest.hexdigest()

    def _changed(self) -> bool:
        return self._file_states() != self._state

    def _file_states(self) -> list[tuple[int, int]]:
        """Return each file's size and time of change."""
        try:
            states = [path.stat() for path in self._files]
        except OSError as error:
            raise CdmisfaError(f"{error.filename}: {error.strerror}") from None
        return [(state.st_size, state.st_mtime_ns) for state in states]


class McapIdentity(Identity):
    """Identity of an MCAP file; its sample has all bytes from its data end record on."""

    def __init__(self, reader: LogReader) -> None:
        self.path, self.size = reader.path, reader.file.size
        self._reader = reader

    def sha256(self, counted: Counted = lambda count: None) -> str:
        """Return the SHA-256 of the file, and check the checksum over its data on the way."""
        return self._reader.sha256(counted)

    def _sample_sha256(self) -> str:
        digest = hashlib.sha256()
        for place in _sampled(self.size):
            digest.update(self._reader.file.read(place, PIECE))
        for block in self._reader.tail():
            digest.update(block)
        return digest.hexdigest()

    def _changed(self) -> bool:
        return self._reader.file.changed()


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file; a CdmisfaError if it cannot be read."""
    return Identity(path).sha256()


def _sampled(size: int) -> list[int]:
    """Return where the pieces of a sample begin: evenly from the first bytes to the last."""
    return [max(size - PIECE, 0) * i // (PIECES - 1) for i in range(PIECES)]


def _blocks(path: Path, start: int = 0, size: int = BLOCK) -> Iterator[bytes]:
    try:
        with path.open("rb", buffering=0) as file:
            file.seek(start)
            while block := file.read(size):
                yield block
    except OSError as error:
        raise CdmisfaError(f"{path}: {error.strerror}") from None


def _encoded(text: str) -> bytes:
    return text.encode("utf-8", "surrogateescape")
