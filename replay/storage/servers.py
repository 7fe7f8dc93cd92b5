"""Servers of logs and results, through fsspec; every answer must be the part that was asked for.

What may be a passing fault is asked for again, within the limits of `replay.storage.location`.
"""

from __future__ import annotations

import asyncio
import contextlib
import random
import re
import time
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable
from concurrent.futures import Future
from dataclasses import dataclass
from email.utils import parsedate_to_datetime
from typing import Any, Final, TypeVar

from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError
from replay.storage.location import Url, limits

TRIES: Final = 6
FIRST_WAIT = 0.5
"""Seconds before the second try; each further wait is twice as long."""

_JITTER: Final = random.Random()
"""Keeps clients that failed together from coming back together; nothing else draws from it."""

_SPARE_SECONDS: Final = 5.0
"""For what is waited for on another thread to end by itself, after its time."""

_LENGTH: Final = re.compile(r"\d{1,19}", re.ASCII)
_RANGE: Final = re.compile(r"bytes (\d{1,19})-(\d{1,19})/(\d{1,19})", re.ASCII)
_NOTHING: Final = re.compile(r"bytes \*/0+", re.ASCII)
_BROKEN_OFF: Final = (
    "ClientPayloadError",
    "ConnectionClosedError",
    "IncompleteRead",
    "IncompleteReadError",
    "ReadTimeoutError",
    "ResponseStreamingError",
    "SocketTimeoutError",
)
"""What aiohttp and botocore call a connection that broke."""

Value = TypeVar("Value")


class RemoteError(LogDamagedError):
    """A server that sends less than it says, or not the log that was opened."""


class UnreachableError(CdmisfaError):
    """A server that cannot be reached, or does not give parts of the log."""


class RetryError(Exception):
    """A fault that may pass: try again, after the seconds that the server asks for."""

    def __init__(self, reason: str = "", after: float = 0.0) -> None:
        super().__init__(reason)
        self.after = after


@dataclass(frozen=True, slots=True)
class Part:
    """A part of an object, with what identifies the whole."""

    data: bytes
    total: int
    tag: str


class Server(ABC):
    """The server of an object, which is not asked for anything yet.

    Args:
        url: of the object.
        files: what fsspec has for it.
    """

    def __init__(self, url: Url, files: Any) -> None:
        self._url, self._files, self._limits = url, files, limits()

    @abstractmethod
    async def part(self, start: int, stop: int) -> Part:
        """The bytes [start, stop), fewer at the end; raises `RetryError` where a fault may pass."""

    def begin(self, start: int, stop: int) -> Future[Part]:
        """Ask for the bytes [start, stop), without waiting for them."""
        asked = with_retries(lambda: self.part(start, stop), self._limits.of(stop - start))
        return asyncio.run_coroutine_threadsafe(asked, self._files.loop)

    def wait(self, coming: Future[Part], count: int) -> Part:
        """The `count` bytes that were asked for; raises as `_answer`."""
        return _answer(self._url, coming, self._limits.of(count))


class _HttpServer(Server):
    """An object of a web server."""

    def __init__(self, url: Url) -> None:
        import aiohttp
        import fsspec
        from yarl import URL

        # Unpacking on the way would make other bytes of the parts, without a limit.
        settings = {"auto_decompress": False}
        super().__init__(url, fsspec.filesystem(url.scheme, client_kwargs=settings))
        self._timeout = aiohttp.ClientTimeout(
            total=None, sock_connect=limits().read, sock_read=limits().read
        )
        self._address = URL(url.address, encoded="%" in url.address)
        self._reached = False

    async def part(self, start: int, stop: int) -> Part:
        import aiohttp

        session = await self._files.set_session()
        headers = {"Range": f"bytes={start}-{stop - 1}", "Accept-Encoding": "identity"}
        try:
            async with session.get(self._address, headers=headers, timeout=self._timeout) as answer:
                self._reached = True
                ways = {step.url.scheme for step in (*answer.history, answer)}
                if self._address.scheme == "https" and ways != {"https"}:
                    raise UnreachableError("the server sends us from https to http")
                total, count = _stated(answer, start, stop)
                data = await answer.content.readexactly(count)
                return Part(data, total, _tag(answer.headers))
        except (aiohttp.InvalidURL, aiohttp.NonHttpUrlClientError):
            raise UnreachableError(
                "this is no http address, or the server sends us to one that is none"
            ) from None
        except aiohttp.TooManyRedirects:
            raise UnreachableError("the server sends us from address to address") from None
        except aiohttp.ClientResponseError as error:
            what = error.message.split("\n")[0].split(": b")[0].rstrip(":")
            raise UnreachableError(f"the server's answer is no HTTP: {what[:80]}") from None
        except aiohttp.ClientConnectorError as error:
            if not self._reached:  # a wrong name is not tried again
                raise
            raise RetryError from error
        except (aiohttp.ClientError, asyncio.IncompleteReadError, TimeoutError) as error:
            raise RetryError from error


def _tag(headers: Any) -> str:
    return str(headers.get("ETag") or headers.get("Last-Modified") or "")


def _stated(answer: Any, start: int, stop: int) -> tuple[int, int]:
    """Total size and number of bytes that the headers of a web server state, validated."""
    headers, status = answer.headers, answer.status
    said = f"the server answers {status} {answer.reason}"
    if _passing(status):
        raise RetryError(said, retry_seconds(headers.get("Retry-After", "")))
    if status == 416 and _NOTHING.fullmatch(headers.get("Content-Range", "")):
        return 0, 0
    if status in (404, 410):
        raise UsageError(said)
    if status not in (200, 206):
        raise UnreachableError(said)
    if headers.get("Content-Encoding", "identity") != "identity":
        raise UnreachableError("the server packs it on the way: download it first")
    if status == 206:
        return _range_of(headers.get("Content-Range", ""), start, stop)
    length = headers.get("Content-Length", "")
    if start or not _LENGTH.fullmatch(length) or int(length) > stop:
        raise UnreachableError(
            "the server sends no parts of a file (range requests): download it first, "
            "or put av: before the address of a camera"
        )
    return int(length), int(length)


class _S3Server(Server):
    """An object of an S3 bucket."""

    def __init__(self, url: Url) -> None:
        super().__init__(url, s3_files())
        self._bucket, self._key, _ = self._files.split_path(url.address)

    async def part(self, start: int, stop: int) -> Part:
        place = {"Bucket": self._bucket, "Key": self._key}
        span = f"bytes={start}-{stop - 1}"
        try:
            answer = await self._files._call_s3("get_object", **place, Range=span)
            total, count = _range_of(answer.get("ContentRange", ""), start, stop)
            data = bytearray()
            async with answer["Body"] as body:
                while len(data) < count and (more := await body.read(count - len(data))):
                    data += more
        except Exception as error:
            if "InvalidRange" in f"{error} {error.__cause__!r}" and not start:
                return Part(b"", 0, "")
            _raise_retry(error)
            raise
        return Part(bytes(data), total, answer.get("ETag", ""))


def connect(url: Url) -> Server:
    """The server of an object.

    Raises:
        CdmisfaError: what reads URLs is not installed.
    """
    return _importing(lambda: _S3Server(url) if url.scheme == "s3" else _HttpServer(url))


def s3_files() -> Any:
    """What s3fs has for buckets; tries are counted and spread by `with_retries` alone."""
    import fsspec

    seconds = limits().read
    settings = {
        "connect_timeout": seconds,
        "read_timeout": seconds,
        "retries": {"total_max_attempts": 1, "mode": "standard"},
    }
    files = fsspec.filesystem("s3", use_listings_cache=False, config_kwargs=settings)
    files.retries = 1
    return files


def ask_s3(url: Url, ask: Callable[[Any], Awaitable[Value]], count: int = 0) -> Value:
    """Call s3fs about a bucket, again after a fault that may pass.

    Args:
        url: what the question is about, for messages.
        ask: asks what s3fs has for buckets.
        count: bytes that are sent with it.

    Raises:
        UsageError: there is no such object or bucket.
        UnreachableError: the server refuses it, or cannot be reached in time.
        CdmisfaError: what reads URLs is not installed.
    """
    files, seconds = _importing(s3_files), limits().of(count)

    async def once() -> Value:
        try:
            return await ask(files)
        except Exception as error:
            _raise_retry(error)
            raise

    asked = asyncio.run_coroutine_threadsafe(with_retries(once, seconds), files.loop)
    return _answer(url, asked, seconds)


def _importing(make: Callable[[], Value]) -> Value:
    try:
        return make()
    except ImportError:
        raise CdmisfaError(
            "reading URLs needs packages that are not installed: pip install 'cdmisfa[cloud]'"
        ) from None


async def with_retries(ask: Callable[[], Awaitable[Value]], seconds: float) -> Value:
    """Ask up to `TRIES` times, with waits between, and no longer than `seconds`.

    Raises:
        UnreachableError: there was none in time.
        RetryError: the last try failed, too.
    """
    clock = asyncio.get_running_loop().time
    end = clock() + seconds
    try:
        async with asyncio.timeout_at(end):
            for attempt in range(TRIES - 1):
                try:
                    return await ask()
                except RetryError as error:
                    wait = max(error.after, backoff(attempt))
                    if clock() + wait >= end:
                        if error.after < wait:
                            raise
                        raise UnreachableError(
                            f"{error} and asks for {error.after:.0f} s, longer than --timeout "
                            f"leaves of {seconds:g} s"
                        ) from error
                await asyncio.sleep(wait)
            return await ask()
    except TimeoutError:
        raise UnreachableError(
            f"the server took longer than {seconds:g} s: raise --timeout, or download it first"
        ) from None


def backoff(attempt: int) -> float:
    """Seconds to wait after so many failed tries (0 the first), with jitter."""
    return FIRST_WAIT * 2.0**attempt * _JITTER.uniform(0.5, 1.0)


def retry_seconds(retry_after: str) -> float:
    """Seconds that a `Retry-After` header asks for: a number or a date; 0 where it is neither."""
    text = retry_after.strip()
    if text.isascii() and text.isdigit():
        return float(text[:12])
    with contextlib.suppress(ValueError, OverflowError):
        return max(parsedate_to_datetime(text).timestamp() - time.time(), 0.0)
    return 0.0


def _passing(status: int) -> bool:
    """Whether a status is of a fault that may pass."""
    return status in (408, 429) or (status >= 500 and status != 501)


def _raise_retry(error: BaseException | None) -> None:
    """Raise `RetryError` for an error of an S3 server that may pass."""
    while error is not None:
        facts = getattr(error, "response", None)
        said = facts.get("ResponseMetadata", {}) if isinstance(facts, dict) else {}
        if _passing(int(said.get("HTTPStatusCode", 0))):
            wait = retry_seconds(str(said.get("HTTPHeaders", {}).get("retry-after", "")))
            raise RetryError(f"the server answers {said['HTTPStatusCode']}", wait) from error
        if type(error).__name__ in _BROKEN_OFF:
            raise RetryError from error
        error = error.__cause__


def _range_of(text: str, start: int, stop: int) -> tuple[int, int]:
    """Total size and bytes of an answer, which must be the part that was asked for."""
    found = _RANGE.fullmatch(text)
    first, last, total = map(int, found.groups()) if found else (-1, -1, -1)
    if first != start or last != min(stop, total) - 1:
        raise RemoteError(
            f"asked for the bytes {start} to {stop - 1}, the server answers {text[:60]!r}"
        )
    return total, last + 1 - first


def _answer(url: Url, coming: Future[Value], seconds: float) -> Value:
    """The result of a request; an error becomes one line that names the URL.

    Raises:
        UsageError: there is no such object.
        RemoteError: it came short, or not as it was said.
        UnreachableError: it did not come.
    """
    try:
        return coming.result(seconds + _SPARE_SECONDS)
    except RetryError as error:
        kind, words = _refusal(error.__cause__ or error)
    except Exception as error:
        kind, words = _refusal(error)
    plain = "".join(letter if letter.isprintable() else "?" for letter in words)
    raise kind(f"{url}: {plain[:300]}")


def _refusal(error: BaseException) -> tuple[type[CdmisfaError], str]:
    """The class and the message of the error to raise for another one."""
    if isinstance(error, CdmisfaError):
        return type(error), str(error)
    if isinstance(error, FileNotFoundError):
        return UsageError, "there is no such object"
    if isinstance(error, asyncio.IncompleteReadError):
        words = f"the server sent {len(error.partial)} bytes of {error.expected} and went away"
        return RemoteError, words
    if "Payload" in type(error).__name__:
        return RemoteError, "the server sent fewer bytes than it said, and went away"
    if isinstance(error, RetryError):
        words = str(error)
    elif type(error).__name__ == "NoCredentialsError":
        words = (
            "no credentials: set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or "
            "FSSPEC_S3_ANON=true for a public bucket"
        )
    elif isinstance(error, PermissionError):
        words = f"the server refuses it ({str(error)[:100]})"
    elif isinstance(error, TimeoutError):
        words = "the server does not answer in time"
    else:
        words = " ".join(f"{type(error).__name__}: {error}".split())[:200]
    return UnreachableError, words
