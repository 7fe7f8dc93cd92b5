"""The kernels give the same bits whichever compiler, optimisation and processor made them.

Those that take long to compile are in `tools/tests/test_compilers.py`.
"""

from __future__ import annotations

import contextlib
import platform
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import pytest

from cdmisfa.kernels import ARITHMETIC

ROOT = Path(__file__).parents[1]
with contextlib.chdir(ROOT):  # where it is read when kernels are built
    from cdmisfa.kernels.build import FILES, FLAGS

BITS = ROOT / "tests" / "data" / "bits.txt"
"""What the self-test prints. Where bits are meant to change, raise `ARITHMETIC`."""

NEHALEM = ("qemu-x86_64", "-cpu", "Nehalem")


def lacking(compiler: Sequence[str], flags: Sequence[str], runner: Sequence[str]) -> str:
    """What this machine lacks to compile or run; "" if nothing."""
    tools = [name for name in (*compiler[:1], *runner[:1]) if not shutil.which(name)]
    if tools:
        return f"{' and '.join(tools)} not installed"
    info = Path("/proc/cpuinfo")
    known = info.read_text().split() if info.exists() else []
    wanted = [flag[2:] for flag in flags if flag in ("-mavx2", "-mavx512f", "-mavx512vl")]
    if not runner and (missing := [name for name in wanted if name not in known]):
        return f"this processor has no {' and '.join(missing)}"
    if runner == NEHALEM and platform.machine() != "x86_64":
        return "gcc compiles for another processor here"
    return ""


def assert_same_bits(
    compiler: Sequence[str], flags: Sequence[str], runner: Sequence[str], folder: Path
) -> None:
    if reason := lacking(compiler, flags, runner):
        pytest.skip(reason)
    source, program = folder / "all.c", folder / "selftest"
    names = "lanes.h", *(f"{name}.c" for name in (*FILES, "selftest"))
    source.write_text("".join(f'#include "{name}"\n' for name in names))
    places = ["-I", ROOT / "cdmisfa" / "kernels", "-I", ROOT / "tests"]
    said = [flag for flag in FLAGS if not flag.startswith(("-O", "-g"))]
    command = [*compiler, *said, "-Werror", *flags, *places, source, "-o", program, "-lm"]
    subprocess.run(command, check=True, timeout=300)
    done = subprocess.run(
        [*runner, program], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    assert f"arithmetic {ARITHMETIC}\n{done.stdout}" == BITS.read_text()


@pytest.mark.parametrize(
    ("compiler", "flags", "runner"),
    [
        (("gcc",), ("-O0",), ()),
        pytest.param(
            *(("aarch64-linux-gnu-gcc",), ("-O0", "-static"), ("qemu-aarch64",)),
            marks=pytest.mark.system,
        ),
    ],
    ids=" ".join,
)
def test_bits_are_the_same(
    compiler: Sequence[str], flags: Sequence[str], runner: Sequence[str], tmp_path: Path
) -> None:
    assert_same_bits(compiler, flags, runner, tmp_path)
