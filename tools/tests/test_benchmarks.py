"""Every benchmark runs, at tiny sizes, and its results make a page."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks import (
    converting,
    estimators,
    foreign,
    history,
    iteration,
    kernels,
    learn,
    live_streams,
    long_recordings,
    many_views,
    modules,
    moments,
    opening,
    reader,
    recorder,
    recursive,
    report,
    scaling,
    startup,
)
from cdmisfa.core.errors import CdmisfaError


@pytest.fixture
def results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(report, "RESULTS", tmp_path / "results")
    monkeypatch.setattr(report, "PAGE", tmp_path / "page.md")
    return tmp_path / "results"


def test_reader(results: Path) -> None:
    reader.main(quick=True)
    table = json.loads((results / "reader.json").read_text())["tables"][0]
    assert [row[0] for row in table["rows"]] == ["sample log", "noisy pictures"]
    assert "## Reading a recording" in report.write_page().read_text(encoding="utf-8")


@pytest.mark.parametrize("work", ["messages", "info"])
def test_long_recordings_take_no_more_memory(tmp_path: Path, work: str) -> None:
    peaks = []
    for size in (50, 200):
        path = long_recordings.write_long(tmp_path / str(size), size * long_recordings.MEGABYTE)
        peaks.append(long_recordings.measured(work, path)[1])
    assert peaks[1] < peaks[0] + 25


def test_estimators(results: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(estimators, "CASES", ((2000, 8),))
    estimators.main(quick=True)
    table = json.loads((results / "estimators.json").read_text())["tables"][0]
    slowest = {row[1]: float(row[-1]) for row in table["rows"]}
    assert slowest["RecursiveSFA"] < slowest["IncrementalPCA"]


def test_learn(tmp_path: Path) -> None:
    times = learn.timed(
        learn.learning(learn.CONFIGS["preset icub"], tmp_path / "run", rerun=True), 2
    )
    assert set(times) == set(learn.CLOCKS)
    assert 0 < times["learning thread"] <= times["all threads"] + 1000
    assert {"run.mcap", "run.rrd"} <= {path.name for path in (tmp_path / "run").iterdir()}


def test_the_parts_of_an_iteration_are_no_more_than_the_whole() -> None:
    times = iteration.measured(1, 3)
    for whole, parts in (("all", iteration.PARTS), ("log", iteration.LOG_PARTS)):
        rows = iteration.table(times, whole, list(parts))
        assert [row[0] for row in rows] == [*parts, "all else", "together"]
        assert all(times[part][0] > 0 for part in parts)
        assert sum(times[part][0] for part in parts) <= times[whole][0]
        shares = [float(row[1].removesuffix(" %")) for row in rows]
        assert sum(shares[:-1]) == pytest.approx(shares[-1], abs=1)


def test_the_page_refuses_a_run_that_contradicts_itself(results: Path) -> None:
    fine = [["all", "no log", 100, "", 100, "", 3], ["all", "run.mcap", 110, "", 105, "", 9]]
    assert learn.contradictions(fine) == []
    wrong = [["all", "no log", 100, "", 100, "", -95], ["all", "run.mcap", 90, "", 90, "", 9]]
    assert len(learn.contradictions(wrong)) == 2
    assert learn.fixed([1300.0], [100.0], 10) == 300
    report.save("learn", "Learning", "", [], contradictions=learn.contradictions(wrong))
    with pytest.raises(CdmisfaError, match=r"learn\.json contradicts itself .*fixed -95 ms"):
        report.write_page()


def test_startup(tmp_path: Path) -> None:
    first, later, more = (
        startup.cpu_ms(startup.WARM[name], tmp_path, "kept")
        for name in ("import of numpy", "import of numpy", "import of numpy and rerun")
    )
    assert 0 < later < first
    assert later < more
    assert set(startup.FIRST) < set(startup.WARM)


def test_many_views(tmp_path: Path) -> None:
    found = many_views.record_and_learn(3, tmp_path / "rec")
    assert found["record"] > 0 < found["learn"]
    assert len(list((tmp_path / "rec").glob("*.mcap"))) == 3


def test_the_ratios_of_each_commit_are_kept_and_drawn(results: Path, tmp_path: Path) -> None:
    assert not history.draw(tmp_path / "none.png")
    header = ["preset icub: CPU of", "logs", "us", "more than no log", "us", "more than no log"]
    rows = [["all threads", "run.mcap", 110, "+10.0 %", 105, "+5.0 %"]]
    report.save("learn", "Learning", "", [(["K"], [[1]]), (header, rows)])
    document = json.loads((results / "learn.json").read_text())
    name = "Iteration, preset icub, times that without a log: run.mcap"
    assert history.ratios(document) == {name: 1.1}
    assert history.keep("learn", tmp_path) is None  # of no repository
    history.add("b" * 40, "2026-02-01T00:00:00+00:00", {name: 1.1})
    path = history.add("b" * 40, "2026-02-01T00:00:00+00:00", {"other": 2.0})
    assert json.loads(path.read_text())["ratios"] == {name: 1.1, "other": 2.0}
    assert not history.draw(tmp_path / "few.png")
    for place in range(1, history.LINE):
        history.add(str(place) * 40, f"2026-02-0{1 + place}T00:00:00+00:00", {name: 1.1})
    assert history.draw(tmp_path / "some.png")
    assert (tmp_path / "some.png").stat().st_size > 1000


def test_ratios_of_before_are_drawn_under_their_own_names() -> None:
    panel, kept = next(iter(history.PANELS.items()))
    own, before = f"{panel}: {kept[0].name}", f"{panel}: vs another"
    some = [{"ratios": {before: 2.0, "Other: a": 1.0}}] * history.LINE + [{"ratios": {}}]
    more = [{"ratios": {own: 3.0}}] * history.LINE
    found = history.curves(some + more, panel)
    places = range(history.LINE)
    assert list(found.items()) == [
        (kept[0].name, [(len(some) + place, 3.0) for place in places]),
        ("vs another", [(place, 2.0) for place in places]),
    ]
    assert history.curves(some[1:] + more[1:], panel) == {}


def test_what_the_history_holds_is_drawn() -> None:
    """But for what starting took against another import."""
    kept = [*(report.RESULTS / "history").glob("*.json")]
    assert kept
    for path in kept:
        panels = {name.partition(": ")[0] for name in json.loads(path.read_text())["ratios"]}
        assert all(name.startswith("Starting, ") for name in panels - set(history.PANELS))


def test_results_are_kept_only_of_code_that_a_commit_holds(results: Path, tmp_path: Path) -> None:
    def git(*words: str) -> None:
        known = ("-c", "user.name=a", "-c", "user.email=a@b.c")
        subprocess.run(["git", "-C", str(tmp_path), *known, *words], check=True)

    (tmp_path / "cdmisfa").mkdir()
    (tmp_path / "cdmisfa" / "code.py").write_text("1\n")
    git("init", "-q")
    git("add", "cdmisfa")
    git("commit", "-qm", "Begin")
    report.save("modules", "Modules", "", [(["modules", "vs a matrix product"], [[10, "1.38x"]])])
    path = history.keep("modules", tmp_path)
    assert path is not None
    told = json.loads(path.read_text())
    assert told["commit"].startswith(path.stem)
    page = report.write_page().read_text(encoding="utf-8")
    assert f"Measured at {told['commit'][:7]};" in page
    assert told["ratios"] == {"Projecting on modules, times faster: 10, vs a matrix product": 1.38}
    (tmp_path / "cdmisfa" / "code.py").write_text("2\n")
    assert history.keep("modules", tmp_path) is None


def test_modules(results: Path) -> None:
    modules.main(quick=True)
    rows = json.loads((results / "modules.json").read_text())["tables"][0]["rows"]
    assert [row[0] for row in rows] == [0, 1, 10]


def test_moments(tmp_path: Path) -> None:
    assert moments.learning("oscillatory", tmp_path / "run", 5, 1200)() == 12
    count, part = moments.share(tmp_path / "run")
    assert count == 3
    assert 0 < part < 0.5
    assert len(moments.moments(tmp_path / "run", 12)) == moments.MOMENTS


def test_recursive() -> None:
    """What is compared finds the same slow features."""
    mixing = np.random.default_rng(0).standard_normal((5, 300))
    frames = np.sin(np.arange(120)[:, None] * np.array([0.05, 0.21, 0.5, 0.9, 1.4])) @ mixing
    frames.flags.writeable = False
    ours, plain = recursive.RecursiveFeature(300, 5), recursive.PlainNumpy(300, 5)
    for start in range(0, 120, 40):
        ours.update(frames[start : start + 40])
        slow = plain.update(frames[start : start + 40])
    one, other = ours.phi[0], slow[0]
    assert abs(one @ other) / np.linalg.norm(one) / np.linalg.norm(other) > 0.99999
    for call in recursive.candidates(frames, 5).values():
        assert call() >= 1


def test_recorder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert recorder.rendering("oscillatory", 4)() == 12
    assert recorder.recording("oscillatory", 4, tmp_path, 1)() == 12
    clock = 0.0

    def recording(scene: str, frames: int, folder: Path, jobs: int) -> Callable[[], int]:
        def call() -> int:
            nonlocal clock
            clock += 2.0 + 3 * frames * 1e-4
            return 3 * frames

        return call

    monkeypatch.setattr(recorder, "recording", recording)
    monkeypatch.setattr(recorder, "time", SimpleNamespace(perf_counter=lambda: clock))
    found = recorder.steady_and_start("oscillatory", 500, tmp_path, 1, 2)
    assert found == pytest.approx((100.0, 2.0))


@pytest.mark.parametrize("name", list(foreign.CASES))
def test_foreign(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both readers give the same."""
    monkeypatch.setattr(foreign, "TAU", 4)
    path = foreign.write(tmp_path / "log.mcap", foreign.CASES[name], 4)
    assert foreign.frames(path) == foreign.mcap_frames(path) == 4 * foreign.CASES[name].number


@pytest.mark.parametrize("case", [*foreign.CASES.values(), *foreign.READ_ONLY.values()])
def test_readers_of_logs_of_others(tmp_path: Path, case: foreign.Case) -> None:
    path = foreign.write(tmp_path / "log.mcap", case, 2)
    for read in foreign.READERS.values():
        assert read(path) == 2 * case.number


def test_opening(tmp_path: Path) -> None:
    path = opening.write(tmp_path / "log.mcap", 15 * long_recordings.MEGABYTE)
    assert 0 < opening.seconds(path, 1, cold=True) < 60
    assert opening.first_block(path) > 40 * 640 * 480


def test_live_streams(tmp_path: Path) -> None:
    """A camera's pictures come, and are recorded."""
    row = live_streams.watch(tmp_path / "recording", 0.1, streams=1)
    assert row[0] == 1
    assert row[-1] == 0


def test_converting(tmp_path: Path) -> None:
    for path in (
        converting.write_folder(tmp_path / "png", 4),
        converting.write_video(tmp_path / "a.mp4", 4),
    ):
        assert converting.decoding(path) == 4
        assert converting.converting(path, tmp_path / "out")() == 4


def test_scaling() -> None:
    assert scaling.agent_steps(300, 4)() == 4
    assert [call() for call in scaling.sweeping(2).values()] == [2, 2, 1]
    cost, peak = scaling.learn_frames(200)
    assert cost > 0
    assert peak > 10


def test_a_kernel_faster_than_the_machine_is_a_contradiction() -> None:
    case = {"K": 64, "inputs": 6144, "ours": "by Gram matrix"}
    case["us_per_frame"] = {"by Gram matrix": 60.0}
    assert kernels.contradictions({kernels.PRODUCT: 23.7}, [case]) == []
    case["us_per_frame"] = {"by Gram matrix": 40.0}
    found = ["29.5 GFMA/s at K = 64, 6144 inputs"]
    assert kernels.contradictions({kernels.PRODUCT: 23.7}, [case]) == found


def test_kernels() -> None:
    frames = kernels.image_frames(12)
    config = kernels.LearnerConfig(components=4, outputs=1, nu=0.01, tau=4)
    for by in (kernels.FRAME, kernels.GRAM):
        assert kernels.learning(by, config, frames, 8)() == 8
    assert kernels.plain_numpy(config, frames, 4)() == 4
    assert all(value > 0 for value in kernels.machine_limits(1).values())
