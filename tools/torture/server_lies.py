"""Ways in which a server lies, `LIES` by name; see `lying_server`."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from typing import Any

from lying_server import CRLF, FOR_EVER, PIECE, Exchange, Lie

LIES: dict[str, Lie] = {}


def lie(name: str) -> Callable[[Lie], Lie]:
    def known(function: Lie) -> Lie:
        LIES[name] = function
        return function

    return known


def _simple(name: str, answer: Callable[[Exchange], Any]) -> None:
    LIES[name] = answer


# What passes, and what does not

_simple("the truth", lambda x: x.part())
_simple("503 for ever", lambda x: x.refuse("503 Busy"))
_simple("503 twice", lambda x: x.refuse("503 Busy") if x.number < 3 else x.part())
_simple("every second request 500", lambda x: x.refuse("500 No") if x.number % 2 else x.part())
_simple(
    "429 at once again", lambda x: x.part() if x.number > 2 else x.refuse("429 Slow", Retry_After=0)
)
_simple("429 in an hour", lambda x: x.refuse("429 Slow", Retry_After=3600))
_simple("503 next year", lambda x: x.refuse("503 No", Retry_After="Wed, 21 Oct 2099 07:28:00 GMT"))
_simple(
    "503 at no time", lambda x: x.refuse("503 No", Retry_After="soon") if x.number < 2 else x.part()
)
_simple("503 in 10^400 s", lambda x: x.refuse("503 No", Retry_After="9" * 400))
_simple(
    "503 before now", lambda x: x.refuse("503 No", Retry_After="-1") if x.number < 2 else x.part()
)
_simple("503 later on", lambda x: x.refuse("503 No") if x.number > 1 else x.part())
_simple("408 once", lambda x: x.refuse("408 Slow") if x.number < 2 else x.part())
_simple("501", lambda x: x.refuse("501 Not Implemented"))
_simple("403", lambda x: x.refuse("403 Forbidden"))
_simple("401", lambda x: x.refuse("401 Unauthorized", WWW_Authenticate="Basic"))
_simple("404 later on", lambda x: x.refuse("404 Gone") if x.number > 1 else x.part())
_simple("410", lambda x: x.refuse("410 Gone"))
_simple("204", lambda x: x.send(x.head("204 No Content")))
_simple("304", lambda x: x.send(x.head("304 Not Modified")))
_simple("101", lambda x: x.send(x.head("101 Switching Protocols", Upgrade="x")))

# Bodies


@lie("half of a part, then closed")
def _half(x: Exchange) -> None:
    data = x.liar.body[x.start : x.stop]
    head = x.head("206 Part", Content_Range=x.range_of(), Content_Length=len(data), ETag='"1"')
    x.send(head, data[: len(data) // 2])


@lie("half of a part, then reset")
def _half_reset(x: Exchange) -> None:
    _half(x)
    x.reset()


@lie("half of a part once")
def _half_once(x: Exchange) -> None:
    _half(x) if x.number == 2 else x.part()


@lie("every third part reset")
def _third_reset(x: Exchange) -> None:
    _half_reset(x) if x.number % 3 == 0 else x.part()


_simple("closed at once", lambda x: None)
_simple("reset at once", lambda x: x.reset())
_simple("silence", lambda x: x.liar.ended.wait(FOR_EVER))
_simple("a byte in half a second", lambda x: x.trickle(b"HTTP/1.1 206 Part\r\n" + x.liar.body))


@lie("a body a byte in half a second")
def _slow_body(x: Exchange) -> None:
    data = x.liar.body[x.start : x.stop]
    head = x.head("206 Part", Content_Range=x.range_of(), Content_Length=len(data), ETag='"1"')
    x.send(head)
    x.trickle(data)


@lie("a body that stands still")
def _stalled(x: Exchange) -> None:
    _half(x)
    x.liar.ended.wait(FOR_EVER)


@lie("silence later on")
def _silence_later(x: Exchange) -> None:
    x.liar.ended.wait(FOR_EVER) if x.number > 1 else x.part()


@lie("more than was said")
def _more(x: Exchange) -> None:
    x.part()
    x.send(bytes(100_000))


@lie("a part without end")
def _endless(x: Exchange) -> None:
    x.send(x.head("206 Part", Content_Range=x.range_of(), ETag='"1"'))
    x.flood(bytes(PIECE))


@lie("the whole, without end")
def _endless_whole(x: Exchange) -> None:
    x.send(x.head("200 OK"))
    x.flood(bytes(PIECE))


@lie("true chunks")
def _chunks(x: Exchange) -> None:
    data = x.liar.body[x.start : x.stop]
    x.send(x.head("206 Part", Content_Range=x.range_of(), Transfer_Encoding="chunked", ETag='"1"'))
    for at in range(0, len(data), 1000):
        piece = data[at : at + 1000]
        x.send(b"%x\r\n" % len(piece), piece, CRLF)
    x.send(b"0\r\n\r\n")


@lie("chunks without end")
def _chunks_endless(x: Exchange) -> None:
    x.send(x.head("206 Part", Content_Range=x.range_of(), Transfer_Encoding="chunked", ETag='"1"'))
    x.flood(b"1000\r\n" + bytes(0x1000) + CRLF)


@lie("chunks of no size")
def _chunks_odd(x: Exchange) -> None:
    x.send(x.head("206 Part", Content_Range=x.range_of(), Transfer_Encoding="chunked", ETag='"1"'))
    x.send(b"zz\r\nabc\r\n")


@lie("a chunk of 2^70 bytes")
def _chunk_huge(x: Exchange) -> None:
    x.send(x.head("206 Part", Content_Range=x.range_of(), Transfer_Encoding="chunked", ETag='"1"'))
    x.send(b"400000000000000000\r\n", x.liar.body[x.start : x.stop])


@lie("a chunk with an endless word")
def _chunk_word(x: Exchange) -> None:
    x.send(x.head("206 Part", Content_Range=x.range_of(), Transfer_Encoding="chunked", ETag='"1"'))
    x.send(b"10;")
    x.flood(b"a" * PIECE)


@lie("zeros")
def _zeros(x: Exchange) -> None:
    x.part(bytes(len(x.liar.body)))


@lie("a bit of each part flipped")
def _flipped(x: Exchange) -> None:
    data = bytearray(x.liar.body)
    middle = (x.start + x.stop) // 2
    data[min(middle, len(data) - 1)] ^= 1
    x.part(bytes(data))


@lie("bits flipped at random")
def _flipped_randomly(x: Exchange) -> None:
    data = bytearray(x.liar.body)
    data[x.liar.random.randrange(len(data))] ^= 1 << x.liar.random.randrange(8)
    x.part(bytes(data))


# Ranges

_simple(
    "another part", lambda x: x.part(Content_Range=f"bytes {x.start + 1}-{x.stop}/{x.stop + 1}")
)
_simple("bytes one further", lambda x: x.part(b"?" + x.liar.body[:-1]))
_simple("no range said", lambda x: x.part(Content_Range=None))
_simple("a range of words", lambda x: x.part(Content_Range="bytes some-more/all"))
_simple("a range of 30 digits", lambda x: x.part(Content_Range=f"bytes 0-{'9' * 30}/{'9' * 30}"))
_simple("a part below nothing", lambda x: x.part(Content_Range="bytes -5--1/-5"))
_simple("it grows", lambda x: x.part(x.liar.body + bytes(x.number)))
_simple("it shrinks", lambda x: x.part(x.liar.body[: len(x.liar.body) - x.number]))
_simple("416 for ever", lambda x: x.refuse("416 No", Content_Range="bytes */0"))
_simple("10^18 bytes", lambda x: x.part(Content_Range=f"bytes {x.start}-{x.stop - 1}/{10**18}"))
_simple(
    "several parts at once",
    lambda x: x.part(Content_Type="multipart/byteranges", Content_Range=None),
)


@lie("half of it as all of it, in parts")
def _short(x: Exchange) -> None:
    half = x.liar.body[: len(x.liar.body) // 2]
    x.stop = min(x.stop, len(half))
    x.part(half)


@lie("half of it as all of it")
def _short_whole(x: Exchange) -> None:
    half = x.liar.body[: len(x.liar.body) // 2]
    x.send(x.head("200 OK", Content_Length=len(half)), half)


@lie("40 kB of it as all of it")
def _short_beginning(x: Exchange) -> None:
    x.send(x.head("200 OK", Content_Length=40_000), x.liar.body[:40_000])


@lie("less than the whole that was said")
def _short_said(x: Exchange) -> None:
    x.send(x.head("200 OK", Content_Length=50_000), x.liar.body[:20_000])


_simple(
    "always all of it",
    lambda x: x.send(x.head("200 OK", Content_Length=len(x.liar.body)), x.liar.body),
)
_simple("all of it, of no length", lambda x: x.send(x.head("200 OK"), x.liar.body))
_simple("a length of 5,000 digits", lambda x: x.send(x.head("200 OK", Content_Length="9" * 5000)))
_simple(
    "a length below nothing", lambda x: x.send(x.head("200 OK", Content_Length=-1), x.liar.body)
)


@lie("two lengths")
def _two_lengths(x: Exchange) -> None:
    head = x.head("206 Part", Content_Range=x.range_of(), Content_Length=10, ETag='"1"')
    x.send(
        head.replace(b"\r\n\r\n", b"\r\nContent-Length: 20\r\n\r\n"), x.liar.body[x.start : x.stop]
    )


# Another object under the same name

_simple("another tag each time", lambda x: x.part(ETag=f'"{x.number}"'))
_simple("a tag that goes", lambda x: x.part(ETag='"1"' if x.number < 2 else None))
_simple("another date", lambda x: x.part(ETag=None, Last_Modified=f"day {x.number}"))
_simple(
    "replaced", lambda x: x.part(x.liar.other if x.number > 1 else None, ETag=f'"{x.number > 1}"')
)
_simple("replaced in silence", lambda x: x.part(x.liar.other if x.number > 1 else None))
_simple("replaced later in silence", lambda x: x.part(x.liar.other if x.number > 3 else None))
_simple("two by turns", lambda x: x.part(x.liar.other if x.number % 2 else None))

# Other addresses

_simple("to itself", lambda x: x.refuse("302 There", Location=x.path))
_simple("to a longer one each time", lambda x: x.refuse("302 There", Location=f"{x.path}x"))
_simple("to a file", lambda x: x.refuse("302 There", Location="file:///etc/passwd"))
_simple("to ftp", lambda x: x.refuse("302 There", Location="ftp://127.0.0.1/a.mcap"))
_simple("to a script", lambda x: x.refuse("302 There", Location="javascript:alert(1)"))
_simple("to nowhere", lambda x: x.refuse("302 There"))
_simple("to nobody", lambda x: x.refuse("302 There", Location="http://127.0.0.1:9/a.mcap"))
_simple("to no address", lambda x: x.refuse("302 There", Location="http://[::1/a"))
_simple("to no port", lambda x: x.refuse("302 There", Location="http://127.0.0.1:99999/a.mcap"))
_simple(
    "to the right place",
    lambda x: x.part() if "moved" in x.path else x.refuse("307 There", Location="/moved.mcap"),
)

# Packed


@lie("packed")
def _packed(x: Exchange) -> None:
    data = gzip.compress(x.liar.body[x.start : x.stop])
    said = x.head("206 Part", Content_Range=x.range_of(), Content_Encoding="gzip", ETag='"1"')
    x.send(said, data)


_simple("said to be packed", lambda x: x.part(Content_Encoding="gzip"))
_simple("packed by a stranger", lambda x: x.part(Content_Encoding="deflate, br, x"))
_simple("packed chunks", lambda x: x.part(Transfer_Encoding="gzip, chunked"))

# Heads

_simple("a header of 1 MB", lambda x: x.part(X_Long="a" * 1_000_000))
_simple("a header without end", lambda x: (x.send(b"HTTP/1.1 206 P\r\nX: "), x.flood(b"a" * PIECE)))
_simple(
    "headers without end", lambda x: (x.send(b"HTTP/1.1 206 P\r\n"), x.flood(b"X-Y: z\r\n" * 8000))
)
_simple("50,000 headers", lambda x: x.send(b"HTTP/1.1 206 P\r\n" + b"X-Y: z\r\n" * 50_000 + CRLF))
_simple("a header of no colon", lambda x: x.send(b"HTTP/1.1 206 P\r\nnothing\r\n\r\n"))
_simple("a header with zeros", lambda x: x.send(b"HTTP/1.1 206 P\r\nX: \0\0\r\n\r\n"))
_simple("a reason for the terminal", lambda x: x.refuse("403 \x1b[2J\x1b]0;owned\x07"))
_simple("a reason of 100 kB", lambda x: x.refuse(f"403 {'no ' * 33_000}"))
_simple("a status of words", lambda x: x.send(b"HTTP/1.1 fine\r\n\r\n"))
_simple("a version to come", lambda x: x.send(b"HTTP/9.9 206 P\r\n\r\n"))
_simple("no head", lambda x: x.send(x.liar.body[x.start : x.stop]))
_simple("noise", lambda x: x.send(x.liar.random.randbytes(5000)))
_simple("a greeting of TLS", lambda x: x.send(bytes.fromhex("16030100fa010000f60303") + bytes(240)))
_simple("another protocol", lambda x: x.send(b"SSH-2.0-OpenSSH_9.9\r\n"))
_simple("go on, for ever", lambda x: x.flood(b"HTTP/1.1 100 Continue\r\n\r\n" * 1000))
_simple(
    "1,000 cookies", lambda x: x.send(b"HTTP/1.1 206 P\r\n" + b"Set-Cookie: a=b\r\n" * 1000 + CRLF)
)
