"""Let a system call on the files of a folder fail.

`refusing` takes the place of `open` and of functions of `os`, below which nothing of the project
writes. Rerun writes run.rrd in native code: only the sync and the rename of it can fail here.
"""

from __future__ import annotations

import _io
import builtins
import io
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

KINDS = ("open", "write", "fsync", "rename", "unlink", "mkdir")


@dataclass(slots=True)
class Refusal:
    """Refuse a call, counted from 0, and where it lasts all later ones.

    Attributes:
        number: of the call; -1 refuses none.
        kinds: kinds of calls that count and can fail.
        code: errno of the failure.
        lasting: whether later calls fail, too.
        seen: number of calls until now.
    """

    number: int
    kinds: tuple[str, ...] = KINDS
    code: int = 0
    lasting: bool = False
    seen: int = 0

    def __call__(self, kind: str, path: Path) -> None:
        """Count a call; raise the error if it is to fail."""
        if kind in self.kinds:
            number, self.seen = self.seen, self.seen + 1
            if number == self.number or (self.lasting and 0 <= self.number <= number):
                raise OSError(self.code, os.strerror(self.code), str(path))


@contextmanager
def refusing(folder: Path, refusal: Refusal) -> Iterator[None]:
    """Ask `refusal` before each call on a path in a folder while the body runs."""
    original_open, original_os_open = io.open, os.open

    def within(name: Any, dir_fd: int | None = None) -> Path | None:
        if isinstance(name, int):
            path = Path(os.readlink(f"/proc/self/fd/{name}"))
        else:
            start = Path.cwd() if dir_fd is None else Path(os.readlink(f"/proc/self/fd/{dir_fd}"))
            path = start / os.fsdecode(name)
        return path if path == folder or folder in path.parents else None

    def opened(file: Any, mode: str = "r", buffering: int = -1, *more: Any, **named: Any) -> Any:
        path = None if isinstance(file, int) else within(file)
        if path is not None:
            refusal("open", path)
        if path is None or not set(mode) & set("wxa+"):
            return original_open(file, mode, buffering, *more, **named)
        raw = _Raw(path, mode.replace("b", "").replace("t", ""), refusal)
        if buffering == 0:
            return raw
        kind = io.BufferedRandom if "+" in mode else io.BufferedWriter
        buffered = kind(raw, buffering if buffering > 1 else os.fstat(raw.fileno()).st_blksize)
        return buffered if "b" in mode else io.TextIOWrapper(buffered, *more, **named)

    def os_opened(name: Any, flags: int, mode: int = 0o777, *, dir_fd: int | None = None) -> int:
        if (path := within(name, dir_fd)) is not None:
            refusal("open", path)
        return original_os_open(name, flags, mode, dir_fd=dir_fd)

    def asked(function: Callable[..., Any], kind: str) -> Callable[..., Any]:
        def call(*args: Any, **named: Any) -> Any:
            first = args[0] if isinstance(args[0], int | str | Path) else args[0].fileno()
            if (path := within(first, named.get("dir_fd"))) is not None:
                refusal(kind, path)
            return function(*args, **named)

        return call

    kinds = {"replace": "rename", "remove": "unlink", "rmdir": "unlink", "fdatasync": "fsync"}
    names = (*kinds, "rename", "unlink", "mkdir", "fsync")
    places = [
        *((module, "open", opened) for module in (builtins, io, _io)),
        (os, "open", os_opened),
        *((os, name, asked(getattr(os, name), kinds.get(name, name))) for name in names),
    ]
    originals = [(module, name, getattr(module, name)) for module, name, _ in places]
    try:
        for module, name, function in places:
            setattr(module, name, function)
        yield
    finally:
        for module, name, function in originals:
            setattr(module, name, function)


class _Raw(io.FileIO):
    """A file that asks before each write; buffers call it when they reach the system."""

    def __init__(self, path: Path, mode: str, refusal: Refusal) -> None:
        super().__init__(path, mode)
        self._path, self._refusal = path, refusal

    def write(self, data: Any) -> int:
        self._refusal("write", self._path)
        return super().write(data)

    def truncate(self, size: int | None = None) -> int:
        self._refusal("write", self._path)
        return super().truncate(size)
