"""The power fails after every call on the disk: what may be left, and what comes of it.

What may be left follows from which calls there were, with these rules: what was written to a file
is there for certain only once the file was synced, and a name that was made, changed or removed
only once its folder was. Up to then the disk may have all of it, or nothing; of a file it may also
have the length alone, with zeros in it.
"""

from __future__ import annotations

import itertools
import os
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

from .calls import Call, watched
from .outcomes import LOST, RIGHT, Defect, Job, Limits, Outcome
from .stories import OUT, STORIES, Story, check, command, compare, refuse_unreadable

WRITTEN, ZEROS, SYNCED = "all that was written", "lengths with zeros", "what was synced"
NAMES, OLD_NAMES = "all names", "synced names"
LEFT = tuple(itertools.product((WRITTEN, ZEROS, SYNCED), (NAMES, OLD_NAMES)))
"""What is left of the data, and of the names."""

LIMITS = Limits(share=3)

GONE = 1 << 22
"""The number of no process, as all processes of before are gone when the power is back."""

Tree = dict[Path, bytes | None]
"""Files with their data, folders with None; paths are relative to the story's folder."""


@dataclass(slots=True)
class _File:
    data: bytearray = field(default_factory=bytearray)
    synced: bytes = b""

    def left(self, what: str) -> bytes:
        """The data that is left."""
        if what == WRITTEN:
            return bytes(self.data)
        if what == ZEROS:
            return self.synced[: len(self.data)].ljust(len(self.data), b"\0")
        return self.synced


class Disk:
    """A folder as its disk may have it, from the calls on it.

    Args:
        tree: what is there at first, all of it on the disk.
    """

    def __init__(self, tree: Tree) -> None:
        self._names: dict[Path, _File | None] = {
            path: None if data is None else _File(bytearray(data), data)
            for path, data in tree.items()
        }
        self._durable = dict(self._names)
        self._moved: dict[Path, Path] = {}

    def do(self, call: Call) -> None:
        """Follow a call."""
        path, names = call.path, self._names
        match call.kind:
            case "create":
                names[path] = _File()
            case "mkdir":
                names[path] = None
            case "unlink" | "rmdir":
                names.pop(path)
            case "rename":
                assert call.target is not None
                for old in [p for p in names if p == path or path in p.parents]:
                    names[call.target / old.relative_to(path)] = names.pop(old)
                if names[call.target] is None:
                    self._moved[call.target] = path
            case "truncate":
                file = self._file(path)
                file.data[:] = file.data[: call.at].ljust(call.at, b"\0")
            case "write":
                file = self._file(path)
                file.data[:] = file.data.ljust(call.at, b"\0")
                file.data[call.at : call.at + len(call.data)] = call.data
            case "fsync" if names.get(path) is None:  # a folder
                for new in [p for p in self._moved if p.parent == path]:
                    self._move(self._moved.pop(new), new)
                for old in [p for p in self._durable if p.parent == path and p not in names]:
                    del self._durable[old]
                for new in [p for p in names if p.parent == path]:
                    self._durable[new] = names[new]
            case "fsync":
                file = self._file(path)
                file.synced = bytes(file.data)

    def left(self, data: str, which: str) -> Tree:
        """What is left; see `LEFT`."""
        names = self._names if which == NAMES else self._durable
        reachable = {
            path: file
            for path, file in sorted(names.items())
            if all(above in names for above in path.parents[:-1])
        }
        return {p: None if file is None else file.left(data) for p, file in reachable.items()}

    def _move(self, old: Path, new: Path) -> None:
        """Let the disk have a folder's new name, with all that it has of it."""
        for path in [p for p in self._durable if old in p.parents]:
            self._durable[new / path.relative_to(old)] = self._durable.pop(path)

    def _file(self, path: Path) -> _File:
        file = self._names[path]
        assert file is not None, path
        return file


@dataclass(frozen=True, slots=True)
class Recorded:
    """A story as it went.

    Attributes:
        before: what there was.
        calls: of its command; their paths are relative to the story's folder.
        result: what came of it.
        progress: how far it had come before.
    """

    story: Story
    before: Tree
    calls: Sequence[Call]
    result: Any
    progress: int

    def disk(self, number: int) -> Disk:
        """The disk after so many calls."""
        disk = Disk(self.before)
        for call in self.calls[:number]:
            disk.do(call)
        return disk


@dataclass(frozen=True, slots=True)
class Cut:
    """A story with the power failing in it, after so many calls; see `LEFT`."""

    recorded: Recorded
    number: int
    data: str
    names: str

    @property
    def over(self) -> bool:
        """Whether the command had ended, so that its result is certain."""
        return self.number == len(self.recorded.calls)

    @property
    def tree(self) -> Tree:
        """What is left."""
        return self.recorded.disk(self.number).left(self.data, self.names)

    def __str__(self) -> str:
        """How it comes to it."""
        call = self.recorded.calls[self.number - 1]
        last = f"{call.kind} {self.number - 1} of {call.path.name}" if self.number else "the start"
        return f"the power fails after {last}, {self.data} and {self.names} are left"


def read_tree(folder: Path) -> Tree:
    """All that is in a folder."""
    return {
        path.relative_to(folder): path.read_bytes() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
    }


def write_tree(tree: Tree, folder: Path) -> None:
    """Make a folder's files."""
    for path, data in sorted(tree.items()):
        if data is None:
            (folder / path).mkdir()
        else:
            (folder / path).write_bytes(data)


def record(story: Story, folder: Path) -> Recorded:
    """Do what a story does, in an empty folder."""
    story.begin(folder)
    tree, out = read_tree(folder), folder / OUT
    progress = story.progress(out) if out.exists() else 0
    calls: list[Call] = []
    known = set(tree)

    def named(path: Path) -> Path:
        return Path(str(path.relative_to(folder)).replace(f".{os.getpid()}.", f".{GONE}."))

    def told(call: Call) -> None:
        path, target = named(call.path), call.target
        if path not in known and call.kind in ("fsync", "rename") and call.path.is_file():
            calls.extend((Call("create", path), Call("write", path, data=call.path.read_bytes())))
        known.add(path)
        if target is not None:
            target = named(target)
            known.discard(path)
            known.add(target)
        if call.kind in ("unlink", "rmdir"):
            known.discard(path)
        calls.append(Call(call.kind, path, target, call.at, call.data))

    with watched(folder, after=told):
        ended = command(folder, story.words)
    assert ended.code in story.done, str(ended)
    return Recorded(story, tree, calls, story.result(out), progress)


def cuts(recorded: Recorded) -> Iterator[Cut]:
    """Everything that may be left of a story, each once."""
    disk, seen = Disk(recorded.before), set[int]()
    for number in range(len(recorded.calls) + 1):
        if number:
            disk.do(recorded.calls[number - 1])
        for data, names in LEFT:
            cut = Cut(recorded, number, data, names)
            key = hash((cut.over, *disk.left(data, names).items()))
            if key not in seen:
                seen.add(key)
                yield cut


def go_on(cut: Cut, folder: Path) -> Outcome:
    """Check what is left after a power cut.

    Raises:
        Defect: the rule does not hold.
    """
    recorded, out = cut.recorded, folder / OUT
    story = recorded.story
    write_tree(cut.tree, folder)
    if cut.over:
        refuse_unreadable(story, folder)
        compare(story, folder, recorded.result, str(cut))
        return Outcome(RIGHT, story.name, str(cut))
    progress = story.progress(out) if out.exists() else 0
    if progress < recorded.progress:
        what = f"{cut}: {recorded.progress} became {progress}"
        raise Defect(LOST, story.name, what)
    on = check(story, folder, recorded.result, str(cut))
    return Outcome(RIGHT, story.name, f"{cut}; gone on with by {on}")


def prepare(folder: Path) -> list[Cut]:
    """Every case there is, those of all stories among each other."""
    found = list[Cut]()
    for number, story in enumerate(STORIES.values()):
        place = folder / str(number)
        place.mkdir()
        found += list(cuts(record(story, place)))
        shutil.rmtree(place)
    Random(0).shuffle(found)
    return found


def case(job: Job) -> Outcome:
    """The case of a seed; see `Job`."""
    return go_on(job.given[job.seed % len(job.given)], job.folder)
