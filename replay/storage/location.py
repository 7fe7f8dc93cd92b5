"""Where a log is, a path or a URL, and how long its server is waited for."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from urllib.parse import unquote, urlsplit

from cdmisfa.core.errors import UsageError
from cdmisfa.core.options import setting

SCHEMES: Final = ("s3", "http", "https")
_SECRET: Final = re.compile(r"(?<=://)[^/@]*@|[?#].*")
_URL: Final = re.compile(r"([A-Za-z][A-Za-z0-9+.-]*)://", re.ASCII)


@dataclass(frozen=True, slots=True)
class Url:
    """A log on a server, by its whole address; as a text it shows no password or signature."""

    address: str

    def __str__(self) -> str:
        if self.scheme == "s3":
            return self.address
        parts = urlsplit(self.address)
        return f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}"

    @property
    def scheme(self) -> str:
        """One of s3, http and https."""
        return self.address.split("://", 1)[0]

    @property
    def name(self) -> str:
        """The last part of its path, fit for a file."""
        last = str(self).rstrip("/").split("://", 1)[1].rsplit("/", 1)[-1]
        name = re.sub(r"[/\\\0]", "_", last if self.scheme == "s3" else unquote(last))
        return "log" if name in ("", ".", "..") else name

    @property
    def stem(self) -> str:
        """See `Path.stem`."""
        return Path(self.name).stem

    @property
    def suffix(self) -> str:
        """See `Path.suffix`."""
        return Path(self.name).suffix

    @property
    def parent(self) -> Url:
        """What it lies in, without a password, or what follows the path."""
        return Url(str(self).rstrip("/").rsplit("/", 1)[0])

    @property
    def folder(self) -> bool:
        """Whether it names what is listed; only s3 lists."""
        return self.scheme == "s3" and self.suffix not in (".mcap", ".partial")


Location = Path | Url
"""Where a log is."""


def location(value: str | Path | Url) -> Location:
    """Tell a URL from a path.

    Raises:
        UsageError: a URL of a kind that is not read, or no name at all.
    """
    if value == "":
        raise UsageError("a name is empty: name a path or a URL")
    found = _URL.match(value) if isinstance(value, str) else None
    if not isinstance(value, str) or found is None:
        return value if isinstance(value, Url) else Path(value)
    scheme = found[1].lower()
    if scheme not in SCHEMES:
        raise UsageError(f"{scheme}:// is not read: use one of {', '.join(SCHEMES)}, or a path")
    url = Url(scheme + value[len(found[1]) :])
    if scheme == "s3" and url.address.removeprefix("s3://").strip("/"):
        return url
    try:
        parts = urlsplit(url.address)
    except ValueError:
        parts = urlsplit("")
    try:
        _ = parts.port
    except ValueError:
        raise UsageError(f"{url} has no port: a port is a number up to 65535") from None
    if not (parts.hostname and parts.path.strip("/")):
        shown = _SECRET.sub("", url.address)
        raise UsageError(f"{shown} names no file: a URL is like {scheme}://PLACE/PATH/left.mcap")
    return url


_PART: Final = 1 << 20


@dataclass(frozen=True, slots=True)
class Limits:
    """Time limits for servers, in seconds; `total` is for tries and waits together."""

    total: float = setting(
        60.0,
        "Give up on a part of a log at a URL (of a large one, on each MiB) after so long.",
        unit="SECONDS",
        name="timeout",
        least=0.1,
        most=1e6,
    )
    read: float = setting(
        20.0,
        "Ask a server again that sends nothing for so long.",
        unit="SECONDS",
        name="read-timeout",
        least=0.1,
        most=1e6,
    )

    def of(self, count: int) -> float:
        """Seconds for `count` bytes."""
        return self.total * max(1.0, count / _PART)


_LIMITS: Final = ContextVar("limits", default=Limits())  # noqa: B039 - it is frozen


def limits() -> Limits:
    """The limits in force."""
    return _LIMITS.get()


@contextlib.contextmanager
def limited(chosen: Limits) -> Iterator[None]:
    """Use these limits for the servers that are connected to in the body."""
    before = _LIMITS.set(chosen)
    try:
        yield
    finally:
        _LIMITS.reset(before)
