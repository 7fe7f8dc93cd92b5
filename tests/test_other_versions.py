"""Runs of another version of the signals, or of the arithmetic, are refused in one line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from conftest import Cdmisfa
from run_data import VECTOR, write_run

from cdmisfa.kernels import ARITHMETIC
from replay.runs.log import read_header

SAMPLE = Path(__file__).parent.parent / "sample_logs" / "icub"


@pytest.mark.parametrize("version", [3, 9])
def test_signals_of_another_version_are_not_read(
    cdmisfa: Cdmisfa, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, version: int
) -> None:
    other, own = tmp_path / "other", tmp_path / "own"
    for folder, stated in ((other, version), (own, 4)):
        folder.mkdir()
        with monkeypatch.context() as patch:
            patch.setattr("replay.runs.writer.SCHEMA_VERSION", stated)
            write_run(folder / "run.mcap", VECTOR, 3)
    for words in (
        ("view", other, "--save", tmp_path / "x.rrd"),
        ("export", other, "-o", tmp_path / "x.parquet"),
        ("compare", own, other),
        ("report", other, "-o", tmp_path / "x.html"),
        ("check", other),
    ):
        done = cdmisfa(*words)
        assert (done.code, done.err.count("\n")) == (2, 1), (words, done.err)
        assert f"was written with version {version} of the signals" in done.err
    assert cdmisfa("info", other).code == 0


@pytest.mark.parametrize("source", ["oscillatory", str(SAMPLE)])
def test_a_run_of_another_arithmetic_is_not_computed_again(
    cdmisfa: Cdmisfa, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, source: str
) -> None:
    run, own = tmp_path / "run", tmp_path / "own"
    words = ("--max-iterations", 4, "--no-rerun", "--set", "learner.algorithm=2.0")
    for folder, arithmetic in ((run, 2), (own, ARITHMETIC)):
        with monkeypatch.context() as patch:
            patch.setattr("cdmisfa.kernels.ARITHMETIC", arithmetic)
            assert cdmisfa("learn", source, *words, "-o", folder).code == 0
        assert json.loads((folder / "run.json").read_text())["arithmetic"] == arithmetic
        assert read_header(folder).arithmetic == arithmetic
    for words in (
        ("check", run),
        ("inspect", run, "--iteration", 2),
        ("fork", run, "--iteration", 0, "-o", tmp_path / "fork"),
    ):
        done = cdmisfa(*words)
        assert (done.code, done.err.count("\n")) == (2, 1), (words, done.err)
        assert (
            "was learned with arithmetic 2, but this version of cdmisfa has arithmetic 3"
            in done.err
        )
    resumed = cdmisfa("learn", "--resume", "-o", run)
    assert (resumed.code, resumed.err.count("\n")) == (2, 1)
    assert "was made with arithmetic = 2, not 3" in resumed.err
    assert cdmisfa("compare", run, own).code == 0
    assert cdmisfa("verify", run).code == 0
