"""Build of the C kernels as two modules: for processors with AVX2 and FMA, and for all others."""

from __future__ import annotations

import os
import platform
from pathlib import Path

from cffi import FFI

FOLDER = Path("cdmisfa/kernels")

# All files form one translation unit, so that their functions are not visible outside.
FILES = (
    *("elementary", "projection", "incsfa", "gram", "eigen"),
    *("recursive", "gate", "agent", "frames"),
)

# No multiply-adds other than those written, and `sqrt` as an instruction: both would change bits.
FLAGS = ["-O3", "-g0", "-std=gnu11", "-ffp-contract=off", "-fno-math-errno", "-Wall", "-Wno-psabi"]

MACHINE = platform.machine().lower().replace("amd64", "x86_64").replace("arm64", "aarch64")
X86 = MACHINE == "x86_64"

# Instruction set of every processor of the architecture, whatever machine built Python.
BASELINE = {"x86_64": ["-march=x86-64"], "aarch64": ["-march=armv8-a"]}.get(MACHINE, [])

if "ziglang" in os.environ.get("CC", ""):
    BASELINE = []  # `backend.py` gives the target to zig, which also compiles its C library for it


def module(name: str, *flags: str) -> FFI:
    """Return the module `cdmisfa.kernels.name`, which setuptools compiles."""
    header = (FOLDER / "kernels.h").read_text("utf-8")
    ffi = FFI()
    ffi.cdef(header)
    ffi.set_source(
        f"cdmisfa.kernels.{name}",
        "\n".join(['#include "lanes.h"', *(f'#include "{file}.c"' for file in FILES)]),
        py_limited_api=True,
        include_dirs=[str(FOLDER)],
        depends=[str(file) for file in sorted(FOLDER.glob("*.[ch]"))],
        extra_compile_args=[*FLAGS, "-fvisibility=hidden", *BASELINE, *flags],
        extra_link_args=["-s"],
        libraries=["m"],
    )
    return ffi


wide = module("_wide", *(["-mavx2", "-mfma"] if X86 else []))
plain = module("_plain")
