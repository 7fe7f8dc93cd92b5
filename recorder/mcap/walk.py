"""Read the structure of a log: by a walk over its outer records, or from its summary.

The walk needs no index: it finds chunks, loose messages, metadata and attachments in
whole files, in files without a summary, and in files that were cut anywhere. The
summary is compared with them.
"""

from __future__ import annotations

import struct
from bisect import bisect_left
from collections.abc import Iterator
from typing import Final

from mcap.opcode import Opcode
from mcap.records import Header, Metadata

from cdmisfa.core.errors import LogDamagedError
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
    Problem,
    Segment,
    no_log,
)
from recorder.mcap.resync import cut_chunk, inner_end, is_record, next_chunk
from recorder.mcap.store import OnePass, Store
from recorder.mcap.summary import Summary, read_summary

# Messages outside chunks are decoded about this many bytes at once, as many as a chunk has.
LOOSE_BYTES: Final = 1024 * 1024
_LOOSE: Final = struct.Struct("<HIQ")
_INDEX: Final = struct.Struct("<HI")
_DATA_END_BYTES: Final = RECORD_HEADER.size + 4
# Most bytes of an attachment's names.
_BEFORE_DATA: Final = 1024 * 1024
# The first opcode of records that writers may define themselves.
_PRIVATE: Final = 0x80


class LogStructure:
    """The outer records of a log.

    Args:
        file: the log.
        skip_damaged: note damage in `problems`, and continue at the next sound chunk; else raise.
        by_index: believe a summary that accounts for every message, and read no chunk.

    Attributes:
        problems: the damage.
        by_index: the summary was believed.
        segments: chunks and messages outside them, in file order.
        torn: the chunk within which the file ends, or None.
        complete: the file has its end, and nothing is missing.
        missing: the end that a cut file lacks, in words; "" for a whole one.
        data_crc: CRC of the data section, 0 for none, None where the file ends before it.
        data_end: place where the data section ends.
        first_damage: place of the first record that is damaged, None where none is.
    """

    def __init__(self, file: Store, *, skip_damaged: bool, by_index: bool) -> None:
        self.file, self.path, self.skip_damaged = file, file.path, skip_damaged
        self.problems: list[Problem] = []
        self.by_index = self.complete = False
        self.first_damage: int | None = None
        self.definitions = Definitions(self.refuse)
        self.segments: list[Segment] = []
        self.torn: Segment | None = None
        self.metadata: list[Metadata] = []
        self.profile = self.library = self.missing = ""
        self.data_crc: int | None = None
        self.data_end = 0
        self._attachments: list[Attachment] = []
        self._attachment_ranges: list[tuple[int, int]] = []
        self._metadata_bytes = 0
        self._loose: Segment | None = None
        self._last_chunk: Segment | None = None
        # The place of the record, the place up to which records are sound, the end of an inner one.
        self._at = self._sure = len(MAGIC)
        self._inside = 0
        if not (start := file.read(0, len(MAGIC))):
            raise LogDamagedError(f"{file.path}: empty, nothing was written")
        if start != MAGIC:
            raise no_log(file.path)
        self.summary: Summary | None = read_summary(file, self.definitions, self.refuse)
        # The damage in a footer may be in the place where it says that the data ends.
        lies = skip_damaged and self.summary is not None and self.summary.broken
        self._limit = self.summary.begin if self.summary and not lies else None
        if not by_index or not self._take_index():
            self._walk_data()

    @property
    def attachments(self) -> list[Attachment]:
        """The attachments; their CRCs were checked."""
        spans, self._attachment_ranges = self._attachment_ranges, []
        try:
            for start, stop in spans:
                self._record_at(start, stop, Opcode.ATTACHMENT)
        except MalformedRecord as error:
            self.refuse("attachments", str(error))
        return self._attachments

    def refuse(self, where: str, what: str) -> None:
        """Raise an error for damage at a place, or note it with `skip_damaged`."""
        if not self.skip_damaged:
            raise LogDamagedError(
                f"{self.path}: {where}: {what}; save the rest with cdmisfa recover (from a "
                "recording, cdmisfa learn --skip-damaged leaves it out)"
            )
        self.note(where, what)

    def note(self, where: str, what: str) -> None:
        """Note a problem at a place once."""
        problem = Problem(where, what)
        self.problems += [problem] if problem not in self.problems else []

    def walk(self) -> Iterator[Segment]:
        """Walk over every record of a log that was opened by its index, in one pass.

        Yields:
            Each chunk that the index names, before the walk continues to the record behind it.
        """
        assert self._limit is not None
        assert isinstance(self.file, OnePass)
        self.file.start(self._limit)
        stated, self.segments, self._attachments = self.segments, [], []
        self.metadata, self._metadata_bytes, self._attachment_ranges = [], 0, []
        self.by_index, self.complete = False, False
        self._at, self.data_crc = len(MAGIC), None
        for segment in stated:
            self._walk_data(segment.offset)
            self.file.pass_to(segment.offset)
            yield segment
        self._walk_data()

    def _damaged(self, where: str, what: str) -> None:
        if self.first_damage is None:
            self.first_damage = self._at
        self.refuse(where, what)

    def _take_index(self) -> bool:
        """Take the chunks from the summary; return whether it accounts for every message."""
        summary = self.summary
        if summary is None:
            return False
        try:
            segments = summary.chunks(set(self.definitions.channels))
            if segments is None:
                return False
            attachments = summary.ranges(Opcode.ATTACHMENT_INDEX)
            self._record_at(len(MAGIC), None, Opcode.HEADER)
            self._record_at(summary.begin - _DATA_END_BYTES, summary.begin, Opcode.DATA_END)
            for start, stop in summary.ranges(Opcode.METADATA_INDEX):
                self._record_at(start, stop, Opcode.METADATA)
        except MalformedRecord:
            # A summary that lies is not used: the walk finds what is in the file.
            self._at, self.data_crc = len(MAGIC), None
            self.metadata, self._metadata_bytes = [], 0
            return False
        self.segments, self._attachment_ranges = segments, attachments
        self.by_index = self.complete = True
        return True

    def _record_at(self, start: int, stop: int | None, opcode: Opcode) -> None:
        """Read a record that the summary names."""
        head = self.file.peek(start, RECORD_HEADER.size).ljust(RECORD_HEADER.size, b"\0")
        present, length = RECORD_HEADER.unpack(head)
        if present != opcode or stop not in (None, start + RECORD_HEADER.size + length):
            raise MalformedRecord(f"at byte {start} is no {opcode.name} record")
        self._at = start
        self._take(present, start + RECORD_HEADER.size, length)

    def _walk_data(self, stop: int | None = None) -> None:
        """Walk over the records up to a place, or to the end of the data."""
        while self.data_crc is None and (stop is None or self._at < stop):
            limit = self.file.size if self._limit is None else self._limit
            where = f"byte {self._at}"
            try:
                if not self._step(limit) and not self._resume_after_cut():
                    break
            except MalformedRecord as error:
                self._damaged(where, str(error))
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
            for what in self.summary.contradictions(self.segments):
                self._damaged("summary", what)
        # The CRC of a cut chunk is that of records that are not there.
        if self.torn is not None and (self.skip_damaged or not self.torn.crc):
            self.segments.append(self.torn)

    # The outer records

    def _step(self, limit: int) -> bool:
        """Read the next record; return whether the file does not end there."""
        head = self.file.peek(self._at, RECORD_HEADER.size) if self._at < limit else b""
        if len(head) < RECORD_HEADER.size or self._at + RECORD_HEADER.size > limit:
            return self._cut("the end of the file and its index are missing")
        opcode, length = RECORD_HEADER.unpack(head)
        content = self._at + RECORD_HEADER.size
        end = content + length
        if opcode == 0:
            # Some file systems leave zeros where data did not reach the disk before a power cut.
            rest = self.file.blocks(self._at, self.file.size)
            if self._limit is None and not any(map(any, rest)):
                return self._cut(f"from byte {self._at} on there are only zeros")
            raise MalformedRecord("no record (opcode 0)")
        inner = inner_end(self.file, opcode, content) if self.skip_damaged else None
        if inner is not None and inner < end and is_record(self.file, inner, limit):
            # Only the record's own length is damaged: what it holds ends where a record begins.
            self._damaged(f"byte {self._at}", "a record's length is not that of what it holds")
            end, length = inner, inner - content
        if end > limit:
            if opcode == Opcode.CHUNK and self._limit is None:
                self.torn = cut_chunk(self.file, content, length, limit)
            return self._cut(
                f"the file ends within a record at byte {self._at}, {limit - self._at} bytes of it "
                "are there"
            )
        if self._at == len(MAGIC) and opcode != Opcode.HEADER:
            raise MalformedRecord("the file does not begin with a header record")
        if self.skip_damaged and self.summary and opcode != Opcode.CHUNK:
            # A damaged length would jump over sound chunks: the summary says where these begin.
            named = self.summary.named
            place = bisect_left(named, self._at)
            if place < len(named) and named[place] == self._at:
                raise MalformedRecord("no chunk where the summary names one")
            if place < len(named) and named[place] < end:
                raise MalformedRecord("a record runs over the chunk behind it")
        self._take(opcode, content, length)
        if end in (inner, self._inside):
            self._sure = end
        self._at = end
        return True

    def _take(self, opcode: int, content: int, length: int) -> None:
        if opcode == Opcode.MESSAGE:
            self._loose_message(content, length)
            return
        if opcode == Opcode.MESSAGE_INDEX:
            if self._last_chunk is None:
                raise MalformedRecord("a message index without its chunk")
            head = self.file.peek(content, min(length, _INDEX.size)).ljust(_INDEX.size, b"\0")
            channel, size = _INDEX.unpack(head)
            if size + _INDEX.size > length or size % 16:
                raise MalformedRecord("a message index lies about its length")
            part = IndexPart(channel, content + _INDEX.size, size // 16)
            self._last_chunk.indexes.append(part)
            return
        self._last_chunk = None
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            record = self._definition(content, length)
            self.definitions.add(opcode, record, f"byte {self._at}")
            return
        self._close_loose()
        if opcode == Opcode.CHUNK:
            head = self.file.peek(content, min(length, CHUNK_PEEK))
            self._last_chunk = Segment.of_chunk(self._at, head).within(content + length)
            self.segments.append(self._last_chunk)
        elif opcode == Opcode.METADATA:
            if self._metadata_bytes + length > MAX_DEFINITION:
                raise MalformedRecord(f"metadata takes more than {MAX_DEFINITION} bytes")
            self._metadata_bytes += length
            fields = Fields(self.file.read(content, length), "metadata")
            self.metadata.append(Metadata.read(fields))
            self._inside = content + fields.count
        elif opcode == Opcode.ATTACHMENT:
            self._attachment(content, length)
        elif opcode == Opcode.HEADER:
            if self._at != len(MAGIC):
                raise MalformedRecord("a second header, as of two files in one")
            header = Header.read(Fields(self._definition(content, length), "the header"))
            self.profile, self.library = header.profile, header.library
        elif opcode == Opcode.DATA_END:
            self.data_end = self._at
            crc = Fields(self.file.peek(content, min(length, 4)), "the data end").read4()
            if self.skip_damaged and self._limit is None and length != 4:
                raise MalformedRecord("a data end of another length than its own")
            if self._limit is not None and content + length != self._limit:
                raise MalformedRecord("the data section does not end where the summary starts")
            self.data_crc = crc
        elif opcode <= max(Opcode) or (self.skip_damaged and opcode < _PRIVATE):
            raise MalformedRecord(f"a record of opcode {opcode} among the data")

    def _definition(self, content: int, length: int) -> bytes:
        """Read a record that is kept in memory."""
        if length > MAX_DEFINITION:
            raise MalformedRecord(f"a record of {length} bytes, above the limit {MAX_DEFINITION}")
        return self.file.read(content, length)

    def _loose_message(self, content: int, length: int) -> None:
        """Add a message outside chunks to the messages before it."""
        if not _LOOSE.size + 8 <= length <= MAX_CHUNK:
            raise MalformedRecord(f"a message of {length} bytes: it has 22 to {MAX_CHUNK}")
        number, _, time = _LOOSE.unpack(self.file.peek(content, _LOOSE.size))
        end = content + length
        if self._loose is not None and end - self._loose.offset > LOOSE_BYTES:
            self._close_loose()
        if self._loose is None:
            places = self._at, self._at, 0, 0
            self._loose = Segment(*places, "", 0, time, time, chunked=False, counts={})
            self._last_chunk = None
        loose = self._loose
        loose.stored = loose.size = end - loose.offset
        loose.start, loose.end = min(loose.start, time), max(loose.end, time)
        assert loose.counts is not None
        loose.counts[number] = loose.counts.get(number, 0) + 1

    def _close_loose(self) -> None:
        if self._loose is not None:
            self.segments.append(self._loose)
            self._loose = None

    def _attachment(self, content: int, length: int) -> None:
        fields = Fields(self.file.read(content, min(length, _BEFORE_DATA)), "an attachment")
        log_time, create_time = fields.read8(), fields.read8()
        name, media_type = fields.read_prefixed_string(), fields.read_prefixed_string()
        size = fields.read8()
        if fields.count + size + 4 > length:
            raise MalformedRecord("an attachment lies about its length")
        data = content + fields.count
        self._inside = data + size + 4
        crc = int.from_bytes(self.file.read(data + size, 4), "little")
        if crc and self.file.crc(content, data + size) != crc:
            self._damaged(f"attachment {name[:80]!r}", "its CRC does not match: damaged")
            return
        times = log_time, create_time
        self._attachments.append(Attachment(name, media_type, *times, data, size))

    # The end of the file

    def _cut(self, what: str) -> bool:
        if self._limit is not None:
            raise MalformedRecord("the data section has no end record before the summary")
        self.missing = f"cut short: {what}"
        if self.torn is not None and self.torn.crc and not self.skip_damaged:
            self.missing += "; recover can save part of the last chunk, unverified"
        return False

    def _resume_after(self) -> bool:
        """Continue at the next chunk that the summary names, else at the next that looks sound."""
        self._close_loose()
        self._last_chunk = None
        place = None
        if self.summary and self.summary.named:
            place = next((c for c in self.summary.named if c > self._at), None)
        elif self.skip_damaged:
            stop = self.file.size if self._limit is None else self._limit
            place = next_chunk(self.file, self._sure + (self._sure == self._at), stop)
        if place is None:
            return False
        # Records behind the last sound one may have been read at wrong places.
        self.segments = [s for s in self.segments if s.offset < place]
        self._attachments = [a for a in self._attachments if a.offset < place]
        self._at = place
        return True

    def _resume_after_cut(self) -> bool:
        """Continue where it was a damaged length that made the file look cut."""
        what = self.missing.removeprefix("cut short: ")
        more = self.torn is None and self._at < self.file.size
        if not (self.skip_damaged and more and self._resume_after()):
            return False
        self.missing = ""
        self._damaged(f"byte {self._sure}", what)
        return True
