"""Eight numbers at a time in registers: the few words `passes` needs to say what stays there.

Left to itself the compiler keeps too little of the residuals in registers, and loads the
coefficients of a whole step at once, which drives the rest out. `Lanes` is a value of
compiled code like a float; every processor has it, with vectors as wide as its own.
Indices are not checked and must not be negative; arrays are two-dimensional and C-ordered.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, cast

from llvmlite import ir

from cdmisfa.core.arithmetic.compiled import before_the_first

LANES = 8
"""Numbers in one value: a cache line."""

_VECTOR = ir.VectorType(ir.DoubleType(), LANES)
_INDEX = ir.IntType(32)


@cache
def _lanes() -> Any:
    """The compiler's type of a value."""
    from numba.core import types
    from numba.core.datamodel.models import PrimitiveModel
    from numba.core.datamodel.registry import register_default

    class Lanes(types.Type):
        def __init__(self) -> None:
            super().__init__(name="Lanes")

    @register_default(Lanes)
    class LanesModel(PrimitiveModel):
        def __init__(self, manager: Any, of: Any) -> None:
            super().__init__(manager, of, _VECTOR)  # type: ignore[no-untyped-call]

    return Lanes()


def _types() -> Any:
    from numba.core import types

    return types


class _Word:
    """A word of compiled code; only the compiler looks at it."""

    def __init__(self, emitter: Callable[..., Any]) -> None:
        self._emitter = emitter
        before_the_first(self._prepare)

    def _prepare(self) -> None:
        from numba.extending import intrinsic

        self._word = intrinsic(self._emitter)

    @property
    def _numba_type_(self) -> Any:
        from numba.core.registry import cpu_target

        return cpu_target.typing_context.resolve_value_type(self._word)


def _intrinsic(emitter: Callable[..., Any]) -> Callable[..., Any]:
    return cast(Callable[..., Any], _Word(emitter))


def _pointer(context: Any, builder: Any, kind: Any, array: Any, row: Any, column: Any) -> Any:
    view = context.make_array(kind)(context, builder, array)
    columns = builder.extract_value(view.shape, 1)
    return builder.gep(view.data, [builder.add(builder.mul(row, columns), column)], inbounds=True)


def _lanes_pointer(context: Any, builder: Any, kind: Any, *where: Any) -> Any:
    return builder.bitcast(_pointer(context, builder, kind, *where), _VECTOR.as_pointer())


def _spread(builder: Any, number: Any) -> Any:
    empty, zero = ir.Constant(_VECTOR, ir.Undefined), ir.Constant(_INDEX, 0)
    one = builder.insert_element(empty, number, zero)
    return builder.shuffle_vector(
        one, empty, ir.Constant(ir.VectorType(_INDEX, LANES), [0] * LANES)
    )


@_intrinsic
def load(typing: Any, array: Any, row: Any, column: Any) -> Any:
    """Return array[row, column : column + LANES]; of bytes, their values."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        if signature.args[0].dtype == _types().uint8:
            pointer = _pointer(context, builder, signature.args[0], *args)
            few = builder.bitcast(pointer, ir.VectorType(ir.IntType(8), LANES).as_pointer())
            return builder.uitofp(builder.load(few, align=1), _VECTOR)
        return builder.load(_lanes_pointer(context, builder, signature.args[0], *args), align=8)

    return _lanes()(array, _types().intp, _types().intp), emit


@_intrinsic
def store(typing: Any, array: Any, row: Any, column: Any, x: Any) -> Any:
    """Set array[row, column : column + LANES] to x."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pointer = _lanes_pointer(context, builder, signature.args[0], *args[:3])
        builder.store(args[3], pointer, align=8)
        return context.get_dummy_value()

    return _types().void(array, _types().intp, _types().intp, _lanes()), emit


@_intrinsic
def add(typing: Any, x: Any, table: Any, row: Any, column: Any, y: Any) -> Any:
    """Return x + table[row, column] * y; the coefficient is not loaded before the last `add`'s."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        x, table, row, column, y = args
        builder.fence("acq_rel", "singlethread")  # orders loads, and emits no instruction
        pointer = _pointer(context, builder, signature.args[1], table, row, column)
        return builder.fadd(x, builder.fmul(_spread(builder, builder.load(pointer)), y))

    return _lanes()(_lanes(), table, _types().intp, _types().intp, _lanes()), emit


@_intrinsic
def multiply_add(typing: Any, x: Any, y: Any, z: Any) -> Any:
    """Return x + y * z."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.fadd(args[0], builder.fmul(args[1], args[2]))

    return _lanes()(_lanes(), _lanes(), _lanes()), emit


@_intrinsic
def times(typing: Any, x: Any, y: Any) -> Any:
    """Return x * y."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.fmul(*args)

    return _lanes()(_lanes(), _lanes()), emit


@_intrinsic
def total(typing: Any, x: Any) -> Any:
    """Return the sum of a value's numbers, of neighbours first."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        parts = [builder.extract_element(args[0], _INDEX(lane)) for lane in range(LANES)]
        while len(parts) > 1:
            pairs = zip(parts[::2], parts[1::2], strict=True)
            parts = [builder.fadd(first, second) for first, second in pairs]
        return parts[0]

    return _types().float64(_lanes()), emit


@_intrinsic
def folded(typing: Any, x: Any) -> Any:
    """Return the sum of a value's numbers, its second half added to the first until one is left."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        parts = [builder.extract_element(args[0], _INDEX(lane)) for lane in range(LANES)]
        while len(parts) > 1:
            half = len(parts) // 2
            pairs = zip(parts[:half], parts[half:], strict=True)
            parts = [builder.fadd(first, second) for first, second in pairs]
        return parts[0]

    return _types().float64(_lanes()), emit


@_intrinsic
def plus(typing: Any, x: Any, y: Any) -> Any:
    """Return x + y."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.fadd(*args)

    return _lanes()(_lanes(), _lanes()), emit


@_intrinsic
def minus(typing: Any, x: Any, y: Any) -> Any:
    """Return x - y."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.fsub(*args)

    return _lanes()(_lanes(), _lanes()), emit


@_intrinsic
def spread(typing: Any, x: Any) -> Any:
    """Return a value of which every number is x."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _spread(builder, args[0])

    return _lanes()(_types().float64), emit


@_intrinsic
def zeros(typing: Any) -> Any:
    """Return a value of zeros."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return ir.Constant(_VECTOR, [0.0] * LANES)

    return _lanes()(), emit
