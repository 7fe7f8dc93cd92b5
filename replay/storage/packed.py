"""Packages of files: zip files without compression, of the same bytes for the same files."""

from __future__ import annotations

import contextlib
import hashlib
import stat
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from cdmisfa.core.errors import LogDamagedError, UsageError, one_line
from cdmisfa.core.untrusted import budget, opened_regular

_BLOCK: Final = 1 << 20
_FIRST_DAY: Final = (1980, 1, 1, 0, 0, 0)
_UNIX: Final = 3
_ENCRYPTED: Final = 1
_DAMAGED: Final = (
    *(zipfile.BadZipFile, zlib.error, EOFError, LookupError, NotImplementedError, OSError),
    *(RuntimeError, ValueError),
)  # together what zipfile raises for damaged files

Counted = Callable[[int], None]
"""Told how many more bytes were packed."""


@dataclass(frozen=True, slots=True)
class Packed:
    """A file in a package: its name there, its bytes and their SHA-256."""

    name: str
    size: int
    sha256: str


class Packer:
    """Writes a package; its file must not be there."""

    def __init__(self, path: Path) -> None:
        self._zip = zipfile.ZipFile(path, "x")

    def add(self, name: str, file: Path, counted: Counted) -> Packed:
        """Pack a file under a name.

        Raises:
            UsageError: it is no regular file that may be read, or its name does not print.
            LogDamagedError: the disk does not give it.
        """
        if not name.isprintable():
            raise UsageError(f"{file}: its name holds what does not print: rename it")
        found, size = hashlib.sha256(), file.stat().st_size
        with opened_regular(file) as data, self._zip.open(_member(name, size), "w") as member:
            while block := data.read(_BLOCK):
                found.update(block)
                member.write(block)
                counted(len(block))
            size = data.tell()
        return Packed(name, size, found.hexdigest())

    def add_text(self, name: str, text: str) -> None:
        """Pack a text under a name."""
        self._zip.writestr(_member(name, 0), text)

    def __enter__(self) -> Packer:
        return self

    def __exit__(self, *_: object) -> None:
        self._zip.close()


def _member(name: str, size: int) -> zipfile.ZipInfo:
    info = zipfile.ZipInfo(name, _FIRST_DAY)
    info.create_system, info.external_attr = _UNIX, (stat.S_IFREG | 0o644) << 16
    info.file_size = size  # large ones have other headers
    return info


class Package:
    """A package of somebody else, of which nothing is trusted.

    What it unpacks has no more bytes than the package itself.

    Attributes:
        path: of it.
        sizes: bytes of each file, by its name.
    """

    def __init__(self, path: Path, members: zipfile.ZipFile) -> None:
        self.path, self._zip = path, members
        infos = [info for info in members.infolist() if not info.is_dir()]
        self.sizes: Mapping[str, int] = {info.filename: info.file_size for info in infos}
        for info in members.infolist():
            if why := _refused(info):
                raise LogDamagedError(f"{path}: {info.filename!r} {why}")
        if len(self.sizes) < len(infos):
            raise LogDamagedError(f"{path}: it holds several files of one name")
        if sum(self.sizes.values()) > path.stat().st_size:
            raise LogDamagedError(f"{path}: its files overlap, or have other sizes than it says")

    def read(self, name: str, most: int) -> bytes:
        """The bytes of a file.

        Raises:
            LogDamagedError: there is none, it is longer than `most`, or damaged.
        """
        if self.sizes.get(name, most + 1) > most:
            raise LogDamagedError(f"{self.path}: it holds no {name}, or one that is too large")
        return b"".join(self._blocks(name))

    def unpack(self, name: str, target: Path) -> Packed:
        """Write a file where none is.

        Raises:
            LogDamagedError: it is damaged.
            OSError: the disk does not take it.
        """
        found = hashlib.sha256()
        target.parent.mkdir(parents=True, exist_ok=True)
        with target.open("xb") as file:
            for block in self._blocks(name):
                found.update(block)
                file.write(block)
        return Packed(name, target.stat().st_size, found.hexdigest())

    def _blocks(self, name: str) -> Iterator[bytes]:
        try:
            with self._zip.open(name) as member:
                while block := member.read(_BLOCK):
                    yield block
        except _DAMAGED as error:
            raise LogDamagedError(f"{self.path}: {name} is damaged ({one_line(error)})") from error


@contextlib.contextmanager
def opened_package(path: Path) -> Iterator[Package]:
    """A package, open to be read.

    Raises:
        UsageError: it is no regular file that may be read.
        LogDamagedError: it is no package, is damaged, or holds what none of ours does.
    """
    with opened_regular(path) as file, contextlib.ExitStack() as opened:
        try:
            with budget():
                members = opened.enter_context(zipfile.ZipFile(file))
        except MemoryError:
            raise UsageError(f"{path}: it holds more files than can be listed") from None
        except _DAMAGED as error:
            raise LogDamagedError(
                f"{path} is no zip file, or a damaged one ({one_line(error)}): copy it again"
            ) from error
        yield Package(path, members)


def _refused(info: zipfile.ZipInfo) -> str:
    """Why a file is not unpacked; "" if it is."""
    name = info.orig_filename
    if not name.isprintable():
        return "is no name of a file in a package"
    if any(part in ("", ".", "..") for part in name.removesuffix("/").split("/")):
        return "leads out of it"
    if stat.S_IFMT(info.external_attr >> 16) not in (0, stat.S_IFREG, stat.S_IFDIR):
        return "is a link, or no file"
    if info.flag_bits & _ENCRYPTED:
        return "is encrypted"
    if info.compress_type != zipfile.ZIP_STORED or info.compress_size != info.file_size:
        return "is compressed: pack it without (zip -0)"
    return ""
