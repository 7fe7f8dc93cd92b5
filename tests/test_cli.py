"""The command line's contract: JSON keys, exit codes, a clean stdout, errors of one line."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import Cdmisfa, Outcome
from folders import flip
from mcap.reader import make_reader
from waiting import started, wait_for

from cdmisfa.cli.commands import doctor
from cdmisfa.kernels import WIDE

SHORT = ("--max-iterations", "5", "--json")


def assert_one_line(outcome: Outcome, code: int, *words: str) -> None:
    """A user error: the code, nothing on stdout, one line that names what is wrong."""
    assert outcome.code == code, outcome.err
    assert outcome.out == ""
    assert outcome.err.startswith("cdmisfa: ")
    assert outcome.err.count("\n") == 1
    for word in words:
        assert word in outcome.err


class TestJson:
    @pytest.mark.parametrize("which", ["oscillatory_recording", "oscillatory_run"])
    def test_info(self, cdmisfa: Cdmisfa, which: str, request: pytest.FixtureRequest) -> None:
        path = request.getfixturevalue(which)
        document = cdmisfa("info", path, "--json").json
        assert {"schema", "path", "kind", "channels", "chunks", "complete", "crc"} <= set(document)
        assert document["kind"] == which.partition("_")[2]
        assert document["complete"] is True
        assert document["crc"] == "ok"
        for channel in document["channels"]:
            keys = {"topic", "encoding", "schema", "messages", "start_ns", "end_ns"}
            assert keys <= set(channel)

    def test_info_in_words(
        self, cdmisfa: Cdmisfa, oscillatory_recording: Path, oscillatory_run: Path, tmp_path: Path
    ) -> None:
        done = cdmisfa("info", oscillatory_run)
        assert done.code == 0
        assert "run, whole, checksums ok, seed 0\n" in done.out
        assert "ended after 15 iterations of 100 frames: the requested number of iter" in done.out
        assert "learner 2.0, 3 streams: x1, x2, x3" in done.out
        assert "2016-01-01 00:00:00.000Z" in done.out
        killed = tmp_path / "killed"
        killed.mkdir()
        log = (oscillatory_run / "run.mcap").read_bytes()
        (killed / "run.mcap.partial").write_bytes(log[: len(log) // 2])
        done = cdmisfa("info", killed)
        assert (done.code, "no module" in done.out) == (3, False)
        assert re.search(
            r"^not finished after \d+ iterations of 100 frames:", done.out, re.MULTILINE
        )
        torn = Path(shutil.copy(oscillatory_recording / "x1.mcap", tmp_path))
        flip(torn)
        done = cdmisfa("info", torn)
        assert (done.code, "checksums bad" in done.out) == (3, True)
        os.truncate(torn, torn.stat().st_size // 3)
        assert "None" not in cdmisfa("recover", torn, "-o", tmp_path / "new" / "x1.mcap").out
        assert (tmp_path / "new" / "x1.mcap").is_file()

    def test_info_says_of_a_log_what_others_say(
        self, cdmisfa: Cdmisfa, oscillatory_recording: Path
    ) -> None:
        log = oscillatory_recording / "x1.mcap"
        with log.open("rb") as file:
            summary = make_reader(file).get_summary()
        stored, whole = (
            sum(getattr(index, name) for index in summary.chunk_indexes)
            for name in ("compressed_size", "uncompressed_size")
        )
        result = cdmisfa("info", log, "--json").json
        chunks = {"zstd": len(summary.chunk_indexes)}
        expected = {"file": log.stat().st_size, "stored": stored, "decompressed": whole}
        assert result["size"] == {**expected, "compression": chunks}
        said = cdmisfa("info", log).out
        statistics = summary.statistics
        seconds = (statistics.message_end_time - statistics.message_start_time) / 1e9
        assert f"{statistics.message_count} messages (protobuf), {seconds:.3f} s" in said
        assert f"{chunks['zstd']} zstd chunks, " in said
        assert f"({1 - stored / whole:.0%} saved)" in said
        assert re.search(r"/view/x1 +2000 +50 +0.000 +39.980", said)

    def test_doctor(self, cdmisfa: Cdmisfa, monkeypatch: pytest.MonkeyPatch) -> None:
        find = doctor.find_spec
        monkeypatch.setattr(doctor, "find_spec", lambda n: None if n == "s3fs" else find(n))
        document = cdmisfa("doctor", "--json").json
        assert document["ok"] is True
        details = {check["what"]: check["detail"] for check in document["checks"]}
        assert {"python", "numpy", "pybullet", "vulkan driver"} <= details.keys()
        assert {f"extra {name}" for name in doctor.EXTRAS} <= details.keys()
        assert details["extra cloud"] == "pip install 'cdmisfa[cloud]'"
        assert details["kernels"].startswith("for AVX2 and FMA" if WIDE else "for any processor")


class TestRuns:
    def test_live_and_recorded_are_the_same(
        self, cdmisfa: Cdmisfa, oscillatory_recording: Path
    ) -> None:
        live = cdmisfa("learn", "oscillatory", *SHORT).json
        recorded = cdmisfa("learn", oscillatory_recording, *SHORT).json
        files = sorted(oscillatory_recording.glob("*.mcap"))
        from_files = cdmisfa("learn", *files, *SHORT).json
        assert live["signals_sha256"] == recorded["signals_sha256"]
        assert live["signals_sha256"] == from_files["signals_sha256"]

    def test_settings_win_over_the_preset_and_stand_in_the_run(
        self, cdmisfa: Cdmisfa, tmp_path: Path
    ) -> None:
        run = tmp_path / "run"
        words = ("--set", "learner.tau=50", "--set", "learner.nu=0.02", "--no-rerun")
        document = cdmisfa("learn", "oscillatory", "-o", run, *words, *SHORT).json
        assert document["frames"] == 250
        assert document["run"] == str(run)
        config = json.loads((run / "run.json").read_text())["config"]
        assert config["learner"]["nu"] == 0.02
        assert config["learner"]["sigma"] == 0.0009
        assert config["scene"].keys() == {"kind", "seed", "streams"}

    @pytest.mark.parametrize(
        ("algorithm", "blocks", "line"),
        [
            ("2.0", 20, r"not decided: x1, x2, x3"),
            (
                "progress",
                50,
                r"x2: not decided after 50 blocks \(slowness 0\.00\d\d on new frames\)",
            ),
        ],
    )
    def test_a_recording_that_ends_is_the_end_of_its_run(
        self,
        cdmisfa: Cdmisfa,
        oscillatory_recording: Path,
        tmp_path: Path,
        algorithm: str,
        blocks: int,
        line: str,
    ) -> None:
        run, fork = tmp_path / "run", tmp_path / "fork"
        words = ("learn", oscillatory_recording, "--algorithm", algorithm)
        done = cdmisfa(*words, "-o", run, "--no-rerun")
        assert done.code == 0
        assert "the source ended: " in done.err
        assert "0 frames are left at frame 2000" in done.err
        assert "--passes" in done.err
        assert re.search(f"^{line}$", done.out, re.MULTILINE)
        assert f"ended after {blocks} iterations: the source has no more frames" in done.out
        result = json.loads((run / "run.json").read_text())["result"]
        again = cdmisfa(*words, "--json").json | {"run": str(run)}
        resumed = cdmisfa("learn", "--resume", "-o", run, "--no-rerun", "--json").json
        assert again == resumed == result | {"warnings": [], "notes": []}
        assert (result["ended"], result["iterations"]) == ("log_exhausted", blocks)
        assert result["undecided"] == ["x1", "x2", "x3"]
        assert (
            cdmisfa("check", run).code == cdmisfa("inspect", run, "--iteration", blocks).code == 0
        )
        forked = cdmisfa("fork", run, "--iteration", 5, "-o", fork, "--no-rerun", "--json")
        assert (forked.code, forked.json["ended"]) == (0, "log_exhausted")
        info = cdmisfa("info", run)
        assert "whole" in info.out
        assert f"ended after {blocks} iterations of " in info.out
        assert "frames: the source has no more frames" in info.out
        looped = cdmisfa(*words, "--loop", "--max-iterations", blocks + 5, "--json").json
        assert looped["iterations"] == blocks + 5

    def test_a_recording_of_less_than_a_block_is_not_enough(
        self, cdmisfa: Cdmisfa, tmp_path: Path
    ) -> None:
        cdmisfa("record", "oscillatory", "-o", tmp_path / "short", "--frames", 80)
        done = cdmisfa("learn", tmp_path / "short")
        assert_one_line(done, 1, "80 frames are left at frame 0, but a block has 100", "--loop")


class TestErrors:
    def test_without_the_simulator(self, tmp_path: Path) -> None:
        stub = "raise ImportError('not installed')\n"
        (tmp_path / "pybullet.py").write_text(stub)
        (tmp_path / "icub_models.py").write_text(stub)
        path = os.pathsep.join([str(tmp_path), *sys.path])
        for words in (["learn", "icub"], ["record", "icub", "-o", str(tmp_path / "r")]):
            with started(*words, PYTHONPATH=path) as process:
                out, err = process.communicate(timeout=60)
            assert_one_line(Outcome(process.returncode, out, err), 1, "pip install")
        with started("learn", "oscillatory", *SHORT, PYTHONPATH=path) as process:
            process.communicate(timeout=60)
        assert process.returncode == 0


class TestInterrupts:
    @pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
    def test_learn_stops_cleanly(
        self, cdmisfa: Cdmisfa, tmp_path: Path, number: int, code: int
    ) -> None:
        run = tmp_path / "run"
        words = ["learn", "oscillatory", "-o", str(run), "--no-rerun", "--json"]
        with started(*words, "--set", "learner.delta=1e-12") as process:
            wait_for_bytes(run / "run.mcap.partial", process)
            process.send_signal(number)
            out, err = process.communicate(timeout=60)
        assert process.returncode == code, err
        assert err.endswith(f"continue with cdmisfa learn --resume -o {run}\n")
        assert "Traceback" not in err
        assert Outcome(code, out, err).json["ended"] == "interrupted"
        assert sorted(f.name for f in run.iterdir() if "partial" in f.name) == []
        assert (run / "run.json").exists()

    def test_closed_pipe_is_quiet(self) -> None:
        with started("signals", PYTHONIOENCODING="ascii", PYTHONUTF8="0") as process:
            out, err = process.communicate(timeout=60)
        assert (process.returncode, err, "eta_dot" in out) == (0, "", True)  # without Greek letters
        with started("signals") as process:
            assert process.stdout is not None
            process.stdout.close()
            assert process.stderr is not None
            assert process.stderr.read() == ""


def wait_for_bytes(path: Path, process: subprocess.Popen[str]) -> None:
    wait_for(lambda: path.exists() and path.stat().st_size > 0, 60, process)
