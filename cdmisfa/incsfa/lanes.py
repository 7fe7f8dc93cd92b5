"""Eight numbers at a time in registers: the few words `passes` needs to say what stays there.

Left to itself the compiler keeps too little of the residuals in registers, and loads the
coefficients of a whole step at once, which drives the rest out. `Lanes` is a value of
compiled code like a float; every processor has it, with vectors as wide as its own.
Indices are not checked and must not be negative; arrays are two-dimensional and C-ordered.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import types
from numba.core.datamodel import PrimitiveModel, register_default
from numba.extending import intrinsic

LANES = 8
"""Numbers in one value: a cache line."""

_VECTOR = ir.VectorType(ir.DoubleType(), LANES)
_INDEX = ir.IntType(32)


class _Lanes(types.Type):  # type: ignore[misc]
    def __init__(self) -> None:
        super().__init__(name="Lanes")


@register_default(_Lanes)
class _LanesModel(PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, of: Any) -> None:
        super().__init__(manager, of, _VECTOR)


_LANES = _Lanes()


def _pointer(context: Any, builder: Any, kind: Any, array: Any, row: Any, column: Any) -> Any:
    view = context.make_array(kind)(context, builder, array)
    columns = builder.extract_value(view.shape, 1)
    return builder.gep(view.data, [builder.add(builder.mul(row, columns), column)], inbounds=True)


def _lanes_pointer(context: Any, builder: Any, kind: Any, *where: Any) -> Any:
    return builder.bitcast(_pointer(context, builder, kind, *where), _VECTOR.as_pointer())


@intrinsic  # type: ignore[untyped-decorator]
def load(typing: Any, array: Any, row: Any, column: Any) -> Any:
    """array[row, column : column + LANES]."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.load(_lanes_pointer(context, builder, signature.args[0], *args), align=8)

    return _LANES(array, types.intp, types.intp), emit


@intrinsic  # type: ignore[untyped-decorator]
def store(typing: Any, array: Any, row: Any, column: Any, x: Any) -> Any:
    """array[row, column : column + LANES] = x."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pointer = _lanes_pointer(context, builder, signature.args[0], *args[:3])
        builder.store(args[3], pointer, align=8)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, _LANES), emit


@intrinsic  # type: ignore[untyped-decorator]
def add(typing: Any, x: Any, table: Any, row: Any, column: Any, y: Any) -> Any:
    """x + table[row, column] * y, the coefficient not loaded before the `add` ahead of it."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        x, table, row, column, y = args
        builder.fence("acq_rel", "singlethread")  # orders loads, and emits no instruction
        pointer = _pointer(context, builder, signature.args[1], table, row, column)
        empty, zero = ir.Constant(_VECTOR, ir.Undefined), ir.Constant(_INDEX, 0)
        one = builder.insert_element(empty, builder.load(pointer), zero)
        spread = ir.Constant(ir.VectorType(_INDEX, LANES), [0] * LANES)
        factor = builder.shuffle_vector(one, empty, spread)
        return builder.fadd(x, builder.fmul(factor, y))

    return _LANES(_LANES, table, types.intp, types.intp, _LANES), emit


@intrinsic  # type: ignore[untyped-decorator]
def nothing(typing: Any) -> Any:
    """LANES zeros."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return ir.Constant(_VECTOR, [0.0] * LANES)

    return _LANES(), emit
