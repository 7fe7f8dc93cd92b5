"""Logs in an S3 bucket, of a server on this machine."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from conftest import Cdmisfa
from s3_server import buckets, forget, s3_files, serving_s3

from replay.storage.opening import open_store

QUICK = ("--max-iterations", "4", "--json")


@pytest.fixture(scope="module")
def filled(oscillatory_recording: Path) -> Iterator[str]:
    """A server with the recording below `rec` of a bucket."""
    with serving_s3() as endpoint:
        with pytest.MonkeyPatch.context() as patch, buckets(endpoint, patch) as files:
            files.mkdir("logs")
            for file in oscillatory_recording.glob("*.mcap"):
                files.pipe(f"logs/rec/{file.name}", file.read_bytes())
            files.pipe("logs/empty.mcap", b"")
            files.pipe("logs/rec/notes.txt", b"no log")
        yield endpoint


@pytest.fixture
def s3(filled: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    with buckets(filled, monkeypatch) as files:
        yield files


def test_a_prefix_is_a_recording(
    cdmisfa: Cdmisfa, s3: Any, oscillatory_recording: Path, tmp_path: Path
) -> None:
    near = cdmisfa("learn", oscillatory_recording, *QUICK)
    far = cdmisfa("learn", "s3://logs/rec", *QUICK)
    assert far.code == 0, far.err
    assert far.json["signals_sha256"] == near.json["signals_sha256"]
    assert far.json["source"]["views"][1]["url"] == "s3://logs/rec/x2.mcap"
    info = cdmisfa("info", "s3://logs/rec/", "--json")
    assert (
        info.json["channels"] == cdmisfa("info", oscillatory_recording, "--json").json["channels"]
    )
    assert cdmisfa("verify", "s3://logs/rec").code == 0
    assert cdmisfa("recover", "s3://logs/rec", "-o", tmp_path / "again").code == 0
    assert cdmisfa("verify", tmp_path / "again").code == 0


def test_what_is_not_there_is_one_line(cdmisfa: Cdmisfa, s3: Any) -> None:
    for url, code, words in (
        ("s3://logs/rec/x9.mcap", 2, "there is no such object"),
        ("s3://nobucket/x1.mcap", 2, "s3://nobucket/x1.mcap: "),
        ("s3://logs/none", 2, "there is no such object"),
        ("s3://logs/empty.mcap", 3, "empty, nothing was written"),
    ):
        done = cdmisfa("info", url)
        assert (done.code, done.err.count("\n"), words in done.err) == (code, 1, True), done.err


def test_an_object_that_changes_is_refused(s3: Any, oscillatory_recording: Path) -> None:
    from recorder.mcap.reader import LogReader
    from replay.storage.servers import RemoteError

    data = (oscillatory_recording / "x1.mcap").read_bytes()
    s3.pipe("logs/changing.mcap", data)
    with LogReader(open_store("s3://logs/changing.mcap")) as reader:
        assert reader.by_index
        s3.pipe("logs/changing.mcap", data[:-1] + b"?")
        with pytest.raises(RemoteError, match="it changed while it was read"):
            list(reader.messages())


def test_without_credentials_the_remedy_is_named(
    cdmisfa: Cdmisfa, s3: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("AWS_ACCESS_KEY_ID")
    monkeypatch.delenv("AWS_SECRET_ACCESS_KEY")
    type(s3).clear_instance_cache()  # a new one looks for credentials again
    done = cdmisfa("info", "s3://logs/rec/x1.mcap")
    forget(s3_files())
    assert (done.code, "FSSPEC_S3_ANON" in done.err) == (1, True), done.err
