"""The structure of a log: found by a walk over its outer records, or stated by its summary.

The walk needs no index: it finds chunks, loose messages, metadata and attachments in
whole files, in files without a summary, and in files that were cut anywhere. What the
summary claims is compared with what was found.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Final

from mcap.opcode import Opcode
from mcap.records import Header, Metadata

from cdmisfa.core.errors import LogDamagedError
from recorder.mcap.chunks import check_size
from recorder.mcap.records import (
    CHUNK_PEEK,
    MAGIC,
    MAX_CHUNK,
    MAX_DEFINITION,
    RECORD_HEADER,
    Attachment,
    Definitions,
    Fields,
    IndexPart,
    MalformedRecord,
    Refuse,
    Segment,
    no_log,
)
from recorder.mcap.resync import fitting, leave_chunks, next_chunk, own_end, stands
from recorder.mcap.store import OnePass, Store
from recorder.mcap.summary import Summary, read_summary

LOOSE_BYTES: Final = 1024 * 1024
"""Messages outside chunks are read about this many bytes at once."""
_LOOSE: Final = struct.Struct("<HIQ")
_INDEX: Final = struct.Struct("<HI")
DATA_END_BYTES: Final = RECORD_HEADER.size + 4
_OPEN_LENGTH: Final = 2**64 - 1
_BEFORE_DATA: Final = 1024 * 1024
_PRIVATE: Final = 0x80
"""The first opcode that writers may give records of their own."""


class LogStructure:
    """What the walk found, or what the summary names.

    Args:
        file: the log.
        refuse: told of every damage.
        by_index: believe a summary that accounts for every message, and read no chunk.
        resync: where a record is damaged, look for the next chunk that is none.

    Attributes:
        by_index: the summary was believed.
        segments: chunks and messages outside them, in file order.
        tail: the segment within which the file ends, or None.
        complete: the file has its end, and nothing is missing.
        missing: what a file that was cut lacks, in words; "" for a whole one.
        data_crc: CRC of the data section, 0 for none, None where the file ends before it.
        data_end: place where the data section ends.
        first_damage: place of the first record that is damaged, None where none is.
    """

    def __init__(
        self, file: Store, refuse: Refuse, *, by_index: bool = False, resync: bool = False
    ) -> None:
        self._file, self._resync = file, resync
        self._sure = len(MAGIC)
        self.by_index = False
        self._tell = refuse
        self.first_damage: int | None = None
        self.definitions = Definitions(refuse)
        self.segments: list[Segment] = []
        self.tail: Segment | None = None
        self.metadata: list[Metadata] = []
        self.attachments: list[Attachment] = []
        self.profile = self.library = ""
        self.summary: Summary | None = None
        self.complete, self.missing = False, ""
        self.data_crc: int | None = None
        self.data_end = 0
        self._limit: int | None = None
        self._attachment_ranges: list[tuple[int, int]] = []
        self._metadata_bytes = self._inside = 0
        self._loose: Segment | None = None
        self._last_chunk: Segment | None = None
        self._at = len(MAGIC)
        if not (start := file.read(0, len(MAGIC))):
            raise LogDamagedError(f"{file.path}: empty, nothing was written")
        if start != MAGIC:
            raise no_log(file.path)
        self._read_end()
        if not by_index or not self._take_index():
            self._walk_data()

    def walk(self, file: OnePass) -> Iterator[Segment]:
        """Walk over every record of a log that was opened by its index.

        Args:
            file: the log, which is read on to each record.

        Yields:
            Each chunk that the index names, before the walk goes on to the record behind it.
        """
        assert self._limit is not None
        file.start(self._limit)
        self._file = file
        stated, self.segments, self.attachments = self.segments, [], []
        self.metadata, self._metadata_bytes, self._attachment_ranges = [], 0, []
        self.by_index, self.complete = False, False
        self._at, self.data_crc = len(MAGIC), None
        for segment in stated:
            self._walk_data(segment.offset)
            file.pass_to(segment.offset)
            yield segment
        self._walk_data()

    def _refuse(self, where: str, what: str) -> None:
        if self.first_damage is None:
            self.first_damage = self._at
        self._tell(where, what)

    def load_attachments(self) -> None:
        """Read the attachments that the summary names, and check them."""
        spans, self._attachment_ranges = self._attachment_ranges, []
        for start, stop in spans:
            self._record_at(start, stop, Opcode.ATTACHMENT)

    def _take_index(self) -> bool:
        """Take the chunks from the summary; whether it accounts for every message."""
        summary = self.summary
        if summary is None:
            return False
        try:
            segments = summary.chunks(set(self.definitions.channels))
            if segments is None:
                return False
            attachments = summary.ranges(Opcode.ATTACHMENT_INDEX)
            self._record_at(len(MAGIC), None, Opcode.HEADER)
            self._record_at(summary.begin - DATA_END_BYTES, summary.begin, Opcode.DATA_END)
            for start, stop in summary.ranges(Opcode.METADATA_INDEX):
                self._record_at(start, stop, Opcode.METADATA)
        except MalformedRecord:
            self._at, self.data_crc = len(MAGIC), None
            self.metadata, self._metadata_bytes = [], 0
            return False
        self.segments, self._attachment_ranges = segments, attachments
        self.by_index = self.complete = True
        return True

    def _record_at(self, start: int, stop: int | None, opcode: Opcode) -> None:
        """Read a record that the summary names."""
        head = self._file.peek(start, RECORD_HEADER.size).ljust(RECORD_HEADER.size, b"\0")
        found, length = RECORD_HEADER.unpack(head)
        if found != opcode or stop not in (None, start + RECORD_HEADER.size + length):
            raise MalformedRecord(f"at byte {start} is no {opcode.name} record")
        self._at = start
        self._take(found, start + RECORD_HEADER.size, length)

    def _walk_data(self, stop: int | None = None) -> None:
        """Walk over the records up to a place, or to the end of the data."""
        while self.data_crc is None and (stop is None or self._at < stop):
            limit = self._file.size if self._limit is None else self._limit
            where = f"byte {self._at}"
            try:
                if not self._step(limit) and not self._resume_after_cut():
                    break
            except MalformedRecord as error:
                self._refuse(where, str(error))
                if not self._resume_after():
                    self.missing = f"everything from byte {self._at} on is unreadable"
                    break
        if stop is not None:
            return
        self._close_loose()
        if self.data_crc is not None and self._limit is None and not self.missing:
            self.missing = "cut short: its summary is not all there, every message is"
        self.complete = self._limit is not None and self.data_crc is not None
        if self.complete and self.summary:
            self._compare_with(self.summary)

    # The outer records

    def _step(self, limit: int) -> bool:
        head = self._file.peek(self._at, RECORD_HEADER.size) if self._at < limit else b""
        if len(head) < RECORD_HEADER.size or self._at + RECORD_HEADER.size > limit:
            return self._cut("the end of the file and its index are missing", limit)
        opcode, length = RECORD_HEADER.unpack(head)
        content = self._at + RECORD_HEADER.size
        end = content + length
        if opcode == 0:
            rest = self._file.blocks(self._at, self._file.size)
            if self._limit is None and not any(map(any, rest)):
                return self._cut(f"from byte {self._at} on there are only zeros", limit)
            raise MalformedRecord("no record (opcode 0)")
        own = own_end(self._file, opcode, content) if self._resync else None
        if own is not None and own < end and stands(self._file, own, limit):
            self._refuse(f"byte {self._at}", "a record's length is not that of what it holds")
            end, length = own, own - content
        if end > limit:
            if opcode == Opcode.CHUNK and self._limit is None:
                self._cut_chunk(content, length, limit)
            return self._cut(
                f"the file ends within a record at byte {self._at}, {limit - self._at} bytes of it "
                "are there",
                limit,
            )
        if self._at == len(MAGIC) and opcode != Opcode.HEADER:
            raise MalformedRecord("the file does not begin with a header record")
        if self._resync and self.summary:
            leave_chunks(self.summary.named, opcode, self._at, end)
        self._take(opcode, content, length)
        if end in (own, self._inside):
            self._sure = end
        self._at = end
        return True

    def _take(self, opcode: int, content: int, length: int) -> None:
        if opcode == Opcode.MESSAGE:
            self._loose_message(content, length)
            return
        if opcode == Opcode.MESSAGE_INDEX:
            self._message_index(content, length)
            return
        self._last_chunk = None
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            record = self._definition(content, length)
            self.definitions.add(opcode, record, f"byte {self._at}")
            return
        self._close_loose()
        if opcode == Opcode.CHUNK:
            self._last_chunk = self._chunk(content, length)
            self.segments.append(self._last_chunk)
        elif opcode == Opcode.METADATA:
            self._take_metadata(self._definition(content, length))
        elif opcode == Opcode.ATTACHMENT:
            self._attachment(content, length)
        elif opcode == Opcode.HEADER:
            if self._at != len(MAGIC):
                raise MalformedRecord("a second header, as of two files in one")
            header = Header.read(Fields(self._definition(content, length), "the header"))
            self.profile, self.library = header.profile, header.library
        elif opcode == Opcode.DATA_END:
            self.data_end = self._at
            crc = Fields(self._file.peek(content, min(length, 4)), "the data end").read4()
            if self._resync and self._limit is None and length != 4:
                raise MalformedRecord("a data end of another length than its own")
            if self._limit is not None and content + length != self._limit:
                raise MalformedRecord("the data section does not end where the summary starts")
            self.data_crc = crc
        elif opcode <= max(Opcode):
            raise MalformedRecord(f"a {Opcode(opcode).name} record among the data")
        elif self._resync and opcode < _PRIVATE:
            raise MalformedRecord(f"no record of the format (opcode {opcode})")

    def _definition(self, content: int, length: int) -> bytes:
        """Read a record that is kept in memory."""
        if length > MAX_DEFINITION:
            raise MalformedRecord(f"a record of {length} bytes, above the limit {MAX_DEFINITION}")
        return self._file.read(content, length)

    def _chunk(self, content: int, length: int) -> Segment:
        head = self._file.peek(content, min(length, CHUNK_PEEK))
        return fitting(Segment.of_chunk(self._at, head), content + length)

    def _cut_chunk(self, content: int, length: int, limit: int) -> None:
        try:
            head = self._file.peek(content, min(limit - content, CHUNK_PEEK))
            tail = Segment.of_chunk(self._at, head)
            check_size(tail.compression, 0)
        except MalformedRecord:
            return
        if length == _OPEN_LENGTH:
            tail.size, tail.crc = MAX_CHUNK, 0
        else:
            fitting(tail, content + length)
        tail.stored, tail.cut = limit - tail.data_offset, True
        self.tail = tail

    def _message_index(self, content: int, length: int) -> None:
        chunk = self._last_chunk
        if chunk is None:
            raise MalformedRecord("a message index without its chunk")
        head = self._file.peek(content, min(length, _INDEX.size))
        if len(head) < _INDEX.size:
            raise MalformedRecord("a message index is cut short")
        number, size = _INDEX.unpack(head)
        if size + _INDEX.size > length or size % 16:
            raise MalformedRecord("a message index lies about its length")
        chunk.indexes.append(IndexPart(number, content + _INDEX.size, size // 16))

    def _loose_message(self, content: int, length: int) -> None:
        if length < _LOOSE.size + 8:
            raise MalformedRecord("a message is shorter than its own header")
        if length > MAX_CHUNK:
            raise MalformedRecord(f"a message of {length} bytes, above the limit of {MAX_CHUNK}")
        number, _, time = _LOOSE.unpack(self._file.peek(content, _LOOSE.size))
        end = content + length
        loose = self._loose
        if loose is not None and end - loose.offset > LOOSE_BYTES:
            self._close_loose()
            loose = None
        if loose is None:
            loose = self._loose = Segment(
                self._at, self._at, 0, 0, "", 0, time, time, chunked=False, counts={}
            )
            self._last_chunk = None
        loose.stored = loose.size = end - loose.offset
        loose.start, loose.end = min(loose.start, time), max(loose.end, time)
        assert loose.counts is not None
        loose.counts[number] = loose.counts.get(number, 0) + 1

    def _close_loose(self) -> None:
        if self._loose is not None:
            self.segments.append(self._loose)
            self._loose = None

    def _take_metadata(self, content: bytes) -> None:
        self._metadata_bytes += len(content)
        if self._metadata_bytes > MAX_DEFINITION:
            raise MalformedRecord(f"metadata takes more than {MAX_DEFINITION} bytes")
        fields = Fields(content, "metadata")
        self.metadata.append(Metadata.read(fields))
        self._inside = self._at + RECORD_HEADER.size + fields.count

    def _attachment(self, content: int, length: int) -> None:
        fields = Fields(self._file.read(content, min(length, _BEFORE_DATA)), "an attachment")
        log_time, create_time = fields.read8(), fields.read8()
        name, media_type = fields.read_prefixed_string(), fields.read_prefixed_string()
        size = fields.read8()
        if fields.count + size + 4 > length:
            raise MalformedRecord("an attachment lies about its length")
        data = content + fields.count
        self._inside = data + size + 4
        crc = int.from_bytes(self._file.read(data + size, 4), "little")
        found = Attachment(name, media_type, log_time, create_time, data, size, crc)
        if crc and self._file.crc(content, data + size) != crc:
            self._refuse(f"attachment {name[:80]!r}", "its CRC does not match: damaged")
            return
        self.attachments.append(found)

    # The end of the file

    def _cut(self, what: str, limit: int) -> bool:
        if self._limit is not None:
            raise MalformedRecord(
                "a record runs into the summary"
                if self._at < limit
                else "the data section has no end record"
            )
        self.missing = f"cut short: {what}"
        return False

    def _resume_after(self) -> bool:
        """Continue at the next chunk that the summary names, else at the next that is found."""
        self._close_loose()
        self._last_chunk = None
        found = None
        if self.summary and self.summary.named:
            found = next((c for c in self.summary.named if c > self._at), None)
        elif self._resync:
            stop = self._file.size if self._limit is None else self._limit
            found = next_chunk(self._file, self._sure + (self._sure == self._at), stop)
        if found is None:
            return False
        self.segments = [s for s in self.segments if s.offset < found]
        self.attachments = [a for a in self.attachments if a.offset < found]
        self._at = found
        return True

    def _resume_after_cut(self) -> bool:
        """Continue where it was a length that made the file look cut."""
        what = self.missing.removeprefix("cut short: ")
        torn = self.tail is None and self._at < self._file.size
        if not (self._resync and torn and self._resume_after()):
            return False
        self.missing = ""
        self._refuse(f"byte {self._sure}", what)
        return True

    def _read_end(self) -> None:
        self.summary = read_summary(self._file, self.definitions, self._tell)
        # What is wrong in a footer may be the place that it says the data to end at.
        lies = self._resync and self.summary is not None and self.summary.broken
        self._limit = self.summary.begin if self.summary and not lies else None

    def _compare_with(self, summary: Summary) -> None:
        """Refuse a summary that tells of other chunks, or of another number of messages."""
        if summary.named and [s.offset for s in self.segments if s.chunked] != summary.named:
            self._refuse("summary", "its chunk index does not name the chunks that are there")
        counts = [s.channel_counts() for s in self.segments]
        there = sum(sum(count.values()) for count in counts if count)
        stated = summary.statistics.message_count if summary.statistics else there
        if stated != there and None not in counts:
            self._refuse("summary", f"it states {stated} messages, there are {there}")
