"""Fuzz decoders, guided by the ways that inputs take through our code.

    python -m tools.fuzz.guided --seconds 60 [DECODER ...]

An input that takes a new way is kept for this run and changed further. An input that breaks
something is stored in tools/fuzz/cases, which the tests read.
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

OURS = tuple(str(logs.ROOT / package) for package in ("cdmisfa", "recorder", "replay"))
HANGS = 30
"""Seconds after which an input that hangs is ended; counting lines makes it slow."""

Ways = set[tuple[Any, int, int]]
"""Code, and two lines of it that ran one after the other."""


@contextlib.contextmanager
def watched(ways: Ways, ours: tuple[str, ...]) -> Iterator[None]:
    """Note the ways through code in files that begin with one of `ours`."""

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
) -> Iterator[tuple[bytes, Exception | None]]:
    """Yield inputs without end, first those of the corpus, each with the exception that escaped."""
    seen: Ways = set()
    first = list(corpus)
    while True:
        is_first = bool(first)
        if is_first:
            data = first.pop(0)
        else:
            recent = corpus[-8:] if rng.random() < 0.3 else corpus
            data = decoders.mutated(rng, rng.choice(recent), rng.choice(corpus), text=text)
        ways: Ways = set()
        broke = None
        try:
            with watched(ways, ours):
                check(data)
        except Exception as error:
            broke = error
        if not ways <= seen and not is_first and broke is None:
            corpus.append(data)
        seen |= ways
        yield data, broke


def hunt(name: str, seconds: float, now: Path) -> int:
    """Fuzz a decoder for a while; return how many kinds of defects were found.

    Args:
        name: of the decoder.
        seconds: to spend.
        now: file of the input that is being decoded, for when the process does not survive it.
    """

    def too_long(*_: object) -> None:
        raise BrokenPromise(f"it took more than {HANGS} s")

    signal.signal(signal.SIGALRM, too_long)
    corpus, number, kinds = list(decoders.seeds(name)), 0, set[str]()
    with tempfile.TemporaryDirectory() as folder:

        def check(data: bytes) -> None:
            now.write_bytes(data)
            signal.alarm(HANGS)
            try:
                decoders.check(name, data, Path(folder) / "case")
            finally:
                signal.alarm(0)

        end = time.monotonic() + seconds
        cases = guided(check, corpus, Random(name), text=decoders.DECODERS[name].text)
        for number, (data, broke) in enumerate(cases, 1):  # noqa: B007 - printed at the end
            if broke is not None:
                last = traceback.extract_tb(broke.__traceback__)[-1]
                kind = f"{type(broke).__name__} at {Path(last.filename).name}:{last.lineno}"
                if kind not in kinds:
                    kinds.add(kind)
                    print(f"{name}: {kind}: {broke}; stored {keep(name, data)}", flush=True)
            if time.monotonic() > end:
                break
    print(f"{name}: {number} inputs, {len(corpus)} ways, {len(kinds)} defects", flush=True)
    return len(kinds)


def keep(name: str, data: bytes) -> Path:
    """Store an input for the tests."""
    path = logs.KEPT / name.replace(" ", "-") / hashlib.sha256(data).hexdigest()[:10]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return path


def _in_child(name: str, seconds: float, now: Path) -> None:
    code = hunt(name, seconds, now)
    sys.stdout.flush()
    os._exit(min(code, 100))


def main(arguments: Sequence[str] | None = None) -> int:
    """Fuzz each decoder in a process of its own, which a library may end; 1 for defects."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("decoders", nargs="*", metavar="DECODER", help="by default all")
    parser.add_argument("--seconds", type=float, default=60, help="for each")
    chosen = parser.parse_args(arguments)
    defects = 0
    with tempfile.TemporaryDirectory() as folder:
        now = Path(folder) / "now"
        for name in chosen.decoders or decoders.DECODERS:
            process = multiprocessing.get_context("fork").Process(
                target=_in_child, args=(name, chosen.seconds, now)
            )
            process.start()
            process.join()
            defects += abs(code := process.exitcode or 0)
            if code < 0:
                end, path = signal.Signals(-code).name, keep(name, now.read_bytes())
                print(f"{name}: ended by {end}; stored {path}")
    return int(defects > 0)


if __name__ == "__main__":
    sys.exit(main())
