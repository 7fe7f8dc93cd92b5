"""Ways in which a server lies, `LIES` by name; see `lying_server`."""

from __future__ import annotations

import gzip

from lying_server import CRLF, FOR_EVER, PIECE, Exchange, Lie


def _asked(x: Exchange) -> bytes:
    return x.liar.body[x.start : x.stop]


def _begin(x: Exchange, *parts: bytes, **headers: object) -> None:
    """Send a head as that of the true answer, with other headers, and what comes behind it."""
    x.send(x.head("206 Part", Content_Range=x.range_of(), ETag='"1"', **headers), *parts)


def _chunked(x: Exchange, *parts: bytes) -> None:
    _begin(x, *parts, Transfer_Encoding="chunked")


def _half(x: Exchange) -> None:
    data = _asked(x)
    _begin(x, data[: len(data) // 2], Content_Length=len(data))


def _half_reset(x: Exchange) -> None:
    _half(x)
    x.reset()


def _chunks(x: Exchange) -> None:
    data = _asked(x)
    pieces = (data[at : at + 1000] for at in range(0, len(data), 1000))
    _chunked(x, *(b"%x\r\n%b\r\n" % (len(piece), piece) for piece in pieces), b"0\r\n\r\n")


def _flipped(x: Exchange, at: int, bit: int) -> None:
    data = bytearray(x.liar.body)
    data[min(at, len(data) - 1)] ^= 1 << bit
    x.part(bytes(data))


def _first_half(x: Exchange) -> bytes:
    """Half of the object."""
    return x.liar.body[: len(x.liar.body) // 2]


def _short(x: Exchange) -> None:
    x.stop = min(x.stop, len(_first_half(x)))
    x.part(_first_half(x))


def _whole(x: Exchange, data: bytes, length: object = None) -> None:
    said = {} if length is None else {"Content_Length": length}
    x.send(x.head("200 OK", **said), data)


def _two_lengths(x: Exchange) -> None:
    head = x.head("206 Part", Content_Range=x.range_of(), Content_Length=10, ETag='"1"')
    x.send(head.replace(b"\r\n\r\n", b"\r\nContent-Length: 20\r\n\r\n"), _asked(x))


LIES: dict[str, Lie] = {
    # What passes, and what does not
    "the truth": lambda x: x.part(),
    "503 for ever": lambda x: x.refuse("503 Busy"),
    "503 twice": lambda x: x.refuse("503 Busy") if x.number < 3 else x.part(),
    "every second request 500": lambda x: x.refuse("500 No") if x.number % 2 else x.part(),
    "429 at once again": lambda x: (
        x.part() if x.number > 2 else x.refuse("429 Slow", Retry_After=0)
    ),
    "429 in an hour": lambda x: x.refuse("429 Slow", Retry_After=3600),
    "503 next year": lambda x: x.refuse("503 No", Retry_After="Wed, 21 Oct 2099 07:28:00 GMT"),
    "503 at no time": lambda x: (
        x.refuse("503 No", Retry_After="soon") if x.number < 2 else x.part()
    ),
    "503 in 10^400 s": lambda x: x.refuse("503 No", Retry_After="9" * 400),
    "503 before now": lambda x: x.refuse("503 No", Retry_After="-1") if x.number < 2 else x.part(),
    "503 later on": lambda x: x.refuse("503 No") if x.number > 1 else x.part(),
    "408 once": lambda x: x.refuse("408 Slow") if x.number < 2 else x.part(),
    "501": lambda x: x.refuse("501 Not Implemented"),
    "403": lambda x: x.refuse("403 Forbidden"),
    "401": lambda x: x.refuse("401 Unauthorized", WWW_Authenticate="Basic"),
    "404 later on": lambda x: x.refuse("404 Gone") if x.number > 1 else x.part(),
    "410": lambda x: x.refuse("410 Gone"),
    "204": lambda x: x.send(x.head("204 No Content")),
    "304": lambda x: x.send(x.head("304 Not Modified")),
    "101": lambda x: x.send(x.head("101 Switching Protocols", Upgrade="x")),
    # Bodies
    "half of a part, then closed": _half,
    "half of a part, then reset": _half_reset,
    "half of a part once": lambda x: _half(x) if x.number == 2 else x.part(),
    "every third part reset": lambda x: _half_reset(x) if x.number % 3 == 0 else x.part(),
    "closed at once": lambda x: None,
    "reset at once": lambda x: x.reset(),
    "silence": lambda x: x.liar.ended.wait(FOR_EVER),
    "a byte in half a second": lambda x: x.trickle(b"HTTP/1.1 206 Part\r\n" + x.liar.body),
    "a body a byte in half a second": lambda x: (
        _begin(x, Content_Length=len(_asked(x))),
        x.trickle(_asked(x)),
    ),
    "a body that stands still": lambda x: (_half(x), x.liar.ended.wait(FOR_EVER)),
    "silence later on": lambda x: x.liar.ended.wait(FOR_EVER) if x.number > 1 else x.part(),
    "more than was said": lambda x: (x.part(), x.send(bytes(100_000))),
    "a part without end": lambda x: (_begin(x), x.flood(bytes(PIECE))),
    "the whole, without end": lambda x: (x.send(x.head("200 OK")), x.flood(bytes(PIECE))),
    "true chunks": _chunks,
    "chunks without end": lambda x: (_chunked(x), x.flood(b"1000\r\n" + bytes(0x1000) + CRLF)),
    "chunks of no size": lambda x: _chunked(x, b"zz\r\nabc\r\n"),
    "a chunk of 2^70 bytes": lambda x: _chunked(x, b"400000000000000000\r\n", _asked(x)),
    "a chunk with an endless word": lambda x: (_chunked(x, b"10;"), x.flood(b"a" * PIECE)),
    "zeros": lambda x: x.part(bytes(len(x.liar.body))),
    "a bit of each part flipped": lambda x: _flipped(x, (x.start + x.stop) // 2, 0),
    "bits flipped at random": lambda x: _flipped(
        x, x.liar.random.randrange(len(x.liar.body)), x.liar.random.randrange(8)
    ),
    # Ranges
    "another part": lambda x: x.part(Content_Range=f"bytes {x.start + 1}-{x.stop}/{x.stop + 1}"),
    "bytes one further": lambda x: x.part(b"?" + x.liar.body[:-1]),
    "no range said": lambda x: x.part(Content_Range=None),
    "a range of words": lambda x: x.part(Content_Range="bytes some-more/all"),
    "a range of 30 digits": lambda x: x.part(Content_Range=f"bytes 0-{'9' * 30}/{'9' * 30}"),
    "a part below nothing": lambda x: x.part(Content_Range="bytes -5--1/-5"),
    "it grows": lambda x: x.part(x.liar.body + bytes(x.number)),
    "it shrinks": lambda x: x.part(x.liar.body[: len(x.liar.body) - x.number]),
    "416 for ever": lambda x: x.refuse("416 No", Content_Range="bytes */0"),
    "10^18 bytes": lambda x: x.part(Content_Range=f"bytes {x.start}-{x.stop - 1}/{10**18}"),
    "several parts at once": lambda x: x.part(
        Content_Type="multipart/byteranges", Content_Range=None
    ),
    "half of it as all of it, in parts": _short,
    "half of it as all of it": lambda x: _whole(x, _first_half(x), len(_first_half(x))),
    "40 kB of it as all of it": lambda x: _whole(x, x.liar.body[:40_000], 40_000),
    "less than the whole that was said": lambda x: _whole(x, x.liar.body[:20_000], 50_000),
    "always all of it": lambda x: _whole(x, x.liar.body, len(x.liar.body)),
    "all of it, of no length": lambda x: _whole(x, x.liar.body),
    "a length of 5,000 digits": lambda x: _whole(x, b"", "9" * 5000),
    "a length below nothing": lambda x: _whole(x, x.liar.body, -1),
    "two lengths": _two_lengths,
    # Another object under the same name
    "another tag each time": lambda x: x.part(ETag=f'"{x.number}"'),
    "a tag that goes": lambda x: x.part(ETag='"1"' if x.number < 2 else None),
    "another date": lambda x: x.part(ETag=None, Last_Modified=f"day {x.number}"),
    "replaced": lambda x: x.part(x.liar.other if x.number > 1 else None, ETag=f'"{x.number > 1}"'),
    "replaced in silence": lambda x: x.part(x.liar.other if x.number > 1 else None),
    "replaced later in silence": lambda x: x.part(x.liar.other if x.number > 3 else None),
    "two by turns": lambda x: x.part(x.liar.other if x.number % 2 else None),
    # Other addresses
    "to itself": lambda x: x.refuse("302 There", Location=x.path),
    "to a longer one each time": lambda x: x.refuse("302 There", Location=f"{x.path}x"),
    "to a file": lambda x: x.refuse("302 There", Location="file:///etc/passwd"),
    "to ftp": lambda x: x.refuse("302 There", Location="ftp://127.0.0.1/a.mcap"),
    "to a script": lambda x: x.refuse("302 There", Location="javascript:alert(1)"),
    "to nowhere": lambda x: x.refuse("302 There"),
    "to nobody": lambda x: x.refuse("302 There", Location="http://127.0.0.1:9/a.mcap"),
    "to no address": lambda x: x.refuse("302 There", Location="http://[::1/a"),
    "to no port": lambda x: x.refuse("302 There", Location="http://127.0.0.1:99999/a.mcap"),
    "to the right place": lambda x: (
        x.part() if "moved" in x.path else x.refuse("307 There", Location="/moved.mcap")
    ),
    # Packed
    "packed": lambda x: _begin(x, gzip.compress(_asked(x)), Content_Encoding="gzip"),
    "said to be packed": lambda x: x.part(Content_Encoding="gzip"),
    "packed by a stranger": lambda x: x.part(Content_Encoding="deflate, br, x"),
    "packed chunks": lambda x: x.part(Transfer_Encoding="gzip, chunked"),
    # Heads
    "a header of 1 MB": lambda x: x.part(X_Long="a" * 1_000_000),
    "a header without end": lambda x: (x.send(b"HTTP/1.1 206 P\r\nX: "), x.flood(b"a" * PIECE)),
    "headers without end": lambda x: (x.send(b"HTTP/1.1 206 P\r\n"), x.flood(b"X-Y: z\r\n" * 8000)),
    "50,000 headers": lambda x: x.send(b"HTTP/1.1 206 P\r\n" + b"X-Y: z\r\n" * 50_000 + CRLF),
    "a header of no colon": lambda x: x.send(b"HTTP/1.1 206 P\r\nnothing\r\n\r\n"),
    "a header with zeros": lambda x: x.send(b"HTTP/1.1 206 P\r\nX: \0\0\r\n\r\n"),
    "a reason for the terminal": lambda x: x.refuse("403 \x1b[2J\x1b]0;owned\x07"),
    "a reason of 100 kB": lambda x: x.refuse(f"403 {'no ' * 33_000}"),
    "a status of words": lambda x: x.send(b"HTTP/1.1 fine\r\n\r\n"),
    "a version to come": lambda x: x.send(b"HTTP/9.9 206 P\r\n\r\n"),
    "no head": lambda x: x.send(_asked(x)),
    "noise": lambda x: x.send(x.liar.random.randbytes(5000)),
    "a greeting of TLS": lambda x: x.send(bytes.fromhex("16030100fa010000f60303") + bytes(240)),
    "another protocol": lambda x: x.send(b"SSH-2.0-OpenSSH_9.9\r\n"),
    "go on, for ever": lambda x: x.flood(b"HTTP/1.1 100 Continue\r\n\r\n" * 1000),
    "1,000 cookies": lambda x: x.send(b"HTTP/1.1 206 P\r\n" + b"Set-Cookie: a=b\r\n" * 1000 + CRLF),
}
