"""What tells a log from other files, and from other logs."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from cdmisfa.core.errors import CdmisfaError
from recorder.mcap.reader import LogReader
from recorder.mcap.records import MAGIC
from replay.storage.hashing import PIECE, Hashed, HashedBytes, Told, sampled
from replay.storage.location import Url


def starts_as_log(path: Path) -> bool:
    """Whether a file begins as every MCAP file does.

    Raises:
        CdmisfaError: it cannot be read.
    """
    try:
        with path.open("rb") as file:
            return file.read(len(MAGIC)) == MAGIC
    except OSError as error:
        raise CdmisfaError(f"{path}: {error.strerror}") from None


def hashed(*readers: LogReader) -> Hashed:
    """What tells a log from others, given its readers, one at least.

    Of a URL, so that not every byte is read, its size and `index_sha256`: over the file from
    its data end record on, which holds the checksum of all data and where each chunk is. Where
    the index does not account for every message, `sha256` over all of it, too.
    """
    return (_HashedUrl if isinstance(readers[0].path, Url) else _HashedLog)(*readers)


class _HashedLog(HashedBytes):
    """A log in a file, whose sample holds all from its data end record on."""

    def __init__(self, reader: LogReader, *_: LogReader) -> None:
        self.path, self.size = reader.path, reader.size
        self._data = reader.data
        self._found = "", 0

    def sample(self) -> str:
        found = hashlib.sha256()
        for place in sampled(self.size):
            found.update(self._data.read(place, PIECE))
        for block in self._data.tail():
            found.update(block)
        return found.hexdigest()

    def read(self, memory: memoryview, told: Told) -> None:
        self._found = self._data.hashed(0, memory, told)

    def sha256(self) -> str:
        found, crc = self._found
        self._data.check(crc)
        return found

    def changed(self) -> bool:
        return self._data.changed()


class _HashedUrl(Hashed):
    """A log behind a URL, of which nothing is read beside other work."""

    def __init__(self, *readers: LogReader) -> None:
        self.path, self.size = readers[0].path, 0
        self._readers = readers
        self._known: dict[str, Any] | None = None

    def at_once(self) -> dict[str, Any]:
        return self.whole()

    def read(self, memory: memoryview, told: Told) -> None:
        pass

    def whole(self) -> dict[str, Any]:
        reader = self._readers[0]
        if self._known is None:
            name = "index_sha256" if reader.by_index else "sha256"
            known = {"file": self.path.name, "url": str(self.path), "bytes": reader.size}
            self._known = {**known, name: reader.digest()}
        return self._known

    def confirm(self) -> None:
        for reader in self._readers:
            reader.confirm()
