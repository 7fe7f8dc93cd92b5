"""Parts that other packages bring: entry points, imported when their name is asked for."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from cdmisfa.core.errors import UsageError, one_line

if TYPE_CHECKING:
    from importlib import metadata

GROUPS: Mapping[str, str] = {
    "cdmisfa.sources": "a source of learn, record and others",
    "cdmisfa.learners": "learn --algorithm",
    "cdmisfa.exports": "export --to",
}
"""Groups of entry points, and where the names of each are used."""


@dataclass(frozen=True, slots=True)
class Plugin:
    """An entry point that an installed package has in one of `GROUPS`.

    Attributes:
        name: under which it is asked for.
        place: module and object, as "toy.scene:PENDULUM".
        package: that brings it.
        version: of the package.
    """

    name: str
    place: str
    package: str
    version: str
    _entry: metadata.EntryPoint

    def __str__(self) -> str:
        return f"{self.place} of {self.package} {self.version}"

    def load(self, *kinds: type[Any]) -> Any:
        """Import it.

        Args:
            kinds: the classes of which it must be one.

        Raises:
            UsageError: it cannot be imported, or is something else.
        """
        try:
            loaded = self._entry.load()
        except Exception as error:  # whatever the import of another's code raises
            raise UsageError(
                f"{self.name} is {self}, which fails to load: {type(error).__name__}: "
                f"{one_line(error)}"
            ) from error
        if not isinstance(loaded, kinds):
            needed = " or ".join(kind.__name__ for kind in kinds)
            raise UsageError(
                f"{self.name} is {self}, which is a {type(loaded).__name__}: a {needed} is needed "
                "here"
            )
        return loaded


def plugins(group: str) -> tuple[Plugin, ...]:
    """What the installed packages have in a group, by name; nothing of it is imported."""
    return _plugins(group, tuple(sys.path))


@lru_cache(maxsize=16)
def _plugins(group: str, path: tuple[str, ...]) -> tuple[Plugin, ...]:
    from importlib import metadata  # takes as long as the rest of --help

    found = [
        Plugin(entry.name, entry.value, entry.dist.name, entry.dist.version, entry)
        for entry in metadata.entry_points(group=group)
        if entry.dist is not None
    ]
    return tuple(sorted(found, key=lambda plugin: (plugin.name, plugin.package)))


def find(group: str, name: str) -> Plugin | None:
    """The plugin of a name.

    Raises:
        UsageError: two packages have one of that name.
    """
    found = [plugin for plugin in plugins(group) if plugin.name == name]
    if len(found) > 1:
        raise UsageError(f"{name} is both {found[0]} and {found[1]}: uninstall one of them")
    return found[0] if found else None
