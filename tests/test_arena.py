"""The arena: known answers of its measures, and a small one from the command line to the page."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from arena_streams import tiny as tiny
from conftest import Cdmisfa

from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.blocks import PIXEL
from cdmisfa.core.errors import UsageError
from cdmisfa.modules import Module
from cdmisfa.studies.arena import arena
from cdmisfa.studies.arena.arena import arena_results, plan_arena
from cdmisfa.studies.arena.figure import comparisons, draw_figure
from cdmisfa.studies.arena.library import ArenaSource, Library, linear
from cdmisfa.studies.arena.page import write_arena_page
from cdmisfa.studies.arena.streams import ArenaSet
from cdmisfa.studies.arena.trial import (
    Course,
    Judge,
    SavedModule,
    allowed_slowness,
    probe,
    run_learner,
    slowest_output,
)

pytestmark = pytest.mark.usefixtures("tiny")

WORDS = ("sway", "hiss", "swing>hiss", "sway#1", "blank")
UNLEARNED = {"frame": None, "block": None, "watched": None, "known": None, "fitted": False}
NO_PAIRS: dict[str, list[bool]] = {"one": [], "others": []}
REFERENCE = 0, 8, "none"
"""Seed, components and expansion."""


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory, tiny: None) -> Library:
    found = Library(tmp_path_factory.mktemp("streams"))
    for name in ("sway", "echo", "swing", "hiss", "short", "blank", "late", "darker:sway"):
        found.prepare(name, *REFERENCE)
    return found


@pytest.fixture(scope="module")
def streams(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where arenas keep their streams, which take seconds to make."""
    return tmp_path_factory.mktemp("made")


def batch(library: Library, name: str) -> Module:
    """Batch SFA of a signal, as a module."""
    return library.reference(name, *REFERENCE).slowest


def judged(
    library: Library,
    *saved: tuple[Module, int, int],
    words: Any = WORDS,
    decided: Sequence[tuple[int, int, int]] = (),
) -> dict[str, Any]:
    """What a run came to that watched all streams in turn and saved modules at (stream, frame)."""
    source = ArenaSource(words, library, 0, change=2000)
    watched = [(40 * k, k % len(words)) for k in range(100)]
    told = []
    for one, stream, frame in saved:
        shown = source.shown(stream, frame - 1)
        told.append(SavedModule(one, stream, shown.name, shown.learnable, frame, frame // 40))
    names = {s.name for phases in source.phases for s in phases if s.learnable}
    references = {name: library.reference(name, *REFERENCE) for name in names}
    return Judge(Course(told, watched, {1: 7}, decided, 4000, ""), source, references).row()


def learned(row: dict[str, Any]) -> dict[str, int | None]:
    return {t["stream"]: t["frame"] for t in row["targets"]}


def test_batch_sfa_itself_has_learned_and_knows_the_stream_shown_twice(library: Library) -> None:
    row = judged(library, (batch(library, "sway"), 0, 400), (batch(library, "swing"), 2, 800))
    assert learned(row) == {"sway": 400, "swing>hiss": 800, "sway#1": 400}
    assert (row["wrong"], row["doubles"]) == (0, 0)
    assert all(t["fitted"] for t in row["targets"])
    assert row["in_vain"] == pytest.approx(0.5)  # hiss, blank, and swing once it is hiss
    assert row["told"] == {"hiss": 7}
    for module in row["modules"]:
        for part in ("following", "fitted"):
            assert module[part] == module[f"{part}_of_batch"]
    assert [t["block"] for t in row["targets"]] == [10, 20, 10]
    assert [t["watched"] for t in row["targets"]] == [2, 4, 2]
    for tells in row["probes"]:
        assert tells["modules"] == pytest.approx(1.0, abs=0.01)
        assert tells["outputs"] == 1


def test_a_sound_module_of_another_stream_counts_where_it_knows_this_one(library: Library) -> None:
    words = ("sway", "echo", "hiss")  # echo fades as sway does, at other times
    good, other = batch(library, "sway"), batch(library, "echo")
    for saved, frames in (
        ([(good, 0, 400)], (400, 400)),
        ([(good, 2, 400)], (None, None)),
        ([(good, 0, 400), (other, 1, 800)], (400, 800)),
    ):
        row = judged(library, *saved, words=words)
        assert learned(row) == dict(zip(("sway", "echo"), frames, strict=True))


def test_streams_of_one_world_or_others_that_one_module_gives_are_told(library: Library) -> None:
    words = ("sway", "darker:sway", "echo", "hiss")
    for by, one, others in (
        ((0, 0, 1), [True], [False, False]),
        ((0, 1, 0), [False], [True, False]),
    ):
        decided = [(400 + stream, stream, module) for stream, module in enumerate(by)]
        row = judged(library, words=words, decided=[(40, 1, 5), *decided])
        assert row["pairs"] == {"one": one, "others": others}
    assert judged(library, words=words)["pairs"] == {"one": [False], "others": [False, False]}


def test_what_was_learned_in_vain_is_told(library: Library) -> None:
    phi = np.zeros((1, 48))
    phi[0, 3] = 1.0
    fast, good = linear(phi, np.zeros(48), "none", PIXEL), batch(library, "sway")
    row = judged(library, (fast, 0, 400))
    assert set(learned(row).values()) == {None}
    assert row["modules"][0]["following"] > 1.25 * row["modules"][0]["following_of_batch"]
    assert 0 < row["probes"][0]["modules"] < 0.999
    row = judged(library, (good, 1, 400), (good, 2, 2400))
    assert row["wrong"] == 2
    assert row["modules"][0]["following_of_batch"] is None
    assert set(learned(row).values()) == {None}  # although it would do for sway
    assert slowest_output(good, library.stream("blank", 0).part("following"))[1] == math.inf
    assert judged(library, (good, 4, 400))["wrong"] == 1


def test_a_stream_needs_one_module_however_often_it_is_shown(library: Library) -> None:
    sway, swing = batch(library, "sway"), batch(library, "swing")
    again = dataclasses.replace(sway, phi=-sway.phi)
    other = dataclasses.replace(sway, phi=noise_direction(library))
    for saved, doubles in (
        ([(sway, 0, 400), (again, 3, 800), (swing, 2, 1200)], 1),
        ([(sway, 0, 400), (other, 3, 800)], 0),
        ([(sway, 0, 400), (other, 0, 800)], 1),
        ([(swing, 2, 400), (swing, 2, 2400)], 0),  # hiss since 2000
    ):
        assert judged(library, *saved)["doubles"] == doubles


def noise_direction(library: Library) -> FloatArray:
    """Weights of a sway's flickering pattern, (1, I), blind to what fades."""
    shown = library.stream("sway", 0).shown
    x = shown.reshape(len(shown), -1) * PIXEL
    x = x - x.mean(axis=0)
    slow = (x * (x @ batch(library, "sway").phi.T)).mean(axis=0)
    directions = np.linalg.svd(x, full_matrices=False)[2][:2]
    a, b = directions @ slow
    return np.asarray([b * directions[0] - a * directions[1]])


@pytest.mark.parametrize(
    ("words", "saved", "frames"),
    [
        (("sway>swing", "hiss"), (("sway", 400), ("swing", 3000)), [400, 3000]),
        (("sway>echo", "hiss"), (("sway", 400),), [400, 2000]),
        (("sway>echo", "hiss"), (("sway", 400), ("echo", 3000)), [400, 3000]),
    ],
)
def test_what_changes_counts_from_its_change(
    library: Library, words: tuple[str, ...], saved: Any, frames: list[int]
) -> None:
    modules = [(batch(library, name), 0, frame) for name, frame in saved]
    targets = judged(library, *modules, words=words)["targets"]
    assert [t["frame"] for t in targets] == frames
    watched = (frames[1] - 2000) // 80 + (frames[1] > 2000)  # every other block
    assert [t["watched"] for t in targets] == [5, watched]


def test_clips_that_loop_are_judged_on_themselves_and_more_mildly(library: Library) -> None:
    reference = library.reference("short", *REFERENCE)
    stream, sway = library.stream("short", 0), library.stream("sway", 0)
    assert len(stream.part("following")) == len(stream.shown) + 1 == 401
    slowest = reference.slowness["following"]
    assert slowest == reference.slowness["fitted"]
    assert allowed_slowness(stream, reference, "following") == 1.5 * slowest
    assert allowed_slowness(sway, reference, "following") == 1.25 * slowest


def test_what_holds_for_the_frames_shown_alone_is_not_learned(library: Library) -> None:
    good = batch(library, "late")
    blind = dataclasses.replace(good, phi=good.phi + 5 * np.eye(1, good.phi.shape[1]))
    for module, frame in ((good, 400), (blind, None)):
        row = judged(library, (module, 0, 400), words=("late", "hiss"))
        assert [(t["frame"], t["fitted"]) for t in row["targets"]] == [(frame, True)]


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

    def summary(self) -> dict[str, Any]:
        learned = {"state": "learned", "module": len(self.modules)}
        return {"streams": [learned, {"state": "given_up", "module": None}]}

    def step(self, block: Any) -> None:
        self.iteration += 1
        if self.iteration in self.saves:
            self.modules.append(self.saves[self.iteration])
        if self.iteration % 4 == 0:
            self.events = ("stream hiss is given up after 2 blocks",)
        else:
            self.events = ("stream sway is learned",) if self.iteration in self.saves else ()


@pytest.mark.parametrize(
    ("ends", "goes_on", "blocks", "ended"),
    [(9, False, 9, "nothing_left"), (99, False, 20, ""), (9, True, 20, None)],
)
def test_a_run_ends_by_itself_or_with_its_frames(
    library: Library, ends: int, goes_on: bool, blocks: int, ended: str | None
) -> None:
    learner: Any = Chooser({5: batch(library, "sway")}, ends)
    entry = ArenaSet(("sway", "hiss"), "", frames=800, goes_on=goes_on)
    course = run_learner(learner, ArenaSource(entry.words, library, 0), entry)
    assert [at for at, _ in course.watched] == [40 * k for k in range(blocks)]
    assert course.given_up == {1: 2}
    assert course.decided == [(200, 0, 0)]
    assert (len(course.watched), course.frames, course.ended) == (blocks, 40 * blocks, ended)
    assert [(s.stream, s.signal, s.frame, s.block) for s in course.saved] == [(0, "sway", 200, 5)]


def test_a_change_of_view_costs_frames(library: Library) -> None:
    entry = ArenaSet(("sway", "hiss"), "", frames=800, switch_cost=60)
    learner: Any = Chooser({}, 99)
    course = run_learner(learner, ArenaSource(entry.words, library, 0), entry)
    assert course.watched == [(100 * k, k % 2) for k in range(8)]
    assert course.frames == 800


def test_trials_are_named_by_what_they_depend_on(tmp_path: Path) -> None:
    def names(*settings: str, learner: str = "2.0", **terms: int) -> set[str]:
        return {t.id for t in plan_arena(["tiny"], [learner], [0, 1], settings, tmp_path, **terms)}

    others = [
        names(),
        names("learner.nu=0.02"),
        names(budget=100),
        names(switch_cost=100),
        names(learner="1.0"),
        {t.id for t in plan_arena(["oscillatory"], ["2.0"], [0, 1], (), tmp_path)},
    ]
    assert len(set.union(*others)) == 12
    assert names() == names("learner.nu=0.01")
    (first,) = plan_arena(["tiny"], ["2.0"], [0], ["learner.components=6"], tmp_path)
    assert first.reference == (6, "none")
    vectors = plan_arena(["oscillatory"], ["2.0", "progress"], [0], (), tmp_path)
    assert [t.reference[1] for t in vectors] == ["quadratic", "quadratic"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("tini",), "no set 'tini': did you mean tiny?"),
        (("tiny", "--learners", "3.0"), "no learner of the arena '3.0'"),
        (("tiny", "--learners", "2.0", "--set", "learner.no=1"), "unknown key learner.no"),
        (("--page", "page.md"), "holds no trials: run cdmisfa arena"),
    ],
)
def test_what_does_not_exist_is_refused_before_anything_runs(
    cdmisfa: Cdmisfa, tmp_path: Path, words: tuple[str, ...], said: str
) -> None:
    done = cdmisfa("arena", *words, "-o", tmp_path / "out")
    assert (done.code, done.out) == (2, "")
    assert said in done.err
    assert not (tmp_path / "out").exists()


def test_a_small_arena_from_trials_to_page(cdmisfa: Cdmisfa, tmp_path: Path, streams: Path) -> None:
    words = ("arena", "tiny", "oscillatory", "--learners", "progress,2.0", "--seeds", "0:2")
    out = ("-o", tmp_path / "arena", "--streams", streams)
    page = tmp_path / "arena.md"  # its pictures go to the folder of the results
    first = cdmisfa(*words, *out, "--page", page)
    assert first.code == 0, first.err
    assert "8 trials: 8 computed, 0 finished before, 0 failed" in first.err
    again = cdmisfa(*words, *out, "--json")
    assert "8 trials: 0 computed, 8 finished before, 0 failed" in again.err
    entries = again.json["entries"]
    points = [(e["point"]["set"], e["point"]["learner"]) for e in entries]
    assert points == [(s, by) for s in ("oscillatory", "tiny") for by in ("progress", "2.0")]
    for entry in entries[::2]:
        measured = entry["measures"]
        found = [measured[k]["mean"] for k in ("learned", "fitted", "wrong", "doubles", "ended")]
        assert found == [1, 1, 0, 0, 1]
        assert measured["blocks"]["mean"] < 300
    waves, tiny = entries[1::2]
    measured = waves["measures"]
    assert measured["learned"] == {"mean": 1.0, "sd": 0.0, "n": 2, "low": 1.0, "high": 1.0}
    assert [measured[k]["mean"] for k in ("wrong", "doubles", "ended")] == [0, 0, 1]
    assert measured["probe"]["mean"] > 0.99 > measured["probe_components"]["mean"]
    assert 1000 < measured["blocks_learned"]["mean"] == measured["blocks"]["mean"] < 2000
    assert (waves["curve"]["mean"][0], waves["curve"]["mean"][-1]) == (0.0, 1.0)
    assert tiny["measures"]["learned"]["mean"] == 0.0
    assert json.loads((tmp_path / "arena" / "results.json").read_text()) == {
        k: v for k, v in again.json.items() if k != "folder"
    }
    text = page.read_text("utf-8")
    assert "## What `progress` did not do" in text
    assert "\nNothing.\n" in text
    assert "| tiny | 2 | 1.00 | 1.00 | 0.0 | 0.0 |" in text
    assert "Means over `oscillatory`, `tiny`:" in text
    assert "| 2.0 | 2 | 0.50 |" in text
    assert (tmp_path / "arena" / "results.json").name in text
    assert (tmp_path / "arena" / "arena.png").stat().st_size > 0
    head, _, *rows = first.out.splitlines()
    assert head.split()[:3] == ["set", "learner", "seeds"]
    assert [tuple(row.split()[:3]) for row in rows] == [(*point, "2") for point in points]


def test_learners_are_compared_on_the_sets_that_all_of_them_were_on() -> None:
    def entries(learner: str, sets: str, **more: str) -> list[dict[str, Any]]:
        return [{"point": {"set": name, "learner": learner, **more}} for name in sets]

    run = [*entries("progress", "abcd"), *entries("2.0", "d"), *entries("robin", "bc")]
    run += [*entries("learning-progress", "abc"), *entries("robin", "a", budget="60")]
    found = [(one.condition, "".join(one.sets), list(one.learners)) for one in comparisons(run)]
    assert found == [
        ("", "d", ["progress", "2.0"]),
        ("", "abc", ["progress", "learning-progress"]),
        ("", "bc", ["progress", "learning-progress", "robin"]),
        ("budget=60", "a", ["robin"]),
    ]
    for one in comparisons(run):
        for of in one.learners.values():
            assert [entry["point"]["set"] for entry in of] == list(one.sets)


def came_to(**more: Any) -> dict[str, Any]:
    """A result: of a run that did not learn sway."""
    result = {"frames": 400, "blocks": 10, "ended": "", "modules": [], "wrong": 0, "doubles": 0}
    result |= {"targets": [{**UNLEARNED, "stream": "sway", "signal": "sway"}]}
    return result | {"probes": [], "in_vain": 0.0, "told": {}, "pairs": NO_PAIRS, **more}


def test_of_a_trial_that_several_versions_computed_that_of_now_counts(tmp_path: Path) -> None:
    point = {"set": "tiny", "learner": "2.0", "learner.nu": "0.02"}
    (now,) = plan_arena(["tiny"], ["2.0"], [0], ["learner.nu=0.02"], tmp_path)

    def row(code: str, wrong: int) -> str:
        found = {"id": code, "status": "done", "point": point, "seed": 0, "code": code}
        return json.dumps(found | {"result": came_to(wrong=wrong)}) + "\n"

    for rows, wrong, outdated in (
        ([row("old", 1), row("newer", 2)], 2, 1),
        ([row("old", 1), row(now.code, 3), row("newer", 2)], 3, 0),
    ):
        (tmp_path / "rows.jsonl").write_text("".join(rows))
        document = arena_results(tmp_path)
        assert document["entries"][0]["measures"]["wrong"]["mean"] == wrong
        assert document["outdated"] == outdated


def test_a_page_says_what_was_not_learned_and_of_what_there_is_a_module(tmp_path: Path) -> None:
    parts = ("following", "following_of_batch", "fitted", "fitted_of_batch")
    module = {"signal": "sway", "learnable": True, **dict.fromkeys(parts, 1.0)}
    noise = {"signal": "hiss", "learnable": False}
    rows = []
    for seed, modules in enumerate(([], [module, noise])):
        result = came_to(modules=modules, wrong=seed, doubles=seed)
        changed = {"stream": "hiss>sway", "signal": "sway", "frame": 2000, "block": 50}
        result["targets"].append(
            {**changed, "watched": 12 * seed, "known": not seed, "fitted": True}
        )
        point = {"set": "tiny", "learner": "progress"}
        row = {"id": str(seed), "status": "done", "point": point, "seed": seed, "code": "old"}
        rows.append(json.dumps(row | {"result": result}) + "\n")
    (tmp_path / "rows.jsonl").write_text("".join(rows))
    document, page = arena_results(tmp_path), tmp_path / "page.md"
    write_arena_page(document, draw_figure(document, tmp_path)[0], page)
    text = page.read_text("utf-8")
    assert "not learned `sway` 2/2 (1 with a module that is too fast); 1 module of `hiss`; " in text
    assert "| tiny | `sway` | 1/2 | 1/2 | 12 |" in text
    assert "1 too many of what it had; 2 of 2 runs did not end." in text
    assert "2 trials are of an earlier version of the code." in text


def test_a_trial_that_breaks_is_a_failure_and_the_others_go_on(
    cdmisfa: Cdmisfa, tmp_path: Path, streams: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(trial: Any) -> dict[str, Any]:
        if trial.seed == 1:
            raise UsageError("it broke")
        return came_to()

    monkeypatch.setattr(arena, "run_arena_trial", broken)
    words = ("arena", "tiny", "--learners", "2.0", "--seeds", "0:2", "--streams", streams)
    done = cdmisfa(*words, "-o", tmp_path)
    assert done.code == 1
    assert "failed: set=tiny learner=2.0 seed 1: it broke" in done.err
    (entry,) = arena_results(tmp_path)["entries"]
    assert (entry["seeds"], entry["failed"]) == ([0, 1], ["it broke"])
    assert entry["measures"]["learned"]["n"] == 1
    assert "1 failed" in done.out
