"""The same seed gives the same signals on every machine: whole runs, where others can be had.

The kernels alone, of more compilers and processors, are in `test_bits.py`.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

from cdmisfa.experiments.session import run_session
from cdmisfa.experiments.sources import Layers, configure, open_source

ROOT = Path(__file__).parents[1]

SIGNALS: Mapping[str, str] = {
    "2.0": "ab36b99cbf97e81d3a54de409e1888e135f3fa9dfb5e0eaa67665d4b73c27054",
    "2.0 of images": "13c67daef9667811a65994187d9e1aa32e49f7378de6031f985bc4e8ab782b5a",
    "1.0": "4182be146ff6de3c252ac219f1104fb955030c7f78e3ed09e50b7a4cf65c376a",
    "progress": "9a69eaa79a2e5f1cf02d88d20bbd089638b5a2ef39c492ba43bcce0480b294f0",
    "progress of images": "094bb2bef1f4ec753d22af375ebfc4dd0aca8b2d1196c508d9051ca2c30f211d",
}
"""Of 20 iterations on the oscillatory streams, and of 2 on images, with seed 3."""

PROGRAM = """
import json, sys
sys.path.insert(0, sys.argv[1])
from test_same_bits import learned
from cdmisfa import kernels
print(json.dumps([kernels.WIDE, learned()]))
"""

THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")

NO_FMA = {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4,-AVX,-AVX512F"}
"""Holds the C library to what any x86-64 processor has."""


def learned() -> dict[str, str]:
    """The `signals_sha256` of each learner, of vectors and of images."""
    actual = {}
    for algorithm in ("2.0", "1.0", "progress"):
        configuration = configure(
            "oscillatory", Layers.read(words=[f"learner.algorithm={algorithm}"])
        )
        source = configuration.open_scene()
        result = run_session(source, configuration.learner, seed=3, max_iterations=20)
        actual[algorithm] = result.signals_sha256
        if algorithm == "1.0":
            continue
        images, configuration = open_source(
            [ROOT / "sample_logs" / "icub"],
            settings=[f"learner.algorithm={algorithm}"],
            seed=3,
            loop=True,
        )
        with contextlib.closing(images):
            result = run_session(images, configuration.learner, seed=3, max_iterations=2)
        actual[f"{algorithm} of images"] = result.signals_sha256
    return actual


def elsewhere(*emulator: str, **environment: str) -> tuple[bool, dict[str, str]]:
    # OpenBLAS takes this for the processor, whatever the emulated one can do.
    variables = {name: value for name, value in os.environ.items() if name != "OPENBLAS_CORETYPE"}
    done = subprocess.run(
        [*emulator, sys.executable, "-c", PROGRAM, str(ROOT / "tests")],
        cwd=ROOT,
        env={**variables, **environment},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    wide, result = json.loads(done.stdout)
    return wide, result


def test_the_signals_are_those_of_every_machine() -> None:
    assert learned() == SIGNALS


@pytest.mark.parametrize("threads", ["1", "5"])
def test_the_number_of_threads_does_not_show(threads: str) -> None:
    assert elsewhere(**dict.fromkeys(THREADS, threads))[1] == SIGNALS


@pytest.mark.system
@pytest.mark.skipif(shutil.which("qemu-x86_64") is None, reason="qemu-x86_64 is not installed")
def test_a_processor_without_avx_gives_the_same_signals() -> None:
    assert elsewhere("qemu-x86_64", "-cpu", "Nehalem", **NO_FMA) == (False, SIGNALS)
