"""Compiling hot functions with numba, and nothing about what they do."""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from functools import cache, cached_property, update_wrapper
from pathlib import Path
from types import FunctionType
from typing import Any, TypeVar, cast

import numpy as np

from cdmisfa.core.arithmetic.choice import Either, portable
from cdmisfa.core.arithmetic.kept import (
    described,
    keep,
    kept_while_sources_last,
    recalled,
    runs_alone,
)
from cdmisfa.core.arithmetic.machine_code import LOADING, fingerprint, loaded, machine_code

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

    def said(compiled_for: Function) -> Function:
        def prepare() -> None:
            from numba.extending import overload

            overload(function, strict=False, inline="always")(compiled_for)

        before_the_first(prepare)
        return compiled_for

    return said


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
            _ForPython(function, options),
            lambda: _ForPython(_named_apart(function, "portable"), strict),
        )
        self._within = (
            cache(lambda: _jit(_named_apart(function, "within"), options | bare)),
            cache(lambda: _jit(_named_apart(function, "portable_within"), strict | bare)),
        )

    @property
    def _numba_type_(self) -> Any:
        """The form for compiled code; see `Either`."""
        from numba import typeof

        return typeof(self._within[portable()]())  # type: ignore[no-untyped-call]


class _ForPython:
    """One form of a compiled function: from disk if it is there, without the compiler."""

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        self._function, self._options = function, options
        self._codes: dict[bytes, Callable[..., Any]] = {}
        self._types: Callable[[tuple[Any, ...]], bytes] = _unseen
        self._source = Path(function.__code__.co_filename)
        update_wrapper(self, function, updated=())

    @cached_property
    def _dispatcher(self) -> Any:
        if runs_alone():
            return compiler().njit(**self._options)(self._function)
        return _jit(self._function, self._options)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Run the machine code for arguments of these types."""
        if kwargs:
            return self._dispatcher(*args, **kwargs)
        for value in args:  # the fingerprint of an array is that of one in another byte order
            if isinstance(value, np.ndarray) and not value.dtype.isnative:
                return self._dispatcher(*args)
        try:
            code = self._codes[self._types(args)]
        except (LookupError, NotImplementedError):
            code = self._first(args)
        return code(*args)

    def __getattr__(self, name: str) -> Any:
        """What compilers and tests ask of a compiled function."""
        return getattr(self._dispatcher, name)

    def __reduce__(self) -> Any:
        """As the compiler tells it apart."""
        return self._dispatcher.__reduce__()

    def _first(self, args: tuple[Any, ...]) -> Callable[..., Any]:
        """What runs arguments of these types from now on."""
        code = None
        with contextlib.suppress(LookupError):
            name = self._name(args)
            if runs_alone():
                code = self._from_disk(name)
                with nullcontext() if code else _compiling():
                    if code is None and _others_compiled():
                        code = self._from_disk(name)
                    code = code or self._compiled(name, args)
        if code is None:
            return cast(Callable[..., Any], self._dispatcher)
        with contextlib.suppress(Exception):
            self._types = fingerprint()
            self._codes[self._types(args)] = code
        return code

    def ready(self, args: tuple[Any, ...]) -> None:
        """Have it compiled for arguments of these types, and on disk, without calling it."""
        if not self.on_disk(args):
            self._compiled(self._name(args), args)

    def on_disk(self, args: tuple[Any, ...]) -> bool:
        """Whether that is so, or cannot be."""
        try:
            return not runs_alone() or recalled(self._name(args), self._source) is not None
        except Exception:
            return False

    def _from_disk(self, name: str) -> Callable[..., Any] | None:
        with contextlib.suppress(Exception):
            kept = recalled(name, self._source)
            return loaded(kept, self._function.__module__)
        return None

    def _compiled(self, name: str, args: tuple[Any, ...]) -> Callable[..., Any] | None:
        """What the compiler makes of it, which is kept; None where it says what is wrong."""
        dispatcher = self._dispatcher
        from numba.core.errors import NumbaError

        if len(args) != self._function.__code__.co_argcount:
            return None
        try:
            types = tuple(map(dispatcher.typeof_pyval, args))
            code = cast(Callable[..., Any], dispatcher.compile(types))
        except (NumbaError, ValueError):
            return None
        with contextlib.suppress(Exception):
            made = machine_code(dispatcher.overloads[types])
            if made is not None and self._function.__closure__ is None:
                keep(name, self._source, made)
        return code

    def _name(self, args: tuple[Any, ...]) -> str:
        function = self._function
        place = f"{function.__qualname__}:{function.__code__.co_firstlineno}"
        options = [(k, sorted(v) if isinstance(v, set) else v) for k, v in self._options.items()]
        return f"{place} {options} {json.dumps(described(args))}"


def _unseen(args: tuple[Any, ...]) -> bytes:
    raise LookupError


def _jit(function: Callable[..., Any], options: Mapping[str, Any]) -> Any:
    numba = compiler()
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


_PREPARATIONS: list[Callable[[], None]] = []
_TOLD: list[Callable[[int, int], None]] = []
_OTHERS: list[Callable[[], None]] = []
_WAITS: list[bool] = []
"""One entry for each call that waits for its function to be compiled."""


@cache
def compiler() -> Any:
    """Numba, once all is prepared."""
    with LOADING:
        import numba
        from numba.core import event

    class Tell(event.Listener):
        def on_start(self, event: Any) -> None:
            tell_compiling(0, 0)

        def on_end(self, event: Any) -> None:
            """Nothing."""

    event.register("numba:compile", Tell())  # type: ignore[no-untyped-call]
    while _PREPARATIONS:
        _PREPARATIONS.pop()()
    return numba


@cache
def compiled_for() -> tuple[str, str]:
    """The processor that code is compiled for, and its features, in the compiler's words."""
    name, source = "compiled for", Path(__file__)
    with contextlib.suppress(Exception):
        return cast(tuple[str, str], recalled(name, source))
    compiler()
    from numba.core.registry import cpu_target

    _, processor, features = cpu_target.target_context.codegen().magic_tuple()
    with contextlib.suppress(Exception):
        keep(name, source, (processor, features))
    return processor, features


def before_the_first(prepare: Callable[[], None]) -> None:
    """Call a function before anything is compiled, if anything is."""
    _PREPARATIONS.append(prepare)
    if compiler.cache_info().currsize:
        _PREPARATIONS.pop()()


@contextmanager
def told_of_compiling(tell: Callable[[int, int], None]) -> Iterator[None]:
    """Call a function whenever something is compiled that is not on disk yet.

    Args:
        tell: gets how many functions are compiled, and of how many; 0 where that is not known.
    """
    if "numba" in sys.modules:  # others may compile, too
        compiler()
    _TOLD.append(tell)
    try:
        yield
    finally:
        _TOLD.remove(tell)


def tell_compiling(done: int, of: int) -> None:
    """Tell all who are to be told; see `told_of_compiling`."""
    for tell in tuple(_TOLD):
        tell(done, of)


@contextmanager
def _compiling() -> Iterator[None]:
    _WAITS.append(True)
    try:
        yield
    finally:
        _WAITS.pop()


def waits_for_compiling() -> bool:
    """Whether a function was called and is compiled at the moment: nothing is half done by it."""
    return bool(_WAITS)


@contextmanager
def before_one_is_compiled(compile_others: Callable[[], None]) -> Iterator[None]:
    """Call a function once, where the first compiled one is called that is not on disk.

    Args:
        compile_others: may have that one compiled, too.
    """
    _OTHERS.append(compile_others)
    try:
        yield
    finally:
        with contextlib.suppress(ValueError):
            _OTHERS.remove(compile_others)


def _others_compiled() -> bool:
    """Whether functions were compiled that had waited for the first one."""
    called = False
    while True:
        try:
            compile_others = _OTHERS.pop()
        except IndexError:  # another thread may have taken the last one
            return called
        called = True
        compile_others()
