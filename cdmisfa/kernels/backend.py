"""Build backend: setuptools, with a C compiler from PyPI if the machine has none."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
import sysconfig
from typing import Any

from setuptools import build_meta
from setuptools.build_meta import *  # noqa: F403 - the hooks that stay as they are

# Clang with everything it needs to link, 100 MB.
ZIG = "ziglang>=0.13,<0.18"


def compiler() -> str | None:
    """Return the C compiler: that of CC, the one that built Python, or a usual one."""
    names = os.environ.get("CC"), sysconfig.get_config_var("CC"), "cc", "gcc", "clang"
    return next((n for n in names if n and n.strip() and shutil.which(shlex.split(n)[0])), None)


def get_requires_for_build_wheel(config_settings: Any = None) -> list[str]:
    """Return the additional packages that building a wheel needs."""
    needed: list[str] = build_meta.get_requires_for_build_wheel(config_settings)
    return needed if compiler() else [*needed, ZIG]


get_requires_for_build_editable = get_requires_for_build_wheel


def build_wheel(*args: Any, **options: Any) -> str:
    """Build a wheel."""
    _choose_compiler()
    return str(build_meta.build_wheel(*args, **options))


def build_editable(*args: Any, **options: Any) -> str:
    """Build the kernels in the checkout, and a wheel that refers to it."""
    _choose_compiler()
    return str(build_meta.build_editable(*args, **options))


def _choose_compiler() -> None:
    """Select the compiler for setuptools; each build hook runs in a process of its own."""
    command = compiler()
    zig = f"{shlex.quote(sys.executable)} -m ziglang cc -mcpu=baseline"
    os.environ["CC"] = command or zig
    if not command:
        os.environ["LDSHARED"] = f"{zig} -shared"
        os.environ["ZIG_GLOBAL_CACHE_DIR"] = os.path.abspath("build/zig")
        # The flags of the compiler that built Python may be unknown to zig.
        sysconfig.get_config_vars()["CFLAGS"] = ""
