"""Reports: what they say is what the data are, of whatever state a run is in."""

from __future__ import annotations

import dataclasses
import json
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
from cdmisfa.experiments.reports import command_again, write_report
from replay.report import conditions
from replay.report.conditions import LIVELY, attempts, conditions_of, deciding
from replay.report.page import MOST_BYTES
from replay.report.told import read_told
from replay.runs.modules import save_modules

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
    told = read_told(run, frames=10)
    rules = deciding(conditions_of(told.outline, told.signals))
    assert [rule.short for rule in rules] == ["η̇", "share", "variance", "novel blocks"]
    every = np.all([rule.holds for rule in rules], axis=0)
    saves = [save.iteration for save in told.outline.saved]
    assert len(saves) > 1
    assert np.flatnonzero(every).tolist() == saves
    assert not all(rule.holds.all() for rule in rules)
    rows = attempts(told.outline, told.signals, rules)
    assert [row.together for row in rows if row.saved] == [1] * len(saves)
    assert sum(row.blocks for row in rows) == len(told)


def test_a_fork_is_shown_with_what_it_was_told_otherwise(
    cdmisfa: Cdmisfa, run: Path, tmp_path: Path
) -> None:
    first = read_told(run, frames=1).outline.saved[0].iteration
    fork, at = tmp_path / "fork", first + 5
    words = ("--iteration", at, "--set", "learner.delta=1e-9", "-o", fork, "--no-rerun")
    assert cdmisfa("fork", run, *words, "--max-iterations", at + 40).code == 0
    page = Page(fork / "report.html")
    assert f"A fork of ../run after {at} iterations: learner.delta 0.02 became 1e-09." in page.text
    assert "the fork begins" in page.text
    assert f"cdmisfa compare {run} {fork}" in page.text


def test_what_is_displayed_is_what_the_data_are(run: Path) -> None:
    page, found = Page(run / "report.html"), library.Run(run)
    signals, names = found.signals, found.streams
    n, tau = len(signals["iteration"]), 40
    streams = np.bincount(signals["stream"], minlength=3)
    learned_of = {m.stream for m in found.modules}
    expected = [
        f"{len(learned_of)} of 3 streams learned",
        f"in {n:,} iterations ({n * tau:,} frames)",
        *(f"{streams[s] / n:.1%} of its attention, {streams[s] * tau:,} frames" for s in range(3)),
        *(f"{m.stream} (module {m.index})" for m in found.modules),
        *(f"Saved after iteration {m.iteration:,}, at frame" for m in found.modules),
        *(f"at frame {(m.iteration + 1) * tau:,}" for m in found.modules),
        *(f"slowness {m.eta[0]:.4f}" for m in found.modules),
        str(found.result["signals_sha256"]),
        "saved only below δ = 0.02",
        "saved only from 0.5 on",
        "saved only from 0.2 on",
        f"cdmisfa check {run}",
    ]  # fmt: skip
    assert [text for text in expected if text not in page.text] == []
    assert all(name in page.text for name in names)
    for module in found.modules:  # it follows the one thing that the world knows
        own = found.frames()[np.repeat(signals["stream"], tau) == module.stream_index]
        text = page.text[page.text.index(f"Module {module.index}: ") :]
        shown = re.search(
            r"Frames of least output : ?([-+.\d]+) at|least output: ([-+.\d]+) at", text
        )
        assert shown is not None
        y = module.transform(own)[:, 0]
        assert float(shown[1] or shown[2]) == pytest.approx(y.min(), abs=0.006)
        assert "It follows" in text


def test_what_one_points_at_is_what_was_watched(tmp_path: Path) -> None:
    folder = pictured_run(tmp_path / "run")
    page = Page(write_report([folder]))
    found = library.Run(folder)
    shown = page.frames["timeline"]
    assert len(shown["t"]) == len(shown["x"]) == len(shown["text"]) > 100
    starts, end = found.signals["t"], int(found.signals["t"][-1]) + 40
    for t, x, text in zip(shown["t"], shown["x"], shown["text"], strict=True):
        row = int(np.searchsorted(starts, t, side="right")) - 1
        start = f"frame {t:,}, iteration {row}: {HOSTILE[found.signals['stream'][row]]}; "
        assert text.startswith(start)
        shares = found.signals["share"][row] >= RULES["novel_share"]
        held = text.removeprefix(start).partition("not: ")[0]
        assert ("share" in held) == shares
        assert x == pytest.approx(1000 * t / end, abs=0.06)
    for module in found.modules:
        own = page.frames[f"module{module.index}"]
        every = dict(zip(range(0, end, 10), found.frames(), strict=True))
        for t, text in zip(own["t"], own["text"], strict=True):
            y = module.transform(every[t][None])[0, 0]
            assert text == f"frame {t:,}: output {y:+.2f}"


def test_no_name_becomes_an_element_and_nothing_is_asked_of_others(tmp_path: Path) -> None:
    page = Page(write_report([pictured_run(tmp_path / "<b onclick='x'>\"&")]))
    assert page.count("script") == 2
    assert all(attributes.get("src") != "x" for _, attributes in page.tags)
    assert page.count("b") == page.text.count(" ! ") + page.text.count(" · ") + page.text.count(
        " ✓ "
    )
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
    assert "60 streams" in page.text
    assert "camera 59" in page.text
    assert "Further modules" in page.text


def test_a_page_that_would_be_too_large_shows_fewer_frames(tmp_path: Path) -> None:
    noise = np.random.default_rng(0)
    spec = dataclasses.replace(IMAGE, frame_shape=(96, 96), truth=())
    write_run(tmp_path / "run.mcap", spec, 20)
    save_modules(tmp_path / "modules.npz", [module_of(1, 5, noise.standard_normal((1, 96 * 96)))])
    counted = {}
    for most in (10**9, 200_000):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("replay.report.page.MOST_BYTES", most)
            page = Page(write_report([tmp_path]))
        counted[most] = len(page.frames["timeline"]["t"])
    assert len(page.source) < 200_000 or counted[200_000] <= 12
    assert counted[200_000] <= counted[10**9]


def test_a_run_that_was_killed_says_what_is_missing(tmp_path: Path, run: Path) -> None:
    killed = tmp_path / "killed"
    killed.mkdir()
    data = (run / "run.mcap").read_bytes()
    (killed / "run.mcap.partial").write_bytes(data[: len(data) * 2 // 3])
    page = Page(write_report([killed]))
    assert (
        "The run was broken off before its end, or still learns: there is no run.json" in page.text
    )
    assert "cdmisfa learn --resume" in page.text
    assert "Why was it saved" not in page.text
    assert "Share of recent blocks" in page.text
    damaged = shutil.copytree(run, tmp_path / "damaged")
    broken = bytearray(data)
    at = len(data) * 4 // 5
    broken[at : at + 2000] = bytes(2000)
    (damaged / "run.mcap").write_bytes(broken)
    page = Page(write_report([damaged]))
    assert "The log is damaged; what follows is what could be read" in page.text
    assert "Where it looked" in page.text


def test_a_run_that_learned_nothing_says_which_rule_did_not_hold(
    cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    run = learned(cdmisfa, tmp_path / "run", "--max-iterations", 20, "--set", "learner.delta=1e-9")
    page = Page(run / "report.html")
    assert "nothing: no module was saved" in page.text
    assert "No module was saved." in page.text
    assert re.search(r"module 1 20 0\.0% .* never no module", page.text)


def test_what_it_learned_from_is_gone_or_was_changed(
    cdmisfa: Cdmisfa, tmp_path: Path, oscillatory_recording: Path
) -> None:
    recording = shutil.copytree(oscillatory_recording, tmp_path / "rec")
    run = tmp_path / "run"
    assert cdmisfa("learn", recording, "-o", run, "--max-iterations", 9, "--no-rerun").code == 0
    there = Page(run / "report.html").text
    assert "What it learned from is there: learn it again, and compare every bit." in there
    assert f"cdmisfa learn {recording} --max-iterations 9 -o RUN" in there
    first, second = sorted(recording.glob("*.mcap"))[:2]
    kept = first.read_bytes()
    first.write_bytes(second.read_bytes())
    changed = Page(write_report([run])).text
    assert "It cannot be learned again here" in changed or "no longer what" in changed
    first.write_bytes(kept)
    recording.rename(tmp_path / "rec2")
    gone = Page(write_report([run])).text
    assert "It cannot be learned again here: " in gone
    assert "no such file or folder. " in gone
    assert "Where it looked" in gone


def test_the_progress_learner_is_shown_with_its_own_rules(tmp_path: Path) -> None:
    assert LIVELY == judging.LIVELY
    for name in ("SLOW_AGAIN", "STILL_GAINING", "PASSED_ON", "TURNING", "FULL"):
        assert getattr(conditions, name) == getattr(judging, name)
    settings = {**PROGRESS, "test_frames": 400}
    write_run(tmp_path / "run.mcap", VECTOR, 60, learner=settings, edit=by_progress)
    page = Page(write_report([tmp_path]))
    for text in (
        "Learning error e",
        "learned below 0.3",
        "learned below 0.05",
        "given up",
        "known",
    ):
        assert text in page.text
    told = read_told(tmp_path, frames=5)
    rules = {rule.short: rule for rule in conditions_of(told.outline, told.signals)}
    tested, fitted = (told.outline.lines[name] for name in ("tested", "fitted"))
    apart = np.abs(np.log(tested / fitted))
    np.testing.assert_array_equal(rules["agreement"].holds, apart < 0.25)


def test_the_progress_learner_saves_where_all_its_rules_hold_and_nowhere_else(
    cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    words = ("--algorithm", "progress", "--no-rerun", "-o", tmp_path)
    assert cdmisfa("learn", "oscillatory", *words).code == 0
    told = read_told(tmp_path, frames=1)
    rules = conditions_of(told.outline, told.signals)
    rows = attempts(told.outline, told.signals, rules)
    assert [(row.together, row.saved) for row in rows] == [(1, True)] * 3


def test_several_runs_and_a_folder_of_them(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    words = ("learn", "oscillatory", "--max-iterations", 12, "--no-rerun")
    runs = [tmp_path / "runs" / name for name in ("a", "b")]
    for seed, folder in enumerate(runs):
        assert cdmisfa(*words, "--seed", seed, "-o", folder).code == 0
    twin = shutil.copytree(runs[0], tmp_path / "twin")
    page = Page(write_report([runs[0], twin], tmp_path / "same.html"))
    assert "All 2 runs are identical, bit for bit." in page.text
    page = Page(write_report([*runs, twin], tmp_path / "all.html"))
    assert "3 runs: they learned nothing; 2 are identical, bit for bit." in page.text
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
    assert "What did it learn?" in page.read_text("utf-8")
    with pytest.raises(UsageError, match="exists"):
        library.Run(run).report(page)
    assert library.Run(run).report() == run / "report.html"


def test_what_is_read_does_not_grow_with_the_run(tmp_path: Path) -> None:
    kept = []
    for iterations in (60, 240):
        folder = tmp_path / str(iterations)
        folder.mkdir()
        write_run(folder / "run.mcap", VECTOR, iterations, saves=True)
        save_modules(folder / "modules.npz", [module_of(1, 20, np.ones((1, 2)))])
        told = read_told(folder, frames=50)
        (module,) = told.modules
        rows = [len(part.columns[0]) for part in (told.seen, module.heard, module.pictures)]
        kept.append((rows, max(len(rows) for rows in told.last.values()), len(module.near)))
        assert json.loads(json.dumps(rows)) <= [50, 2000, 96]
    assert kept[1][1] == kept[0][1]
