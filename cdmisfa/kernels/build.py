"""How the C of this package becomes two modules: for processors with AVX2 and FMA, and for any."""

from __future__ import annotations

import os
import platform
from pathlib import Path

from cffi import FFI

HERE = Path("cdmisfa/kernels")

# All are one translation unit, so that nothing of them is visible outside.
FILES = (
    *("elementary", "projection", "incsfa", "gram", "eigen"),
    *("recursive", "gate", "agent", "frames"),
)

# No more multiply-adds than are written, and `sqrt` as an instruction.
FLAGS = ["-O3", "-g0", "-std=gnu11", "-ffp-contract=off", "-fno-math-errno", "-Wall", "-Wno-psabi"]

MACHINE = platform.machine().lower().replace("amd64", "x86_64").replace("arm64", "aarch64")
X86 = MACHINE == "x86_64"

# For every processor of this kind, though Python may have been built for that of one machine.
ANY = {"x86_64": ["-march=x86-64"], "aarch64": ["-march=armv8-a"]}.get(MACHINE, [])

if "ziglang" in os.environ.get("CC", ""):
    ANY = []  # said where it is called: it compiles what it links with, too


def module(name: str, *flags: str) -> FFI:
    """Return the module `cdmisfa.kernels.name`, to be compiled by setuptools."""
    header = (HERE / "kernels.h").read_text("utf-8")
    ffi = FFI()
    ffi.cdef(header)
    ffi.set_source(
        f"cdmisfa.kernels.{name}",
        "\n".join(['#include "lanes.h"', *(f'#include "{file}.c"' for file in FILES)]),
        py_limited_api=True,
        include_dirs=[str(HERE)],
        depends=[str(file) for file in sorted(HERE.glob("*.[ch]"))],
        extra_compile_args=[*FLAGS, "-fvisibility=hidden", *ANY, *flags],
        extra_link_args=["-s"],
        libraries=["m"],
    )
    return ffi


wide = module("_wide", *(["-mavx2", "-mfma"] if X86 else []))
plain = module("_plain")
