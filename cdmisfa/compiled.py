"""Compiling hot functions with numba, and nothing about what they do."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """Compile strictly (no reordering of floating point) and keep the result on disk."""
    return cast(Function, numba.njit(cache=True)(function))
