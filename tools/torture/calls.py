"""Every call of this process that changes a folder or opens a file in it: seen, told, refused.

It takes the place of `open` and of the functions of `os`, below which nothing of the project
writes; `BufferedWriter` calls `write` of the raw file that it is given, so that what is buffered
counts when it reaches the system. Rerun writes run.rrd in native code and is not seen, until the
file is synced or takes its name.
"""

from __future__ import annotations

import _io
import builtins
import errno
import io
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

KINDS = ("open", "write", "fsync", "rename", "unlink", "mkdir")
"""What can be refused; rmdir counts as unlink, truncate as write."""

DELETED = " (deleted)"

_RECORD = 512
"""Bytes for a call that counted."""


@dataclass(frozen=True, slots=True)
class Call:
    """A call on something in the folder.

    Attributes:
        kind: one of `KINDS`, or create and truncate, which an open did, or rmdir.
        path: what it is about.
        target: the new name.
        at: where in the file, or its new length.
        data: what was written.
    """

    kind: str
    path: Path
    target: Path | None = None
    at: int = 0
    data: bytes = b""


Told = Callable[[Call], object]


@contextmanager
def watched(
    folder: Path, before: Told = lambda call: None, after: Told = lambda call: None
) -> Iterator[None]:
    """Tell of every call on what is in a folder, or on itself, while the body runs.

    Args:
        folder: as the calls name it.
        before: told first; what it raises is what the call raises. An opening is one call,
            whatever it does.
        after: told of what was done.
    """
    watch = _Watch(Path(folder), before, after)
    places = [
        *((module, "open", watch.open) for module in (builtins, io, _io)),
        (os, "open", watch.os_open),
        *((os, name, watch.names(getattr(os, name), "rename")) for name in ("replace", "rename")),
        *((os, name, watch.names(getattr(os, name), "unlink")) for name in ("unlink", "remove")),
        (os, "rmdir", watch.names(os.rmdir, "rmdir")),
        (os, "mkdir", watch.names(os.mkdir, "mkdir")),
        *((os, name, watch.fsync(getattr(os, name))) for name in ("fsync", "fdatasync")),
    ]
    originals = [(module, name, getattr(module, name)) for module, name, _ in places]
    try:
        for module, name, function in places:
            setattr(module, name, function)
        yield
    finally:
        for module, name, function in originals:
            setattr(module, name, function)


@dataclass(slots=True)
class Refusal:
    """Refuses the N-th call of some kinds, and where it lasts all later ones too.

    Those of processes that are forked meanwhile count with those of this one.

    Attributes:
        number: counted from 0; -1 refuses none.
        kinds: those that count.
        code: what is wrong, as `errno` has it.
        lasting: the disk stays so.
    """

    number: int
    kinds: tuple[str, ...] = KINDS
    code: int = errno.ENOSPC
    lasting: bool = False
    _seen: int = field(default_factory=lambda: os.memfd_create("seen"))

    def __del__(self) -> None:
        os.close(self._seen)

    @property
    def seen(self) -> list[Call]:
        """The calls that counted, but for their data."""
        raw = os.pread(self._seen, os.fstat(self._seen).st_size, 0)
        records = (raw[at : at + _RECORD] for at in range(0, len(raw), _RECORD))
        told = [os.fsdecode(record.rstrip(b"\0")).partition(" ") for record in records]
        return [Call(kind, Path(path)) for kind, _, path in told]

    def __call__(self, call: Call) -> None:
        """See `watched`."""
        if call.kind not in self.kinds:
            return
        at = self._count(call)
        if at == self.number or (self.lasting and 0 <= self.number <= at):
            raise OSError(self.code, os.strerror(self.code), str(call.path))

    def _count(self, call: Call) -> int:
        """Which call it is, of those of all processes; nothing is locked that one might die in."""
        record = os.fsencode(f"{call.kind} {call.path}").ljust(_RECORD, b"\0")
        assert len(record) == _RECORD, call.path
        file = os.open(f"/proc/self/fd/{self._seen}", os.O_WRONLY | os.O_APPEND)
        try:
            os.write(file, record)
            return os.lseek(file, 0, os.SEEK_CUR) // _RECORD - 1
        finally:
            os.close(file)


class _Watch:
    def __init__(self, folder: Path, before: Told, after: Told) -> None:
        self.folder, self.before, self.after = folder, before, after
        self._open, self._os_open, self._fsync = io.open, os.open, os.fsync

    def within(self, name: Any, dir_fd: int | None = None) -> Path | None:
        """A name as a path in the folder; None elsewhere."""
        if isinstance(name, int):
            path = Path(os.readlink(f"/proc/self/fd/{name}"))
        else:
            start = Path.cwd() if dir_fd is None else Path(os.readlink(f"/proc/self/fd/{dir_fd}"))
            path = start / os.fsdecode(name)
        return path if path == self.folder or self.folder in path.parents else None

    def open(
        self,
        file: Any,
        mode: str = "r",
        buffering: int = -1,
        encoding: str | None = None,
        errors: str | None = None,
        newline: str | None = None,
        closefd: bool = True,
        opener: Any = None,
    ) -> Any:
        path = None if isinstance(file, int) else self.within(file)
        if path is None:
            return self._open(file, mode, buffering, encoding, errors, newline, closefd, opener)
        self.before(Call("open", path))
        if not set(mode) & set("wxa+"):
            return self._open(file, mode, buffering, encoding, errors, newline, closefd, opener)
        there = os.path.lexists(path)
        raw = _Raw(self, path, mode.replace("b", "").replace("t", ""))
        if not there:
            self.after(Call("create", path))
        elif "w" in mode:
            self.after(Call("truncate", path))
        if buffering == 0:
            return raw
        kind = io.BufferedRandom if "+" in mode else io.BufferedWriter
        buffered = kind(raw, buffering if buffering > 1 else os.fstat(raw.fileno()).st_blksize)
        if "b" in mode:
            return buffered
        text = io.TextIOWrapper(buffered, encoding, errors, newline)
        text.mode = mode
        return text

    def os_open(
        self, name: Any, flags: int, mode: int = 0o777, *, dir_fd: int | None = None
    ) -> int:
        path = self.within(name, dir_fd)
        if path is None:
            return self._os_open(name, flags, mode, dir_fd=dir_fd)
        self.before(Call("open", path))
        if flags & (os.O_WRONLY | os.O_RDWR):
            raise NotImplementedError(f"{path} is opened for writing below what is watched")
        return self._os_open(name, flags, mode, dir_fd=dir_fd)

    def names(self, function: Callable[..., None], kind: str) -> Callable[..., None]:
        """A function of one or two names."""

        def call(*args: Any, **more: Any) -> None:
            path = self.within(args[0], more.get("dir_fd"))
            if path is None:
                return function(*args, **more)
            target = self.within(args[1]) if kind == "rename" else None
            self.before(Call("unlink" if kind == "rmdir" else kind, path, target))
            function(*args, **more)
            self.after(Call(kind, path, target))
            return None

        return call

    def fsync(self, function: Callable[[Any], None]) -> Callable[[Any], None]:
        def call(file: Any) -> None:
            number = file if isinstance(file, int) else file.fileno()
            path = self.within(number)
            if path is not None:
                self.before(Call("fsync", path))
            function(number)
            if path is not None:
                self.after(Call("fsync", path))

        return call


class _Raw(io.FileIO):
    """A file that tells of what is written to it."""

    def __init__(self, watch: _Watch, path: Path, mode: str) -> None:
        super().__init__(path, mode)
        self._watch, self._named = watch, path

    def _now(self) -> Path | None:
        """Its name now; None where it has none any more."""
        name = os.readlink(f"/proc/self/fd/{self.fileno()}")
        return None if name.endswith(DELETED) else Path(name)

    def write(self, data: Any) -> int:
        self._watch.before(Call("write", self._now() or self._named))
        end = os.lseek(self.fileno(), 0, os.SEEK_CUR)
        if "a" in self.mode:
            end = os.fstat(self.fileno()).st_size
        written = super().write(data)
        if (path := self._now()) is not None:
            self._watch.after(Call("write", path, at=end, data=bytes(data)[:written]))
        return written

    def truncate(self, size: int | None = None) -> int:
        self._watch.before(Call("write", self._now() or self._named))
        size = super().truncate(size)
        if (path := self._now()) is not None:
            self._watch.after(Call("truncate", path, at=size))
        return size
