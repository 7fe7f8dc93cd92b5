"""Lazy public exports of a package: its names load on first use, so commands start quickly."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def exports(
    package: str, modules: Mapping[str, str], beside: Mapping[str, str] | None = None
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """`__getattr__`, `__dir__` and `__all__` of a package.

    Args:
        package: its `__name__`.
        modules: by module, the names that the package exports from it, separated by spaces. A
            name must not be that of a module of the package, which would hide it.
        beside: more of these, which can be imported and are not listed.
    """
    module_of = {name: module for module, names in modules.items() for name in names.split()}
    listed = sorted(module_of)
    more = {name: module for module, names in (beside or {}).items() for name in names.split()}
    module_of |= more

    def load(name: str) -> Any:
        if name not in module_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(module_of[name]), name)
        setattr(sys.modules[package], name, value)
        return value

    return load, lambda: listed, listed
