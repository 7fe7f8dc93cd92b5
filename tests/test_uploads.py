"""Results that go to an S3 bucket: written here, uploaded when finished, checked, gone on with."""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Cdmisfa
from folders import contents
from s3_server import buckets, serving_s3

from cdmisfa.cli import run
from cdmisfa.core.errors import CdmisfaError
from replay.storage import uploads
from replay.storage.location import Url
from replay.storage.servers import UnreachableError
from replay.storage.uploads import fetch, upload

LEARN = ("learn", "oscillatory", "--no-rerun", "--json")


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    with serving_s3() as endpoint:
        with pytest.MonkeyPatch.context() as patch, buckets(endpoint, patch) as files:
            files.mkdir("lab")
        yield endpoint


@pytest.fixture
def s3(server: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Any]:
    """The server's files, empty; the folder one is in is empty, too."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    with buckets(server, monkeypatch) as files:
        yield files
        for key in files.find("lab"):
            files.rm(key)


def stored(files: Any, below: str) -> dict[str, bytes]:
    return {key.removeprefix(f"{below}/"): files.cat(key) for key in files.find(below)}


@pytest.fixture
def sent(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The calls that send bytes, as they are made."""
    calls: list[str] = []

    def noted(call: str, words: dict[str, Any]) -> None:
        if call in ("put_object", "upload_part"):
            calls.append(f"s3://{words['Bucket']}/{words['Key']}")

    heard(monkeypatch, noted)
    return calls


def heard(
    patch: pytest.MonkeyPatch,
    before: Callable[[str, dict[str, Any]], None] = lambda call, words: None,
    after: Callable[[str, Any], None] = lambda call, answer: None,
) -> None:
    """Have each call of the S3 interface told of: it may change the call, or fail it."""
    from s3fs import S3FileSystem

    ask = S3FileSystem._call_s3

    async def asked(self: Any, call: str, *kinds: Any, **words: Any) -> Any:
        before(call, words)
        answer = await ask(self, call, *kinds, **words)
        after(call, answer)
        return answer

    patch.setattr(S3FileSystem, "_call_s3", asked)


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (["record", "oscillatory", "--frames", "50"], "rec"),
        (["convert", "LOGS/left.mcap", "LOGS/right.mcap", "--size", "16x12"], "converted"),
        ([*LEARN, "--max-iterations", "3"], "runs/first"),
        (["sweep", "oscillatory", "--seeds", "0:1", "--max-iterations", "3"], "sweeps/nu"),
        (["export", "RUN", "--to", "csv"], "table.csv"),
    ],
)
def test_each_command_uploads_what_it_wrote(
    cdmisfa: Cdmisfa, s3: Any, oscillatory_run: Path, words: list[str], name: str
) -> None:
    logs = str(Path(__file__).parents[1] / "sample_logs" / "icub")
    words = [w.replace("LOGS", logs).replace("RUN", str(oscillatory_run)) for w in words]
    done = cdmisfa(*words, "-o", f"s3://lab/{name}")
    assert done.code == 0, done.err
    local = Path(name).name
    assert f"written to {local}, and uploaded to s3://lab/{name} when it is finished" in done.err
    files = contents(Path(local)) or contents(Path())
    assert files
    there = stored(s3, f"lab/{name}" if Path(local).is_dir() else "lab")
    assert there == files
    size = sum(map(len, files.values()))
    assert f"uploaded s3://lab/{name}: {len(files)} files, {size} bytes, checked\n" in done.err


def test_what_was_recorded_there_is_learned_from(cdmisfa: Cdmisfa, s3: Any, tmp_path: Path) -> None:
    words = ("record", "oscillatory", "--frames", 900, "-o", "s3://lab/rec", "--json")
    done = cdmisfa(*words, "--local", tmp_path / "kept")
    assert done.json["recording"] == str(tmp_path / "kept")
    assert not list(Path().iterdir())
    far = cdmisfa("learn", "s3://lab/rec", "--max-iterations", 4, "--json")
    near = cdmisfa("learn", tmp_path / "kept", "--max-iterations", 4, "--json")
    assert far.json["signals_sha256"] == near.json["signals_sha256"]


def test_a_run_is_resumed_from_where_it_was_uploaded(cdmisfa: Cdmisfa, s3: Any) -> None:
    whole = cdmisfa(*LEARN, "--max-iterations", 9).json["signals_sha256"]
    assert cdmisfa(*LEARN, "--max-iterations", 4, "-o", "s3://lab/run").code == 0
    shutil.rmtree("run")
    words = ("--max-iterations", 9, "-o", "s3://lab/run", "--resume", "--no-rerun", "--json")
    done = cdmisfa("learn", *words)  # the run knows its source
    assert (done.code, done.json["signals_sha256"]) == (0, whole), done.err
    assert "run was fetched from s3://lab/run" in done.err
    assert stored(s3, "lab/run") == contents(Path("run"))
    assert done.err.count("uploaded s3://lab/run: ") == 1


def test_a_sweep_goes_on_elsewhere(cdmisfa: Cdmisfa, s3: Any) -> None:
    words = ("sweep", "oscillatory", "--max-iterations", 2, "-o", "s3://lab/sweep", "--json")
    assert cdmisfa(*words, "--seeds", "0:1").json["computed"] == 1
    shutil.rmtree("sweep")
    assert cdmisfa(*words, "--seeds", "0:2").json["skipped"] == 1
    assert stored(s3, "lab/sweep") == contents(Path("sweep"))


def test_what_is_there_is_kept_before_any_work(cdmisfa: Cdmisfa, s3: Any) -> None:
    s3.pipe("lab/rec/x9.mcap", b"of before")
    s3.pipe("lab/record", b"another's")
    words = ("record", "oscillatory", "--frames", 20, "-o", "s3://lab/rec")
    refused = cdmisfa(*words)
    assert (refused.code, refused.err.count("\n")) == (2, 1)
    assert "s3://lab/rec exists: choose another name, go on with --resume or" in refused.err
    assert not list(Path().iterdir())
    done = cdmisfa(*words, "--force")
    assert done.code == 0
    assert "warning: s3://lab/rec/x9.mcap was there before, and is not of it" in done.err
    assert s3.cat("lab/rec/x9.mcap") == b"of before"
    export = cdmisfa("export", "rec/x1.mcap", "--to", "images", "-o", "s3://lab/rec")
    assert "exists: choose another name, overwrite with --force" in export.err


def test_an_upload_that_fails_keeps_the_result_and_says_how_to_go_on(
    cdmisfa: Cdmisfa, s3: Any, monkeypatch: pytest.MonkeyPatch, sent: list[str]
) -> None:
    def failing(call: str, words: dict[str, Any]) -> None:
        if call == "put_object" and words["Key"].endswith("x2.mcap"):
            raise UnreachableError("the server answers 503")

    with monkeypatch.context() as patch:
        heard(patch, failing)
        done = cdmisfa("record", "oscillatory", "--frames", 20, "-o", "s3://lab/rec")
    assert done.code == 1
    again = "cdmisfa upload rec s3://lab/rec"
    last = done.err.splitlines()[-1]
    assert last == (
        "cdmisfa: s3://lab/rec/x2.mcap: the server answers 503: rec is kept, upload it with "
        f"{again}"
    )
    assert set(stored(s3, "lab/rec")) == {"x1.mcap"}
    sent.clear()
    done = cdmisfa(*shlex.split(again)[1:], "--json")
    assert (done.code, done.json["files"]) == (0, 3), done.err
    assert sent == ["s3://lab/rec/x2.mcap", "s3://lab/rec/x3.mcap"]  # x1 was there
    assert stored(s3, "lab/rec") == contents(Path("rec"))


def test_what_is_broken_off_is_not_uploaded(
    cdmisfa: Cdmisfa, s3: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*args: Any, **words: Any) -> None:
        Path("sweep").mkdir()
        raise KeyboardInterrupt

    monkeypatch.setattr("cdmisfa.experiments.sweep.sweep", interrupted)
    done = cdmisfa("sweep", "oscillatory", "-o", "s3://lab/sweep")
    assert done.code == 130
    line = "sweep is not uploaded: when it is finished, cdmisfa upload sweep s3://lab/sweep\n"
    assert line in done.err
    assert s3.find("lab/sweep") == []


def test_a_run_whose_recording_ends_is_uploaded(cdmisfa: Cdmisfa, s3: Any, tmp_path: Path) -> None:
    assert run(["record", "oscillatory", "-o", str(tmp_path / "rec"), "--frames", "300"]) == 0
    done = cdmisfa("learn", tmp_path / "rec", "--no-rerun", "-o", "s3://lab/run")
    assert done.code == 0, done.err
    assert set(stored(s3, "lab/run")) == set(contents(Path("run")))


def test_large_files_go_in_parts_and_come_back(
    s3: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sent: list[str]
) -> None:
    monkeypatch.setattr(uploads, "PART", 5 << 20)
    data = np.random.default_rng(0).bytes((11 << 20) + 3)
    folder = tmp_path / "run" / "logs"
    folder.mkdir(parents=True)
    (folder / "big.mcap").write_bytes(data)
    (folder / "empty.json").write_bytes(b"")
    url = Url("s3://lab/big")
    assert upload(tmp_path / "run", url) == (2, len(data), [])
    assert len(sent) == 4
    assert s3.cat("lab/big/logs/big.mcap") == data
    assert upload(tmp_path / "run", url)[0] == 2
    assert len(sent) == 4
    fetch(url, tmp_path / "back", uploads.objects_below(url), lambda done, total: None)
    assert contents(tmp_path / "back") == contents(tmp_path / "run")


def test_other_bytes_than_were_sent_are_found(
    s3: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, url = tmp_path / "a.csv", Url("s3://lab/a.csv")
    file.write_bytes(b"1,2,3")

    def encrypted(call: str, answer: Any) -> None:
        if call == "head_object":
            answer["ETag"] = '"no MD5 of it"'

    def lying(call: str, words: dict[str, Any]) -> None:
        if call == "put_object":
            del words["ContentMD5"]
            words["Body"] = b"1,2,4"

    heard(monkeypatch, after=encrypted)
    upload(file, url)  # read again, and found to be the same
    assert s3.cat("lab/a.csv") == b"1,2,3"
    heard(monkeypatch, lying)
    s3.rm("lab/a.csv")
    with pytest.raises(CdmisfaError, match="the server has other bytes than were sent"):
        upload(file, url)


def test_a_server_that_speaks_no_s3_is_said(
    cdmisfa: Cdmisfa, s3: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def silent(call: str, answer: Any) -> None:
        answer.clear()

    heard(monkeypatch, after=silent)
    (tmp_path / "a.csv").write_bytes(b"1,2,3")
    done = cdmisfa("upload", tmp_path / "a.csv", "s3://lab/a.csv")
    assert (done.code, done.err.count("\n")) == (1, 1), done.err
    assert "lacks ContentLength: it does not speak S3" in done.err


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["record", "oscillatory", "-o", "s3://lab"], "s3://lab names no place in a bucket"),
        (["record", "oscillatory", "-o", "s3://nobucket/x"], "s3://nobucket/x: there is no such"),
        (["upload", "nothing", "s3://lab/x"], "nothing: no such file or folder"),
        (["upload", ".", "there"], "there is no s3:// address"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(
    cdmisfa: Cdmisfa, s3: Any, words: list[str], why: str
) -> None:
    done = cdmisfa(*words)
    assert (done.code, done.err.count("\n")) == (2, 1), done.err
    assert why in done.err
    assert not list(Path().iterdir())
