"""Every benchmark runs, at tiny sizes, and its results make a page."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks import (
    constants,
    converting,
    foreign,
    kernels,
    learn,
    live_streams,
    long_recordings,
    modules,
    recorder,
    report,
    startup,
)


def _kernels(folder: Path) -> None:
    frames = kernels.image_frames(12)
    config = kernels.LearnerConfig(components=4, outputs=1, nu=0.01, tau=4)
    for by in (kernels.FRAME, kernels.GRAM):
        assert kernels.learning(by, config, frames, 8)() == 8
    assert kernels.plain_numpy(config, frames, 4)() == 4


RUNS: dict[str, Callable[[Path], object]] = {
    "converting": lambda p: converting.converting(
        converting.write_folder(p / "png", 4), p / "out"
    )(),
    "kernels": _kernels,
    "learn": lambda p: learn.timed(
        learn.learning(learn.CONFIGS["preset icub"], p / "run", rerun=True), 2
    ),
    "live_streams": lambda p: live_streams.watch(p / "recording", 0.1, streams=1),
    "long_recordings": lambda p: long_recordings.measured(
        "messages", long_recordings.write_long(p / "log", 50 * long_recordings.MEGABYTE)
    ),
    "recorder": lambda p: recorder.recording("oscillatory", 4, p, 1)(),
    "startup": lambda p: startup.cpu_ms(startup.WARM["import of numpy"], p, "kept"),
}


@pytest.mark.parametrize("name", RUNS)
def test_it_runs(tmp_path: Path, name: str) -> None:
    RUNS[name](tmp_path)


@pytest.mark.parametrize("case", [*foreign.CASES.values(), *foreign.READ_ONLY.values()])
def test_readers_of_external_logs_read_the_same(tmp_path: Path, case: foreign.Case) -> None:
    path = foreign.write(tmp_path / "log.mcap", case, 2)
    for read in foreign.READERS.values():
        assert read(path) == 2 * case.number


def test_results_make_a_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "RESULTS", tmp_path / "results")
    monkeypatch.setattr(report, "PAGE", tmp_path / "page.md")
    modules.main(quick=True)
    page = report.write_page().read_text(encoding="utf-8")
    assert "## Learning with many modules" in page
    assert "(results/modules.json)" in page


def test_stored_rows_of_another_commit_are_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(constants, "PARTIAL", tmp_path / "constants.json")
    assert constants.stored_rows("abc") == []
    constants.PARTIAL.write_text('{"code": "abc", "rows": [["tau", 20]]}', encoding="utf-8")
    assert constants.stored_rows("abc") == [["tau", 20]]
    assert constants.stored_rows("abd") == []
