"""Compiling hot functions with numba, and nothing about what they do."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from types import FunctionType
from typing import Any, TypeVar, cast

import numba
from numba.core import event
from numba.extending import overload

from cdmisfa.core.arithmetic.choice import Either, portable
from cdmisfa.core.arithmetic.kept import kept_while_sources_last

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """Compile strictly (no reordering of floating point) and keep the result on disk."""
    return _compile(function)


def inlined(function: Function) -> Function:
    """Compile strictly, into every function that calls it: for the small ones of a hot loop."""
    return _compile(function, forceinline=True)


def spliced(function: Function) -> Function:
    """Write a function's body into the compiled ones that call it, and compile it with them."""
    return _compile(function, inline="always")


def reordered(function: Function) -> Function:
    """Compile with sums in whichever order is fastest on this processor, and keep the result.

    One machine gives the same bits every time; other processors may differ in the last ones,
    but not where `portable_bits` are asked for: then sums are in the order in which they stand.
    """
    return _compile(function, fastmath={"reassoc", "contract"})


def in_compiled_code(function: Callable[..., Any]) -> Callable[[Function], Function]:
    """Say what compiled code does where it calls a plain function.

    The decorated function gets the types of the arguments, and returns the function to compile
    for them, or None where it has none.
    """
    return cast(Callable[[Function], Function], overload(function, strict=False, inline="always"))


def _compile(function: Function, **options: Any) -> Function:
    options["error_model"] = "numpy"  # no test at every division whether an error is to be raised
    options["no_cfunc_wrapper"] = True  # for callers in C, of which there are none
    return cast(Function, _Compiled(function, options))


class _Compiled(Either):
    """A compiled function in both forms of arithmetic, for Python, and apart for compiled callers.

    What Python needs to call it, and they do not, is a quarter of what compiling takes.
    """

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        strict = {name: value for name, value in options.items() if name != "fastmath"}
        bare = {"no_cpython_wrapper": True}
        super().__init__(
            _jit(function, options), lambda: _jit(_named_apart(function, "portable"), strict)
        )
        self._within = (
            cache(lambda: _jit(_named_apart(function, "within"), options | bare)),
            cache(lambda: _jit(_named_apart(function, "portable_within"), strict | bare)),
        )

    @property
    def _numba_type_(self) -> Any:
        """The form for compiled code; see `Either`."""
        return numba.typeof(self._within[portable()]())  # type: ignore[no-untyped-call]


def _jit(function: Callable[..., Any], options: Mapping[str, Any]) -> Any:
    try:
        return kept_while_sources_last(numba.njit(cache=True, **options)(function))
    except RuntimeError:  # numba found no folder that it may write to
        return numba.njit(**options)(function)


def _named_apart(function: Callable[..., Any], form: str) -> Callable[..., Any]:
    """The same function under a name that leads to files and symbols of its own."""
    code = function.__code__
    copy = FunctionType(
        code, function.__globals__, function.__name__, function.__defaults__, function.__closure__
    )
    copy.__qualname__ = f"{function.__qualname__}_{form}"
    copy.__module__ = function.__module__
    return copy


class _OnFirst(event.Listener):
    """Calls a function when the first of some events begins."""

    def __init__(self, tell: Callable[[], None]) -> None:
        self._tell: Callable[[], None] | None = tell

    def on_start(self, event: Any) -> None:
        if self._tell is not None:
            tell, self._tell = self._tell, None
            tell()

    def on_end(self, event: Any) -> None:
        """Nothing."""


@contextmanager
def before_compiling(tell: Callable[[], None]) -> Iterator[None]:
    """Call a function once, as soon as something is compiled that is not on disk yet."""
    with event.install_listener("numba:compile", _OnFirst(tell)):
        yield
