"""Compiling hot functions with numba, and nothing about what they do."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """Compile strictly (no reordering of floating point) and keep the result on disk."""
    return cast(Function, numba.njit(cache=True)(function))


def needs_compiling(function: Callable[..., Any]) -> bool:
    """Whether the first call of a compiled function will compile it, which takes seconds.

    It will not where this process has done so, or left its result on disk since the
    source changed.
    """
    dispatcher: Any = function
    if dispatcher.signatures:
        return False
    source = Path(inspect.getfile(dispatcher.py_func))
    index = f"{source.stem}.{dispatcher.py_func.__qualname__}-*.nbi"
    kept = Path(dispatcher.stats.cache_path).glob(index)
    return all(file.stat().st_mtime < source.stat().st_mtime for file in kept)
