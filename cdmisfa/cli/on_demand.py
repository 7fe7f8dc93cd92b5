"""Lazy imports in packages that export many names, of which a command needs few."""

from __future__ import annotations

import ast
import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from types import ModuleType
from typing import Any


def names_on_demand(package: str) -> None:
    """Import the names that a package and its subpackages export when they are first used.

    A package that is already imported stays as it is.
    """
    if package not in sys.modules:
        sys.meta_path.insert(0, _Finder(package))


class _Finder(MetaPathFinder):
    def __init__(self, package: str) -> None:
        self._package = package

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """See `MetaPathFinder`."""
        if fullname.partition(".")[0] != self._package:
            return None
        spec = PathFinder.find_spec(fullname, path, target)
        if spec is None or spec.submodule_search_locations is None:
            return spec
        if isinstance(spec.loader, SourceFileLoader):
            spec.loader = _Loader(fullname, spec.loader.path)
        return spec


class _Loader(SourceFileLoader):
    """Loads the `__init__` of a package."""

    def exec_module(self, module: ModuleType) -> None:
        """Execute the module, but for imports of names that it does not use itself."""
        tree = ast.parse(self.get_data(self.path))
        used = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
        homes: dict[str, tuple[str, str]] = {}
        rest: list[ast.stmt] = []
        for node in tree.body:
            if isinstance(node, ast.ImportFrom) and node.level == 1:
                names = {name.asname or name.name: name.name for name in node.names}
                if not used & names.keys() and "*" not in names:
                    homes |= {name: (node.module or "", names[name]) for name in names}
                    continue
            rest.append(node)
        tree.body = rest
        modules = {home.partition(".")[0] for home, _ in homes.values()}

        own: Any = None

        def take(name: str) -> Any:
            if name in homes:
                home, there = homes[name]
                inner = import_module(".".join(filter(None, (module.__name__, home or there))))
                value = getattr(inner, there) if home else inner
            elif name in modules:
                value = import_module(f"{module.__name__}.{name}")
            elif own is None:
                raise AttributeError(f"module {module.__name__!r} has no attribute {name!r}")
            else:
                return own(name)
            setattr(module, name, value)
            return value

        module.__dict__["__getattr__"] = take  # its own modules import names from it meanwhile
        exec(compile(tree, self.path, "exec", dont_inherit=True), module.__dict__)
        if module.__dict__["__getattr__"] is not take:
            own = module.__dict__["__getattr__"]
        module.__dict__["__getattr__"] = take
        module.__dict__.setdefault(
            "__all__", [name for name in (*module.__dict__, *homes) if not name.startswith("_")]
        )
