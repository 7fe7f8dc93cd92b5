"""Setuptools as build backend, which takes a C compiler from PyPI where the machine has none."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
import sysconfig
from typing import Any

from setuptools import build_meta
from setuptools.build_meta import *  # noqa: F403 - the hooks that stay as they are

# Clang, and all it needs to link, in 100 MB.
ZIG = "ziglang>=0.13,<0.18"


def compiler() -> str | None:
    """Return the machine's C compiler: what was asked for, what built Python, or a usual one."""
    names = os.environ.get("CC"), sysconfig.get_config_var("CC"), "cc", "gcc", "clang"
    return next((n for n in names if n and n.strip() and shutil.which(shlex.split(n)[0])), None)


def get_requires_for_build_wheel(config_settings: Any = None) -> list[str]:
    """Return what else must be installed to build a wheel."""
    needed: list[str] = build_meta.get_requires_for_build_wheel(config_settings)
    return needed if compiler() else [*needed, ZIG]


get_requires_for_build_editable = get_requires_for_build_wheel


def build_wheel(*args: Any, **options: Any) -> str:
    """Build a wheel."""
    _choose_compiler()
    return str(build_meta.build_wheel(*args, **options))


def build_editable(*args: Any, **options: Any) -> str:
    """Build the kernels in the checkout, and a wheel that points to it."""
    _choose_compiler()
    return str(build_meta.build_editable(*args, **options))


def _choose_compiler() -> None:
    """Have setuptools compile with what there is; each hook is a process of its own."""
    found = compiler()
    zig = f"{shlex.quote(sys.executable)} -m ziglang cc -mcpu=baseline"
    os.environ["CC"] = found or zig
    if not found:
        os.environ["LDSHARED"] = f"{zig} -shared"
        os.environ["ZIG_GLOBAL_CACHE_DIR"] = os.path.abspath("build/zig")
        # The flags of the compiler that Python was built with may be unknown to this one.
        sysconfig.get_config_vars()["CFLAGS"] = ""
