"""A run: how it ends, what its folder holds, what it never overwrites."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from run_data import parts_of, read_signals

from cdmisfa.core.blocks import Block
from cdmisfa.core.config import LearnerConfig, build, load_preset
from cdmisfa.core.errors import CdmisfaError, LogExhaustedError, UsageError
from cdmisfa.core.learning import Learner, Sink
from cdmisfa.core.signals import BlockSignals, SignalsHash
from cdmisfa.experiments.documents import write_json
from cdmisfa.experiments.loop import ENDINGS
from cdmisfa.experiments.run_folder import RunResult
from cdmisfa.experiments.session import run as run_it
from recorder.world.oscillatory import OscillatorySource
from replay.runs.modules import load_modules

CONFIG = build(LearnerConfig, "learner", load_preset("oscillatory")["learner"])


def run(out: Path | None = None, source: OscillatorySource | None = None, **how: Any) -> RunResult:
    how = {"max_iterations": 12, "rerun": False, **how}
    config = how.pop("config", CONFIG)
    return run_it(source or OscillatorySource(), config, out, **how)


def logged(out: Path) -> SignalsHash:
    digest = SignalsHash()
    for signals in read_signals(out):
        digest.add(signals)
    return digest


def after(n: int) -> Callable[[], bool]:
    """Says stop when asked for the (n+1)-th time."""
    asked = iter(range(10**9))
    return lambda: next(asked) >= n


def test_it_ends_when_every_stream_is_learned(tmp_path: Path) -> None:
    result = run(tmp_path / "run", max_iterations=None)
    assert result.ended == "max_modules"
    assert [m.stream_index for m in result.modules] == [0, 1, 2]
    assert result.iterations == result.modules[-1].iteration + 1
    assert result.summary["epsilon"] == 1.2
    assert logged(tmp_path / "run").hexdigest() == result.signals_sha256
    texts = [event.text for event in parts_of(tmp_path / "run", "events")]
    assert texts == [
        "module 1 saved on stream x1, policy [0, 1, 1]",
        "module 2 saved on stream x2, policy [1, 0, 1]",
        "module 3 saved on stream x3, policy [1, 1, 0]",
        f"ended: {ENDINGS['max_modules']}",
    ]
    for one, other in zip(load_modules(tmp_path / "run"), result.modules, strict=True):
        for field in dataclasses.fields(one):
            np.testing.assert_array_equal(getattr(one, field.name), getattr(other, field.name))


def test_it_ends_after_the_modules_asked_for() -> None:
    result = run(max_iterations=None, max_modules=1)
    assert (result.ended, len(result.modules)) == ("max_modules", 1)


@pytest.mark.parametrize("n", [0, 1, 5])
def test_it_ends_after_the_iterations_asked_for(n: int, tmp_path: Path) -> None:
    result = run(tmp_path / "run", max_iterations=n)
    assert (result.ended, result.iterations, result.frames) == ("max_iterations", n, 100 * n)
    assert logged(tmp_path / "run").count == n


def test_it_ends_when_exploration_is_long_over() -> None:
    config = dataclasses.replace(CONFIG, epsilon_start=1e-4, patience=3)
    result = run(config=config, max_iterations=None)
    assert (result.ended, result.iterations) == ("nothing_left", 4)


def test_it_ends_when_it_is_asked_to_and_leaves_a_whole_run(tmp_path: Path) -> None:
    result = run(tmp_path / "run", stop=after(7), max_iterations=None)
    assert (result.ended, result.iterations) == ("interrupted", 7)
    assert (tmp_path / "run" / "run.mcap").is_file()
    assert logged(tmp_path / "run").hexdigest() == result.signals_sha256
    assert json.loads((tmp_path / "run" / "run.json").read_text())["result"] == result.as_json()


def test_the_end_of_a_recording_is_an_error_with_everything_saved(tmp_path: Path) -> None:
    out = tmp_path / "run"
    with pytest.raises(LogExhaustedError, match=f"0 modules of 3 iterations are in {out}"):
        run(out, OscillatorySource(length=350))
    document = json.loads((out / "run.json").read_text())
    assert document["result"]["ended"] == "log_exhausted"
    assert logged(out).count == document["result"]["iterations"] == 3
    assert load_modules(out) == ()
    with pytest.raises(LogExhaustedError):
        run(None, OscillatorySource(length=50))


@pytest.mark.parametrize(("n", "kept"), [(1, [0]), (8, [0, 7]), (51, [0, 50]), (53, [0, 50, 52])])
def test_the_last_weights_are_in_the_log_once(n: int, kept: list[int], tmp_path: Path) -> None:
    shown: list[Any] = []

    class Last(Sink):
        def block(self, block: Block, signals: BlockSignals, learner: Learner) -> None:
            shown.append(learner.phi.copy())

    run(tmp_path / "run", max_iterations=n, sinks=[Last()])
    found = parts_of(tmp_path / "run", "phi")
    assert [t for t, _ in found] == [CONFIG.tau * k for k in kept]
    for (_, phi), k in zip(found, kept, strict=True):
        np.testing.assert_array_equal(phi, shown[k])


def test_every_ending_has_words() -> None:
    assert set(ENDINGS) == {
        "max_modules",
        "max_iterations",
        "nothing_left",
        "all_decided",
        "log_exhausted",
        "interrupted",
    }


def test_without_a_folder_nothing_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run().run is None
    assert not list(tmp_path.iterdir())


def test_logging_does_not_change_what_is_learned(tmp_path: Path) -> None:
    assert run(tmp_path / "run").signals_sha256 == run().signals_sha256


def test_the_seed_decides() -> None:
    one, two, other = run(seed=1), run(seed=1), run(seed=2)
    assert one.signals_sha256 == two.signals_sha256 != other.signals_sha256


def test_the_json_of_a_result() -> None:
    result = run(seed=5, max_iterations=None, max_modules=1)
    document = json.loads(json.dumps(result.as_json(), allow_nan=False))
    assert set(document) >= {
        "schema",
        "run",
        "source",
        "seed",
        "iterations",
        "frames",
        "signals_sha256",
        "modules",
        "final_policy",
        "epsilon",
    }
    assert document["schema"] == 1
    assert document["seed"] == 5
    assert document["frames"] == 100 * document["iterations"]
    assert len(document["signals_sha256"]) == 64
    (module,) = document["modules"]
    assert set(module) >= {"index", "stream", "stream_index", "iteration", "policy", "eta"}
    assert (module["index"], module["stream"], module["stream_index"]) == (1, "x1", 0)
    assert module["policy"] == [0, 1, 1]
    assert module["iteration"] == document["iterations"] - 1
    assert len(module["eta"]) == 1


def test_the_manifest_tells_how_to_do_it_again(tmp_path: Path) -> None:
    run(tmp_path / "run", seed=9, sections={"scene": {"kind": "oscillatory"}})
    document = json.loads((tmp_path / "run" / "run.json").read_text())
    assert document["seed"] == 9
    assert document["source"]["kind"] == "oscillatory"
    assert document["config"]["scene"] == {"kind": "oscillatory"}
    assert build(LearnerConfig, "learner", document["config"]["learner"]) == CONFIG
    assert {"python", "numpy"} <= set(document["versions"])


@pytest.mark.parametrize("leftover", ["run.mcap", "run.mcap.partial", "notes.txt"])
def test_a_folder_that_holds_something_is_refused(tmp_path: Path, leftover: str) -> None:
    (tmp_path / leftover).write_text("mine")
    with pytest.raises(UsageError, match=f"{tmp_path} exists: .*--force"):
        run(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == [leftover]
    assert (tmp_path / leftover).read_text() == "mine"


def test_an_empty_folder_will_do(tmp_path: Path) -> None:
    assert run(tmp_path).iterations == 12


@pytest.mark.parametrize("force", [False, True])
def test_a_file_in_the_place_of_the_folder_stays(tmp_path: Path, force: bool) -> None:
    file = tmp_path / "run"
    file.write_text("mine")
    for out in (file, file / "inside"):
        with pytest.raises(UsageError, match=str(file)):
            run(out, force=force)
    assert file.read_text() == "mine"


def test_force_replaces_the_run_and_nothing_else(tmp_path: Path) -> None:
    run(tmp_path, max_iterations=3)
    for name in ("run.rrd", "notes.txt"):
        (tmp_path / name).write_text("before")
    result = run(tmp_path, max_iterations=5, seed=1, force=True)
    assert logged(tmp_path).hexdigest() == result.signals_sha256
    assert json.loads((tmp_path / "run.json").read_text())["seed"] == 1
    assert not (tmp_path / "run.rrd").exists(), "a view of another run"
    assert (tmp_path / "notes.txt").read_text() == "before"


class Failing(OscillatorySource):
    """A source that breaks at its sixth block."""

    def take(self, stream: int, n: int) -> Block:
        if self.t >= 500:
            raise RuntimeError("the simulator died")
        return super().take(stream, n)


@pytest.mark.parametrize("before", [False, True])
def test_a_run_that_breaks_leaves_what_it_has_and_nothing_older(
    tmp_path: Path, before: bool
) -> None:
    if before:
        run(tmp_path, seed=1, max_iterations=8)
    with pytest.raises(RuntimeError, match="the simulator died"):
        run(tmp_path, Failing(), force=before)
    assert not (tmp_path / "run.mcap").exists()
    assert not (tmp_path / "run.json").exists()
    assert logged(tmp_path).count == 5
    assert logged(tmp_path).hexdigest() == run(max_iterations=5).signals_sha256


def test_json_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write_json(path, {"a": 1})
    with pytest.raises(TypeError):
        write_json(path, {"a": object()})
    assert json.loads(path.read_text()) == {"a": 1}
    with pytest.raises(CdmisfaError, match="is a file: name a folder"):
        write_json(path / "b.json", {})


def test_the_folder_is_held_until_the_view_is_built(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[Path] = []

    def build(folder: Path, view: Path) -> None:
        with pytest.raises(UsageError, match="in use by another process"):
            run(folder, force=True)
        assert (folder / "run.mcap").is_file()
        seen.append(view)

    monkeypatch.setattr("replay.view.build.build_view", build)
    run(tmp_path / "run", rerun=True)
    assert seen == [tmp_path / "run" / "run.rrd"]


def test_without_a_view_rerun_is_not_imported(tmp_path):
    words = ["learn", "oscillatory", "-o", str(tmp_path / "run"), "--max-iterations", "1"]
    script = (
        "import sys\nfrom cdmisfa.cli import run\n"
        f"assert run({[*words, '--no-rerun']}) == 0\n"
        "print([name for name in ('rerun', 'matplotlib', 'pybullet') if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines()[-1] == "[]"
