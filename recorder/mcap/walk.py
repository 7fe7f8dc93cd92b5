"""Structure of an MCAP log: read from its summary, or by a walk over its outer records.

The walk needs no index. It finds chunks, messages outside chunks, metadata and attachments in
complete files, in files without a summary, and in files that are cut anywhere, and compares the
summary with them.
"""

from __future__ import annotations

import contextlib
import struct
from bisect import bisect_left
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
from recorder.mcap.store import Store
from recorder.mcap.summary import Summary, read_summary

# Approximate size of the pieces in which messages outside chunks are decoded, that of a usual
# chunk.
LOOSE_BYTES: Final = 1024 * 1024
_LOOSE: Final = struct.Struct("<HIQ")  # channel, sequence and log time of a message
_INDEX: Final = struct.Struct("<HI")  # channel and size of a message index
_DATA_END_BYTES: Final = RECORD_HEADER.size + 4
# Largest size of an attachment's fields before its data (name and media type).
_BEFORE_DATA: Final = 1024 * 1024
# First opcode that the format reserves for records of other programs.
_PRIVATE: Final = 0x80


class LogStructure:
    """The outer records of a log.

    Args:
        file: the log.
        skip_damaged: True to note damage in `problems`, and continue at the next sound chunk; False
            to raise an error.
        by_index: True to trust a summary that accounts for every message, and read no chunk.

    Attributes:
        problems: the damage.
        by_index: True if the summary was trusted.
        segments: chunks and stretches of messages outside chunks, in file order.
        torn: the chunk in which the file ends, or None.
        complete: True if the file has its end, and nothing is missing.
        missing: description of the missing end of a cut file; "" if nothing is missing.
        data_crc: CRC of the data section; 0: none; None: the file ends before it.
        data_end: offset at which the data section ends.
        first_damage: offset of the first damaged record; None if there is none.
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
        # Offset of the present record; offset up to which records are sound; end of an inner
        # record.
        self._at = self._sure = len(MAGIC)
        self._inside = 0
        if not (start := file.read(0, len(MAGIC))):
            raise LogDamagedError(f"{file.path}: it is empty: record or copy it again")
        if start != MAGIC:
            raise no_log(file.path)
        self.summary: Summary | None = read_summary(file, self.definitions, self.refuse)
        # In a damaged footer the offset at which the data section ends can be wrong.
        lies = skip_damaged and self.summary is not None and self.summary.broken
        self._limit = self.summary.begin if self.summary and not lies else None
        if not by_index or not self._take_index():
            self._walk_data()

    @property
    def attachments(self) -> list[Attachment]:
        """The attachments; reading them checks their CRCs."""
        spans, self._attachment_ranges = self._attachment_ranges, []
        try:
            for start, stop in spans:
                self._record_at(start, stop, Opcode.ATTACHMENT)
        except MalformedRecord as error:
            self.refuse("attachments", str(error))
        return self._attachments

    def refuse(self, place: str, problem: str) -> None:
        """Raise an error for damage or, with `skip_damaged`, note it."""
        if not self.skip_damaged:
            raise LogDamagedError(
                f"{self.path}: {place}: {problem}; repair the file with cdmisfa recover "
                "(of a recording or log, learn, convert and apply skip it with --skip-damaged)"
            )
        self.note(place, problem)

    def note(self, place: str, problem: str) -> None:
        """Add a problem to `problems`, unless it is there."""
        new = Problem(place, problem)
        self.problems += [new] if new not in self.problems else []

    def _damaged(self, place: str, problem: str) -> None:
        if self.first_damage is None:
            self.first_damage = self._at
        self.refuse(place, problem)

    def _take_index(self) -> bool:
        """Take chunks from the summary; return False if it does not account for each message."""
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
            # The summary is wrong: do not use it. The walk finds the content of the file.
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
            raise MalformedRecord(f"there is no {opcode.name} record at byte {start}")
        self._at = start
        self._take(present, start + RECORD_HEADER.size, length)

    def _walk_data(self) -> None:
        """Walk over the records up to the end of the data section."""
        while self.data_crc is None:
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
        self._close_loose()
        if self.data_crc is not None and self._limit is None and not self.missing:
            self.missing = "cut short: part of its summary is missing, but no message is"
        self.complete = self._limit is not None and self.data_crc is not None
        if self.complete and self.summary:
            for contradiction in self.summary.contradictions(self.segments):
                self._damaged("summary", contradiction)
        # The CRC of a cut chunk is that of its complete records.
        if self.torn is not None and (self.skip_damaged or not self.torn.crc):
            self.segments.append(self.torn)

    def _define_behind_data(self) -> None:
        """Take further schemas and channels from a summary that the footer does not name."""
        at, defined = self._at, self.definitions
        known = {Opcode.SCHEMA: {*defined.schemas}, Opcode.CHANNEL: {*defined.channels}}
        with contextlib.suppress(MalformedRecord, struct.error):
            while True:
                opcode, length = RECORD_HEADER.unpack(self.file.peek(at, RECORD_HEADER.size))
                if opcode not in known:
                    return
                record = self._definition(at + RECORD_HEADER.size, length)
                if int.from_bytes(record[:2], "little") not in known[Opcode(opcode)]:
                    defined.add(opcode, record, f"byte {at}")
                at += RECORD_HEADER.size + length

    # The outer records

    def _step(self, limit: int) -> bool:
        """Read the next record; return False if the file ends here."""
        head = self.file.peek(self._at, RECORD_HEADER.size) if self._at < limit else b""
        if len(head) < RECORD_HEADER.size or self._at + RECORD_HEADER.size > limit:
            return self._cut("the end of the file and its index are missing")
        opcode, length = RECORD_HEADER.unpack(head)
        content = self._at + RECORD_HEADER.size
        end = content + length
        if opcode == 0:
            # After a power cut some file systems leave zeros where data did not reach the disk.
            rest = self.file.blocks(self._at, self.file.size)
            if self._limit is None and not any(map(any, rest)):
                return self._cut(f"from byte {self._at} on there are only zeros")
            raise MalformedRecord("no record (opcode 0)")
        inner = inner_end(self.file, opcode, content) if self.skip_damaged else None
        if inner is not None and inner < end and is_record(self.file, inner, limit):
            # Only the length of the record is damaged: its content ends where a record begins.
            self._damaged(f"byte {self._at}", "the length of a record contradicts its content")
            end, length = inner, inner - content
        if end > limit:
            if opcode == Opcode.CHUNK and self._limit is None:
                self.torn = cut_chunk(self.file, content, length, limit)
            return self._cut(f"the file ends within the record at byte {self._at}")
        if self._at == len(MAGIC) and opcode != Opcode.HEADER:
            raise MalformedRecord("the file does not begin with a header record")
        if self.skip_damaged and self.summary and opcode != Opcode.CHUNK:
            # A damaged length would skip sound chunks: the summary has their offsets.
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
                raise MalformedRecord("the length of a message index contradicts its content")
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
                raise MalformedRecord("there is a second header, as in two joined files")
            header = Header.read(Fields(self._definition(content, length), "the header"))
            self.profile, self.library = header.profile, header.library
        elif opcode == Opcode.DATA_END:
            self.data_end = self._at
            crc = Fields(self.file.peek(content, min(length, 4)), "the data end").read4()
            if self.skip_damaged and self._limit is None and length != 4:
                raise MalformedRecord("a data end record has a wrong length")
            if self._limit is not None and content + length != self._limit:
                raise MalformedRecord("the data section does not end where the summary starts")
            self.data_crc = crc
        elif opcode <= max(Opcode) or (self.skip_damaged and opcode < _PRIVATE):
            raise MalformedRecord(f"the data section has a record of opcode {opcode}")

    def _definition(self, content: int, length: int) -> bytes:
        """Read a record that is stored in memory."""
        if length > MAX_DEFINITION:
            raise MalformedRecord(f"a record of {length} bytes, above the limit {MAX_DEFINITION}")
        return self.file.read(content, length)

    def _loose_message(self, content: int, length: int) -> None:
        """Add a message outside chunks to the present stretch of such messages."""
        if not _LOOSE.size + 8 <= length <= MAX_CHUNK:
            raise MalformedRecord(f"a message has {length} bytes, not 22 to {MAX_CHUNK}")
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
            raise MalformedRecord("the length of an attachment contradicts its content")
        data = content + fields.count
        self._inside = data + size + 4
        crc = int.from_bytes(self.file.read(data + size, 4), "little")
        if crc and self.file.crc(content, data + size) != crc:
            self._damaged(f"attachment {name[:80]!r}", "its CRC does not match: damaged")
            return
        times = log_time, create_time
        self._attachments.append(Attachment(name, media_type, *times, data, size))

    # The end of the file

    def _cut(self, fact: str) -> bool:
        if self._limit is not None:
            raise MalformedRecord("the data section has no end record before the summary")
        self.missing = f"cut short: {fact}"
        if self.torn is not None and self.torn.crc and not self.skip_damaged:
            self.missing += "; cdmisfa recover can save part of the last chunk"
        return False

    def _resume_after(self) -> bool:
        """Continue at the next chunk in the summary, or else at the next that looks sound."""
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
        # Records after the last sound one may have been read at wrong offsets: drop them.
        self.segments = [s for s in self.segments if s.offset < place]
        self._attachments = [a for a in self._attachments if a.offset < place]
        self._at = place
        return True

    def _resume_after_cut(self) -> bool:
        """Continue if the file looked cut only because of a damaged length."""
        fact = self.missing.removeprefix("cut short: ")
        more = self.torn is None and self._at < self.file.size
        if not (self.skip_damaged and more and self._resume_after()):
            return False
        self.missing = ""
        self._damaged(f"byte {self._sure}", fact)
        return True
