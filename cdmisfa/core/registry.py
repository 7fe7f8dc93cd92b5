"""`Registry`: things of one kind by their names, to which anybody may add; and wrong names."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator, Mapping
from typing import Generic, TypeVar

from cdmisfa.core.errors import UsageError
from cdmisfa.core.plugins import Plugin, find, plugins

Entry = TypeVar("Entry")


class Registry(Mapping[str, Entry], Generic[Entry]):
    """Entries by name, in the order in which they were added.

    A plugin counts as there; it is loaded, and one of those that are gone through, once it was
    asked for.

    Args:
        kind: what an entry is, for messages: "expansion".
        entries: those there are from the beginning, all of one class.
        group: of the entry points that add to them; see `cdmisfa.core.plugins`.

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
