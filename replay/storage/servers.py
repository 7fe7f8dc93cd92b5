"""Servers that logs lie on, through fsspec: parts of an object, and what an S3 prefix lists.

Every answer must be the part that was asked for.
"""

from __future__ import annotations

import asyncio
import re
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any, Final, TypeVar

from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError
from replay.storage.limits import limits
from replay.storage.location import Location, Url
from replay.storage.tries import Again, UnreachableError, asked_wait, patiently

SPARE_SECONDS: Final = 5.0
"""For what is waited for on another thread to end by itself, after its time."""

_LISTED: Final = 1 << 20
_LENGTH: Final = re.compile(r"\d{1,19}", re.ASCII)
_RANGE: Final = re.compile(r"bytes (\d{1,19})-(\d{1,19})/(\d{1,19})", re.ASCII)
_BROKEN_OFF: Final = (
    "ClientPayloadError",
    "ConnectionClosedError",
    "IncompleteRead",
    "IncompleteReadError",
    "ReadTimeoutError",
    "ResponseStreamingError",
    "SocketTimeoutError",
)
_NOTHING: Final = re.compile(r"bytes \*/0+", re.ASCII)

Value = TypeVar("Value")


class RemoteError(LogDamagedError):
    """A server that sends less than it says, or not the log that was opened."""


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

        # Unpacking on the way would make other bytes of the parts, without a limit.
        settings = {"auto_decompress": False}
        self._files = fsspec.filesystem(url.scheme, client_kwargs=settings)
        self._timeout = aiohttp.ClientTimeout(
            total=None, sock_connect=limits().read, sock_read=limits().read
        )
        self.loop = self._files.loop
        self._address = URL(url.address, encoded="%" in url.address)
        self._reached = False

    async def part(self, start: int, stop: int) -> Part:
        import aiohttp

        session = await self._files.set_session()
        headers = {"Range": f"bytes={start}-{stop - 1}", "Accept-Encoding": "identity"}
        try:
            async with session.get(self._address, headers=headers, timeout=self._timeout) as answer:
                self._reached = True
                self._check_way(answer)
                return await self._taken(answer, start, stop)
        except (aiohttp.InvalidURL, aiohttp.NonHttpUrlClientError):
            raise UnreachableError("the server sends us to what is no http address") from None
        except aiohttp.TooManyRedirects:
            raise UnreachableError("the server sends us from address to address") from None
        except aiohttp.ClientResponseError as error:
            what = error.message.split("\n")[0].split(": b")[0].rstrip(":")
            raise UnreachableError(f"the server's answer is no HTTP: {what[:80]}") from None
        except aiohttp.ClientConnectorError as error:
            if not self._reached:  # a name that is wrong does not get better
                raise
            raise Again from error
        except (aiohttp.ClientError, asyncio.IncompleteReadError, TimeoutError) as error:
            raise Again from error

    def _check_way(self, answer: Any) -> None:
        """Refuse to be sent from an encrypted to an open address."""
        ways = {step.url.scheme for step in (*answer.history, answer)}
        if self._address.scheme == "https" and ways != {"https"}:
            raise UnreachableError("the server sends us from https to http")

    async def _taken(self, answer: Any, start: int, stop: int) -> Part:
        headers = answer.headers
        tag = headers.get("ETag") or headers.get("Last-Modified") or ""
        if _passing(answer.status):
            wait = asked_wait(headers.get("Retry-After", ""))
            raise Again(f"the server answers {answer.status} {answer.reason}", wait)
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
            if start or not _LENGTH.fullmatch(length) or int(length) > stop:
                raise UnreachableError(
                    "the server sends no parts of a file (range requests): download it first, "
                    "or put av: before the address of a camera"
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
        place = {"Bucket": self._bucket, "Key": self._key}
        span = f"bytes={start}-{stop - 1}"
        try:
            answer = await self._files._call_s3("get_object", **place, Range=span)
        except Exception as error:
            if "InvalidRange" in f"{error} {error.__cause__!r}" and not start:
                return Part(b"", 0, "")
            _ask_again(error)
            raise
        total, count = _range_of(answer.get("ContentRange", ""), start, stop)
        data = bytearray()
        try:
            async with answer["Body"] as body:
                while len(data) < count and (more := await body.read(count - len(data))):
                    data += more
        except Exception as error:
            _ask_again(error)
            raise
        return Part(bytes(data), total, answer.get("ETag", ""))


def _passing(status: int) -> bool:
    """Whether what a server answers may go better the next time."""
    return status in (408, 429) or (status >= 500 and status != 501)


def _ask_again(error: Exception) -> None:
    """Ask for another try after what may be a passing fault of an S3 server."""
    found: BaseException | None = error
    while found is not None:
        facts = getattr(found, "response", None)
        said = facts.get("ResponseMetadata", {}) if isinstance(facts, dict) else {}
        if _passing(int(said.get("HTTPStatusCode", 0))):
            wait = asked_wait(str(said.get("HTTPHeaders", {}).get("retry-after", "")))
            raise Again(f"the server answers {said['HTTPStatusCode']}", wait) from error
        if type(found).__name__ in _BROKEN_OFF:
            raise Again from error
        found = found.__cause__


def listed(url: Url) -> list[Url]:
    """The logs right below an S3 prefix, finished or `.partial`, by name.

    Raises:
        UsageError: there is none.
        UnreachableError: the server does not list it.
    """

    async def keys(files: Any) -> list[str]:
        entries = await files._ls(url.address, detail=True, refresh=True)
        return [str(entry["name"]) for entry in entries]

    names = _asked(url, keys, limits().of(_LISTED))
    logs = [Url(f"s3://{n}") for n in sorted(names) if n.endswith((".mcap", ".mcap.partial"))]
    if not logs:
        raise UsageError(f"{url}: no .mcap file below this prefix")
    return logs


def s3_place(url: Url) -> tuple[str, str]:
    """Bucket and key of an s3:// address.

    Raises:
        UsageError: it names no place in a bucket.
        CdmisfaError: what reads URLs is not installed.
    """
    bucket, key, _ = _importing(_s3).split_path(url.address)
    if not (bucket and key):
        raise UsageError(f"{url} names no place in a bucket: write s3://BUCKET/NAME")
    return str(bucket), str(key).rstrip("/")


def ask_s3(url: Url, call: str, seconds: float, **words: Any) -> Any:
    """The answer to a call of the S3 interface, asked again after what may be a passing fault.

    Args:
        url: what the call is about, for messages.
        call: its name: "put_object".
        seconds: tries and waits together.
        words: of the call.

    Raises:
        UsageError: there is no such object or bucket.
        UnreachableError: the server refuses it, or cannot be reached in time.
    """
    return _asked(url, lambda files: files._call_s3(call, **words), seconds)


def _asked(url: Url, ask: Callable[[Any], Awaitable[Value]], seconds: float) -> Value:
    files = _importing(_s3)

    async def once() -> Value:
        try:
            return await ask(files)
        except Exception as error:
            _ask_again(error)
            raise

    try:
        asked = asyncio.run_coroutine_threadsafe(patiently(once, seconds), files.loop)
        return asked.result(seconds + SPARE_SECONDS)
    except Exception as error:
        raise refusal(url, error) from None


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

    seconds = limits().read
    settings = {  # tries are counted and spread by `patiently` alone
        "connect_timeout": seconds,
        "read_timeout": seconds,
        "retries": {"total_max_attempts": 1, "mode": "standard"},
    }
    files = fsspec.filesystem("s3", use_listings_cache=False, config_kwargs=settings)
    files.retries = 1
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
    words = "".join(letter if letter.isprintable() else "?" for letter in _words(error))
    return kind(f"{url}: {words[:300]}")


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
    if "Payload" in type(error).__name__:
        return "the server sent fewer bytes than it said, and went away"
    return " ".join(f"{type(error).__name__}: {error}".split())[:200]
