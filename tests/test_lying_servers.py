"""Servers that lie, and the time that they are given; `server_cases` has all of them."""

from __future__ import annotations

import contextlib
import time
import tracemalloc
from dataclasses import replace
from pathlib import Path

import pytest
from conftest import Cdmisfa
from lying_server import Exchange, lying

from cdmisfa.core.errors import CdmisfaError
from recorder.mcap.reader import LogReader
from replay.storage import servers
from replay.storage.location import Limits, Url, limited, limits
from replay.storage.remote import RemoteStore
from replay.storage.servers import UnreachableError, backoff, retry_seconds
from tools.torture.server_cases import CAMERAS, CASES, Case, Given, check, prepare
from tools.torture.server_lies import LIES

pytest.importorskip("aiohttp")

BODY = bytes(range(256)) * 1200


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(servers, "FIRST_WAIT", 0.005)


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Given:
    return prepare(tmp_path_factory.mktemp("lies"))


def read(lie: str, held: Limits, at: int = 200_000) -> bytes:
    """What a store gives of a server's object, after its beginning."""
    with lying(BODY, LIES[lie]) as server, limited(held):
        store = RemoteStore(Url(server.address))
        with contextlib.closing(store):
            return store.read_at(at, 100)


QUICK = Limits(total=0.4, read=0.15)

SAMPLE = (
    ("the truth", "recording", "learn"),
    ("503 twice", "cameras", "convert"),
    ("half of it as all of it", "recording", "learn"),
    ("replaced in silence", "recording", "learn"),
    ("replaced", "cameras", "verify"),
    ("10^18 bytes", "cameras", "verify"),
    ("bits flipped at random", "cameras", "convert"),
    ("a reason for the terminal", "recording", "info"),
    ("to a file", "cameras", "info"),
    ("headers without end", "recording", "info"),
)


@pytest.mark.parametrize("case", SAMPLE, ids=" ".join)
def test_it_is_the_right_bits_or_one_clear_line(
    case: tuple[str, str, str], given: Given, tmp_path: Path
) -> None:
    assert Case(*case) in CASES
    check(Case(*case), given, tmp_path / "out")


@pytest.mark.parametrize(
    ("lie", "code", "words"),
    [
        ("40 kB of it as all of it", 3, "sends less than the log"),
        ("half of it as all of it, in parts", 3, "sends less than the log"),
        ("less than the whole that was said", 3, "and went away"),
        ("half of a part, then closed", 3, "and went away"),
        ("another part", 3, "asked for the bytes 0 to"),
        ("another tag each time", 3, "it changed while it was read; begin again"),
        ("it grows", 3, "asked for the bytes"),
        ("always all of it", 1, "no parts of a file"),
        ("403", 1, "403 Forbidden"),
        ("packed", 1, "packs it"),
        ("410", 2, "410 Gone"),
    ],
)
def test_what_a_server_has_against_us_is_one_line_and_nothing_is_learned(
    cdmisfa: Cdmisfa, given: Given, lie: str, code: int, words: str
) -> None:
    for log, options in (("recording", ()), ("cameras", ("--topic", "/left", "--size", "16x12"))):
        with lying(given.logs[log][0], LIES[lie]) as server:
            done = cdmisfa("learn", server.address, *options, "--max-iterations", 3)
            assert (done.code, done.out, done.err.count("\n")) == (code, "", 1), done
            assert words in done.err
            assert done.err.startswith(f"cdmisfa: {server.address}: ")


def test_no_more_is_taken_than_was_asked_for() -> None:
    tracemalloc.start()
    read("a part without end", Limits())
    assert tracemalloc.get_traced_memory()[1] < 4 << 20
    tracemalloc.stop()


@pytest.mark.parametrize("command", ["learn", "convert"])
def test_a_camera_log_that_is_replaced_in_silence_is_damage(
    cdmisfa: Cdmisfa, given: Given, tmp_path: Path, command: str
) -> None:
    one, two = given.logs["cameras"]
    with lying(one, LIES["replaced later in silence"], two) as server:
        done = cdmisfa(command, server.address, *CAMERAS, "-o", tmp_path / "out")
    assert (done.code, "it was replaced while it was read" in done.err) == (3, True), done
    assert not list((tmp_path / "out").glob("*.mcap"))


def test_a_recording_that_is_replaced_in_silence_by_one_of_the_same_index_is_damage(
    cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    logs = []
    for seed in (1, 2):
        plain = ("--set", "record.compression=none", "--frames", 6000, "--view", "x1")
        cdmisfa("record", "oscillatory", *plain, "--seed", seed, "-o", tmp_path / f"{seed}")
        logs.append((tmp_path / f"{seed}" / "x1.mcap").read_bytes())
    with LogReader(tmp_path / "1" / "x1.mcap") as reader:
        begin = reader.segments[-1].stop
    assert logs[0][begin + 100 :] == logs[1][begin + 100 :]  # all but the checksum of the data
    with lying(logs[0], LIES["replaced later in silence"], logs[1]) as server:
        done = cdmisfa("learn", server.address, "--loop", "--max-iterations", 100)
    assert (done.code, "it was replaced while it was read" in done.err) == (3, True), done


def test_a_server_that_is_busy_at_first_is_asked_again() -> None:
    for lie in ("503 twice", "429 at once again", "503 at no time", "408 once"):
        assert read(lie, Limits()) == BODY[200_000:200_100], lie


def test_a_server_is_left_alone_as_long_as_it_asks() -> None:
    def busy(x: Exchange) -> None:
        x.refuse("503 Busy", Retry_After=1) if x.number == 1 else x.part()

    began = time.monotonic()
    with lying(BODY, busy) as server:
        RemoteStore(Url(server.address)).close()
        assert server.requests == 2
    assert time.monotonic() - began >= 1


@pytest.mark.parametrize("lie", ["429 in an hour", "503 next year", "503 in 10^400 s"])
def test_a_longer_wait_than_the_limit_is_not_waited_for(lie: str) -> None:
    began = time.monotonic()
    with pytest.raises(UnreachableError, match=r"asks for \d+ s, longer than --timeout leaves"):
        read(lie, Limits())
    assert time.monotonic() - began < 1


@pytest.mark.parametrize(
    "lie",
    ["a byte in half a second", "a body a byte in half a second", "silence", "go on, for ever"],
)
def test_what_comes_too_slowly_ends_by_the_limit(lie: str) -> None:
    began = time.monotonic()
    with pytest.raises(UnreachableError, match=r"took longer than 0\.4 s: raise --timeout"):
        read(lie, QUICK)
    assert 0.35 < time.monotonic() - began < 3


def test_what_stands_still_is_asked_for_again() -> None:
    def stalls(x: Exchange) -> None:
        x.liar.ended.wait(60) if x.number == 2 else x.part()

    with lying(BODY, stalls) as server, limited(replace(QUICK, total=20)):
        store = RemoteStore(Url(server.address))
        assert store.read_at(200_000, 100) == BODY[200_000:200_100]
        store.close()
        assert server.requests == 3


def test_a_server_is_not_asked_for_ever() -> None:
    with lying(BODY, LIES["503 for ever"]) as server:
        with pytest.raises(UnreachableError, match="the server answers 503 Busy"):
            RemoteStore(Url(server.address))
        assert server.requests == servers.TRIES


def test_what_does_not_get_better_is_asked_once() -> None:
    for lie in ("403", "410", "501", "to a file", "packed", "always all of it", "another part"):
        with lying(BODY, LIES[lie]) as server:
            with pytest.raises(CdmisfaError, match=r"^http://127\.0\.0\.1"):
                RemoteStore(Url(server.address))
            assert server.requests == 1, lie


def test_the_limit_is_for_each_mebibyte() -> None:
    held = Limits(total=2)
    assert (held.of(10), held.of(1 << 20), held.of(5 << 20)) == (2, 2, 10)


def test_waits_grow_and_differ(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(servers, "FIRST_WAIT", 1.0)
    for attempt in range(5):
        waits = {backoff(attempt) for _ in range(20)}
        assert len(waits) > 10
        assert 0.5 * 2**attempt <= min(waits) <= max(waits) <= 2**attempt


def test_the_wait_that_is_asked_for_is_read_or_none() -> None:
    assert [retry_seconds(text) for text in ("7", " 120 ", "", "soon", "-3", "1.5", "٣")] == [
        *(7.0, 120.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    ]
    assert retry_seconds("Wed, 21 Oct 2099 07:28:00 GMT") > 1e9
    assert retry_seconds("Wed, 21 Oct 1999 07:28:00 GMT") == 0


def test_the_options_are_the_limits(cdmisfa: Cdmisfa, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    monkeypatch.setattr("replay.integrity.info.describe", lambda path: seen.append(limits()))
    cdmisfa("info", "https://host/a.mcap")
    cdmisfa("info", "https://host/a.mcap", "--timeout", 7, "--read-timeout", 3)
    assert seen == [Limits(), Limits(7, 3)]
    assert limits() == Limits()


def test_no_more_is_copied_than_there_is_room_for(cdmisfa: Cdmisfa, given: Given) -> None:
    with lying(given.logs["recording"][0], LIES["10^18 bytes"]) as server:
        done = cdmisfa("verify", server.address)
    assert (done.code, "there is room for" in done.err) == (1, True), done
