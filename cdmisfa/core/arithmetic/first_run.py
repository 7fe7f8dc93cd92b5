"""A first run compiles with two processes, where it would wait for one.

Which functions a run calls, with arguments of which types, is in `first_run.json`, what takes
longest first; `python -m tests.first_run` writes it. What it lacks, or has in vain, costs time
alone: a function that is not on disk is compiled when it is called.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from cdmisfa.core.arithmetic.choice import portable_bits
from cdmisfa.core.arithmetic.compiled import before_one_is_compiled, tell_compiling
from cdmisfa.core.arithmetic.kept import example_of, folder_of

LISTED = Path(__file__).with_name("first_run.json")


class _Call(NamedTuple):
    """A function, as "module:name", with the types of its arguments, see `kept.described`."""

    function: str
    types: list[Any]
    portably: bool


@contextmanager
def compiled_by_two(parts: Mapping[str, bool]) -> Iterator[None]:
    """Have all that parts of a run call compiled as soon as one of it is called that is not.

    Args:
        parts: keys of `first_run.json`, others are passed over; and whether in portable arithmetic.
    """
    with before_one_is_compiled(partial(_compile_all, parts)):
        yield


def _compile_all(parts: Mapping[str, bool]) -> None:
    listed = json.loads(LISTED.read_text("utf-8"))
    calls = [
        call
        for part, portably in parts.items()
        for function, types in listed.get(part, ())
        if not _ready(call := _Call(function, types, portably), look=True)
    ]
    if len(calls) < 2 or len(os.sched_getaffinity(0)) < 2 or folder_of(LISTED) is None:
        return
    from cdmisfa.core.processes import Workers  # of no use to later runs

    second = Workers(1)
    try:
        futures = [second.submit(_ready, call) for call in calls[1:]]

        def tell(_: object = None) -> None:
            tell_compiling(sum(one.done() for one in futures), len(calls))

        tell()
        for one in futures:
            one.add_done_callback(tell)
        for call, future in zip(calls, [None, *futures], strict=True):
            if future is None or future.cancel():  # the other has not begun it
                _ready(call)
        for one in futures:
            if not one.cancelled():
                one.exception()
        tell_compiling(len(calls), len(calls))
    except Exception:  # no process can be started here
        return
    finally:
        second.close()


def _ready(call: _Call, *, look: bool = False) -> bool:
    """Whether a function is on disk, once it was compiled unless it is only looked for."""
    module, _, name = call.function.partition(":")
    with portable_bits(call.portably), contextlib.suppress(Exception):
        function = getattr(import_module(module), name).meant
        arguments = tuple(map(example_of, call.types))
        if not look:
            function.ready(arguments)
        return bool(function.on_disk(arguments))
    return True  # there is no such function any more: nothing to compile
