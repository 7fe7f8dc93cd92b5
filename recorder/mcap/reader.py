"""Read any MCAP file, strictly: whole or cut, with or without an index.

A reader gives every message that is there, in file order, and never one whose checksum does not
match. Memory holds a few chunks.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final, Literal, Self

import numpy as np
from mcap.records import Channel, Schema, Statistics

from cdmisfa.core.errors import LogDamagedError
from recorder.mcap.chunks import Chunks, MessageTable, Pairs
from recorder.mcap.records import (
    CHUNK_PEEK,
    MAX_CHUNK,
    RECORD_HEADER,
    Attachment,
    MalformedRecord,
    Message,
    Segment,
    crc32,
)
from recorder.mcap.store import OnePass, Store
from recorder.mcap.walk import LogStructure

Check = Literal["chunks", "data", "pass"]

NO_CHECKSUMS: Final = "it has no checksums, nothing vouches for its bytes"


class LogReader(LogStructure):
    """An MCAP file, read by its content and not by what its index claims.

    Damage is an error that names the file, the chunk and its time range. With
    `skip_damaged` the damaged chunk is left out and noted in `problems` instead, and the
    unverifiable part of a chunk in which the file ends is read too. Where its summary accounts
    for every message, only what is asked for is read: each chunk is checked when it is, and the
    checksum over all data where all of it is read (`check`, `sha256`) or a chunk has none of its
    own.
    """

    def __init__(
        self, log: str | Path | Store, *, skip_damaged: bool = False, check: Check | None = None
    ) -> None:
        """Open a log.

        Args:
            log: path of a file, or its bytes, which are closed with the reader.
            skip_damaged: leave out what is damaged.
            check: "chunks" believes a summary that accounts for every message; "data" looks at
                every record of a file and at the checksum over its data; "pass" leaves to
                `one_pass` the latter, and without `skip_damaged` also the former. By default
                "chunks", with `skip_damaged` "data".

        Raises:
            UsageError: it cannot be opened.
            LogDamagedError: not an MCAP file, or its structure is damaged.
        """
        self._failed: set[int] = set()
        self._defined = self._searched = self._checked = False
        if not isinstance(log, Store):
            log = OnePass(Path(log)) if check == "pass" else Store(Path(log))
        check = check or ("data" if skip_damaged else "chunks")
        try:
            by_index = check == "chunks" or (check == "pass" and not skip_damaged)
            super().__init__(log, skip_damaged=skip_damaged, by_index=by_index)
            note = None if check == "chunks" else self.note
            self._chunks = Chunks(log, self.definitions, note, self._check_unproven)
            if self.torn is not None and self.torn in self.segments:
                # The header of a chunk that was still open states no times yet.
                table = self.table(self.torn)
                if table is not None and len(table):
                    times = table.log_time
                    self.torn.start, self.torn.end = int(times.min()), int(times.max())
            if not self.by_index and check != "pass":
                self._check_data()
        except BaseException as error:
            log.close()
            if isinstance(error, MalformedRecord):
                raise LogDamagedError(f"{log.path}: {error}") from None
            raise

    # What the file holds

    @property
    def statistics(self) -> Statistics | None:
        """The statistics in the summary, or None."""
        return self.summary.statistics if self.summary else None

    @property
    def warnings(self) -> list[str]:
        """Missing, left out and unproven parts of the file, a line each that names it."""
        problems = [f"{p.where}: {p.what}" for p in self.problems]
        lines = (f"{self.path}: {text}" for text in (self.missing, *problems) if text)
        return [*lines, *self.unproven()]

    def unproven(self) -> list[str]:
        """Return a line that names the file if nothing vouches for its bytes."""
        return [f"{self.path}: {NO_CHECKSUMS}"] if self.crc_absent() else []

    @property
    def channels(self) -> Mapping[int, Channel]:
        """Every channel of the file; reads the chunks where nothing else names them."""
        self._define()
        return self.definitions.channels

    @property
    def schemas(self) -> Mapping[int, Schema]:
        """Every schema of the file; reads the chunks where nothing else names them."""
        self._define()
        return self.definitions.schemas

    def attachment_data(self, attachment: Attachment) -> bytes:
        """Read an attachment's bytes; a LogDamagedError where that is too much at once."""
        if attachment.size > MAX_CHUNK:
            raise LogDamagedError(
                f"{self.path}: attachment {attachment.name[:80]!r} has {attachment.size} bytes, "
                f"above the limit of {MAX_CHUNK}"
            )
        return self.file.read(attachment.offset, attachment.size)

    def crc_absent(self) -> int:
        """Count the segments that no checksum protects.

        Of a file opened by its index without a checksum over all data, the first chunk stands for
        all: reading the head of each would take as long as reading the file.
        """
        if self.data_crc:
            return 0
        segments = self.segments
        if self.by_index:
            places = [s.offset + RECORD_HEADER.size for s in segments[:1]]
            segments = [Segment.of_chunk(p, self.file.peek(p, CHUNK_PEEK)) for p in places]
        return sum(1 for s in segments if s.crc == 0 and s.size)

    def sha256(self, counted: Callable[[int], None] = lambda count: None) -> str:
        """Return the SHA-256 of the file, and check the checksum over all data on the way.

        Args:
            counted: called with the number of each further bytes that were hashed.
        """
        sha256, crc, at = hashlib.sha256(), 0, 0
        end = self.data_end if self.data_crc else 0
        for block in self.file.blocks(0, self.file.size):
            sha256.update(block)
            crc = crc32(block[: max(end - at, 0)], crc)
            at += len(block)
            counted(len(block))
        self._check_data(crc)
        return sha256.hexdigest()

    def tail(self) -> Iterator[bytes]:
        """Yield the bytes from the data end record on, where the file was opened by its index."""
        if self.by_index:
            yield from self.file.blocks(self.data_end, self.file.size)

    # Messages

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Message]:
        """Yield the messages in file order.

        Args:
            topics: only these; None for all.

        Raises:
            LogDamagedError: at the first damage, without `skip_damaged`.
        """
        for segment, table in self.tables(topics=topics):
            known = {c: self._channel(c, segment) for c in np.unique(table.channel).tolist()}
            own = {c: k for c, k in known.items() if k and (topics is None or k.topic in topics)}
            if len(own) < len(known):
                table = table.select(np.isin(table.channel, list(own)))
            for number, sequence, log_time, published, data in table.rows():
                yield Message(own[number], sequence, log_time, published, data)

    def tables(
        self, *, start: int = 0, topics: Collection[str] | None = None
    ) -> Iterator[tuple[Segment, MessageTable]]:
        """Yield the messages chunk by chunk as columns, in file order.

        Chunks that end before log time `start` are left out, and of a log that was opened by its
        index those without any of `topics`.

        Raises:
            LogDamagedError: at the first damage, without `skip_damaged`.
        """
        chosen = [s for s in self.segments if s.end >= start]
        if self.by_index:
            numbers = {c for c, k in self.channels.items() if topics is None or k.topic in topics}
            chosen = [s for s in chosen if numbers & (s.channel_counts() or {}).keys()]
        self.expect(chosen)
        for segment in chosen:
            table = self.table(segment)
            if table is not None:
                yield segment, table.select(table.log_time >= np.uint64(start)) if start else table

    def one_pass(self) -> Iterator[tuple[Segment, MessageTable | None]]:
        """Yield every chunk in file order, None for one that is damaged and left out.

        Without `skip_damaged` each byte is read once, and every record is looked at on the way. The
        checksum over all of the data is checked at the end. The log was opened with check "pass".

        Raises:
            LogDamagedError: at the first damage, without `skip_damaged`.
        """
        file = self.file
        assert isinstance(file, OnePass)
        if self.by_index:
            for segment in self.walk():
                yield segment, self.table(segment)
        else:
            file.start(file.size)
            for segment in self.segments:
                file.pass_to(segment.offset)
                yield segment, self.table(segment)
        self._check_data(file.crc_to(self.data_end))

    def expect(self, segments: Sequence[Segment], *, indexes: bool = False) -> None:
        """Announce the chunks, or only `indexes` of them, that will be read one after the other."""
        self._chunks.expect(() if indexes else segments)
        spans = ((s.data_end if indexes else s.offset, s.stop) for s in segments)
        self.file.expect(list(spans))

    def table(self, segment: Segment) -> MessageTable | None:
        """Decode a chunk and check it; the last few are kept.

        Returns:
            Its messages in file order, or None where it is damaged and `skip_damaged` is on.

        Raises:
            LogDamagedError: it is damaged, without `skip_damaged`.
        """
        if self.skip_damaged and segment.offset in self._failed:
            return None
        try:
            return self._chunks.table(segment)
        except MalformedRecord as error:
            self._failed.add(segment.offset)
            if not (segment.cut and self.skip_damaged):  # that the file ends in it is said anyway
                self.refuse(segment.name, str(error))
            return None

    def index(self, segment: Segment, channels: Collection[int] | None = None) -> Pairs:
        """Read a chunk's message indexes, or those of some channels.

        Raises:
            LogDamagedError: they are larger than any chunk.
        """
        try:
            return self._chunks.index(segment, channels)
        except MalformedRecord as error:
            raise LogDamagedError(f"{self.path}: {segment.name}: {error}") from None

    def close(self) -> None:
        """Close the file; harmless when called twice."""
        self._chunks.close()
        self.file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # Inside

    def _check_data(self, crc: int | None = None) -> None:
        """Compare the checksum over all data that the log states with theirs, once.

        Args:
            crc: of the data, where they were read; by default they are read now.
        """
        if not self.data_crc or self._checked:
            return
        self._checked = True
        if (self.file.crc(0, self.data_end) if crc is None else crc) != self.data_crc:
            if not self.skip_damaged:
                self._search()  # an error that names the chunk says more
            self.refuse("data section", "its CRC does not match: damaged")

    def _check_unproven(self) -> None:
        """Check the data for a chunk that has no checksum of its own."""
        if self.by_index:
            self._check_data()

    def _channel(self, number: int, segment: Segment) -> Channel | None:
        """Return the channel of messages in a chunk; some writers define it in a later chunk."""
        for search in (False, True):
            if search:
                self._search()
            channel = self.definitions.channels.get(number)
            schemas = {0, *self.definitions.schemas}
            if channel and channel.schema_id in schemas:
                return channel
        what = f"it holds messages of channel {number}, never defined"
        if channel is not None:
            what = f"schema {channel.schema_id} of {channel.topic!r} is never defined"
        self.refuse(segment.name, what)
        return channel

    def _define(self) -> None:
        """Decode chunks until every channel that has messages is known."""
        if self._defined:
            return
        known, counted = self.definitions.channels, set[int]()
        # A summary that is believed defines every channel of which it counts messages.
        for segment in () if self.by_index else self.segments:
            counts = segment.channel_counts()
            if counts is None or not counts.keys() <= known.keys():
                self.table(segment)
            counted.update(counts or ())
        self._defined = True
        schemas = {0, *self.definitions.schemas}
        if not (counted <= known.keys() and {c.schema_id for c in known.values()} <= schemas):
            self._search()

    def _search(self) -> None:
        """Decode every chunk: a definition may be in one that holds no message of it."""
        if not self._searched:
            self._searched = True
            for segment in self.segments:
                self.table(segment)
