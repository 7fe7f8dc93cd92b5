"""Any moment of a run again: bit for bit the straight run's, however it came about."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from conftest import Cdmisfa
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from PIL import Image

from cdmisfa import Run
from cdmisfa.agents.learners import open_learner
from cdmisfa.cli import run
from cdmisfa.core.errors import NotReproducedError
from cdmisfa.core.learning import Keyframe, Learner, LearnerState
from cdmisfa.experiments.resume import Recomputation, check_run
from cdmisfa.experiments.session import Session
from cdmisfa.experiments.sources import open_source
from recorder.mcap.reader import LogReader
from replay.runs.compare import first_difference
from replay.runs.keyframes import encode_keyframe, read_keyframe
from replay.runs.log import read_header

EASY = ("learner.tau=40", "learner.eta_dot_window=8", "learner.warm_up=3", "learner.delta=1.0")
EASIER = (*EASY, "learner.min_variance=1e-6", "learner.novel_share=0.0")
"""It saves modules at iterations 8 and 42."""

pytestmark = pytest.mark.xdist_group("moments")  # one process makes what all of them share

OF = {
    "2.0": EASIER,
    "progress": ("learner.tau=40", "learner.test_frames=40", "learner.watch=1000000"),
}
ENDS = 130
LEARN = ("--seed", 3, "--max-modules", 99, "--no-rerun", "--json")


def words(algorithm: str) -> list[str]:
    chosen = (f"learner.algorithm={algorithm}", *OF[algorithm])
    return [word for setting in chosen for word in ("--set", setting)]


def same(a: Learner, b: Learner) -> None:
    """Refuse two learners that differ in a bit."""
    first, second = a.state, b.state
    assert first.policy_rng == second.policy_rng
    assert first.arrays.keys() == second.arrays.keys()
    for name, array in first.arrays.items():
        assert array.tobytes() == second.arrays[name].tobytes(), name
    assert len(first.modules) == len(second.modules)
    for x, y in zip(first.modules, second.modules, strict=True):
        assert (x.index, x.stream, x.iteration) == (y.index, y.stream, y.iteration)
        assert x.phi.tobytes() == y.phi.tobytes()


def must(*args: object) -> None:
    """Run a command that succeeds."""
    assert run([str(arg) for arg in args]) == 0


def lying(folder: Path, old: bytes, new: bytes) -> None:
    """Change what a run's log says of itself, which no checksum protects while it is written."""
    log = folder / "run.mcap"
    with LogReader(log) as reader:
        end = reader.segments[-1].stop
    data = log.read_bytes()[:end]
    assert old in data
    (folder / "run.mcap.partial").write_bytes(data.replace(old, new))
    log.unlink()


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs of both learners: live, recorded in a loop, and stopped and resumed many times."""
    folder = tmp_path_factory.mktemp("moments")
    defaults = Session.learn.__kwdefaults__
    defaults["keyframes"] = 20
    must("record", "oscillatory", "-o", folder / "log", "--frames", 1500)
    for algorithm in OF:
        for name, source in (("live", "oscillatory"), ("loop", folder / "log")):
            options = (*words(algorithm), *(["--loop"] if name == "loop" else []), *LEARN)
            for out, stops in ((name, (ENDS,)), (f"{name}-resumed", (17, 23, 64, ENDS))):
                for stop in stops:
                    resume = () if stop == stops[0] else ("--resume",)
                    where = ("-o", folder / f"{algorithm}-{out}", *resume)
                    must("learn", source, *options, *where, "--max-iterations", stop)
    defaults["keyframes"] = None
    return folder


@pytest.fixture(scope="module")
def straight() -> Callable[[str, int], Learner]:
    """A learner after so many iterations of a run that nobody logged."""

    def after(algorithm: str, iterations: int) -> Learner:
        chosen = (f"learner.algorithm={algorithm}", *OF[algorithm])
        source, configuration = open_source(["oscillatory"], settings=chosen, seed=3)
        learner = open_learner(configuration.learner, source.spec, 3)
        for _ in range(iterations):
            learner.step(source.take(learner.stream, learner.tau))
        return learner

    return after


@pytest.mark.parametrize("algorithm", OF)
@pytest.mark.parametrize("name", ["live", "loop", "live-resumed", "loop-resumed"])
@settings(max_examples=8, suppress_health_check=[HealthCheck.function_scoped_fixture])
@example(k=0)
@example(k=20)
@example(k=ENDS)
@given(k=st.integers(0, ENDS))
def test_any_moment_is_that_of_the_straight_run(
    place: Path, straight: Callable[[str, int], Learner], algorithm: str, name: str, k: int
) -> None:
    result = Run(place / f"{algorithm}-{name}").at(k)
    assert result.iteration == k
    same(result, straight(algorithm, k))


@pytest.mark.parametrize("algorithm", OF)
def test_a_run_is_what_it_says(place: Path, algorithm: str) -> None:
    for name in ("live", "loop-resumed"):
        checked = check_run(place / f"{algorithm}-{name}")
        assert (checked.start, checked.stop, checked.difference) == (0, ENDS, None)
    part = check_run(place / f"{algorithm}-live", start=47, stop=71)
    assert (part.start, part.stop, part.difference) == (40, 71, None)
    recorded = check_run(place / f"{algorithm}-live", [str(place / "log")], stop=30)
    assert recorded.difference is None


def test_another_source_is_found_out(place: Path, tmp_path: Path, cdmisfa: Cdmisfa) -> None:
    other = tmp_path / "other"
    scene = ("--set", "scene.streams=x2,x1,x3")
    assert cdmisfa("record", "oscillatory", *scene, "-o", other, "--frames", 3000).code == 0
    run = place / "2.0-live"
    refused = cdmisfa("check", run, "--source", other)
    assert (refused.code, "has other streams" in refused.err) == (2, True)
    short = cdmisfa("check", run, "--source", place / "log", "--json")
    assert short.code == 4
    assert short.json["first_difference"]["iteration"] == 1500 // 40
    assert "learned again" in cdmisfa("check", run, "--source", place / "log").out


def test_files_that_were_changed_since_are_named(tmp_path: Path, cdmisfa: Cdmisfa) -> None:
    folder, run = tmp_path / "cam", tmp_path / "run"
    folder.mkdir()
    rng = np.random.default_rng(4)
    for i in range(90):
        Image.fromarray(rng.integers(0, 256, (12, 16), np.uint8)).save(folder / f"{i}.png")
    learned = ("--rate", 20, "--max-iterations", 2, "--no-rerun")
    assert cdmisfa("learn", folder, *learned, "-o", run).code == 0
    whole = cdmisfa("check", run, "--json")
    assert (whole.code, whole.json["other_files"]) == (0, [])
    (folder / "89.png").write_bytes((folder / "88.png").read_bytes())  # it learned from 80
    changed = cdmisfa("check", run)
    assert changed.code == 4
    assert "bit for bit; but cam: no longer what the run learned from" in changed.out
    (folder / "3.png").write_bytes((folder / "4.png").read_bytes())
    changed = cdmisfa("check", run, "--json")
    assert (changed.code, changed.json["other_files"]) == (4, ["cam"])
    assert changed.json["first_difference"]["iteration"] == 0


def test_a_run_that_lies_is_found_out(tmp_path: Path, cdmisfa: Cdmisfa) -> None:
    run = tmp_path / "run"
    cdmisfa("learn", "oscillatory", *words("2.0"), *LEARN, "-o", run, "--max-iterations", 30)
    lying(run, b'"seed": 3', b'"seed": 4')
    assert read_header(run).manifest["seed"] == 4
    checked = check_run(run)
    assert checked.difference is not None
    assert checked.difference.iteration <= 1
    with pytest.raises(NotReproducedError, match="learned again, iteration"):
        Recomputation.after(run, 20)


def a_bit(state: LearnerState) -> LearnerState:
    arrays = {name: array.copy() for name, array in state.arrays.items()}
    arrays["abstraction.v"].view(np.uint64)[3, 1] ^= 1
    return dataclasses.replace(state, arrays=arrays)


def test_a_keyframe_that_lies_is_found_out(
    tmp_path: Path,
    cdmisfa: Cdmisfa,
    keyframes_every: Callable[[int], None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def kept(keyframe: Keyframe) -> bytes:
        state = a_bit(keyframe.state) if keyframe.iteration == 20 else keyframe.state
        return encode_keyframe(dataclasses.replace(keyframe, state=state))

    monkeypatch.setattr("replay.runs.keyframes.encode_keyframe", kept)
    keyframes_every(10)
    options = (*words("2.0"), *LEARN, "--max-iterations", 30)
    assert cdmisfa("learn", "oscillatory", *options, "-o", tmp_path / "run").code == 0
    checked = cdmisfa("check", tmp_path / "run")
    assert checked.code == 4
    assert checked.out.startswith("iteration 19: keyframe abstraction.v[3, 1] differs: ")
    assert cdmisfa("check", tmp_path / "run", "--iterations", ":15").code == 0
    assert cdmisfa("check", tmp_path / "run", "--iterations", "10:", "--json").code == 4


def test_without_its_source_a_run_has_its_keyframes(
    tmp_path: Path, cdmisfa: Cdmisfa, keyframes_every: Callable[[int], None]
) -> None:
    keyframes_every(10)
    log, run = tmp_path / "log", tmp_path / "run"
    cdmisfa("record", "oscillatory", "-o", log, "--frames", 2000)
    options = (*words("2.0"), *LEARN, "--max-iterations", 25)
    assert cdmisfa("learn", log, *options, "-o", run).code == 0
    log.rename(tmp_path / "moved")
    assert cdmisfa("inspect", run, "--iteration", 20, "--json").json["t"] == 800
    refused = cdmisfa("inspect", run, "--iteration", 21)
    assert refused.code == 2
    assert len(refused.err.splitlines()) == 1
    assert all(word in refused.err for word in ("no such file", "--source", "20 iterations"))
    assert cdmisfa("inspect", run, "--iteration", 21, "--source", tmp_path / "moved").code == 0


def test_at_prints_all_of_the_memory(place: Path, cdmisfa: Cdmisfa) -> None:
    run = place / "2.0-live"
    result = cdmisfa("inspect", run, "--iteration", 50, "--json").json
    learner = Run(run).at(50)
    assert [m["iteration"] for m in result["modules"]] == [8, 42]
    assert result["arrays"].keys() == learner.state.arrays.keys()
    for name, array in learner.state.arrays.items():
        if not array.dtype.names:
            printed = np.array(result["arrays"][name], float).reshape(array.shape)
            assert np.array_equal(printed, array, equal_nan=True), name
    assert (
        f"memory: {len(result['arrays'])} arrays, "
        in cdmisfa("inspect", run, "--iteration", 50).out
    )


def test_a_fork_goes_on_as_told(place: Path, tmp_path: Path, cdmisfa: Cdmisfa) -> None:
    parent, fork = place / "2.0-loop", tmp_path / "fork"
    done = cdmisfa(
        "fork", parent, "--iteration", 30, "--set", "learner.nu=0.02", "-o", fork, "--json"
    )
    assert done.code == 0, done.err
    assert done.json["iterations"] == ENDS
    result = first_difference(parent, fork)
    assert result is not None
    assert 30 <= result.iteration < 42
    about = json.loads((fork / "run.json").read_text())["fork"]
    assert (about["at"], about["changed"]) == (30, {"learner.nu": [0.05, 0.02]})
    assert (fork / about["parent"]).resolve() == parent.resolve()
    assert cdmisfa("check", fork).code == 0
    assert cdmisfa("verify", fork).code == 0
    same(Run(fork).at(27), Run(parent).at(27))
    same(Run(fork).at(30), Run(parent).at(30))
    view = tmp_path / "both.rrd"
    assert cdmisfa("compare", parent, fork, "--save", view).code == 4
    assert view.stat().st_size > 0


def test_a_fork_that_changes_nothing_is_its_parent(place: Path, tmp_path: Path) -> None:
    for algorithm in OF:
        parent, fork = place / f"{algorithm}-live", tmp_path / algorithm
        with Session.fork(parent, 33, fork, seed=3) as session:
            session.learn(rerun=False)
        assert first_difference(parent, fork) is None


@pytest.mark.parametrize(
    ("parent", "key", "at"),
    [("2.0-loop", "learner.nu=0.03", 31), ("2.0-live", "learner.nu=0.02", 0)],
)
def test_forks_of_forks_are_resumed_and_checked(
    place: Path,
    tmp_path: Path,
    cdmisfa: Cdmisfa,
    keyframes_every: Callable[[int], None],
    parent: str,
    key: str,
    at: int,
) -> None:
    keyframes_every(15)
    one, two, straight = (tmp_path / n for n in ("one", "two", "straight"))
    options = ("--no-rerun",)
    fork = ("fork", place / parent, "--iteration", at, "--set", key, *options, "-o", one)
    assert cdmisfa(*fork, "--max-iterations", 60).code == 0
    again = ("fork", one, "--iteration", 52, "--seed", 9, *options)
    assert cdmisfa(*again, "-o", two, "--max-iterations", 70).code == 0
    assert cdmisfa(*again, "-o", straight, "--max-iterations", 110).code == 0
    resumed = cdmisfa("learn", "--resume", "-o", two, "--max-iterations", 110, "--no-rerun")
    assert resumed.code == 0, resumed.err
    assert first_difference(two, straight) is None
    assert check_run(two).difference is None
    assert check_run(two, start=40, stop=100).difference is None
    keyframe, result = read_keyframe(two, 52), first_difference(one, two)
    assert keyframe is not None
    assert result is not None
    assert (keyframe.iteration, result.iteration >= 52) == (52, True)


SAME, OTHER = "same results, at other iterations", "different results"
