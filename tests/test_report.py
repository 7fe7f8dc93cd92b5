"""Reports show the data of a run: finished, killed, damaged, forked, compared."""

from __future__ import annotations

import dataclasses
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from conftest import Cdmisfa
from report_data import HOSTILE, RULES, Page, pictured_run
from run_data import IMAGE, PROGRESS, VECTOR, by_progress, module_of, write_run

import cdmisfa as library
from cdmisfa.agents.progress import judging
from cdmisfa.core.errors import UsageError
from cdmisfa.experiments import reports
from cdmisfa.experiments.reports import write_report
from cdmisfa.experiments.run_folder import command_again
from replay.report import measurements
from replay.report.data import RunData
from replay.report.measurements import attempts, measurements_of
from replay.report.page import MOST_BYTES
from replay.runs.modules import save_modules
from replay.runs.run import read_outline

EASY = (
    *("tau=40", "eta_dot_window=8", "warm_up=3", "delta=0.02", "min_variance=0.2"),
    "novel_share=0.5",
)
"""Settings with which 2.0 saves soon, and each of whose rules decides at times."""


def learned(cdmisfa: Cdmisfa, out: Path, *words: object) -> Path:
    settings = [word for key in EASY for word in ("--set", f"learner.{key}")]
    done = cdmisfa("learn", "oscillatory", "-o", out, *settings, "--no-rerun", "--seed", 3, *words)
    assert done.code == 0, done.err
    return out


@pytest.fixture
def run(cdmisfa: Cdmisfa, keyframes_every: Callable[[int], None], tmp_path: Path) -> Path:
    """A run of 2.0 with some modules, and its report."""
    keyframes_every(10)
    return learned(cdmisfa, tmp_path / "run", "--max-modules", 3)


def test_a_module_is_saved_where_all_rules_hold_and_nowhere_else(run: Path) -> None:
    outline = read_outline(run)
    rules = measurements_of(outline)
    assert [rule.name for rule in rules] == ["|η̇|", "share", "variance", "novel blocks"]
    every = np.all([rule.holds for rule in rules], axis=0)
    saves = [save.iteration for save in outline.saved]
    assert len(saves) > 1
    assert np.flatnonzero(every).tolist() == saves
    assert not all(rule.holds.all() for rule in rules)
    rows = attempts(outline, rules)
    assert [row.together for row in rows if row.save] == [1] * len(saves)
    assert sum(row.blocks for row in rows) == outline.iterations


def test_the_report_of_a_fork_names_its_parent_and_its_changes(
    cdmisfa: Cdmisfa, run: Path, tmp_path: Path
) -> None:
    fork, at = tmp_path / "fork", read_outline(run).saved[0].iteration + 5
    words = ("--iteration", at, "--set", "learner.delta=1e-9", "-o", fork, "--no-rerun")
    assert cdmisfa("fork", run, *words, "--max-iterations", at + 40).code == 0
    page = Page(fork / "report.html")
    assert f"Fork of ../run after {at} iterations; learner.delta: 0.02 → 1e-09" in page.text
    assert f"cdmisfa compare {run} {fork}" in page.text


def test_the_page_shows_the_data_of_the_run(run: Path) -> None:
    page, data = Page(run / "report.html"), library.Run(run)
    signals, tau = data.signals, 40
    n, visits = len(signals["iteration"]), np.bincount(signals["stream"], minlength=3)
    expected = [
        f"{len({m.stream for m in data.modules})} of 3 streams learned, {n:,} iterations, "
        f"{n * tau:,} frames",
        *(f"{v / n:.1%} of its attention, {v * tau:,} frames" for v in visits.tolist()),
        *(f"module {m.index}, frame {(m.iteration + 1) * tau:,}" for m in data.modules),
        *(f"module {m.index}, slowness {m.eta[0]:.4f}" for m in data.modules),
        *data.streams,
        str(data.result["signals_sha256"]),
        "below 0.02",
        "at least 0.5",
        "at least 0.2",
        f"cdmisfa check {run}",
        "yes: its source is present and looks unchanged",
    ]
    assert [text for text in expected if text not in page.text] == []
    for module in data.modules:
        frames = data.frames()[np.repeat(signals["stream"], tau) == module.stream_index]
        text = page.text[page.text.index(f"Module {module.index}: ") :]
        least = re.search(r"Frames of least output: ([-+.\d]+) at", text)
        assert least is not None
        y = module.transform(frames)[:, 0]
        assert float(least[1]) == pytest.approx(y.min(), abs=0.006)
        assert "theta" in text  # the one true quantity of the scene


def test_the_pointer_shows_the_watched_frame(tmp_path: Path) -> None:
    folder = pictured_run(tmp_path / "run")
    page = Page(write_report([folder]))
    data = library.Run(folder)
    timeline = page.frames["timeline"]
    assert len(timeline["t"]) == len(timeline["x"]) == len(timeline["text"]) > 100
    starts, end = data.signals["t"], int(data.signals["t"][-1]) + 40
    for t, x, text in zip(timeline["t"], timeline["x"], timeline["text"], strict=True):
        row = int(np.searchsorted(starts, t, side="right")) - 1
        start = f"frame {t:,}, iteration {row}: {HOSTILE[data.signals['stream'][row]]}; "
        assert text.startswith(start)
        shares = data.signals["share"][row] >= RULES["novel_share"]
        held = text.removeprefix(start).partition("not: ")[0]
        assert ("share" in held) == shares
        assert x == pytest.approx(1000 * t / end, abs=0.06)
    for module in data.modules:
        frames = page.frames[f"module{module.index}"]
        every = dict(zip(range(0, end, 10), data.frames(), strict=True))
        for t, text in zip(frames["t"], frames["text"], strict=True):
            y = module.transform(every[t][None])[0, 0]
            assert text == f"frame {t:,}: output {y:+.2f}"


def test_a_name_becomes_no_element_and_the_page_loads_nothing(tmp_path: Path) -> None:
    page = Page(write_report([pictured_run(tmp_path / "<b onclick='x'>\"&")]))
    assert page.count("script") == 2
    assert page.count("b") == 0
    assert all(attributes.get("src") != "x" for _, attributes in page.tags)
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
    rng = np.random.default_rng(0)
    phi = rng.standard_normal((100, 1, 48 * 64))
    each = [module_of(i + 1, i, phi[i], i % 60, names[i % 60]) for i in range(100)]
    save_modules(tmp_path / "modules.npz", each)
    page = Page(write_report([tmp_path]))
    assert len(page.source.encode()) < MOST_BYTES
    assert "of 60 streams" in page.text
    assert "camera 59" in page.text


def test_a_page_that_would_be_too_large_shows_fewer_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    noise = np.random.default_rng(0)
    spec = dataclasses.replace(IMAGE, frame_shape=(96, 96), truth=())
    write_run(tmp_path / "run.mcap", spec, 20)
    save_modules(tmp_path / "modules.npz", [module_of(1, 5, noise.standard_normal((1, 96 * 96)))])
    assert len(Page(write_report([tmp_path])).frames["timeline"]["t"]) == 80
    monkeypatch.setattr("replay.report.page.MOST_BYTES", 1)
    assert len(Page(write_report([tmp_path])).frames["timeline"]["t"]) <= 12


def test_the_report_of_a_killed_or_damaged_run_shows_what_is_readable(
    tmp_path: Path, run: Path
) -> None:
    data = (run / "run.mcap").read_bytes()
    damaged = shutil.copytree(run, tmp_path / "damaged")
    (tmp_path / "killed").mkdir()
    (tmp_path / "killed" / "run.mcap.partial").write_bytes(data[: len(data) * 2 // 3])
    at = len(data) * 4 // 5
    (damaged / "run.mcap").write_bytes(data[:at] + bytes(2000) + data[at + 2000 :])
    for folder, problem in (
        (tmp_path / "killed", "cdmisfa learn --resume continues it"),
        (damaged, "The log is damaged. This page shows what is readable"),
    ):
        page = Page(write_report([folder]))
        assert problem in page.text
        assert "Running share of blocks" in page.text


def test_the_report_of_a_run_without_a_module_shows_which_rule_did_not_hold(
    cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    run = learned(cdmisfa, tmp_path / "run", "--max-iterations", 20, "--set", "learner.delta=1e-9")
    page = Page(run / "report.html")
    assert "Learned nothing" in page.text
    assert "No module was saved." in page.text
    assert re.search(r"module 1 20 0\.0% .* 0 no module", page.text)


def test_a_run_whose_source_changed_is_not_reproducible(
    cdmisfa: Cdmisfa, tmp_path: Path, oscillatory_recording: Path
) -> None:
    recording = shutil.copytree(oscillatory_recording, tmp_path / "rec")
    run = tmp_path / "run"
    assert cdmisfa("learn", recording, "-o", run, "--max-iterations", 9, "--no-rerun").code == 0
    page = Page(run / "report.html").text
    assert "Reproducible yes" in page
    assert f"cdmisfa learn {recording} --max-iterations 9 -o RUN" in page
    first, second = sorted(recording.glob("*.mcap"))[:2]
    kept = first.read_bytes()
    first.write_bytes(second.read_bytes())
    assert "Reproducible no: " in Page(write_report([run])).text
    first.write_bytes(kept)
    recording.rename(tmp_path / "rec2")
    gone = Page(write_report([run])).text
    assert re.search(r"Reproducible no: [^.]*no such file or folder", gone)
    assert "Attention and saves" in gone


def test_the_progress_learner_is_measured_by_its_own_rules(tmp_path: Path) -> None:
    for name in ("LIVELY", "SLOW_AGAIN", "STILL_GAINING", "PASSED_ON", "TURNING", "FULL"):
        assert getattr(measurements, name) == getattr(judging, name)
    settings = {**PROGRESS, "test_frames": 400}
    write_run(tmp_path / "run.mcap", VECTOR, 60, learner=settings, edit=by_progress)
    page = Page(write_report([tmp_path]))
    for text in ("Learning error", "below 0.25", "below 0.05", "given up", "known"):
        assert text in page.text
    outline = read_outline(tmp_path)
    rules = {rule.name: rule for rule in measurements_of(outline)}
    disagreement = np.abs(np.log(outline.lines["tested"] / outline.lines["fitted"]))
    np.testing.assert_array_equal(rules["disagreement"].holds, disagreement < 0.25)


def test_the_progress_learner_saves_where_all_its_rules_hold_and_nowhere_else(
    cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    words = ("--algorithm", "progress", "--no-rerun", "-o", tmp_path)
    assert cdmisfa("learn", "oscillatory", *words).code == 0
    outline = read_outline(tmp_path)
    rows = attempts(outline, measurements_of(outline))
    assert [(row.together, row.save is not None) for row in rows] == [(1, True)] * 3


def test_several_runs_and_a_folder_of_them(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    words = ("learn", "oscillatory", "--max-iterations", 12, "--no-rerun")
    runs = [tmp_path / "runs" / name for name in ("a", "b")]
    for seed, folder in enumerate(runs):
        assert cdmisfa(*words, "--seed", seed, "-o", folder).code == 0
    twin = shutil.copytree(runs[0], tmp_path / "twin")
    page = Page(write_report([runs[0], twin], tmp_path / "same.html"))
    assert "identical to the first, bit for bit: 1 of 1" in page.text
    page = Page(write_report([*runs, twin], tmp_path / "all.html"))
    assert "3 runs; identical to the first, bit for bit: 1 of 2" in page.text
    done = cdmisfa("report", tmp_path / "runs", "-o", tmp_path / "folder.html", "--json")
    assert done.json["bytes"] == (tmp_path / "folder.html").stat().st_size


def test_what_is_refused(
    cdmisfa: Cdmisfa, tmp_path: Path, run: Path, oscillatory_recording: Path
) -> None:
    page = tmp_path / "r.html"
    page.write_text("mine")
    for words, said in (
        ((oscillatory_recording, "-o", tmp_path / "x.html"), "is no run: look at a log with"),
        ((run, run), "name the file of the report"),
        ((run, "-o", page), "exists"),
        ((run, "-o", tmp_path / "r.pdf"), "a report is an HTML page, name it r.html"),
        ((run, oscillatory_recording, "-o", tmp_path / "x.html"), "is no run"),
        ((tmp_path / "nothing", "-o", tmp_path / "x.html"), "nothing"),
    ):
        done = cdmisfa("report", *words)
        assert (done.code, done.err.count("\n")) == (2, 1), done.err
        assert said in done.err
    assert page.read_text() == "mine"


def test_learning_does_not_fail_with_its_report(
    cdmisfa: Cdmisfa, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("learn", "oscillatory", "--max-iterations", 5, "--no-rerun", "-o")
    done = cdmisfa(*words, tmp_path / "with", "--json")
    assert (done.code, done.json["ended"], done.err) == (0, "max_iterations", "")
    assert (tmp_path / "with" / "report.html").is_file()

    def broken(*_: object) -> str:
        raise ZeroDivisionError("no page today")

    monkeypatch.setattr(reports, "_page", broken)
    done = cdmisfa(*words, tmp_path / "broken")
    assert done.code == 0
    assert "has no report (no page today)" in done.err
    assert (tmp_path / "broken" / "modules.npz").is_file()


def test_the_command_that_makes_a_run_again_makes_it(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    words = ("--set", "learner.nu=0.03", "--set", "learner.tau=30", "--max-iterations", 12)
    first, second = tmp_path / "first", tmp_path / "second"
    assert cdmisfa("learn", "oscillatory", "--seed", 4, *words, "-o", first, "--no-rerun").code == 0
    again = command_again(first).split()
    assert again[:2] == ["cdmisfa", "learn"]
    assert cdmisfa(*again[1:-1], second, "--no-rerun").code == 0
    assert cdmisfa("compare", first, second).out == "identical, bit for bit\n"


def test_a_run_in_python_writes_its_report(run: Path, tmp_path: Path) -> None:
    page = library.Run(run).report(tmp_path / "mine.html")
    assert page == tmp_path / "mine.html"
    assert "Rules for saving a module" in page.read_text("utf-8")
    with pytest.raises(UsageError, match="exists"):
        library.Run(run).report(page)
    assert library.Run(run).report() == run / "report.html"


def test_memory_does_not_grow_with_the_run(tmp_path: Path) -> None:
    write_run(tmp_path / "run.mcap", VECTOR, 240, saves=True)
    save_modules(tmp_path / "modules.npz", [module_of(1, 20, np.ones((1, 2)))])
    data = RunData(tmp_path, 50)
    (module,) = data.modules
    rows = [len(part.columns[0]) for part in (data.watched, module.outputs, module.frames)]
    assert np.all(np.array(rows) <= [50, 2000, 96])
    assert max(map(len, data.last.values())) == 200
    assert len(module.recent[0]) == 80
