"""How something was begun, kept with it, so that it can be resumed without being told again.

`Begun` is the one form of it: the words that named the source, and the options of the command
that make the result what it is. A run keeps it within the manifest in its log, a recording that
is not finished in RECORDING. Paths are kept relative to the folder, so that the folder can be
moved together with what it was made from.

Example:
    >>> begun = Begun(("logs/a.mcap",), {"seed": 7})
    >>> begun.as_json(Path("runs/a"))
    {'source': ['./../../logs/a.mcap'], 'seed': 7}
    >>> Begun.from_json(begun.as_json(Path("runs/a")), Path("runs/a")) == begun
    True
"""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from cdmisfa.core.untrusted.memory import MAX_JSON, parse_json
from cdmisfa.core.untrusted.regular import read_regular
from recorder.log.folder import RECORDING
from recorder.log.whole import to_disk, whole


@dataclass(frozen=True, slots=True)
class Begun:
    """How something was begun.

    Attributes:
        source: the words that name the source: a scene, paths or URLs; empty where nobody knows.
        options: what else makes the result what it is, by name, as JSON values.
    """

    source: tuple[str, ...] = ()
    options: Mapping[str, Any] = field(default_factory=dict)

    def as_json(self, folder: Path, names: Collection[str] = ()) -> dict[str, Any]:
        """The same as JSON values, to be kept in a folder.

        Args:
            folder: to which paths become relative.
            names: words that are no paths, as those of scenes; URLs are not, either.
        """
        return {
            "source": [relative_path(word, folder, names) for word in self.source],
            **self.options,
        }

    @classmethod
    def from_json(cls, values: object, folder: Path) -> Begun | None:
        """How something was begun, as a folder keeps it; None where the values do not say it."""
        if not isinstance(values, Mapping) or not isinstance(values.get("source"), list):
            return None
        options = {str(name): value for name, value in values.items() if name != "source"}
        return cls(tuple(found_path(str(word), folder) for word in values["source"]), options)


def relative_path(word: str, folder: Path, names: Collection[str] = ()) -> str:
    """A path relative to the folder that keeps it; other words as they are."""
    if word in names or "://" in word:
        return word
    return os.path.join(os.curdir, os.path.relpath(word, folder))


def found_path(word: str, folder: Path) -> str:
    """A word of `relative_path` as it was, or where it lies now."""
    return os.path.normpath(folder / word) if word.startswith(os.curdir) else word


def is_path(word: str) -> bool:
    """Whether a word of `relative_path` is a path or a URL, and no name."""
    return word.startswith(os.curdir) or "://" in word


def read_recording(folder: Path) -> Begun:
    """How an unfinished recording was begun, as far as its folder readably says so.

    Returns:
        The scene as its source, and the options `seed`, `frames` and `split`; the latter two are
        given for each unfinished view.

    Raises:
        UsageError: its file is larger than any that says so.
        LogDamagedError: the disk does not give it.
    """
    path = folder / RECORDING
    data = read_regular(path, MAX_JSON) if path.is_file() else b""
    try:
        values = parse_json(data)
        frames = {str(view): n for view, n in values["frames"].items() if _is_count(n) and n > 0}
        split = {v: limit for v, limit in values.get("split", {}).items() if isinstance(limit, str)}
        scene, seed = values.get("scene", ""), values.get("seed")
    except (ValueError, KeyError, TypeError, AttributeError):
        return Begun((), {"frames": {}, "split": {}})
    known = {"seed": seed} if _is_count(seed) and 0 <= seed < 2**63 else {}
    source = (scene,) if scene and isinstance(scene, str) else ()
    return Begun(source, {"frames": frames, "split": split, **known})


def keep_recording(folder: Path, views: Sequence[str], begun: Begun | None = None) -> None:
    """Keep how some views are begun, or that they are finished, beside what the others are.

    Raises:
        LogWriteError: the disk does not take it.
    """
    known = read_recording(folder)
    begun = begun or replace(known, options={**known.options, "frames": {}, "split": {}})
    frames, split = (
        {v: value for v, value in known.options[name].items() if v not in views}
        | begun.options[name]
        for name in ("frames", "split")
    )
    scene, seed = "".join(begun.source), begun.options.get("seed")
    path = folder / RECORDING
    if not frames:
        path.unlink(missing_ok=True)
        to_disk(folder)
        return
    with whole(path) as partial:
        values = {"frames": frames, "split": split, "scene": scene, "seed": seed}
        partial.write_text(json.dumps(values) + "\n", "utf-8")


def _is_count(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)
