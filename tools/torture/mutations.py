"""Damage files in ways that disks, interruptions and attackers do."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from random import Random

PAGES = (64, 512, 4096)
WORDS = (b"", b"-1", b"9" * 400, b"1e999", b"NaN", b"[" * 3000, b"null", b'"', b"{}", b"\xff\xfe")
"""Replacements within a text."""


def flipped(rng: Random, data: bytearray) -> None:
    """Flip some bits."""
    for _ in range(rng.choice((1, 1, 1, 2, 8, 64))):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def cut_off(rng: Random, data: bytearray) -> None:
    """Cut the end off, as a full disk does."""
    del data[rng.randrange(len(data)) :]


def zeroed(rng: Random, data: bytearray) -> None:
    """Zero a page, as a power cut does."""
    size = rng.choice(PAGES)
    start = rng.randrange(len(data)) // size * size
    data[start : start + size] = bytes(len(data[start : start + size]))


def spliced(rng: Random, data: bytearray) -> None:
    """Overwrite a piece by another one."""
    size = rng.randint(1, max(1, min(4096, len(data) // 2)))
    source, target = (rng.randrange(len(data) - size + 1) for _ in range(2))
    data[target : target + size] = data[source : source + size]


def doubled(rng: Random, data: bytearray) -> None:
    """Repeat a piece, or everything."""
    start = rng.choice((0, rng.randrange(len(data))))
    stop = rng.choice((len(data), rng.randint(start, len(data))))
    data[stop:stop] = data[start:stop]


def left_out(rng: Random, data: bytearray) -> None:
    """Remove a piece."""
    start = rng.randrange(len(data))
    del data[start : start + rng.randint(1, 4096)]


def noise(rng: Random, data: bytearray) -> None:
    """Overwrite a piece by random bytes."""
    start = rng.randrange(len(data))
    size = rng.randint(1, 256)
    data[start : start + size] = rng.randbytes(min(size, len(data) - start))


def worded(rng: Random, data: bytearray) -> None:
    """Overwrite a piece by a word of `WORDS`."""
    start = rng.randrange(len(data))
    data[start : start + rng.randint(0, 12)] = rng.choice(WORDS)


def numbers(rng: Random, data: bytearray) -> None:
    """Overwrite a number by a huge, small or negative one."""
    width = rng.choice((2, 4, 8))
    value = rng.choice((0, 1, 2**31 - 1, 2**32 - 1, 2**62, 2**63 - 1, 2**64 - 1))
    start = rng.randrange(len(data))
    raw = (value % 256**width).to_bytes(width, rng.choice(("little", "big")))
    data[start : start + width] = raw[: len(data) - start]


BYTES: tuple[Callable[[Random, bytearray], None], ...] = (
    *(flipped, flipped, cut_off, zeroed, spliced, doubled, left_out, noise, numbers),
)
TEXT = (*BYTES, worded, worded, worded, worded)


def damage(rng: Random, files: Sequence[Path]) -> str:
    """Damage one of the files; return what was done to it."""
    path = rng.choice(files)
    if (chance := rng.random()) < 0.01:
        path.write_bytes(b"")
        return f"{path.name} emptied"
    if chance < 0.02:
        path.write_bytes(rng.choice(files).read_bytes())
        return f"{path.name} replaced by another"
    data = bytearray(path.read_bytes())
    is_text = path.suffix in (".json", ".toml", ".jsonl")
    done = []
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        if data:
            how = rng.choice(TEXT if is_text else BYTES)
            how(rng, data)
            done.append(how.__name__)
    path.write_bytes(data)
    return f"{path.name} {', '.join(done)}"
