"""How the C of this package becomes two modules: for processors with AVX2 and FMA, and for any."""

from __future__ import annotations

import platform
from pathlib import Path

from cffi import FFI

HERE = Path("cdmisfa/kernels")

FILES = (
    "elementary.c",
    "projection.c",
    "incsfa.c",
    "gram.c",
    "eigen.c",
    "recursive.c",
    "gate.c",
    "agent.c",
    "frames.c",
)
"""All are one translation unit, so that nothing of them is visible outside."""

FLAGS = ["-O3", "-std=gnu11", "-ffp-contract=off", "-fno-math-errno", "-Wall", "-Wno-psabi"]
"""No more multiply-adds than are written, and `sqrt` as an instruction."""

X86 = platform.machine().lower() in ("x86_64", "amd64")


def module(name: str, *flags: str) -> FFI:
    """The module `cdmisfa.kernels.name`, to be compiled by setuptools."""
    header = (HERE / "kernels.h").read_text("utf-8")
    ffi = FFI()
    ffi.cdef(header)
    ffi.set_source(
        f"cdmisfa.kernels.{name}",
        "\n".join(['#include "lanes.h"', *(f'#include "{file}"' for file in FILES)]),
        py_limited_api=True,
        define_macros=[("Py_LIMITED_API", "0x030b0000")],
        include_dirs=[str(HERE)],
        depends=[str(file) for file in sorted(HERE.glob("*.[ch]"))],
        extra_compile_args=[*FLAGS, *flags],
        libraries=["m"],
    )
    return ffi


wide = module("_wide", *(["-mavx2", "-mfma"] if X86 else []))
plain = module("_plain")
