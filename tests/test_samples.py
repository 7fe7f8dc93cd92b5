"""The sample logs where there is no checkout: those of a wheel, and those that are fetched."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from conftest import Cdmisfa
from folders import contents
from lying_server import PIECE, Exchange, lying
from test_cli import assert_one_line
from web_server import WebServer, serving

from cdmisfa.studies import samples
from cdmisfa.studies.samples import logs

ROOT = Path(__file__).parents[1]
SAMPLES = ROOT / "sample_logs"
LEFT = (SAMPLES / "icub" / "left.mcap").read_bytes()


@pytest.fixture(autouse=True)
def of_a_wheel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What a wheel holds of the samples, in place of the checkout's."""
    held = tmp_path / "installed"
    shutil.copytree(SAMPLES, held, ignore=shutil.ignore_patterns("icub"))
    monkeypatch.setattr(samples, "samples_here", lambda: held)
    return held


@pytest.fixture
def release() -> Iterator[WebServer]:
    """The attachments of a release."""
    with serving() as web:
        for log in (SAMPLES / "icub").glob("*.mcap"):
            web.files[f"/v1/icub-{log.name}"] = log.read_bytes()
        yield web


def test_samples_become_those_of_the_repository(
    cdmisfa: Cdmisfa, release: WebServer, tmp_path: Path
) -> None:
    out = tmp_path / "sample_logs"
    listed = cdmisfa("samples", "--json").json["samples"]
    assert {row["name"]: row["path"] is not None for row in listed} == {
        "icub": False,
        "oscillatory": True,
    }
    assert "not here: cdmisfa samples -o sample_logs" in cdmisfa("samples").out
    done = cdmisfa("samples", "-o", out, "--url", release.url("/v1/"), "--json")
    assert [Path(row["path"]) for row in done.json["samples"]] == [
        out / "icub",
        out / "oscillatory",
    ]
    for name in ("icub", "oscillatory"):
        assert contents(out / name) == contents(SAMPLES / name)
    assert sorted(os.listdir(out)) == ["README.md", "icub", "oscillatory"]
    release.files.clear()
    (out / "oscillatory" / "x1.mcap").unlink()
    assert cdmisfa("samples", "-o", out).code == 0  # what is there is not fetched again
    assert cdmisfa("verify", out / "oscillatory").code == 0


def test_without_a_network_the_rest_is_there(
    cdmisfa: Cdmisfa, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "sample_logs"
    assert_one_line(cdmisfa("samples", "-o", out), 1, "states no address", "--url")
    assert_one_line(cdmisfa("samples", "-o", out, "--url", "here"), 2, "here is no http address")
    unknown = "http://127.0.0.1:9/v1"
    done = cdmisfa("samples", "-o", out, "--url", unknown)
    assert_one_line(
        done, 1, f"{unknown}/icub-", "refused; fetched elsewhere, it belongs to", str(out)
    )
    assert sorted(os.listdir(out / "oscillatory")) == ["x1.mcap", "x2.mcap", "x3.mcap"]
    assert not (out / "icub").exists()
    (out / "icub").mkdir()
    (out / "icub" / "left.mcap").write_text("mine")
    done = cdmisfa("samples", "-o", out, "--url", unknown)
    assert_one_line(done, 2, "icub/left.mcap is not that sample: remove it or name another folder")
    assert (out / "icub" / "left.mcap").read_text() == "mine"


def test_the_release_says_where_its_attachments_are(
    cdmisfa: Cdmisfa, release: WebServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Metadata:
        def get_all(self, name: str) -> list[str]:
            return ["Paper, https://p.example/", f"Samples, {release.url('/v1')}"]

    monkeypatch.setattr("importlib.metadata.metadata", lambda _: Metadata())
    assert cdmisfa("samples", "-o", tmp_path / "s").code == 0
    assert contents(tmp_path / "s" / "icub") == contents(SAMPLES / "icub")


def _whole(x: Exchange, body: bytes) -> None:
    x.send(x.head("200 OK", Content_Length=len(body)), body)


def _flood(x: Exchange) -> None:
    x.send(x.head("200 OK"))
    x.flood(bytes(PIECE))


def _trickle(x: Exchange) -> None:
    x.trickle(x.head("200 OK", Content_Length=5) + b"abcde")


LIES: dict[str, tuple[Callable[[Exchange], None], int, str]] = {
    "a bit flipped": (lambda x: _whole(x, LEFT[:-1] + b"?"), 3, "its SHA-256 differs"),
    "half of it": (lambda x: _whole(x, LEFT[:9000]), 3, "its SHA-256 differs"),
    "less than said": (
        lambda x: x.send(x.head("200 OK", Content_Length=len(LEFT)), LEFT[:9000]),
        3,
        "its SHA-256 differs",
    ),
    "without end": (_flood, 3, "its SHA-256 differs"),
    "a byte in half a second": (_trickle, 1, "does not answer in time"),
    "closed at once": (lambda x: None, 1, "closed connection without response"),
    "404": (lambda x: x.refuse("404 Gone"), 1, "Gone"),
    "round and round": (lambda x: x.refuse("302 No", Location=x.path), 1, "infinite loop"),
    "to a file": (
        lambda x: x.refuse("302 No", Location="file:///etc/passwd"),
        1,
        "is not allowed",
    ),
    "to ftp": (lambda x: x.refuse("302 No", Location="ftp://a.example/b"), 1, "an address of ftp"),
    "no HTTP": (lambda x: x.send(b"hello\x1b[31m\r\n\r\n"), 1, "hello"),
}


@pytest.mark.parametrize("lie", LIES)
def test_what_a_server_sends_is_the_sample_or_one_line(
    cdmisfa: Cdmisfa, lie: str, tmp_path: Path
) -> None:
    tell, code, words = LIES[lie]
    out = tmp_path / "s"
    with lying(LEFT, tell) as server:
        address = server.address.rpartition("/")[0]
        limits = ("--timeout", 1, "--read-timeout", 0.8)
        done = cdmisfa("samples", "-o", out, "--url", address, *limits)
        assert_one_line(done, code, words)
        assert server.requests <= 11
    assert not (out / "icub").exists()


def test_the_card_is_what_says_so() -> None:
    found = {path.relative_to(SAMPLES).as_posix(): path for path in SAMPLES.glob("*/*.mcap")}
    assert found.keys() == logs().keys()
    for name, log in logs().items():
        data = found[name].read_bytes()
        assert (log.size, log.sha256) == (len(data), hashlib.sha256(data).hexdigest())
