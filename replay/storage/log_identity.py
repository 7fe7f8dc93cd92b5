"""Identity of an MCAP log."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from cdmisfa.core.errors import CdmisfaError
from recorder.mcap.reader import LogReader
from recorder.mcap.records import MAGIC
from replay.storage.identity import PIECE, ByteIdentity, Counted, Identity, sampled
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


def log_identity(*readers: LogReader) -> Identity:
    """The identity of a log, given its readers, one at least.

    Of a URL, so that not every byte is read, its size and `index_sha256`: over the file from
    its data end record on, which holds the checksum of all data and where each chunk is. Where
    the index does not account for every message, `sha256` over all of it, too.
    """
    return (_RemoteIdentity if isinstance(readers[0].path, Url) else _LocalIdentity)(*readers)


class _LocalIdentity(ByteIdentity):
    """A log in a file, whose sample holds all from its data end record on."""

    def __init__(self, reader: LogReader, *_: LogReader) -> None:
        self.path, self.size = reader.path, reader.size
        self._data = reader.data

    def sample_sha256(self) -> str:
        found = hashlib.sha256()
        for place in sampled(self.size):
            found.update(self._data.read(place, PIECE))
        for block in self._data.tail():
            found.update(block)
        return found.hexdigest()

    def sha256(self, counted: Counted) -> str:
        return self._data.sha256(0, counted)

    def changed(self) -> bool:
        return self._data.changed()


class _RemoteIdentity(Identity):
    """A log behind a URL, of which not all is read."""

    def __init__(self, *readers: LogReader) -> None:
        self.path, self.size = readers[0].path, 0
        self._readers = readers
        self._known: dict[str, Any] | None = None

    def sample(self) -> dict[str, Any]:
        return self.whole(lambda count: None)

    def whole(self, counted: Counted) -> dict[str, Any]:
        reader = self._readers[0]
        if self._known is None:
            name = "index_sha256" if reader.by_index else "sha256"
            known = {"file": self.path.name, "url": str(self.path), "bytes": reader.size}
            self._known = {**known, name: reader.digest()}
        else:
            for reader in self._readers:
                reader.confirm()
        return self._known
