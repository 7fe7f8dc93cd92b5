"""Change what is decoded, guided by the ways that it takes through our code.

    python -m tools.fuzz.guided --seconds 60 [DECODER ...]

An input that takes a way which none has taken is kept in build/fuzz/corpus, and changed further,
in the next run, too. What breaks something is kept in tools/fuzz/cases, and the tests read it
from then on. `decoders` says what is decoded.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import multiprocessing
import os
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from random import Random
from types import FrameType
from typing import Any

from . import decoders, logs
from .oracle import BrokenPromise

CORPUS = logs.STATE / "corpus"
OURS = tuple(str(logs.ROOT / room) for room in ("cdmisfa", "recorder", "replay"))
HANGS = 30
"""Seconds after which one that does not end is ended, while lines are counted."""

Ways = set[tuple[Any, int, int]]
"""Code, and lines of it that came one after the other."""


@contextlib.contextmanager
def watched(ways: Ways, ours: tuple[str, ...]) -> Iterator[None]:
    """Note the ways that are taken through code whose files begin so."""

    def entered(frame: FrameType, event: str, argument: object) -> Callable[..., Any] | None:
        code = frame.f_code
        if not code.co_filename.startswith(ours):
            return None
        last = 0

        def line(frame: FrameType, event: str, argument: object) -> Any:
            nonlocal last
            if event == "line":
                ways.add((code, last, frame.f_lineno))
                last = frame.f_lineno
            return line

        return line

    before = sys.gettrace()
    sys.settrace(entered)
    try:
        yield
    finally:
        sys.settrace(before)


def guided(
    check: Callable[[bytes], None],
    corpus: list[bytes],
    rng: Random,
    *,
    text: bool,
    ours: tuple[str, ...] = OURS,
) -> Iterator[tuple[bytes, bool, Exception | None]]:
    """Inputs without end, those of the corpus first: each, whether its way is new, what it broke.

    Args:
        check: raises what escapes.
        corpus: what is changed further; what takes a new way is added.
        rng: all that is random.
        text: whether inputs are of words.
        ours: how the files of the code begin in which ways count.
    """
    seen: Ways = set()
    first = list(corpus)
    while True:
        data = first.pop(0) if first else b""
        is_first = bool(data)
        if not is_first:
            recent = corpus[-8:] if rng.random() < 0.3 else corpus
            data = decoders.mutated(rng, rng.choice(recent), rng.choice(corpus), text=text)
        ways: Ways = set()
        broke = None
        try:
            with watched(ways, ours):
                check(data)
        except Exception as error:
            broke = error
        is_new = not ways <= seen
        seen |= ways
        if is_new and not is_first and broke is None:
            corpus.append(data)
        yield data, is_new and not is_first, broke


def _too_long(*_: object) -> None:
    raise BrokenPromise(f"it took more than {HANGS} s")


def hunt(name: str, seconds: float) -> int:
    """Change inputs of a decoder for a while; how many were found that break something."""
    place = CORPUS / name.replace(" ", "-")
    place.mkdir(parents=True, exist_ok=True)
    kept = [path.read_bytes() for path in sorted(place.iterdir())]
    corpus = [*decoders.seeds(name), *kept]
    signal.signal(signal.SIGALRM, _too_long)
    found, number, told = 0, 0, set[str]()
    with tempfile.TemporaryDirectory(dir=logs.memory_folder()) as temporary:
        folder = Path(temporary) / "case"

        def check(data: bytes) -> None:
            _now(name).write_bytes(data)
            signal.alarm(HANGS)
            try:
                decoders.check(name, data, folder)
            finally:
                signal.alarm(0)

        rng = Random(f"{name} {len(kept)}")
        cases = guided(check, corpus, rng, text=decoders.DECODERS[name].text)
        end = time.monotonic() + seconds
        for number, (data, is_new, broke) in enumerate(cases):  # noqa: B007 - told at the end
            if is_new:
                (place / hashlib.sha256(data).hexdigest()[:16]).write_bytes(data)
            if broke is not None:
                last = traceback.extract_tb(broke.__traceback__)[-1]
                what = f"{type(broke).__name__} at {Path(last.filename).name}:{last.lineno}"
                if what not in told:
                    told.add(what)
                    found += 1
                    print(f"{name}: {what}: {broke}; kept {keep(name, data)}", flush=True)
            if time.monotonic() > end:
                break
    print(f"{name}: {number + 1} inputs, {len(corpus)} ways, {found} found", flush=True)
    return found


def _now(name: str) -> Path:
    """The input that is being decoded, for when the process does not survive it."""
    return logs.STATE / f"{name}.now".replace("/", "-")


def keep(name: str, data: bytes) -> Path:
    """Store an input that broke something for the tests to read."""
    place = logs.KEPT / name.replace(" ", "-")
    place.mkdir(parents=True, exist_ok=True)
    path = place / hashlib.sha256(data).hexdigest()[:10]
    path.write_bytes(data)
    return path


def _ended(name: str, seconds: float) -> int:
    """Hunt in a process of its own, as a library may end it, and its memory is its own."""
    process = multiprocessing.get_context("fork").Process(target=_child, args=(name, seconds))
    process.start()
    process.join()
    code = process.exitcode or 0
    if code < 0:
        data = _now(name).read_bytes()
        print(f"{name}: ended by {signal.Signals(-code).name}; kept {keep(name, data)}")
    return abs(code)


def _child(name: str, seconds: float) -> None:
    found = hunt(name, seconds)
    sys.stdout.flush()
    os._exit(min(found, 100))


def main(arguments: Sequence[str] | None = None) -> int:
    """Hunt in each decoder; 1 when something was found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("decoders", nargs="*", metavar="DECODER", help="by default all")
    parser.add_argument("--seconds", type=float, default=60, help="of each")
    chosen = parser.parse_args(arguments)
    names = chosen.decoders or decoders.available()
    found = sum(_ended(name, chosen.seconds) for name in names)
    print(f"{len(names)} decoders, {found} found")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
