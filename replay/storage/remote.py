"""Logs behind URLs, through fsspec: only the parts that are asked for, each checked.

Nothing is taken on trust: every answer must be the part that was asked for, of an object that
is still the one that was opened.
"""

from __future__ import annotations

import asyncio
import bisect
import re
import time
from collections import OrderedDict
from collections.abc import Callable, Coroutine, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, Final, Protocol, TypeVar

from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError
from replay.storage.location import Url

EDGE_BYTES: Final = 64 * 1024
"""What is read of the beginning, and of the end, at once."""
CACHE_BYTES: Final = 16 * 1024 * 1024
"""Bytes of an object that are kept; the last part always is."""
_LEAST: Final = 16 * 1024
_MOST: Final = 1024 * 1024
_AT_ONCE: Final = 16
_TRIES: Final = 3
_CONNECT_SECONDS: Final = 20.0
_READ_SECONDS: Final = 60.0
_WAIT_SECONDS: Final = 600.0
_RANGE: Final = re.compile(r"bytes (\d{1,19})-(\d{1,19})/(\d{1,19})", re.ASCII)
_NOTHING: Final = re.compile(r"bytes \*/0+", re.ASCII)

Value = TypeVar("Value")


class RemoteError(LogDamagedError):
    """A server that sends less than it says, or not the log that was opened."""


class UnreachableError(CdmisfaError):
    """A server that cannot be reached, or does not give parts of the log."""


class _Again(Exception):  # noqa: N818 - asks for another try
    """What may go better the next time."""


@dataclass(frozen=True, slots=True)
class Part:
    """A part of an object, with what identifies the whole."""

    data: bytes
    total: int
    tag: str


class _Remote(Protocol):
    """Where parts come from."""

    loop: asyncio.AbstractEventLoop

    async def part(self, start: int, stop: int) -> Part:
        """Fetch the bytes from `start` to before `stop`, or to the end."""


class RemoteStore:
    """An object on a server, read part by part.

    Attributes:
        size: its bytes, as the server says.
        tag: what the server calls this version of it: its ETag, or its date.
    """

    def __init__(self, url: Url) -> None:
        """Look for the object and read its beginning.

        Raises:
            UsageError: there is no such object.
            UnreachableError: the server does not give it.
            RemoteError: what it gives is not what it says.
            CdmisfaError: what reads URLs is not installed.
        """
        self._url = url
        self._remote = _connect(url)
        self._parts: OrderedDict[int, bytes] = OrderedDict()
        self._begins: list[int] = []
        self._held = 0
        self._spans: list[tuple[int, int]] = []
        self._starts: list[int] = []
        self._ahead: dict[int, tuple[int, Future[Part]]] = {}
        self._reach, self._follows = _LEAST, -1
        self._stride = EDGE_BYTES
        self.size, self.tag = 0, ""
        first = self._wait(self._start(0, EDGE_BYTES), 0, EDGE_BYTES)
        self.size, self.tag = first.total, first.tag
        self._keep(0, self._checked(first, 0, EDGE_BYTES))

    def read_at(self, offset: int, count: int) -> bytes:
        """Read `count` bytes from `offset` on, fewer only at the end.

        Raises:
            UnreachableError: the server does not give them.
            RemoteError: it gives others, or the object changed.
        """
        count = max(min(count, self.size - offset), 0)
        if not count:
            return b""
        found = self._cached(offset, count)
        if found is None:
            number = bisect.bisect_right(self._starts, offset) - 1
            if number >= 0 and offset + count <= self._spans[number][1]:
                start, data = self._expected(number)
            else:
                start, data = self._unexpected(offset, offset + count)
            self._keep(start, data)
            found = data[offset - start : offset - start + count]
        return found

    def expect(self, spans: Sequence[tuple[int, int]]) -> None:
        """Hear which spans, from and up to before, will be read, one after the other."""
        self._drop_ahead()
        self._spans = sorted(spans)
        self._starts = [start for start, _ in self._spans]

    def grow(self) -> bool:
        """Say no: an object is written as a whole."""
        return False

    def close(self) -> None:
        """Forget what was read; harmless when called twice."""
        self._drop_ahead()
        self._parts.clear()
        self._begins.clear()
        self._held = 0

    def _unexpected(self, start: int, stop: int) -> tuple[int, bytes]:
        """Fetch somewhat more than was asked for; more and more while reads go forward."""
        forward = 0 <= start - self._follows <= self._reach
        self._reach = min(2 * self._reach, _MOST) if forward else _LEAST
        if self.size - start <= EDGE_BYTES:
            start = max(self.size - EDGE_BYTES, 0)
        stop = self._follows = min(max(stop, start + self._reach), self.size)
        return start, self._checked(self._wait(self._start(start, stop), start, stop), start, stop)

    def _expected(self, number: int) -> tuple[int, bytes]:
        """Fetch a span that was expected, with those after it, and ask for what comes then."""
        place = self._spans[number][0]
        start = next((a for a, (b, _) in self._ahead.items() if a <= place < b), None)
        if start is None:
            self._drop_ahead()
            self._stride = EDGE_BYTES
            start, stop = self._bundle(number)
            future = self._start(start, stop)
        else:
            self._stride = min(2 * self._stride, _MOST)
            stop, future = self._ahead.pop(start)
        self._ask_ahead(stop)
        return start, self._checked(self._wait(future, start, stop), start, stop)

    def _bundle(self, number: int) -> tuple[int, int]:
        """Expected spans from one on that touch, up to a stride of bytes."""
        start, stop = self._spans[number]
        while number + 1 < len(self._spans) and stop - start < self._stride:
            number += 1
            if self._spans[number][0] != stop:
                break
            stop = self._spans[number][1]
        return start, stop

    def _ask_ahead(self, stop: int) -> None:
        """Ask for a stride of what is expected after a place, without waiting for it."""
        held = sum(end - begin for begin, (end, _) in self._ahead.items())
        stop = max([stop, *(end for end, _ in self._ahead.values())])
        number = bisect.bisect_left(self._starts, stop)
        while number < len(self._spans) and held < self._stride and len(self._ahead) < _AT_ONCE:
            begin, end = self._bundle(number)
            self._ahead[begin] = end, self._start(begin, end)
            held += end - begin
            number = bisect.bisect_left(self._starts, end)

    def _drop_ahead(self) -> None:
        for _, future in self._ahead.values():
            future.cancel()
        self._ahead.clear()

    def _start(self, start: int, stop: int) -> Future[Part]:
        return asyncio.run_coroutine_threadsafe(self._remote.part(start, stop), self._remote.loop)

    def _wait(self, future: Future[Part], start: int, stop: int) -> Part:
        """Wait for a part; what may be a passing fault is tried again."""
        for attempt in range(_TRIES):
            try:
                return future.result(_WAIT_SECONDS)
            except _Again as error:
                if attempt == _TRIES - 1 or not self.size:
                    raise _refusal(self._url, error.__cause__ or error) from None
            except Exception as error:
                raise _refusal(self._url, error) from None
            time.sleep(0.2 * 4**attempt)
            future = self._start(start, stop)
        raise AssertionError("every try ends")

    def _checked(self, part: Part, start: int, stop: int) -> bytes:
        if (part.total, part.tag) != (self.size, self.tag):
            raise RemoteError(f"{self._url}: it changed while it was read; begin again")
        if len(part.data) != min(stop, self.size) - start:
            raise RemoteError(
                f"{self._url}: the server sent {len(part.data)} bytes of {stop - start} "
                f"at byte {start}"
            )
        return part.data

    def _cached(self, offset: int, count: int) -> bytes | None:
        place = bisect.bisect_right(self._begins, offset) - 1
        if place < 0:
            return None
        start = self._begins[place]
        data = self._parts[start]
        if offset + count > start + len(data):
            return None
        self._parts.move_to_end(start)
        return data[offset - start : offset - start + count]

    def _keep(self, start: int, data: bytes) -> None:
        low = bisect.bisect_left(self._begins, start)
        high = bisect.bisect_left(self._begins, start + len(data))
        for inner in self._begins[low:high]:
            if inner + len(self._parts[inner]) <= start + len(data):
                self._drop(inner)
        if start in self._parts:  # a longer one
            return
        bisect.insort(self._begins, start)
        self._parts[start] = data
        self._held += len(data)
        while self._held > CACHE_BYTES and len(self._parts) > 1:
            self._drop(next(iter(self._parts)))

    def _drop(self, start: int) -> None:
        self._held -= len(self._parts.pop(start))
        del self._begins[bisect.bisect_left(self._begins, start)]


class _HttpRemote:
    """An object of a web server."""

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
            raise _Again from error

    async def _taken(self, answer: Any, start: int, stop: int) -> Part:
        headers = answer.headers
        tag = headers.get("ETag") or headers.get("Last-Modified") or ""
        if answer.status >= 500 or answer.status == 429:
            raise _Again(f"the server answers {answer.status} {answer.reason}")
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


class _S3Remote:
    """An object of an S3 bucket."""

    def __init__(self, url: Url) -> None:
        self._files = _s3()
        self.loop = self._files.loop
        self._bucket, self._key, _ = self._files.split_path(url.address)

    async def part(self, start: int, stop: int) -> Part:
        try:
            answer = await self._files._call_s3(
                "get_object",
                Bucket=self._bucket,
                Key=self._key,
                Range=f"bytes={start}-{stop - 1}",
            )
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
        names = _waited(files.loop, keys())
    except Exception as error:
        raise _refusal(url, error) from None
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


def _connect(url: Url) -> _Remote:
    kind: type[_S3Remote] | type[_HttpRemote] = _S3Remote if url.scheme == "s3" else _HttpRemote
    return _importing(lambda: kind(url))


def _s3() -> Any:
    import fsspec

    limits = {"connect_timeout": _CONNECT_SECONDS, "read_timeout": _READ_SECONDS}
    files = fsspec.filesystem("s3", use_listings_cache=False, config_kwargs=limits)
    files.retries = _TRIES
    return files


def _importing(make: Callable[[], Value]) -> Value:
    try:
        return make()
    except ImportError:
        raise CdmisfaError(
            "reading URLs needs packages that are not installed: pip install 'cdmisfa[cloud]'"
        ) from None


def _waited(loop: asyncio.AbstractEventLoop, work: Coroutine[Any, Any, Value]) -> Value:
    return asyncio.run_coroutine_threadsafe(work, loop).result(_WAIT_SECONDS)


def _refusal(url: Url, error: BaseException) -> CdmisfaError:
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
    if isinstance(error, CdmisfaError | _Again):
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
