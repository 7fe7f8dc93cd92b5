"""Which arithmetic is meant: the fastest, or the one that every processor does bit for bit.

What differs between processors is written twice, and an `Either` stands for both. Compiled code
that calls one is itself compiled twice, so that runs of both kinds can share a process.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, TypeVar, cast

Function = TypeVar("Function", bound=Callable[..., Any])

_PORTABLE = ContextVar("portable", default=False)


@contextmanager
def portable_bits(wanted: bool = True) -> Iterator[None]:
    """Compute with portable arithmetic, or without, for as long as this lasts."""
    before = _PORTABLE.set(wanted)
    try:
        yield
    finally:
        _PORTABLE.reset(before)


def portable() -> bool:
    """Whether portable arithmetic is meant at the moment."""
    return _PORTABLE.get()


def portable_wanted(of: Any) -> bool:
    """What a learner, or its configuration, says of the arithmetic that it computes with."""
    return bool(getattr(getattr(of, "config", of), "portable", False))


def in_own_arithmetic(function: Function) -> Function:
    """Have a learner's method, or what takes its configuration first, do what `portable` says."""

    @functools.wraps(function)
    def computing(first: Any, *args: Any, **kwargs: Any) -> Any:
        wanted = portable_wanted(first)
        if wanted == _PORTABLE.get():
            return function(first, *args, **kwargs)
        with portable_bits(wanted):
            return function(first, *args, **kwargs)

    return cast(Function, computing)


class Either:
    """A function in two forms: called, or looked at, it is the one that is meant at the moment.

    Args:
        fast: for ordinary arithmetic.
        portable: makes the form for portable arithmetic, when that is first needed.
    """

    def __init__(self, fast: Any, portable: Callable[[], Any]) -> None:
        self._fast = fast
        self._portable = functools.cache(portable)
        functools.update_wrapper(self, fast, updated=())

    @property
    def meant(self) -> Any:
        """The form for the arithmetic of the moment."""
        return self._portable() if portable() else self._fast

    @property
    def _numba_type_(self) -> Any:
        """What compiled code that names this function calls: settled when that is compiled."""
        from numba import typeof

        return typeof(self.meant)  # type: ignore[no-untyped-call]

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Call the form for the arithmetic of the moment."""
        return (self._portable() if _PORTABLE.get() else self._fast)(*args, **kwargs)

    def __getattr__(self, name: str) -> Any:
        """What compilers and tests ask of a compiled function."""
        return getattr(self.meant, name)

    def __reduce__(self) -> tuple[Any, ...]:
        """As the form that is meant: what compiled code on disk is told apart by."""
        return _the_same, (self.meant,)


def _the_same(form: Any) -> Any:
    return form
