"""Portable bits: the same signals whatever the processor, numpy and the C library make of it."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Cdmisfa

from cdmisfa.agents.learner import CuriousLearner
from cdmisfa.core.arithmetic import elementary
from cdmisfa.core.arithmetic.choice import Either, portable_bits
from cdmisfa.core.arithmetic.compiled import compiled, reordered
from cdmisfa.core.config import LearnerConfig
from cdmisfa.experiments.documents import machine
from cdmisfa.experiments.runs import run
from cdmisfa.experiments.sources import configure
from cdmisfa.experiments.trial import run_trial
from cdmisfa.features.inner_products import measure_tile
from cdmisfa.features.projection import outputs
from recorder.world.oscillatory import OscillatorySource

# One process compiles what these need, twice, in minutes: another would do so again.
pytestmark = pytest.mark.xdist_group("portable")

OLD_PROCESSOR = {
    "NUMBA_CPU_NAME": "x86-64",
    "NUMBA_CPU_FEATURES": "",
    "NPY_DISABLE_CPU_FEATURES": " ".join(machine()["numpy_features"].split()),
    "OPENBLAS_CORETYPE": "Prescott",
    "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4,-AVX,-AVX512F",
}
"""What holds each library to the first x86-64 processors, as far as it was built for them."""

SIGNALS = {
    "2.0": "79d08570e00380b292b7d26afcd6b91fa046fe614488b49d25e113422479c4e7",
    "1.0": "be3d0fc23caca0d1df41b4bc4410117c41324af9381823f66cc522f2aae44e6d",
}
"""Of 40 iterations on the oscillatory streams with seed 3, by learners that change no more."""

PROGRAM = """
import json
from test_portable import learned, of_images
print(json.dumps({name: learned(name) for name in ("2.0", "1.0", "progress")} | of_images()))
"""


def learned(algorithm: str, portable: bool = True) -> str:
    words = [f"learner.algorithm={algorithm}", f"learner.portable={str(portable).lower()}"]
    configuration = configure("oscillatory", settings=words)
    source = configuration.open_scene()
    return run(source, configuration.learner, seed=3, max_iterations=40).signals_sha256


def of_images() -> dict[str, str]:
    """What both kinds of slow feature analysis come to on images too wide for lanes alone."""
    from cdmisfa.features.incsfa.abstraction import IncSFA
    from cdmisfa.features.recursive import RecursiveSFA

    frames = np.random.default_rng(0).integers(0, 256, (3, 40, 301), dtype=np.uint8)
    with portable_bits():
        config = LearnerConfig(components=6, outputs=2, tau=40)
        incremental = IncSFA(config, 301, np.random.default_rng(1))
        recursive = RecursiveSFA(301, 6, 2)
        for block in frames:
            incremental.update(block)
            block[1:, 80:] = block[0, 80:]  # most of it stands still
            incremental.update(block)
            recursive.update(block)
        y = outputs(incremental.phi, np.zeros(2), frames[0])
        sums = {"incremental": incremental.phi, "recursive": recursive.phi, "outputs": y}
    return {name: array.tobytes().hex()[:4000] for name, array in sums.items()}


@pytest.fixture(scope="module")
def elsewhere() -> Mapping[str, str]:
    """The same in a process that is held to an old processor."""
    tests = Path(__file__).parent
    path = os.pathsep.join([str(tests), str(tests.parent)])
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env={**os.environ, **OLD_PROCESSOR, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=True,
        timeout=600,
    )
    told: Mapping[str, str] = json.loads(done.stdout)
    return told


@pytest.mark.parametrize("algorithm", ["2.0", "1.0", "progress"])
def test_every_processor_gives_the_same_signals(
    algorithm: str, elsewhere: Mapping[str, str]
) -> None:
    signals = learned(algorithm)
    assert (signals, elsewhere[algorithm]) == (SIGNALS.get(algorithm, signals),) * 2


def test_images_are_learned_alike_on_every_processor(elsewhere: Mapping[str, str]) -> None:
    assert {name: elsewhere[name] for name in of_images()} == of_images()


def test_both_arithmetics_share_a_process() -> None:
    ordinary, portable = learned("2.0", portable=False), learned("2.0")
    assert ordinary != portable
    assert (learned("2.0", portable=False), learned("2.0")) == (ordinary, portable)


def test_a_compiled_trial_is_portable_as_its_learner_is() -> None:
    config = LearnerConfig(portable=True)
    trial = run_trial(config, seed=3, max_iterations=40, curves=True)
    with portable_bits():
        source = OscillatorySource()
    learner = CuriousLearner(config, source.spec, 3)
    xi = [learner.step(source.take(learner.stream, learner.tau)).xi for _ in range(40)]
    assert trial.curves is not None
    np.testing.assert_array_equal(trial.curves["xi"], xi)
    plain = run_trial(LearnerConfig(), seed=3, max_iterations=40, curves=True).curves
    assert plain is not None
    assert not np.array_equal(plain["xi"], xi)


def test_a_portable_sum_is_in_the_order_it_says() -> None:
    rng = np.random.default_rng(0)
    v, u, e = rng.random((2, 21)), rng.random((4, 21)), np.zeros((2, 4))
    with portable_bits():
        measure_tile(v, 0, 21, 2, u, 0, e)
    for j, k in np.ndindex(2, 4):
        lanes = [v[j, lane] * u[k, lane] + v[j, lane + 8] * u[k, lane + 8] for lane in range(8)]
        while len(lanes) > 1:
            lanes = [a + b for a, b in zip(lanes[::2], lanes[1::2], strict=True)]
        total = lanes[0]
        for i in range(16, 21):
            total += v[j, i] * u[k, i]
        assert e[j, k] == 0.0 + total


def test_either_is_the_form_that_is_meant_also_where_both_are_compiled() -> None:
    @compiled
    def in_order(x: float) -> float:
        return -x

    @reordered
    def fastest(x: float) -> float:
        return x

    form = Either(fastest, lambda: in_order)

    @compiled
    def twice(x: float) -> float:
        return 2.0 * form(x)

    assert (form(1.0), twice(1.0)) == (1.0, 2.0)
    with portable_bits():
        assert (form(1.0), twice(1.0)) == (-1.0, -2.0)
        with portable_bits(False):
            assert (form(1.0), twice(1.0)) == (1.0, 2.0)


@pytest.mark.parametrize(
    ("name", "low", "high"), [("exp", -700.0, 1.0), ("log", 1e-12, 1e3), ("sin", -300, 300)]
)
def test_elementary_functions_are_right_to_the_last_bits(
    name: str, low: float, high: float
) -> None:
    x = np.random.default_rng(0).uniform(low, high, 2000)
    exact = getattr(np, name)(x)
    with portable_bits():
        function = getattr(elementary, name)
        found = function(x) if name == "sin" else np.array([function(v) for v in x])
        if name == "sin":
            np.testing.assert_allclose(elementary.cos(x), np.cos(x), rtol=0, atol=2.3e-16)
    np.testing.assert_allclose(found, exact, rtol=5e-16, atol=2.3e-16 if name == "sin" else 0)


def test_portable_draws_are_standard_normal() -> None:
    with portable_bits():
        draws = elementary.normal(np.random.default_rng(0), (400, 500))
    assert abs(draws.mean()) < 0.01
    assert abs(draws.std() - 1.0) < 0.01
    assert abs(np.mean(np.abs(draws) < 1.0) - math.erf(math.sqrt(0.5))) < 0.005


def test_a_portable_run_says_so_and_is_resumed_as_one(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    words = ("oscillatory", "--portable", "--seed", "3", "--no-rerun", "--json")
    once = cdmisfa("learn", *words, "--max-iterations", "40").json
    run_folder = str(tmp_path / "run")
    cdmisfa("learn", *words, "--max-iterations", "20", "-o", run_folder)
    other = cdmisfa(
        "learn", "oscillatory", "--seed", "3", "--resume", "-o", run_folder, "--no-rerun"
    )
    assert other.code == 2
    assert "was made with learner.portable = True, not False" in other.err
    resumed = cdmisfa(
        "learn", "--resume", "-o", run_folder, "--max-iterations", "40", "--no-rerun", "--json"
    ).json
    assert resumed["signals_sha256"] == once["signals_sha256"] == SIGNALS["2.0"]
    document: Any = json.loads((tmp_path / "run" / "run.json").read_text())
    assert document["config"]["learner"]["portable"] is True
    assert {"cpu", "compiled_for", "cpu_features", "numpy_features", "blas", "libc"} <= set(
        document["platform"]
    )


def test_compare_says_when_another_processor_may_be_why(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    folders = []
    for name, changed in (("a", {}), ("b", {"cpu": "Other", "cpu_features": "sse2 new"})):
        for portable in (False, True):
            folder = tmp_path / f"{name}{portable}"
            settings = () if not portable else ("--portable",)
            # a run that differs early, as if it had been computed elsewhere
            seed = "3" if name == "a" else "4"
            words = ("--seed", seed, "--max-iterations", "3", "--no-rerun", "-o", str(folder))
            cdmisfa("learn", "oscillatory", *settings, *words)
            path = folder / "run.json"
            document: Any = json.loads(path.read_text())
            same = {"seed": 3, "config": document["config"] | {"scene": {}}}
            document |= same | {"platform": document["platform"] | changed}
            path.write_text(json.dumps(document))
            folders.append(str(folder))
    ordinary = cdmisfa("compare", folders[0], folders[2])
    assert ordinary.code == 4
    assert "was computed otherwise, which may be why: cpu " in ordinary.out
    assert " against Other; cpu_features " in ordinary.out
    assert "+new" in ordinary.out
    told = cdmisfa("compare", folders[0], folders[2], "--json").json
    assert any(word.endswith("against Other") for word in told["runs"][1]["computed_otherwise"])
    portable = cdmisfa("compare", folders[1], folders[3])
    assert portable.code == 4
    assert "computed otherwise" not in portable.out
