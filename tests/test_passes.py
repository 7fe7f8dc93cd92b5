"""A finite log is read several times, until each stream is decided."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import Cdmisfa
from numpy.typing import NDArray

import cdmisfa as package
from cdmisfa.core.errors import LogExhaustedError, UsageError
from replay.open_sources import open_arrays
from replay.stored_source import PAUSE


def values(frames: int, seed: int = 0) -> NDArray[np.float64]:
    """Return (frames, 6) mixtures of a slow course and noise."""
    rng = np.random.default_rng(seed)
    slow = np.cumsum(rng.normal(size=frames)) / 20
    return np.c_[np.tanh(slow), rng.normal(size=(frames, 5))] @ rng.normal(size=(6, 6))


@pytest.mark.parametrize("held_out", [0, 7])
def test_each_pass_returns_the_same_frames_after_a_pause(held_out: int) -> None:
    x = values(100)
    with open_arrays({"a": x}) as source:
        source.hold_out(held_out)
        source.repeat(3)
        end = 100 - held_out
        assert source.spec.length == 2 * (100 + PAUSE) + end
        each = end // 10
        blocks = [source.take(0, 10) for _ in range(3 * each)]
        with pytest.raises(LogExhaustedError, match="was read 3 times"):
            source.take(0, 10)
        assert [block.t for block in blocks[::each]] == [0, 100 + PAUSE, 2 * (100 + PAUSE)]
        for i, block in enumerate(blocks):
            first = i % each * 10
            np.testing.assert_array_equal(block.frames, x[first : first + 10])
        assert source.passes_begun == 3
        source.seek(95 - held_out)
        assert source.take(0, 10).t == 100 + PAUSE  # no block crosses from one pass to the next
        both = source.spans(0, 0, 2 * (100 + PAUSE))
        assert both == [(0, 100), (100 + PAUSE, 200 + PAUSE)]


def test_a_short_log_is_repeated_until_it_is_decided(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    log, run, fork = tmp_path / "log.npy", tmp_path / "run", tmp_path / "fork"
    np.save(log, values(1000))
    learned = cdmisfa("learn", log, "--json", "--no-rerun", "-o", run)
    assert learned.code == 0, learned.err
    result = learned.json
    assert (result["ended"], len(result["modules"]), result["undecided"]) == ("all_decided", 1, [])
    assert 2 <= result["passes"] <= 20
    assert json.loads((run / "run.json").read_text())["result"]["passes"] == result["passes"]
    assert f"{result['passes']} passes over the log" in (run / "report.html").read_text()
    once = cdmisfa("learn", log, "--passes", 1, "--json")
    assert (once.json["ended"], once.json["undecided"]) == ("log_exhausted", ["log"])
    assert cdmisfa("check", run).code == 0
    middle = result["iterations"] - 30
    assert cdmisfa("fork", run, "--iteration", middle, "-o", fork, "--no-rerun").code == 0
    assert cdmisfa("compare", run, fork).code == 0
    stopped = tmp_path / "stopped"
    cdmisfa("learn", log, "--max-iterations", middle, "--no-rerun", "-o", stopped)
    resume = ("learn", "--resume", "-o", stopped, "--max-iterations", 9999, "--no-rerun", "--json")
    assert cdmisfa(*resume).json["signals_sha256"] == result["signals_sha256"]
    array = package.learn(np.load(log))
    assert array.result["passes"] == result["passes"]


def test_passes_are_for_logs_that_end(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    np.save(tmp_path / "log.npy", values(200))
    for words in (("oscillatory",), (tmp_path / "log.npy", "--loop")):
        refused = cdmisfa("learn", *words, "--passes", 1)
        assert (refused.code, "--passes" in refused.err) == (2, True)
    with pytest.raises(UsageError, match="passes"):
        package.learn(iter(values(200)), passes=2)
    with pytest.raises(UsageError, match="passes"):
        package.learn("oscillatory", passes=1)


def test_an_undecided_run_is_continued_with_more_passes(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    log, run, fork = tmp_path / "log.npy", tmp_path / "run", tmp_path / "fork"
    np.save(log, values(1000))
    whole = cdmisfa("learn", log, "--json").json
    once = cdmisfa("learn", log, "--passes", 1, "-o", run, "--no-rerun")
    more = f"continue with cdmisfa learn --resume --passes 20 -o {run}"
    assert once.err.splitlines()[-1] == f"log not decided: {more}"
    resumed = cdmisfa("learn", "--resume", "--passes", 20, "-o", run, "--json", "--no-rerun")
    assert resumed.json["signals_sha256"] == whole["signals_sha256"]
    limit = ("--max-iterations", whole["iterations"] - 20)
    at = whole["iterations"] - 30
    cdmisfa("fork", run, "--iteration", at, "-o", fork, "--no-rerun", *limit)
    words = ("learn", "--resume", "-o", fork, "--max-iterations", 9999, "--json", "--no-rerun")
    assert cdmisfa(*words).json["signals_sha256"] == whole["signals_sha256"]
    cdmisfa("sweep", log, "--seeds", "0", "-o", tmp_path / "sweep", "--jobs", 1)
    (trial,) = map(json.loads, (tmp_path / "sweep" / "rows.jsonl").read_text().splitlines())
    assert trial["result"]["modules"] == whole["modules"]
    refused = cdmisfa("learn", tmp_path / "missing.npy", "-o", run)
    assert "exists" in refused.err  # before the source is opened
