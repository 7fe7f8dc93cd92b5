"""Reports show the data of a run: finished, killed, damaged, forked, compared."""

from __future__ import annotations

import dataclasses
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from conftest import Cdmisfa
from report_data import HOSTILE, RULES, Page, pictured_run
from run_data import IMAGE, PROGRESS, VECTOR, by_progress, module_of, write_run

import cdmisfa as library
from cdmisfa.agents.progress import decisions
from cdmisfa.experiments import reports
from cdmisfa.experiments.reports import write_report
from cdmisfa.experiments.run_folder import command_again
from replay.report import saving_rules
from replay.report.page import MOST_BYTES
from replay.report.run_data import RunData
from replay.report.saving_rules import attempts, measurements_of
from replay.report.svg_plot import Axis, Plot
from replay.runs.modules import save_modules
from replay.runs.run import read_outline

TAU = 40


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of 2.0 with two modules, each of whose rules decides at times, and its report."""
    easy = {"delta": 0.02, "min_variance": 0.2, "novel_share": 0.5, "eta_dot_window": 8}
    out = tmp_path_factory.mktemp("report") / "run"
    library.learn("oscillatory", out, seed=3, max_modules=3, tau=TAU, warm_up=3, **easy)
    write_report([out])
    return out


def test_a_module_is_saved_where_all_rules_hold_and_nowhere_else(run: Path) -> None:
    outline = read_outline(run)
    rules = measurements_of(outline)
    assert [rule.name for rule in rules] == ["|η̇|", "share", "variance", "novel blocks"]
    saves = [save.iteration for save in outline.saved]
    assert len(saves) == 2
    every = np.all([rule.holds for rule in rules], axis=0)
    assert np.flatnonzero(every).tolist() == saves
    assert not all(rule.holds.all() for rule in rules)
    rows = attempts(outline, rules)
    assert [row.together for row in rows if row.save] == [1, 1]
    assert sum(row.blocks for row in rows) == outline.iterations


def test_the_progress_learner_is_measured_by_its_own_rules(tmp_path: Path) -> None:
    for name in (
        *("VARIANCE_BOUNDS", "IMPROVEMENT_ONGOING", "IMPROVEMENT_NEGLIGIBLE", "ROTATING_CHANGE"),
        *("FITTED_RATIO_SLOW", "SETTLING_WINDOWS"),
    ):
        assert getattr(saving_rules, name) == getattr(decisions, name)
    library.learn("oscillatory", tmp_path / "run", algorithm="progress")
    outline = read_outline(tmp_path / "run")
    rows = attempts(outline, measurements_of(outline))
    assert [(row.together, row.save is not None) for row in rows] == [(1, True)] * 3
    settings = {**PROGRESS, "test_frames": 400}
    write_run(tmp_path / "run.mcap", VECTOR, 60, learner=settings, edit=by_progress)
    text = Page(write_report([tmp_path])).text
    for words in ("Learning error", "below 0.25", "below 0.05", "rejected", "explained"):
        assert words in text
    outline = read_outline(tmp_path)
    rules = {rule.name: rule for rule in measurements_of(outline)}
    disagreement = np.abs(np.log(outline.lines["tested"] / outline.lines["fitted"]))
    np.testing.assert_array_equal(rules["disagreement"].holds, disagreement < 0.25)


def test_the_page_shows_the_data_of_the_run(run: Path) -> None:
    page, data = Page(run / "report.html"), library.Run(run)
    signals = data.signals
    n, visits = len(signals["iteration"]), np.bincount(signals["stream"], minlength=3)
    expected = [
        f"2 of 3 streams learned, {n:,} iterations, {n * TAU:,} frames",
        *(f"attended for {v * TAU:,} frames, {v / n:.1%} of the run" for v in visits.tolist()),
        *(f"module {m.index}, frame {(m.iteration + 1) * TAU:,}" for m in data.modules),
        *(f"module {m.index}, slowness {m.eta[0]:.4f}" for m in data.modules),
        *data.streams,
        *(str(data.result["signals_sha256"]), f"cdmisfa check {run}"),
        *("below 0.02", "at least 0.5", "at least 0.2"),
    ]
    assert [text for text in expected if text not in page.text] == []
    for module in data.modules:
        frames = data.frames()[np.repeat(signals["stream"], TAU) == module.stream_index]
        text = page.text[page.text.index(f"Module {module.index}: ") :]
        least = re.search(r"Least output: ([-+.\d]+) at", text)
        assert least is not None
        y = module.transform(frames)[:, 0]
        assert float(least[1]) == pytest.approx(y.min(), abs=0.006)
        of_stream = signals["iteration"][signals["stream"] == module.stream_index]
        counts = len(of_stream) * TAU, int((of_stream > module.iteration).sum()) * TAU
        cells = [f'<td class="number">{count:,}</td>' for count in counts]
        assert "".join(cells) in (run / "report.html").read_text()
        assert "theta" in text  # the one true quantity of the scene


def test_the_pointer_shows_the_watched_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = pictured_run(tmp_path / "run")
    page, data = Page(write_report([folder])), library.Run(folder)
    timeline = page.frames["timeline"]
    assert len(timeline["t"]) == len(timeline["x"]) == len(timeline["text"]) > 100
    starts, end = data.signals["t"], int(data.signals["t"][-1]) + TAU
    for t, x, text in zip(timeline["t"], timeline["x"], timeline["text"], strict=True):
        row = int(np.searchsorted(starts, t, side="right")) - 1
        start = f"frame {t:,}, iteration {row}: {HOSTILE[data.signals['stream'][row]]}; "
        assert text.startswith(start)
        held = text.removeprefix(start).partition("not: ")[0]
        assert ("share" in held) == (data.signals["share"][row] >= RULES["novel_share"])
        assert x == pytest.approx(1000 * t / end, abs=0.06)
    every = dict(zip(range(0, end, 10), data.frames(), strict=True))
    for module in data.modules:
        frames = page.frames[f"module{module.index}"]
        for t, text in zip(frames["t"], frames["text"], strict=True):
            y = module.transform(every[t][None])[0, 0]
            assert text == f"frame {t:,}: output {y:+.2f}"
    monkeypatch.setattr("replay.report.page.MOST_BYTES", 1)  # a page that would be too large
    assert len(Page(write_report([folder])).frames["timeline"]["t"]) <= 12


def test_a_name_becomes_no_element_and_the_page_loads_nothing(tmp_path: Path) -> None:
    page = Page(write_report([pictured_run(tmp_path / "<b onclick='x'>\"&")]))
    assert (page.count("script"), page.count("b")) == (2, 0)
    for name in HOSTILE[:2]:
        assert name in page.text
        assert name not in page.source
    policy = next(a["content"] for t, a in page.tags if a.get("http-equiv"))
    assert policy is not None
    assert policy.startswith("default-src 'none'; img-src data:; style-src 'sha256-")
    assert "unsafe" not in policy
    for _, attributes in page.tags:
        assert not {"style", "onclick", "onerror"} & attributes.keys()
        for key in ("src", "href", "srcset", "action"):
            assert str(attributes.get(key, "data:")).startswith("data:")


def test_many_streams_and_modules_fit_on_a_page(tmp_path: Path) -> None:
    names = tuple(f"camera {i}" for i in range(60))
    spec = dataclasses.replace(IMAGE, streams=names, frame_shape=(48, 64), truth=())
    write_run(tmp_path / "run.mcap", spec, 300)
    phi = np.random.default_rng(0).standard_normal((100, 1, 48 * 64))
    modules = [module_of(i + 1, i, phi[i], i % 60, names[i % 60]) for i in range(100)]
    save_modules(tmp_path / "modules.npz", modules)
    page = Page(write_report([tmp_path]))
    assert len(page.source.encode()) < MOST_BYTES
    assert "of 60 streams" in page.text
    assert "camera 59" in page.text


def test_the_report_of_a_killed_or_damaged_run_shows_what_is_readable(
    cdmisfa: Cdmisfa, tmp_path: Path, run: Path
) -> None:
    data = (run / "run.mcap").read_bytes()
    damaged = shutil.copytree(run, tmp_path / "damaged")
    (tmp_path / "killed").mkdir()
    (tmp_path / "killed" / "run.mcap.partial").write_bytes(data[: len(data) * 2 // 3])
    at = len(data) * 4 // 5
    (damaged / "run.mcap").write_bytes(data[:at] + bytes(2000) + data[at + 2000 :])
    for folder, problem in (
        (tmp_path / "killed", "Continue it with cdmisfa learn --resume"),
        (damaged, "The log is damaged; this page shows its readable part"),
    ):
        done = cdmisfa("report", folder)
        assert (done.code, problem in done.err) == ((3, True) if folder == damaged else (0, False))
        text = Page(folder / "report.html").text
        assert problem in text
        assert "Recent share of blocks" in text


def test_a_run_whose_source_changed_is_not_reproducible(
    cdmisfa: Cdmisfa, tmp_path: Path, oscillatory_recording: Path
) -> None:
    recording, run = shutil.copytree(oscillatory_recording, tmp_path / "rec"), tmp_path / "run"
    assert cdmisfa("learn", recording, "-o", run, "--max-iterations", 9, "--no-rerun").code == 0
    text = Page(run / "report.html").text
    assert "Learned nothing" in text
    assert "Reproducible yes: its source is present and looks unchanged" in text
    assert f"cdmisfa learn {recording} --max-iterations 9 -o RUN" in text
    first, second = sorted(recording.glob("*.mcap"))[:2]
    before = first.read_bytes()
    first.write_bytes(second.read_bytes())
    assert "Reproducible no: " in Page(write_report([run])).text
    first.write_bytes(before)
    recording.rename(tmp_path / "rec2")
    text = Page(write_report([run])).text
    assert re.search(r"Reproducible no: [^.]*no such file or folder", text)


def test_several_runs_and_a_folder_of_them(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    runs = [tmp_path / "runs" / name for name in ("a", "b")]
    for seed, folder in enumerate(runs):
        library.learn("oscillatory", folder, seed=seed, max_iterations=12)
    twin = shutil.copytree(runs[0], tmp_path / "twin")
    write_run(tmp_path / "run.mcap", VECTOR, 0)  # interrupted before its first iteration
    page = Page(write_report([*runs, twin, tmp_path], tmp_path / "all.html"))
    assert "4 runs; 1 of 3 have the same signals as the first, bit for bit" in page.text
    done = cdmisfa("report", tmp_path / "runs", "-o", tmp_path / "folder.html", "--json")
    assert done.json["bytes"] == (tmp_path / "folder.html").stat().st_size


def test_learning_does_not_fail_with_its_report(
    cdmisfa: Cdmisfa, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> str:
        raise ZeroDivisionError("no page today")

    monkeypatch.setattr(reports, "_reproducible", broken)
    done = cdmisfa("learn", "oscillatory", "--max-iterations", 5, "--no-rerun", "-o", tmp_path)
    assert done.code == 0
    assert "no report was written (no page today)" in done.err
    assert (tmp_path / "modules.npz").is_file()


def test_the_command_that_learns_a_run_again_does(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    words = ("--set", "learner.nu=0.03", "--set", "learner.tau=30", "--max-iterations", 12)
    first, second = tmp_path / "first", tmp_path / "second"
    assert cdmisfa("learn", "oscillatory", "--seed", 4, *words, "-o", first, "--no-rerun").code == 0
    again = command_again(first).split()
    assert again[:2] == ["cdmisfa", "learn"]
    assert cdmisfa(*again[1:-1], second, "--no-rerun").code == 0
    assert cdmisfa("compare", first, second).out == "identical, bit for bit\n"


def test_memory_does_not_grow_with_the_run(tmp_path: Path) -> None:
    write_run(tmp_path / "run.mcap", VECTOR, 240, saves=True)
    save_modules(tmp_path / "modules.npz", [module_of(1, 20, np.ones((1, 2)))])
    data = RunData(tmp_path, 50)
    (module,) = data.modules
    rows = [len(part.columns[0]) for part in (data.watched, module.outputs, module.frames)]
    assert np.all(np.array(rows) <= [50, 2000, 96])
    assert max(map(len, data.last.values())) == 200
    assert len(module.recent[0]) == 80


def test_a_curve_keeps_its_extremes_and_its_gaps() -> None:
    t = np.arange(50_000, dtype=float)
    values = np.sin(t / 40)
    values[777], values[30_000] = 9.0, -9.0
    values[20_000:21_000] = np.nan
    values[21_001] = np.nan  # one value alone
    plot = Plot("a curve", Axis(0, 50_000, 1000), Axis(-9, 9, 90, upward=True))
    plot.curve("plain", t, values)
    (path,) = plot.shapes
    points = [tuple(map(float, p.split())) for p in re.findall(r"[\d.]+ [\d.]+", path)]
    assert len(points) < 2200
    assert {0.0, 90.0} <= {y for _, y in points}
    assert (path.count("M"), path.count("h0")) == (3, 1)
    assert not [x for x, _ in points if 400.5 < x < 419.5]
    assert np.all(np.diff([x for x, _ in points]) >= 0)
