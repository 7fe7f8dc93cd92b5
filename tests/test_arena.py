"""The arena: known answers of its measures, and a small one from the command line to the page."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from arena_streams import tiny as tiny
from conftest import Cdmisfa

from cdmisfa.arena import measures
from cdmisfa.arena.arena import plan
from cdmisfa.arena.contestants import configured
from cdmisfa.arena.library import Library, Wanted, linear
from cdmisfa.arena.measures import Saved, probe
from cdmisfa.arena.results import results
from cdmisfa.arena.source import ArenaSource
from cdmisfa.arena.streams import LEARNED_FROM
from cdmisfa.arena.trial import History, follow, judge
from cdmisfa.core.blocks import PIXEL
from cdmisfa.core.errors import UsageError
from cdmisfa.core.modules import Module

pytestmark = pytest.mark.usefixtures("tiny")

WORDS = ("sway", "hiss", "swing>hiss", "sway#1", "blank")


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory, tiny: None) -> Library:
    found = Library(tmp_path_factory.mktemp("streams"))
    for name in ("sway", "echo", "swing", "hiss", "short", "blank"):
        found.prepare(Wanted(name, 0, ((8, "none"),)))
    return found


def batch(library: Library, name: str) -> Module:
    """Batch SFA of a signal, as a module."""
    return library.reference(name, 0, 8, "none").slowest


def pixel(place: int) -> Module:
    """A module whose output is one of the pixels."""
    phi = np.zeros((1, 48))
    phi[0, place] = 1.0
    return linear(phi, np.zeros(48), "none", PIXEL)


def judged(library: Library, *saved: tuple[Module, int, int], words: Any = WORDS) -> dict[str, Any]:
    """What a run came to that watched all streams in turn and saved modules at (stream, frame)."""
    source = ArenaSource(words, library, 0, change=2000)
    watched = [(40 * k, k % len(words)) for k in range(100)]
    told = []
    for one, stream, frame in saved:
        signal = source.shown(stream, frame - 1)
        told.append(Saved(one, stream, signal.name, signal.learnable, frame, frame // 40))
    names = {s.name for phases in source.phases for s in phases if s.learnable}
    references = {name: library.reference(name, 0, 8, "none") for name in names}
    return judge(History(told, watched, 4000, ""), source, references)


def learned(row: dict[str, Any]) -> dict[str, int | None]:
    return {t["stream"]: t["frame"] for t in row["targets"]}


def test_batch_sfa_itself_has_learned_and_knows_the_stream_shown_twice(library: Library) -> None:
    row = judged(library, (batch(library, "sway"), 0, 400), (batch(library, "swing"), 2, 800))
    assert learned(row) == {"sway": 400, "swing>hiss": 800, "sway#1": 400}
    assert (row["wrong"], row["doubles"]) == (0, 0)
    assert [t["block"] for t in row["targets"]] == [10, 20, 10]
    assert [t["watched"] for t in row["targets"]] == [2, 4, 2]
    for tells in row["probes"]:
        assert tells["modules"] == pytest.approx(1.0, abs=0.01)
        assert tells["outputs"] == 1


def test_a_sound_module_of_another_stream_counts_where_it_knows_this_one(library: Library) -> None:
    words = ("sway", "echo", "hiss")  # echo fades as sway does, at other times
    good = batch(library, "sway")
    assert learned(judged(library, (good, 0, 400), words=words)) == {"sway": 400, "echo": 400}
    assert learned(judged(library, (good, 2, 400), words=words)) == {"sway": None, "echo": None}
    both = judged(library, (good, 0, 400), (batch(library, "echo"), 1, 800), words=words)
    assert learned(both) == {"sway": 400, "echo": 800}


def test_a_module_that_is_not_slow_has_learned_nothing(library: Library) -> None:
    row = judged(library, (pixel(3), 0, 400))
    assert set(learned(row).values()) == {None}
    ((only,), tells) = row["modules"], row["probes"]
    assert only["slowness"] > only["allowed"]
    assert 0 < tells[0]["modules"] < 0.999


def test_a_module_of_noise_is_wrong_however_it_was_learned(library: Library) -> None:
    noise = batch(library, "sway")
    row = judged(library, (noise, 1, 400), (noise, 2, 2400))
    assert row["wrong"] == 2
    assert row["modules"][0]["allowed"] is None
    assert set(learned(row).values()) == {None}  # although it would do for sway


def test_a_stream_needs_one_module_however_often_it_is_shown(library: Library) -> None:
    sway, swing = batch(library, "sway"), batch(library, "swing")
    again = dataclasses.replace(sway, phi=-sway.phi)
    row = judged(library, (sway, 0, 400), (again, 3, 800), (swing, 2, 1200))
    assert row["doubles"] == 1
    other = dataclasses.replace(sway, phi=noise_direction(library))
    assert judged(library, (sway, 0, 400), (other, 3, 800))["doubles"] == 0
    assert judged(library, (sway, 0, 400), (other, 0, 800))["doubles"] == 1
    assert judged(library, (swing, 2, 400), (swing, 2, 2400))["doubles"] == 0  # hiss since 2000


def noise_direction(library: Library) -> np.ndarray:
    """Weights of a sway's flickering pattern, (1, I), blind to what fades."""
    x = library.stream("sway", 0).learned_from.reshape(LEARNED_FROM, -1) * PIXEL
    x = x - x.mean(axis=0)
    slow = (x * (x @ library.reference("sway", 0, 8, "none").slowest.phi.T)).mean(axis=0)
    directions = np.linalg.svd(x, full_matrices=False)[2][:2]
    a, b = directions @ slow
    return np.asarray([b * directions[0] - a * directions[1]])


def test_what_changes_counts_from_its_change(library: Library) -> None:
    words = ("sway>swing", "hiss")
    both = (batch(library, "sway"), 0, 400), (batch(library, "swing"), 0, 3000)
    row = judged(library, *both, words=words)
    assert [(t["signal"], t["frame"]) for t in row["targets"]] == [("sway", 400), ("swing", 3000)]
    assert [t["watched"] for t in row["targets"]] == [5, 13]  # 3000 - 2000 frames, every other
    words = ("sway>echo", "hiss")
    early = judged(library, (batch(library, "sway"), 0, 400), words=words)
    assert [t["frame"] for t in early["targets"]] == [400, 2000]
    again = (batch(library, "sway"), 0, 400), (batch(library, "echo"), 0, 3000)
    assert [t["frame"] for t in judged(library, *again, words=words)["targets"]] == [400, 3000]


def test_clips_that_loop_are_judged_on_themselves_and_more_mildly(library: Library) -> None:
    reference = library.reference("short", 0, 8, "none")
    stream = library.stream("short", 0)
    assert len(stream.held_out) == len(stream.learned_from) + 1 == 401
    assert measures.allowed(stream, reference) == 1.5 * reference.slowness
    sway = library.stream("sway", 0)
    assert measures.allowed(sway, reference) == 1.25 * reference.slowness


def test_an_output_that_never_moves_is_not_slow(library: Library) -> None:
    dead = batch(library, "sway")
    assert measures.slowest(dead, library.stream("blank", 0).held_out).slowness == math.inf
    assert judged(library, (dead, 4, 400))["wrong"] == 1


def test_a_probe_tells_what_is_in_the_features_and_no_more() -> None:
    rng = np.random.default_rng(0)
    features = rng.standard_normal((40000, 3))
    told = features @ [[1.0], [2.0], [-0.5]]
    hidden, still = rng.standard_normal((40000, 1)), np.ones((40000, 1))
    assert probe(features, told) == pytest.approx(1.0, abs=1e-5)
    assert probe(features, told + 2.2913 * hidden) == pytest.approx(0.5, abs=0.03)
    assert probe(features, hidden) == pytest.approx(0.0, abs=0.01)
    assert probe(features, np.hstack([told, still])) == pytest.approx(1.0, abs=1e-5)
    assert math.isnan(probe(features, still))
    assert probe(np.zeros((40000, 1)), told) == 0.0


class Chooser:
    """A learner that saves a module a stream, at given iterations, and then has nothing left."""

    tau = 40
    max_modules = None

    def __init__(self, saves: dict[int, Module], ends: int) -> None:
        self.saves, self.ends = saves, ends
        self.iteration, self.modules = 0, list[Module]()

    @property
    def stream(self) -> int:
        return self.iteration % 2

    @property
    def over(self) -> str:
        return "nothing_left" if self.iteration >= self.ends else ""

    def step(self, block: Any) -> None:
        assert block.t == 40 * self.iteration
        self.iteration += 1
        if self.iteration in self.saves:
            self.modules.append(self.saves[self.iteration])


@pytest.mark.parametrize(
    ("ends", "goes_on", "blocks", "ended"),
    [(9, False, 9, "nothing_left"), (99, False, 20, ""), (9, True, 20, None)],
)
def test_a_run_ends_by_itself_or_with_its_frames(
    library: Library, ends: int, goes_on: bool, blocks: int, ended: str | None
) -> None:
    learner: Any = Chooser({5: batch(library, "sway")}, ends)
    source = ArenaSource(("sway", "hiss"), library, 0)
    history = follow(learner, source, 800, goes_on=goes_on)
    assert (len(history.watched), history.frames, history.ended) == (blocks, 40 * blocks, ended)
    assert [(s.stream, s.signal, s.frame, s.block) for s in history.saved] == [(0, "sway", 200, 5)]


def test_trials_are_named_by_what_they_depend_on(tmp_path: Path) -> None:
    def names(*settings: str, frames: int | None = None, learner: str = "2.0") -> set[str]:
        return {t.id for t in plan(["tiny"], [learner], [0, 1], settings, frames, tmp_path)}

    others = [
        names(),
        names("learner.nu=0.02"),
        names(frames=100),
        names(learner="1.0"),
        {t.id for t in plan(["oscillatory"], ["2.0"], [0, 1], (), None, tmp_path)},
    ]
    assert len(set.union(*others)) == 10
    assert names() == names("learner.nu=0.01")
    (first, _) = plan(["tiny"], ["2.0"], [0, 1], ["learner.components=6"], None, tmp_path)
    assert {w.name for w in first.wanted()} == {"sway", "swing", "hiss"}
    assert first.reference == (6, "none")
    vectors = plan(["oscillatory"], ["2.0", "progress"], [0], (), None, tmp_path)
    assert [t.reference[1] for t in vectors] == ["quadratic", "quadratic"]
    assert configured("1.0", ["learner.tau=20"], images=True).tau == 20


def test_what_does_not_exist_is_refused_before_anything_runs(
    cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    out = ("-o", tmp_path / "out")
    for words, said in (
        (("tini",), "no set 'tini': did you mean tiny?"),
        (("tiny", "--learners", "3.0"), "no learner of the arena '3.0'"),
        (("tiny", "--learners", "2.0", "--set", "learner.no=1"), "unknown key learner.no"),
        (("--page", tmp_path / "page.md"), "holds no trials: run cdmisfa arena"),
    ):
        done = cdmisfa("arena", *words, *out)
        assert (done.code, done.out) == (2, "")
        assert said in done.err
    assert not (tmp_path / "out").exists()


def test_a_small_arena_from_trials_to_page(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    words = ("arena", "tiny", "oscillatory", "--learners", "progress,2.0", "--seeds", "0:2")
    out = ("-o", tmp_path / "out", "--streams", tmp_path / "streams")
    page = tmp_path / "docs" / "arena.md"
    first = cdmisfa(*words, *out, "--page", page)
    assert first.code == 0, first.err
    assert "8 trials: 8 computed, 0 finished before, 0 failed" in first.err
    again = cdmisfa(*words, *out, "--json")
    assert "8 trials: 0 computed, 8 finished before, 0 failed" in again.err
    entries = again.json["entries"]
    assert [e["point"] for e in entries] == [
        {"set": name, "learner": learner}
        for name in ("oscillatory", "tiny")
        for learner in ("progress", "2.0")
    ]
    for entry in entries[::2]:
        measured = entry["measures"]
        assert [measured[k]["mean"] for k in ("learned", "wrong", "doubles")] == [1, 0, 0]
        assert measured["ended"]["mean"] == 1
        assert measured["blocks"]["mean"] < 300
    waves, tiny = entries[1::2]
    measured = waves["measures"]
    assert measured["learned"] == {"mean": 1.0, "sd": 0.0, "n": 2, "low": 1.0, "high": 1.0}
    assert (measured["wrong"]["mean"], measured["doubles"]["mean"]) == (0, 0)
    assert measured["ended"]["mean"] == 1
    assert measured["probe"]["mean"] > 0.99 > measured["probe_components"]["mean"]
    assert 1000 < measured["blocks_learned"]["mean"] == measured["blocks"]["mean"] < 2000
    assert waves["curve"]["mean"][0] == 0.0
    assert waves["curve"]["mean"][-1] == 1.0
    assert tiny["measures"]["learned"]["mean"] == 0.0
    assert json.loads((tmp_path / "out" / "results.json").read_text()) == {
        k: v for k, v in again.json.items() if k != "folder"
    }
    text = page.read_text("utf-8")
    assert "**2.0**, tiny: not learned `sway` 2/2, `swing` 2/2; 2 of 2 runs did not end." in text
    assert "| 2.0 | 2 | 1.00 | 3.0 | 0.0 | 0.0 | 1.00" in text
    failures = text.partition("## What did not work")[2].partition("## oscillatory")[0]
    assert "oscillatory: " not in failures
    assert "**progress**" not in failures
    assert "| progress | 2 of 2 | 1.00 | 0.00 | 0.00 | 1.00" in text
    assert (page.with_suffix("") / "arena.png").stat().st_size > 0
    head, _, *rows = first.out.splitlines()
    assert head.split()[:3] == ["set", "learner", "seeds"]
    assert [row.split()[:3] for row in rows] == [
        [name, learner, "2"] for name in ("oscillatory", "tiny") for learner in ("progress", "2.0")
    ]


def test_of_a_trial_that_several_versions_computed_that_of_now_counts(tmp_path: Path) -> None:
    def row(number: str, wrong: int) -> str:
        target = dict.fromkeys(("frame", "block", "watched")) | {"stream": "sway", "signal": "sway"}
        result = {"frames": 400, "blocks": 10, "ended": "", "modules": [], "targets": [target]}
        result |= {"wrong": wrong, "doubles": 0, "probes": []}
        point = {"set": "tiny", "learner": "2.0", "learner.nu": "0.02"}
        found = {"id": number, "status": "done", "point": point, "seed": 0, "code": ""}
        return json.dumps(found | {"result": result}) + "\n"

    def wrong() -> tuple[float, int]:
        document = results(tmp_path)
        (entry,) = document["entries"]
        return entry["measures"]["wrong"]["mean"], document["outdated"]

    (now,) = plan(["tiny"], ["2.0"], [0], ["learner.nu=0.02"], None, tmp_path)
    rows = tmp_path / "rows.jsonl"
    rows.write_text(row("old", 1) + row("newer", 2))
    assert wrong() == (2, 1)
    rows.write_text(row("old", 1) + row(now.id, 3) + row("newer", 2))
    assert wrong() == (3, 0)


def test_a_trial_that_breaks_is_a_failure_and_the_others_go_on(
    cdmisfa: Cdmisfa, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from cdmisfa.arena import arena

    def broken(trial: Any) -> dict[str, Any]:
        if trial.seed == 1:
            raise UsageError("it broke")
        return {**judged_nothing, "frames": 400}

    judged_nothing = {
        "blocks": 10, "ended": "", "modules": [], "wrong": 0, "doubles": 0, "probes": [],
        "targets": [{"stream": "sway", "signal": "sway", "frame": None, "block": None,
                     "watched": None}],
    }  # fmt: skip
    monkeypatch.setattr(arena, "run_trial", broken)
    words = ("arena", "tiny", "--learners", "2.0", "--seeds", "0:3", "-o", tmp_path)
    done = cdmisfa(*words)
    assert done.code == 1
    assert "failed: set=tiny learner=2.0 seed 1: it broke" in done.err
    (entry,) = results(tmp_path)["entries"]
    assert (entry["seeds"], entry["failed"]) == ([0, 1, 2], ["it broke"])
    assert entry["measures"]["learned"]["n"] == 2
    assert "1 failed" in done.out
