"""Things of one kind by their names, to which anybody may add: `Registry`, and plugins.

Plugins are entry points of other packages, imported when their name is asked for.
"""

from __future__ import annotations

import difflib
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from cdmisfa.core.errors import UsageError, one_line

if TYPE_CHECKING:
    from importlib import metadata

Entry = TypeVar("Entry")

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


class Registry(Mapping[str, Entry], Generic[Entry]):
    """Entries by name, in the order in which they were added.

    A plugin counts as there; it is loaded, and one of those that are gone through, once it was
    asked for.

    Args:
        kind: what an entry is, for messages: "expansion".
        entries: those there are from the beginning, all of one class.
        group: of the entry points that add to them; see `GROUPS`.

    Attributes:
        first: names of those from the beginning.

    Example:
        >>> sizes = Registry("size", {"small": 1})
        >>> sizes.add("large", 100)
        >>> list(sizes), sizes["large"]
        (['small', 'large'], 100)
    """

    def __init__(
        self, kind: str, entries: Mapping[str, Entry] | None = None, *, group: str | None = None
    ) -> None:
        self._kind, self._group = kind, group
        self._entries = dict(entries or {})
        self._loaded: dict[str, Plugin] = {}
        self.first = tuple(self._entries)

    def add(self, name: str, entry: Entry) -> None:
        """Add an entry.

        Raises:
            ValueError: the name is taken.
        """
        if name in self._entries:
            raise ValueError(f"there is a {self._kind} {name!r} already")
        self._entries[name] = entry

    def remove(self, name: str) -> None:
        """Take an entry out again."""
        del self._entries[name]
        self._loaded.pop(name, None)

    def __getitem__(self, name: str) -> Entry:
        """The entry of a name.

        Raises:
            UsageError: there is none, it names the nearest; or it is a plugin's and cannot be
                loaded.
        """
        if name not in self._entries:
            found = find(self._group, name) if self._group else None
            if found is None:
                hint = did_you_mean(name, self.names())
                raise UsageError(f"no {self._kind} {name!r}: {hint}")
            self._entries[name] = found.load(self.entry_class)
            self._loaded[name] = found
        return self._entries[name]

    def versions(self, *names: str) -> dict[str, str]:
        """The packages whose plugins entries are that were asked for, with their versions."""
        used = (self._loaded[name] for name in names if name in self._loaded)
        return {plugin.package: plugin.version for plugin in used}

    @property
    def entry_class(self) -> type[Entry]:
        """The class of the entries, of which there is one from the beginning."""
        return type(self._entries[self.first[0]])

    def __contains__(self, name: object) -> bool:
        return name in self._entries or name in self.names()

    def get(self, name: str, default: Entry | None = None) -> Entry | None:  # type: ignore[override]
        """The entry of a name, or the default."""
        if name not in self:
            return default
        return self[name]

    def names(self) -> list[str]:
        """All names, those of plugins that were not loaded last."""
        others = plugins(self._group) if self._group else ()
        return list(dict.fromkeys([*self._entries, *(other.name for other in others)]))

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)


def did_you_mean(name: str, known: Iterable[str], prefix: str = "") -> str:
    """The end of an error about an unknown name: the nearest one, or all there are.

    Args:
        name: as it was written.
        known: the names there are.
        prefix: what stands before each of them.
    """
    names = list(known)
    nearest = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    if nearest:
        return f"did you mean {prefix}{nearest[0]}?"
    return f"there are {', '.join(names)}"
