"""What the command line says when it is asked for what it cannot do, or need not do."""

from __future__ import annotations

import importlib.util
import json
import shlex
from pathlib import Path

import pytest
from conftest import Cdmisfa
from web_server import serving

from cdmisfa.cli.commands.doctor import EXTRAS
from cdmisfa.core.errors import LogDamagedError
from cdmisfa.kernels import WIDE
from replay.runs.folders import runs_in

LOGS = Path(__file__).parents[1] / "sample_logs" / "icub"
SHORT = ("--set", "learner.tau=10", "--no-rerun")


@pytest.mark.parametrize("words", [("oscillatory", "icub"), ("here", "oscillatory")])
def test_only_one_scene_can_be_named(cdmisfa: Cdmisfa, words: tuple[str, ...]) -> None:
    done = cdmisfa("learn", *words)
    assert done.code == 2
    assert "is a scene, of which only one can be named" in done.err
    assert done.err.count("\n") == 1


def test_verify_says_its_schema(cdmisfa: Cdmisfa, oscillatory_recording: Path) -> None:
    assert cdmisfa("verify", oscillatory_recording, "--json").json["schema"] == 1


@pytest.mark.parametrize(
    "words",
    [
        ("info",),
        ("verify",),
        ("recover", "-o", "out.mcap"),
        ("learn",),
        ("convert", "-o", "out"),
        ("view", "--save", "out.rrd"),
        ("play",),
        ("check",),
        ("plot",),
        ("compare", "numbers.npz"),
        ("export", "--to", "csv", "-o", "out.csv"),
        ("export", "--to", "images", "-o", "out"),
    ],
)
def test_a_file_of_another_kind_is_a_wrong_word_and_no_damage(
    cdmisfa: Cdmisfa, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "numbers.npz").write_bytes(b"PK" + bytes(100))
    done = cdmisfa(*words, "numbers.npz")
    assert (done.code, done.err.count("\n")) == (2, 1), done.err
    assert "numbers.npz is no MCAP file: name a recording" in done.err
    assert [path.name for path in tmp_path.iterdir()] == ["numbers.npz"]


@pytest.mark.parametrize("name", ["numbers.csv", "pictures"])
def test_recover_says_that_it_is_for_mcap_files(
    cdmisfa: Cdmisfa, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("numbers.csv").write_text("a,b\n1,2\n")
    Path("pictures").mkdir()
    Path("pictures", "0.png").write_bytes(b"")
    done = cdmisfa("recover", name, "-o", "out.mcap")
    assert (done.code, done.err.count("\n")) == (2, 1), done.err
    assert f"{name} is no MCAP file, and others are not recovered" in done.err
    assert "--salvage" in done.err
    assert not Path("out.mcap").exists()


@pytest.mark.parametrize("key", ["scene.seed", "record.fps"])
def test_what_only_a_live_scene_can_be_told_is_not_set_in_vain(
    cdmisfa: Cdmisfa, oscillatory_recording: Path, tmp_path: Path, key: str
) -> None:
    """The manifest would state it, whatever was recorded."""
    table = tmp_path / "numbers.csv"
    table.write_text("a,b\n" + "1,2\n" * 200)
    cases: tuple[tuple[object, ...], ...] = (
        ("learn", oscillatory_recording, "--set", f"{key}=9"),
        ("learn", table, "--rate", 10, "--set", f"{key}=9"),
        ("learn", "av:lavfi:testsrc=rate=30", "--set", f"{key}=9"),
        ("sweep", oscillatory_recording, "--grid", f"{key}=9,10", "-o", tmp_path / "sweep"),
    )
    for words in cases:
        done = cdmisfa(*words)
        assert (done.code, done.err.count("\n")) == (2, 1), done.err
        assert f"{key} is for live scenes, and {words[1]} is none: leave it out" in done.err


def test_export_writes_no_file_named_dash(
    cdmisfa: Cdmisfa, oscillatory_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = cdmisfa("export", oscillatory_run, "-o", "-", "--to", "csv")
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "words",
    [
        ("learn", "oscillatory", "--max-iterations", 3, "-o"),
        ("record", "oscillatory", "--frames", 20, "-o"),
        ("record", "icub", "--scene-picture"),
        ("convert", "no.mcap", "-o"),
        ("sweep", "oscillatory", "--seeds", 0, "--max-iterations", 3, "-o"),
        ("export", "RUN", "--to", "csv", "-o"),
        ("recover", "RUN/run.mcap", "-o"),
        ("plot", "RUN", "-o"),
        ("reproduce", "stability", "--trials", 1, "-o"),
        ("reproduce", "--page"),
        ("demo", "--frames", 400, "-o"),
        ("view", "RUN", "--save"),
        ("view", "RUN", "--screenshot"),
        ("compare", "RUN", "RUN", "--save"),
    ],
    ids=lambda words: f"{words[0]} {words[-1]}",
)
@pytest.mark.parametrize("url", ["gs://bucket/there", "https://there.org/x"])
def test_what_is_written_goes_to_no_url_but_those_of_s3(
    cdmisfa: Cdmisfa,
    oscillatory_run: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    words: tuple[str, ...],
    url: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    done = cdmisfa(*(str(word).replace("RUN", str(oscillatory_run)) for word in words), url)
    assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
    assert f"{url} is a URL: name a path on this machine" in done.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["y.csv", "y.parquet"])
def test_export_makes_its_folders(
    cdmisfa: Cdmisfa, oscillatory_run: Path, tmp_path: Path, name: str
) -> None:
    out = tmp_path / "no" / "such" / name
    assert cdmisfa("export", oscillatory_run, "-o", out).code == 0
    assert out.stat().st_size > 0


def test_errors_about_a_fetched_log_name_its_url(
    cdmisfa: Cdmisfa, oscillatory_recording: Path, tmp_path: Path
) -> None:
    with serving() as web:
        web.files["/x1.mcap"] = (oscillatory_recording / "x1.mcap").read_bytes()
        url = web.url("/x1.mcap")
        done = cdmisfa("export", url, "-o", tmp_path / "a.csv")
    assert done.code != 0
    assert url in done.err
    assert "/cdmisfa-" not in done.err


@pytest.mark.parametrize(
    "words",
    [
        ("learn", "oscillatory", "-o"),
        ("record", "oscillatory", "-o"),
        ("record", "oscillatory", "--resume", "-o"),
        ("sweep", "oscillatory", "--seeds", 0, "-o"),
        ("fork", "RUN", "--at", 3, "-o"),
        ("plot", "RUN", "-o"),
    ],
    ids=lambda words: " ".join(map(str, words)),
)
def test_a_file_is_not_taken_for_a_folder(
    cdmisfa: Cdmisfa, oscillatory_run: Path, tmp_path: Path, words: tuple[str, ...]
) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"kept")
    force = ("--force",) if words[0] in ("learn", "fork") else ()
    for out in (file, file / "below"):
        told = (str(word).replace("RUN", str(oscillatory_run)) for word in words)
        done = cdmisfa(*told, out, *force)
        assert (done.code, done.err.count("\n")) == (2, 1)
        assert f"{file} is a file: name a folder" in done.err
    assert file.read_bytes() == b"kept"


@pytest.mark.parametrize(
    "words",
    [
        ("learn", "oscillatory", "-o", ""),
        ("record", "oscillatory", "--frames", 20, "-o", ""),
        ("view", "RUN", "--save", ""),
        ("fork", "", "--at", 3, "-o", "fork"),
        ("learn", ""),
        ("view", ""),
        ("info", ""),
        ("play", ""),
    ],
    ids=lambda words: " ".join(map(str, words)),
)
def test_no_name_is_not_the_folder_one_is_in(
    cdmisfa: Cdmisfa,
    oscillatory_run: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    words: tuple[str, ...],
) -> None:
    monkeypatch.chdir(tmp_path)
    done = cdmisfa(*(str(word).replace("RUN", str(oscillatory_run)) for word in words))
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert "is empty: name a" in done.err
    assert list(tmp_path.iterdir()) == []


def test_resuming_is_advised_only_where_it_can_be(
    cdmisfa: Cdmisfa, oscillatory_run: Path, tmp_path: Path
) -> None:
    (tmp_path / "there").touch()
    for words, goes_on in (
        (("fork", oscillatory_run, "--at", 3), False),
        (("learn", "gym:Pendulum-v1"), False),
        (("record", "gym:Pendulum-v1"), False),
        (("learn", "oscillatory"), True),
        (("record", "oscillatory"), True),
    ):
        done = cdmisfa(*words, "-o", tmp_path)
        assert (done.code, "go on with --resume" in done.err) == (2, goes_on)
        assert f"{tmp_path} exists: choose another folder" in done.err


def test_a_picture_is_not_written_under_the_name_of_another_format(
    cdmisfa: Cdmisfa, oscillatory_run: Path, tmp_path: Path
) -> None:
    done = cdmisfa("view", oscillatory_run, "--screenshot", tmp_path / "x.jpg")
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert "the picture is a PNG, name it x.png" in done.err
    assert list(tmp_path.iterdir()) == []


def test_options_of_cameras_are_refused_for_a_scene_by_their_names(
    cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    for command in ("learn", "record", "sweep"):
        done = cdmisfa(command, "oscillatory", "-o", tmp_path / "o", "--size", "8x8", "--rate", 9)
        assert (done.code, list(tmp_path.iterdir())) == (2, [])
        told = "oscillatory is a scene: --size and --rate are for cameras; its rate is --set rec"
        assert told in done.err


@pytest.mark.parametrize("command", ["convert", "learn"])
def test_a_plan_needs_no_folder_and_none_is_written(
    cdmisfa: Cdmisfa, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    monkeypatch.chdir(tmp_path)
    words = (command, LOGS / "left.mcap", "--size", "16x12", "--dry-run")
    planned = cdmisfa(*words)
    assert planned.code == 0, planned.err
    for out in ("rec", "s3://nowhere/rec"):
        done = cdmisfa(*words, "-o", out)
        assert (done.code, done.out, done.err) == (0, planned.out, planned.err)
    assert list(tmp_path.iterdir()) == []


def test_a_conversion_needs_a_folder(cdmisfa: Cdmisfa) -> None:
    done = cdmisfa("convert", LOGS / "left.mcap")
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert "say -o FOLDER, where the recording goes" in done.err
    apart = cdmisfa("convert", LOGS / "left.mcap", LOGS / "right.mcap", "--rate", 9, "--dry-run")
    assert (apart.code, apart.err.rstrip().endswith("-o REC")) == (2, True), apart.err


def test_advice_can_be_pasted_into_a_shell(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    run = tmp_path / "my run #1"
    done = cdmisfa("learn", "oscillatory", "-o", run, "--max-iterations", 3, *SHORT)
    advice = done.out.partition("look at it: ")[2]
    assert shlex.split(advice, comments=True) == ["cdmisfa", "view", str(run)]


def test_a_sweep_goes_into_no_run(cdmisfa: Cdmisfa, oscillatory_run: Path) -> None:
    before = sorted(oscillatory_run.iterdir())
    done = cdmisfa("sweep", "oscillatory", "-o", oscillatory_run, "--seeds", "0:1")
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert "run.mcap" in done.err
    assert sorted(oscillatory_run.iterdir()) == before


@pytest.mark.parametrize("words", [(), ("--web",), ("--save", "a.rrd")])
def test_a_sweep_without_logs_says_how_to_keep_them(
    cdmisfa: Cdmisfa, tmp_path: Path, words: tuple[str, ...]
) -> None:
    swept = ("sweep", "oscillatory", "-o", tmp_path, "--seeds", "0:1", "--max-iterations", 2)
    assert cdmisfa(*swept).code == 0
    done = cdmisfa("view", tmp_path, *words)
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert "this sweep kept no logs: sweep again with --keep-logs" in done.err


def test_the_runs_of_a_sweep_are_those_it_was_asked_for_last(
    cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    swept = ("sweep", "oscillatory", "-o", tmp_path, "--keep-logs", "--max-iterations", 2)
    assert cdmisfa(*swept, "--seeds", "0:2").code == 0
    assert cdmisfa(*swept, "--seeds", "1:2", "--set", "learner.tau=10").code == 0
    assert len(list((tmp_path / "trials").iterdir())) == 3
    (run,) = runs_in(tmp_path)
    assert json.loads((run / "run.json").read_text())["config"]["learner"]["tau"] == 10
    (tmp_path / "sweep.json").write_text("{")
    with pytest.raises(LogDamagedError, match=r"sweep\.json is damaged"):
        runs_in(tmp_path)


def test_a_stub_is_not_recovered_as_an_empty_log(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    stub, out = tmp_path / "stub.mcap", tmp_path / "out.mcap"
    stub.write_bytes(b"\x89MCAP0\r\n" + bytes([1]) + (100).to_bytes(8, "little") + b"cut")
    done = cdmisfa("recover", stub, "-o", out)
    assert (done.code, "nothing in it can be saved" in done.err) == (3, True), done.err
    assert not out.exists()


def test_resuming_what_has_come_as_far_is_said(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    run = tmp_path / "run"
    words = ("learn", "oscillatory", "-o", run, *SHORT, "--max-iterations")
    assert cdmisfa(*words, 5).code == 0
    again = cdmisfa(*words, 4, "--resume")
    assert (again.code, "nothing was left to do" in again.err) == (0, True), again.err
    more = cdmisfa(*words, 6, "--resume")
    assert (more.code, "nothing was left to do" in more.err) == (0, False), more.err


def test_doctor_says_how_to_get_each_extra(
    cdmisfa: Cdmisfa, monkeypatch: pytest.MonkeyPatch
) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda n: None if n == "s3fs" else find(n))
    done = cdmisfa("doctor", "--json")
    details = {check["what"]: check["detail"] for check in json.loads(done.out)["checks"]}
    assert details["extra cloud"] == "pip install 'cdmisfa[cloud]'"
    assert {f"extra {name}" for name in EXTRAS} <= details.keys()


def test_doctor_says_which_kernels_run(cdmisfa: Cdmisfa) -> None:
    checks = cdmisfa("doctor", "--json").json["checks"]
    detail = next(check["detail"] for check in checks if check["what"] == "kernels")
    assert detail.startswith("for AVX2 and FMA" if WIDE else "for any processor")


@pytest.mark.parametrize("form", ["images", "mp4", "csv"])
def test_what_is_missing_is_said_alike(cdmisfa: Cdmisfa, tmp_path: Path, form: str) -> None:
    missing = tmp_path / "missing"
    refused = cdmisfa("export", missing, "--to", form, "-o", tmp_path / "out")
    assert (refused.code, refused.err) == (2, f"cdmisfa: {missing}: no such file or folder\n")


def test_what_is_too_slow_to_convert_is_converted_as_is_said(
    cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    rows = [f"{1800 * row},{row % 7}" for row in range(50)]
    (tmp_path / "slow.csv").write_text("\n".join(["time,x", *rows]))
    convert = ("convert", tmp_path / "slow.csv", "--time", "time:s", "-o", tmp_path / "out")
    refused = cdmisfa(*convert)
    assert refused.code == 2
    assert "0.001 to 1000000 frames a second, not 0.000555556" in refused.err
    assert "logs are read at another rate with --align time --rate" in refused.err
    assert cdmisfa(*convert, "--align", "time", "--rate", 0.001).code == 0
