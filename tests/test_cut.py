"""`cut`: messages are copied as they are, chunks that are wanted in all without being decoded."""

from __future__ import annotations

import contextlib
import errno
import json
import random
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import mcap_files
import numpy as np
import pytest
from conftest import Cdmisfa
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import NonSeekingReader, make_reader
from mcap.writer import CompressionType, IndexType, Writer

from cdmisfa.core.errors import LogExhaustedError, UsageError
from recorder.config import Split
from recorder.log import logfile
from recorder.mcap import chunks
from recorder.mcap.reader import LogReader
from replay.cutting.cut import cut_logs
from replay.integrity.verify import check_logs
from replay.recordings.source import RecordedSource

SECOND = 10**9


class Logged(NamedTuple):
    """A message with all that a log says of it."""

    topic: str
    encoding: str
    metadata: tuple[tuple[str, str], ...]
    schema: tuple[str, str, bytes]
    sequence: int
    log_time: int
    publish_time: int
    data: bytes


def write(path: Path, messages: Iterable[tuple[str, int]], seed: int = 0, **how: Any) -> Path:
    """A log with messages of such topics and times, with an attachment and metadata."""
    numbers = random.Random(seed)
    how = {"compression": CompressionType.ZSTD, "chunk_size": 600, **how}
    channels: dict[str, int] = {}
    with path.open("wb") as file:
        writer = Writer(file, enable_data_crcs=True, **how)
        writer.start(profile="robot", library="tests")
        writer.add_attachment(7, SECOND, f"map {seed}", "image/png", b"attached")
        writer.add_metadata("robot", {"name": "icub", "seed": str(seed)})
        for i, (topic, time) in enumerate(messages):
            if topic not in channels:
                schema = writer.register_schema(f"of {topic}", "ros2msg", topic.encode() * 3)
                channels[topic] = writer.register_channel(topic, "cdr", schema, {"of": topic})
            data = numbers.randbytes(numbers.randrange(60, 120))
            writer.add_message(channels[topic], time, data, time + 3, i)
        writer.finish()
    return path


def steady(topics: Sequence[str], count: int, start: int = SECOND) -> list[tuple[str, int]]:
    return [(topics[i % len(topics)], start + i * SECOND // 10) for i in range(count)]


def read(*paths: Path, topics: Sequence[str] | None = None) -> list[Logged]:
    """All messages in file order, by the mcap package alone."""
    found = []
    for path in paths:
        with path.open("rb") as file:
            reader = NonSeekingReader(file, validate_crcs=True)
            for schema, channel, one in reader.iter_messages(topics, log_time_order=False):
                assert schema is not None
                kind = schema.name, schema.encoding, schema.data
                about = tuple(channel.metadata.items())
                of = channel.topic, channel.message_encoding, about, kind, one.sequence
                found.append(Logged(*of, one.log_time, one.publish_time, one.data))
    return found


def sound(path: Path) -> LogReader:
    """A log in which every record was looked at, with all checksums."""
    with LogReader(path, check="data") as reader:
        assert [table for _, table in reader.one_pass() if table is None] == reader.warnings == []
        return reader


def stored(path: Path) -> list[bytes]:
    """The chunks of a log, as they stand in the file."""
    raw = path.read_bytes()
    with LogReader(path) as reader:
        return [raw[s.offset : s.data_end] for s in reader.segments]


TOPICS = ("/a", "/b", "/cam")
TIMES = st.lists(
    st.tuples(st.sampled_from(TOPICS), st.integers(0, 4 * SECOND)), min_size=1, max_size=60
)


@given(
    TIMES,
    st.none() | st.integers(0, 4 * SECOND),
    st.integers(1, 4 * SECOND),
    st.sets(st.sampled_from(["/a", "/b", "/c*"])),
    st.sampled_from([CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE]),
    st.sampled_from([IndexType.ALL, IndexType.NONE]),
    st.booleans(),
)
def test_of_a_log_it_takes_what_a_loop_over_its_messages_would(
    tmp_path_factory: pytest.TempPathFactory,
    messages: list[tuple[str, int]],
    start: int | None,
    length: int,
    topics: set[str],
    compression: CompressionType,
    index: IndexType,
    chunked: bool,
) -> None:
    folder = tmp_path_factory.mktemp("cut")
    how = {"compression": compression, "index_types": index, "use_chunking": chunked}
    log, out, rows = write(folder / "a.mcap", messages, **how), folder / "b.mcap", folder / "s.json"
    start, stop = (0, 2**63) if start is None else (start, start + length)
    rows.write_text(json.dumps([{"start": start, "stop": stop}]))
    names = {"/a": "/a", "/b": "/b", "/c*": "/cam"}
    wanted = {names[topic] for topic in topics} or set(TOPICS)
    expected = [m for m in read(log) if m.topic in wanted and start <= m.log_time < stop]
    if not expected:
        with pytest.raises(UsageError, match="no message there"):
            cut_logs([log], out, segments=rows, topics=sorted(topics))
        assert not out.exists()
        return
    found = cut_logs([log], out, segments=rows, topics=sorted(topics))
    assert read(out) == expected
    reader = sound(out)
    times = [m.log_time for m in expected]
    assert (found.files[0].start_ns, found.files[0].end_ns) == (min(times), max(times))
    assert found.files[0].messages == len(expected)
    assert not found.problems
    assert {c.topic for c in reader.channels.values()} == wanted & {t for t, _ in messages}


@given(st.lists(TIMES, min_size=2, max_size=4), st.booleans())
def test_joined_logs_are_in_the_order_of_log_time(
    tmp_path_factory: pytest.TempPathFactory, logs: list[list[tuple[str, int]]], apart: bool
) -> None:
    folder = tmp_path_factory.mktemp("cut")
    paths = []
    for i, messages in enumerate(logs):
        later = 10 * i * SECOND if apart else 0
        paths.append(write(folder / f"{i}.mcap", [(t, at + later) for t, at in messages], i))
    cut_logs(paths, folder / "out.mcap")
    expected = sorted((m for path in paths for m in read(path)), key=lambda m: m.log_time)
    found = read(folder / "out.mcap")
    assert [m.log_time for m in found] == [m.log_time for m in expected]
    assert sorted(found) == sorted(expected)
    reader = sound(folder / "out.mcap")
    assert len(reader.channels) == len({t for messages in logs for t, _ in messages})
    assert [m.values["seed"] for m in reader.metadata if m.name == "robot"] == [
        str(i) for i in range(len(logs))
    ]


def test_a_chunk_that_is_wanted_in_all_is_copied_byte_for_byte(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = write(tmp_path / "a.mcap", steady(("/a", "/b"), 200))
    made = stored(log)
    decoded: list[int] = []
    monkeypatch.setattr(
        chunks, "decompressed", lambda *a, **k: decoded.append(1) or chunks.decompressed(*a, **k)
    )
    cut_logs([log], tmp_path / "all.mcap")
    assert stored(tmp_path / "all.mcap") == made
    assert not decoded
    monkeypatch.undo()
    cut_logs([log], tmp_path / "some.mcap", start=5, stop=15)
    some = stored(tmp_path / "some.mcap")
    assert set(some[1:-1]) < set(made)
    assert len(some) > 10
    sound(tmp_path / "some.mcap")


def test_logs_one_after_the_other_are_joined_without_being_decoded(tmp_path: Path) -> None:
    one = write(tmp_path / "a.mcap", steady(("/a", "/b"), 80))
    two = write(tmp_path / "b.mcap", steady(("/a", "/b"), 80, 60 * SECOND), 1)
    cut_logs([two, one], tmp_path / "out.mcap")
    assert stored(tmp_path / "out.mcap") == stored(one) + stored(two)
    assert read(tmp_path / "out.mcap") == read(one, two)


def test_ids_that_mean_something_else_in_another_log_are_changed(tmp_path: Path) -> None:
    one = write(tmp_path / "a.mcap", steady(("/a", "/b"), 30))
    two = write(tmp_path / "b.mcap", steady(("/b", "/c"), 30), 1)
    cut_logs([one, two], tmp_path / "out.mcap")
    reader = sound(tmp_path / "out.mcap")
    assert sorted(c.topic for c in reader.channels.values()) == ["/a", "/b", "/c"]
    assert sorted(read(tmp_path / "out.mcap")) == sorted(read(one, two))


def test_attachments_metadata_and_where_it_came_from_are_kept(tmp_path: Path) -> None:
    log = write(tmp_path / "a.mcap", steady(("/a",), 30))
    cut_logs([log], tmp_path / "b.mcap", stop=1)
    cut_logs([tmp_path / "b.mcap"], tmp_path / "c.mcap")
    with (tmp_path / "c.mcap").open("rb") as file:
        reader = make_reader(file)
        (attached,) = reader.iter_attachments()
        metadata = list(reader.iter_metadata())
        assert reader.get_header().profile == "robot"
    assert (attached.name, attached.data, attached.log_time) == ("map 0", b"attached", SECOND)
    assert [m.name for m in metadata] == ["robot", "cdmisfa.cut", "cdmisfa.cut"]
    (origin,) = json.loads(metadata[1].metadata["logs"])
    assert origin == {
        "file": "a.mcap",
        "bytes": log.stat().st_size,
        "wanted": [[SECOND, 2 * SECOND, "*"]],
    }


@pytest.mark.parametrize("compression", ["", "zstd", "lz4"])
def test_every_form_of_the_format_is_cut(tmp_path: Path, compression: str) -> None:
    for number, (kind, features) in enumerate(mcap_files.variants()):
        if kind not in ("ten", "schemaless"):
            continue
        path, out = tmp_path / f"{number}.mcap", tmp_path / f"{number}-cut.mcap"
        path.write_bytes(mcap_files.variant(kind, features, compression))
        assert not cut_logs([path], out).problems
        with LogReader(path) as one, LogReader(out, check="data") as two:
            assert list(two.messages()) == list(one.messages())
            assert two.warnings == []


class TestSplit:
    def test_by_time(self, tmp_path: Path) -> None:
        log = write(tmp_path / "a.mcap", steady(("/a", "/b"), 100))
        cut_logs([log], tmp_path / "out", split=Split.parse("3s"))
        parts = sorted((tmp_path / "out").iterdir())
        assert [part.name for part in parts] == [f"a-{i:03d}.mcap" for i in range(4)]
        assert read(*parts) == read(log)
        starts = [sound(part).segments[0].start for part in parts]
        assert starts == [SECOND * (1 + 3 * i) for i in range(4)]

    def test_by_size(self, tmp_path: Path) -> None:
        log = write(
            tmp_path / "a.mcap", steady(("/a", "/b"), 400), compression=CompressionType.NONE
        )
        done = cut_logs([log], tmp_path / "out.mcap", split=Split.parse("10kB"))
        parts = [Path(part.file) for part in done.files]
        assert [part.name for part in parts[:2]] == ["out-000.mcap", "out-001.mcap"]
        assert read(*parts) == read(log)
        assert all(part.stat().st_size < 16_000 for part in parts)


class TestRecording:
    """A recording that is cut is one, and says which is its first frame."""

    def same(self, cut: Path, recording: Path) -> list[int]:
        """The frames of a part, which are those of the recording."""
        with contextlib.ExitStack() as stack:
            whole, part = (
                stack.enter_context(contextlib.closing(RecordedSource(path)))
                for path in (recording, cut)
            )
            assert part.spec.streams == whole.spec.streams
            shown = []
            with contextlib.suppress(LogExhaustedError):
                while True:
                    if not (found := part.take_all(1)):
                        continue
                    whole.seek(found[0].t)
                    for one, two in zip(found, whole.take_all(1), strict=True):
                        assert (one.t, one.stream) == (two.t, two.stream)
                        assert np.array_equal(one.frames, two.frames)
                        assert np.array_equal(one.truth, two.truth)
                    shown.append(found[0].t)
        return shown

    def test_by_time(self, tmp_path: Path, oscillatory_recording: Path) -> None:
        cut_logs([oscillatory_recording], tmp_path / "cut", start=2, stop=4.5)
        assert self.same(tmp_path / "cut", oscillatory_recording) == list(range(100, 225))
        assert check_logs(tmp_path / "cut").state == "whole"

    def test_in_parts_and_joined_again(self, tmp_path: Path, oscillatory_recording: Path) -> None:
        cut_logs([oscillatory_recording], tmp_path / "cut", start=2, split=Split.parse("1s"))
        parts = sorted((tmp_path / "cut").glob("x1-*"))
        assert len(parts) > 3
        frames = self.same(tmp_path / "cut", oscillatory_recording)
        assert frames == list(range(100, 2000))
        cut_logs(parts, tmp_path / "one" / "x1.mcap")
        cut_logs([oscillatory_recording / "x1.mcap"], tmp_path / "two" / "x1.mcap", start=2)
        assert read(tmp_path / "one" / "x1.mcap") == read(tmp_path / "two" / "x1.mcap")
        assert self.same(tmp_path / "one", tmp_path / "two") == frames

    def test_segments_leave_gaps_that_no_block_reaches_across(
        self, tmp_path: Path, oscillatory_recording: Path
    ) -> None:
        with LogReader(oscillatory_recording / "x1.mcap") as reader:
            zero = reader.segments[0].start
        times = [(zero + a * SECOND, zero + b * SECOND) for a, b in ((1, 2), (5, 7))]
        rows = tmp_path / "s.csv"
        rows.write_text("start,stop\n" + "".join(f"{a},{b}\n" for a, b in times))
        cut_logs([oscillatory_recording], tmp_path / "cut", segments=rows)
        expected = [*range(50, 100), *range(250, 350)]
        assert self.same(tmp_path / "cut", oscillatory_recording) == expected
        with contextlib.closing(RecordedSource(tmp_path / "cut")) as source:
            taken = [len(block) for _ in range(7) for block in source.take_all(40)[:1]]
        assert taken == [40, 10, 40, 40]

    @pytest.mark.parametrize("topics", [["/truth"], ["/view/*"]])
    def test_frames_without_their_truth_are_refused(
        self, tmp_path: Path, oscillatory_recording: Path, topics: list[str]
    ) -> None:
        with pytest.raises(UsageError, match="its frames on /view/x1 and /truth: cut these alike"):
            cut_logs([oscillatory_recording], tmp_path / "cut", topics=topics)

    def test_views_are_not_joined(self, tmp_path: Path, oscillatory_recording: Path) -> None:
        with pytest.raises(UsageError, match=r"different views or recordings.*name a folder"):
            cut_logs([oscillatory_recording], tmp_path / "cut.mcap")
        assert not list(tmp_path.iterdir())

    def test_a_run_is_not_cut(self, tmp_path: Path, oscillatory_run: Path) -> None:
        with pytest.raises(UsageError, match="log of a run, which is not cut"):
            cut_logs([oscillatory_run / "run.mcap"], tmp_path / "cut.mcap")


class TestDamage:
    @pytest.mark.parametrize("whole", [True, False])
    def test_a_damaged_chunk_is_left_out_and_said(
        self, tmp_path: Path, cdmisfa: Cdmisfa, whole: bool
    ) -> None:
        log = write(tmp_path / "a.mcap", steady(("/a", "/b"), 200))
        before, made = read(log), stored(log)
        with LogReader(log) as reader:
            chunk = reader.segments[7]
        raw = bytearray(log.read_bytes())
        raw[chunk.data_offset + 30] ^= 4
        log.write_bytes(raw)
        part = [] if whole else ["--to", "9"]
        done = cdmisfa("cut", log, "-o", tmp_path / "b.mcap", *part)
        assert done.code == 3
        assert done.err.count("\n") == 2
        assert f"chunk at byte {chunk.offset}" in done.err
        stop = 200 * SECOND if whole else 10 * SECOND
        kept = [m for m in before if not chunk.start <= m.log_time <= chunk.end]
        assert read(tmp_path / "b.mcap") == [m for m in kept if m.log_time < stop]
        assert stored(tmp_path / "b.mcap")[7] == made[8]
        sound(tmp_path / "b.mcap")

    def test_a_log_that_was_cut_short(self, tmp_path: Path, cdmisfa: Cdmisfa) -> None:
        log = write(tmp_path / "a.mcap", steady(("/a", "/b"), 200))
        before = read(log)
        log.write_bytes(log.read_bytes()[:9000])
        done = cdmisfa("cut", log, "-o", tmp_path / "b.mcap")
        assert done.code == 3
        assert "cut short" in done.err
        found = read(tmp_path / "b.mcap")
        assert found == before[: len(found)]
        assert len(found) > 50

    def test_one_log_of_several_that_is_none(self, tmp_path: Path, cdmisfa: Cdmisfa) -> None:
        log, bad = write(tmp_path / "a.mcap", steady(("/a",), 20)), tmp_path / "b.mcap"
        bad.write_bytes(b"nothing of the kind")
        for out in (tmp_path / "out", tmp_path / "out.mcap"):
            done = cdmisfa("cut", log, bad, "-o", out)
            assert (done.code, done.err) == (
                3,
                f"{bad}: not an MCAP file (its first bytes are not MCAP's)\n",
            )
        assert read(tmp_path / "out.mcap") == read(tmp_path / "out" / "a.mcap") == read(log)

    def test_a_full_disk_is_one_line_and_leaves_nothing(
        self, tmp_path: Path, cdmisfa: Cdmisfa, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        log = write(tmp_path / "a.mcap", steady(("/a",), 200))
        write_all, room = logfile.AppendOnlyFile.write, [8000]

        def fill(self: logfile.AppendOnlyFile, data: bytes) -> int:
            room[0] -= len(data)
            if room[0] < 0:
                raise logfile.write_error(self._path, OSError(errno.ENOSPC, "No space left"))
            return write_all(self, data)

        monkeypatch.setattr(logfile.AppendOnlyFile, "write", fill)
        done = cdmisfa("cut", log, "-o", tmp_path / "out" / "b.mcap")
        assert done.code == 1
        assert done.err.count("\n") == 1
        assert "No space left" in done.err
        assert not list((tmp_path / "out").iterdir())


class TestSegments:
    def test_each_row_names_its_log_and_may_name_a_topic(self, tmp_path: Path) -> None:
        paths = [write(tmp_path / f"{i}.mcap", steady(("/a", "/b"), 100), i) for i in range(2)]
        rows = tmp_path / "s.csv"
        rows.write_text(
            "path,start,stop,topic\n"
            f"0.mcap,{2 * SECOND},1970-01-01T00:00:03Z,/a\n"
            f"{paths[1]},1970-01-01 00:00:02.5,{9 * SECOND // 2},\n"
            f"0.mcap,{5 * SECOND // 2},{4 * SECOND},\n"
        )
        cut_logs([], tmp_path / "out", segments=rows)
        one = [
            m
            for m in read(paths[0])
            if (2 * SECOND <= m.log_time < 3 * SECOND and m.topic == "/a")
            or 5 * SECOND // 2 <= m.log_time < 4 * SECOND
        ]
        two = [m for m in read(paths[1]) if 2.5 * SECOND <= m.log_time < 4.5 * SECOND]
        assert read(tmp_path / "out" / "0.mcap") == one
        assert read(tmp_path / "out" / "1.mcap") == two

    @pytest.mark.parametrize(
        ("name", "text", "said"),
        [
            ("s.csv", "path,start\na.mcap,1\n", "line 2 misses stop"),
            ("s.csv", "start,stop\n5,5\n", "line 2: its times [5, 5) ns hold no moment"),
            ("s.csv", "start,stop\n1.5,5\n", "line 2: '1.5' is no time"),
            ("s.csv", "start,stop\n2000-13-01T00:00:00,5\n", "line 2: "),
            ("s.csv", "", "it lists no segment"),
            ("s.json", "{}", "JSON is a list of objects"),
            ("s.json", "[{]", "it is no list of segments"),
            ("s.json", '[{"start": true, "stop": 3}]', "segment 0: 'True' is no time"),
            ("s.json", '[{"start": 1, "stop": 3, "topic": 7}]', "its topic is no text"),
            ("s.json", '[{"start": 1, "stop": 3, "path": "no.mcap"}]', "name their logs"),
            ("s.csv", b"\xff\xfe\x00", "it is no list of segments"),
        ],
    )
    def test_what_is_no_list_is_refused(
        self, tmp_path: Path, cdmisfa: Cdmisfa, name: str, text: str | bytes, said: str
    ) -> None:
        log, rows = write(tmp_path / "a.mcap", steady(("/a",), 9)), tmp_path / name
        rows.write_bytes(text if isinstance(text, bytes) else text.encode())
        done = cdmisfa("cut", log, "--segments", rows, "-o", tmp_path / "b.mcap")
        assert (done.code, done.err.count("\n")) == (2, 1)
        assert said in done.err
        assert str(rows) in done.err


def test_logs_of_one_name_keep_the_folders_that_they_differ_by(
    cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    for name in ("one", "two"):
        cdmisfa("record", "oscillatory", "--frames", 60, "-o", tmp_path / name)
    listed = tmp_path / "wanted.csv"
    rows = (
        f"{name}/{view}.mcap,0,1600000000000000000"
        for name in ("one", "two")
        for view in ("x1", "x2", "x3")
    )
    listed.write_text("\n".join(["path,start,stop", *rows]) + "\n")
    assert cdmisfa("cut", "--segments", listed, "-o", tmp_path / "out").code == 0
    for name in ("one", "two"):
        assert check_logs(tmp_path / "out" / name).state == "whole"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["a.mcap", "-o", "a.mcap", "--force"], "cannot be cut into itself"),
        (["a.mcap", "-o", "b.mcap"], "b.mcap exists: choose another name"),
        (["a.mcap", "-o", "full"], "full exists: choose another folder or overwrite"),
        (["a.mcap", "-o", "c.mcap", "--from", "5", "--to", "4"], "--from 5 is no earlier"),
        (["a.mcap", "-o", "c.mcap", "--topic", "/none"], "no message there is of these"),
        (["a.mcap", "-o", "new", "--topic", "/none"], "no message there is of these"),
        (["a.mcap", "-o", "c.mcap", "--split", "3"], "--split is '3'"),
        (["film.mp4", "-o", "c.mcap"], "film.mp4 is no MCAP file, and others are not cut"),
        (["-o", "c.mcap"], "no log was named"),
        (["none.mcap", "-o", "c.mcap"], "no such file"),
    ],
)
def test_what_is_refused(
    tmp_path: Path, cdmisfa: Cdmisfa, monkeypatch: pytest.MonkeyPatch, words: list[str], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "full").mkdir()
    for path in (Path("a.mcap"), Path("full/a.mcap")):
        write(path, steady(("/a",), 20))
    Path("b.mcap").touch()
    Path("film.mp4").touch()
    done = cdmisfa("cut", *words)
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert said in done.err
    assert not Path("c.mcap").exists()
    assert not Path("new").exists()


def test_json_says_what_was_written(tmp_path: Path, cdmisfa: Cdmisfa) -> None:
    log, out = write(tmp_path / "a.mcap", steady(("/a",), 20)), tmp_path / "b.mcap"
    done = cdmisfa("cut", log, "-o", out, "--from", "0.5", "--json")
    start, end = SECOND * 3 // 2, SECOND * 29 // 10
    told = {"bytes": out.stat().st_size, "messages": 15, "start_ns": start, "end_ns": end}
    assert done.json == {
        "schema": 1,
        "complete": True,
        "files": [{"file": str(out), **told}],
        "problems": [],
    }
