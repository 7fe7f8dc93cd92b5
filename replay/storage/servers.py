"""Servers that logs lie on, through fsspec: parts of an object, and what an S3 prefix lists.

Every answer must be the part that was asked for.
"""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, TypeVar

from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError
from replay.storage.location import Location, Url

TRIES: Final = 3
_CONNECT_SECONDS: Final = 20.0
_READ_SECONDS: Final = 60.0
WAIT_SECONDS: Final = 600.0
_RANGE: Final = re.compile(r"bytes (\d{1,19})-(\d{1,19})/(\d{1,19})", re.ASCII)
_NOTHING: Final = re.compile(r"bytes \*/0+", re.ASCII)

Value = TypeVar("Value")


class RemoteError(LogDamagedError):
    """A server that sends less than it says, or not the log that was opened."""


class UnreachableError(CdmisfaError):
    """A server that cannot be reached, or does not give parts of the log."""


class Again(Exception):  # noqa: N818 - asks for another try
    """What may go better the next time."""


@dataclass(frozen=True, slots=True)
class Part:
    """A part of an object, with what identifies the whole."""

    data: bytes
    total: int
    tag: str


class _HttpServer:
    """An object of a web server; `part` fetches its bytes [start, stop), or up to the end."""

    def __init__(self, url: Url) -> None:
        import aiohttp
        import fsspec
        from yarl import URL

        timeout = aiohttp.ClientTimeout(
            total=None, sock_connect=_CONNECT_SECONDS, sock_read=_READ_SECONDS
        )
        # Unpacking on the way would make other bytes of the parts, without a limit.
        settings = {"timeout": timeout, "auto_decompress": False}
        self._files = fsspec.filesystem(url.scheme, client_kwargs=settings)
        self.loop = self._files.loop
        self._address = URL(url.address, encoded="%" in url.address)

    async def part(self, start: int, stop: int) -> Part:
        import aiohttp

        session = await self._files.set_session()
        headers = {"Range": f"bytes={start}-{stop - 1}", "Accept-Encoding": "identity"}
        try:
            async with session.get(self._address, headers=headers) as answer:
                return await self._taken(answer, start, stop)
        except (aiohttp.ClientError, asyncio.IncompleteReadError, TimeoutError) as error:
            raise Again from error

    async def _taken(self, answer: Any, start: int, stop: int) -> Part:
        headers = answer.headers
        tag = headers.get("ETag") or headers.get("Last-Modified") or ""
        if answer.status >= 500 or answer.status == 429:
            raise Again(f"the server answers {answer.status} {answer.reason}")
        if answer.status == 416 and _NOTHING.fullmatch(headers.get("Content-Range", "")):
            return Part(b"", 0, tag)
        if answer.status in (404, 410):
            raise UsageError(f"the server answers {answer.status} {answer.reason}")
        if answer.status not in (200, 206):
            raise UnreachableError(f"the server answers {answer.status} {answer.reason}")
        if headers.get("Content-Encoding", "identity") != "identity":
            raise UnreachableError("the server packs it on the way: download it first")
        if answer.status == 200:
            length = headers.get("Content-Length", "")
            if start or not length.isdecimal() or int(length) > stop:
                raise UnreachableError(
                    "the server sends no parts of a file (range requests): download it first"
                )
            return Part(await answer.content.readexactly(int(length)), int(length), tag)
        total, count = _range_of(headers.get("Content-Range", ""), start, stop)
        return Part(await answer.content.readexactly(count), total, tag)


class _S3Server:
    """An object of an S3 bucket, as `_HttpServer`."""

    def __init__(self, url: Url) -> None:
        self._files = _s3()
        self.loop = self._files.loop
        self._bucket, self._key, _ = self._files.split_path(url.address)

    async def part(self, start: int, stop: int) -> Part:
        try:
            place = {"Bucket": self._bucket, "Key": self._key}
            span = f"bytes={start}-{stop - 1}"
            answer = await self._files._call_s3("get_object", **place, Range=span)
        except OSError as error:
            if "InvalidRange" in f"{error} {error.__cause__!r}" and not start:
                return Part(b"", 0, "")
            raise
        total, count = _range_of(answer.get("ContentRange", ""), start, stop)
        data = bytearray()
        async with answer["Body"] as body:
            while len(data) < count and (more := await body.read(count - len(data))):
                data += more
        return Part(bytes(data), total, answer.get("ETag", ""))


def listed(url: Url) -> list[Url]:
    """The logs right below an S3 prefix, finished or `.partial`, by name.

    Raises:
        UsageError: there is none.
        UnreachableError: the server does not list it.
    """
    files = _importing(_s3)

    async def keys() -> list[str]:
        return [str(e["name"]) for e in await files._ls(url.address, detail=True, refresh=True)]

    try:
        names = asyncio.run_coroutine_threadsafe(keys(), files.loop).result(WAIT_SECONDS)
    except Exception as error:
        raise refusal(url, error) from None
    logs = [Url(f"s3://{n}") for n in sorted(names) if n.endswith((".mcap", ".mcap.partial"))]
    if not logs:
        raise UsageError(f"{url}: no .mcap file below this prefix")
    return logs


def _range_of(text: str, start: int, stop: int) -> tuple[int, int]:
    """Total size and bytes of an answer, which must be the part that was asked for."""
    found = _RANGE.fullmatch(text)
    first, last, total = map(int, found.groups()) if found else (-1, -1, -1)
    if first != start or last != min(stop, total) - 1:
        raise RemoteError(
            f"asked for the bytes {start} to {stop - 1}, the server answers {text[:60]!r}"
        )
    return total, last + 1 - first


def connect(url: Url) -> _S3Server | _HttpServer:
    """The server of an object, which is not asked for anything yet."""
    return _importing(lambda: _S3Server(url) if url.scheme == "s3" else _HttpServer(url))


def _s3() -> Any:
    import fsspec

    limits = {"connect_timeout": _CONNECT_SECONDS, "read_timeout": _READ_SECONDS}
    files = fsspec.filesystem("s3", use_listings_cache=False, config_kwargs=limits)
    files.retries = TRIES
    return files


def _importing(make: Callable[[], Value]) -> Value:
    try:
        return make()
    except ImportError:
        raise CdmisfaError(
            "reading URLs needs packages that are not installed: pip install 'cdmisfa[cloud]'"
        ) from None


def refusal(url: Location, error: BaseException) -> CdmisfaError:
    """What to raise: there is no such object, it came short or changed, or not at all."""
    kind: type[CdmisfaError] = UnreachableError
    if isinstance(error, CdmisfaError):
        kind = type(error)
    elif isinstance(error, FileNotFoundError):
        kind = UsageError
    elif isinstance(error, asyncio.IncompleteReadError) or "Payload" in type(error).__name__:
        kind = RemoteError
    return kind(f"{url}: {_words(error)}")


def _words(error: BaseException) -> str:
    """What a server, or the way to it, has against us, in one line."""
    if isinstance(error, CdmisfaError | Again):
        return str(error)
    if type(error).__name__ == "NoCredentialsError":
        return (
            "no credentials: set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or "
            "FSSPEC_S3_ANON=true for a public bucket"
        )
    if isinstance(error, FileNotFoundError):
        return "there is no such object"
    if isinstance(error, PermissionError):
        return f"the server refuses it ({str(error)[:100]})"
    if isinstance(error, TimeoutError):
        return "the server does not answer in time"
    if isinstance(error, asyncio.IncompleteReadError):
        return f"the server sent {len(error.partial)} bytes of {error.expected} and went away"
    return " ".join(f"{type(error).__name__}: {error}".split())[:200]
