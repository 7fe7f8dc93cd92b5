"""Messages of a run's log, as protobuf: what each signal's field is follows from its declaration.

`cdmisfa.BlockSignals` has a field for each signal, and one with the sizes of all arrays, so that
an empty array keeps its shape.

`cdmisfa.Matrix` holds rows of float64 from frame t on: a block's vectors, its ground truth, or
the abstraction's weights.

Every number has a fixed width, so what is read is, bit for bit, what was written. Messages of
the same shapes differ in their values alone: `Layout` says where each value stands in all of
them. It writes messages, and reads many at once; protobuf's own parser reads those that another
program laid out differently.
"""

from __future__ import annotations

import dataclasses
import math
import struct
from collections.abc import Iterator, Sequence
from functools import lru_cache
from itertools import groupby
from operator import attrgetter
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message, message_factory
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray, IntArray
from cdmisfa.core.errors import LogDamagedError
from cdmisfa.core.signals import SIGNALS, BlockSignals, Signal
from recorder.log.messages import varint
from replay.runs.columns import SignalColumns, columns_of_records

SIGNALS_SCHEMA = "cdmisfa.BlockSignals"
MATRIX_SCHEMA = "cdmisfa.Matrix"

SHAPES = "shapes"
"""Field with the sizes of every dimension of every array."""

_FIELD = descriptor_pb2.FieldDescriptorProto
_VARINT, _FIXED64, _LENGTH_DELIMITED = 0, 1, 2


@dataclasses.dataclass(frozen=True, slots=True)
class _Type:
    """Storage of a numpy type: protobuf type, wire type, numpy type and struct code."""

    field: int
    wire: int
    stored: np.dtype[Any]
    code: str


_TYPES = {
    "float64": _Type(_FIELD.TYPE_DOUBLE, _FIXED64, np.dtype("<f8"), "d"),
    "int64": _Type(_FIELD.TYPE_SFIXED64, _FIXED64, np.dtype("<i8"), "q"),
    "bool": _Type(_FIELD.TYPE_BOOL, _VARINT, np.dtype("u1"), "?"),
}

_BEHIND_SHAPES = (
    *("roc_error_inst", "roc_error", "roc_error_frozen", "change", "tested", "fitted"),
    *("learning_error", "interest", "state", "typical", "regret"),
)
"""Signals whose fields are numbered after that of `SHAPES`: numbers of fields stay as they are."""

_STORED = sorted(SIGNALS.values(), key=lambda s: s.name in _BEHIND_SHAPES)
_FIRST = [s.name for s in _STORED if s.name not in _BEHIND_SHAPES]
_NUMBERS = {name: n for n, name in enumerate((*_FIRST, SHAPES, *_BEHIND_SHAPES), start=1)}
_SCALARS = [s for s in _STORED if not s.dims]
_ARRAYS = [s for s in _STORED if s.dims]
"""The signals in the order in which messages hold them: scalars, then arrays."""

_MATRIX_HEAD = struct.Struct("<BqBIB5s")
"""Tag and value of t, of the number of columns, and the values' tag and length.

The length is a varint of five bytes, which any reader takes and which has a fixed place.
"""


class Layout:
    """Places of the values in messages of the same shapes.

    Args:
        fields: of each value its name, numpy type and shape, and the bytes that stand before it.
        end: what stands behind all values.
    """

    def __init__(
        self, fields: Sequence[tuple[str, np.dtype[Any], tuple[int, ...], bytes]], end: bytes = b""
    ) -> None:
        template, offsets = bytearray(), list[int]()
        for _, kind, shape, before in fields:
            template += before
            offsets.append(len(template))
            template += bytes(kind.itemsize * math.prod(shape))
        template += end
        self.names = [name for name, *_ in fields]
        described: Any = {
            "names": self.names,
            "formats": [(kind, shape) for _, kind, shape, _ in fields],
            "offsets": offsets,
            "itemsize": len(template),
        }
        self._rows = np.dtype(described)
        self._template = np.frombuffer(bytes(template), np.uint8)
        self._fixed = np.ones(len(template), dtype=bool)
        for (_, kind, shape, _), start in zip(fields, offsets, strict=True):
            self._fixed[start : start + kind.itemsize * math.prod(shape)] = False

    def read(self, messages: Sequence[bytes]) -> dict[str, NDArray[Any]] | None:
        """The values of n messages by name, (n, *shape); None where they are laid out otherwise."""
        size = len(self._template)
        if any(len(data) != size for data in messages):
            return None
        data = b"".join(messages)
        rows = np.frombuffer(data, np.uint8).reshape(len(messages), size)
        if (rows[:, self._fixed] != self._template[self._fixed]).any():
            return None
        records = np.frombuffer(data, self._rows)
        return {name: records[name].copy() for name in self.names}


@lru_cache
def _around(shapes: tuple[tuple[int, ...], ...]) -> tuple[bytes, ...]:
    """The parts of a message: its scalars, each array after what stands before it, its end.

    Args:
        shapes: of all arrays.

    Returns:
        Places for the scalars (0) and for the arrays (2, 4, ...) are empty.
    """
    parts, sizes = [b""], b""
    for signal, shape in zip(_ARRAYS, shapes, strict=True):
        size = _TYPES[signal.dtype].stored.itemsize * math.prod(shape)
        parts += [_tag(signal) + varint(size) if size else b"", b""]
        sizes += b"".join(map(varint, shape))
    end = varint(_NUMBERS[SHAPES] << 3 | _LENGTH_DELIMITED) + varint(len(sizes)) + sizes
    return *parts, end


@lru_cache
def _layout(shapes: tuple[tuple[int, ...], ...]) -> Layout:
    """Layout of records whose arrays have these shapes."""
    *before, end = _around(shapes)[1::2]
    scalars = [(s, (), _tag(s)) for s in _SCALARS]
    arrays = [item for item in zip(_ARRAYS, shapes, before, strict=True) if item[2]]
    fields = [(s.name, _TYPES[s.dtype].stored, shape, tag) for s, shape, tag in scalars + arrays]
    return Layout(fields, end)


def _tag(signal: Signal) -> bytes:
    wire = _LENGTH_DELIMITED if signal.dims else _TYPES[signal.dtype].wire
    return varint(_NUMBERS[signal.name] << 3 | wire)


_SCALARS_OF = attrgetter(*(s.name for s in _SCALARS))
_ARRAYS_OF = attrgetter(*(s.name for s in _ARRAYS))
_SHAPE_OF = attrgetter("shape")
_ARRAY_TYPES = [_TYPES[s.dtype].stored for s in _ARRAYS]
_TAGGED: list[Any] = [x for s in _SCALARS for x in (_tag(s), None)]
"""The tag of each scalar, and a place for its value."""
_SCALARS_STRUCT = struct.Struct(
    "<" + "".join(f"{len(_tag(s))}s{_TYPES[s.dtype].code}" for s in _SCALARS)
)


def encode_signals(signals: BlockSignals) -> bytes:
    """A record as the bytes of its message."""
    scalars = _TAGGED.copy()
    scalars[1::2] = _SCALARS_OF(signals)
    arrays = list(map(np.ascontiguousarray, _ARRAYS_OF(signals), _ARRAY_TYPES))
    parts: list[Any] = list(_around(tuple(map(_SHAPE_OF, arrays))))
    parts[0] = _SCALARS_STRUCT.pack(*scalars)
    parts[2::2] = arrays
    return b"".join(parts)


def decode_signals(data: bytes, where: str = "record") -> BlockSignals:
    """The record in what `encode_signals` made.

    Raises:
        LogDamagedError: the bytes are not such a message, or its sizes contradict its values.
    """
    decoded = parsed(_SIGNALS, data, where)
    sizes = iter(getattr(decoded, SHAPES))
    fields: dict[str, Any] = {s.name: getattr(decoded, s.name) for s in _SCALARS}
    for signal in _ARRAYS:
        shape = tuple(size for _, size in zip(signal.dims, sizes, strict=False))
        fields[signal.name] = _array(getattr(decoded, signal.name), shape, signal, where)
    return BlockSignals(**fields)


def decode_columns(messages: Sequence[bytes], where: str = "record") -> Iterator[SignalColumns]:
    """The records in messages as arrays, bit for bit what `decode_signals` makes of each."""
    for _, group in groupby(messages, key=len):
        same_size = list(group)
        first = decode_signals(same_size[0], where)
        layout = _layout(tuple([array.shape for array in _ARRAYS_OF(first)]))
        found = layout.read(same_size)
        if found is None or any(v.dtype == np.uint8 and v.max() > 1 for v in found.values()):
            records = [decode_signals(data, where) for data in same_size]
            yield from columns_of_records(records)
            continue
        values = {}
        for name, signal in SIGNALS.items():
            if name in found:
                values[name] = found[name].astype(signal.dtype, copy=False)
            else:  # an empty array
                value = np.asarray(getattr(first, name), dtype=signal.dtype)
                values[name] = np.broadcast_to(value, (len(same_size), *value.shape))
        yield SignalColumns(values)


def _array(values: Any, shape: tuple[int, ...], signal: Signal, where: str) -> NDArray[Any]:
    if len(shape) != len(signal.dims) or math.prod(shape) != len(values):
        raise LogDamagedError(
            f"{where}: {signal.name} has {len(values)} values for shape {shape}, see cdmisfa verify"
        )
    return np.array(values, dtype=signal.dtype).reshape(shape)


def iteration_of(data: bytes, where: str = "record") -> int:
    """The iteration of the record in the bytes of a message."""
    return int(parsed(_SIGNALS, data, where).iteration)


def encode_matrix(t: int, matrix: FloatArray) -> bytes:
    """(rows, columns) values from frame t on as the bytes of a message."""
    values: Any = np.ascontiguousarray(matrix, dtype="<f8")
    return b"".join((_matrix_head(t, values.shape[1], values.nbytes), values))


def _matrix_head(t: int, columns: int, size: int) -> bytes:
    return _MATRIX_HEAD.pack(0x09, t, 0x15, columns, 0x1A, _five_bytes(size))


@lru_cache
def _five_bytes(size: int) -> bytes:
    """A number as a varint of five bytes."""
    return bytes(size >> 7 * k & 0x7F | (k < 4) << 7 for k in range(5))


def decode_matrices(
    messages: Sequence[bytes], where: str = "record"
) -> Iterator[tuple[IntArray, FloatArray]]:
    """Frames and rows of the matrices in messages, those of one size together.

    Raises:
        LogDamagedError: a message holds no matrix.
    """
    for _, group in groupby(messages, key=len):
        same_size = list(group)
        if (found := _matrices(same_size)) is not None:
            values = found["values"]
            frames = found["t"][:, None] + np.arange(values.shape[1])
            yield frames.reshape(-1), values.reshape(frames.size, values.shape[2])
            continue
        for data in same_size:
            t, rows = decode_matrix(data, where)
            yield t + np.arange(len(rows)), rows


def decode_matrix(data: bytes, where: str = "record") -> tuple[int, FloatArray]:
    """The frame counter and (rows, columns) values of a message; see `decode_matrices`."""
    if (found := _matrices([data])) is not None:
        return int(found["t"][0]), found["values"][0]
    decoded = parsed(_MATRIX, data, where)
    values = np.array(decoded.values, dtype=np.float64)
    if values.size and (decoded.columns == 0 or values.size % decoded.columns):
        raise LogDamagedError(f"{where}: {values.size} values in rows of {decoded.columns}")
    rows = values.size // decoded.columns if decoded.columns else 0
    return decoded.t, values.reshape(rows, decoded.columns)


def _matrices(messages: Sequence[bytes]) -> dict[str, NDArray[Any]] | None:
    """T and values of messages of one size, where they are as `encode_matrix` lays them out."""
    size = len(messages[0]) - _MATRIX_HEAD.size
    columns = _MATRIX_HEAD.unpack_from(messages[0])[3] if size > 0 else 0
    if columns == 0 or size % (8 * columns):
        return None
    head, float64 = _matrix_head(0, columns, size), _TYPES["float64"].stored
    t = ("t", _TYPES["int64"].stored, (), head[:1])
    values = ("values", float64, (size // (8 * columns), columns), head[9:])
    return Layout([t, values]).read(messages)


def parsed(kind: Any, data: bytes, where: str) -> Any:
    """A message of some kind in its bytes.

    Raises:
        LogDamagedError: there is none in them.
    """
    try:
        return kind.FromString(data)
    except message.DecodeError as error:
        name = kind.DESCRIPTOR.full_name
        raise LogDamagedError(f"{where}: not a {name} message, see cdmisfa verify") from error


def _sentence(signal: Signal) -> str:
    facts = {"symbol": signal.symbol, "equation": signal.equation, "dimensions": signal.dims}
    said = [f"{name} {value}" for name, value in facts.items() if value]
    return "; ".join([signal.about.rstrip("."), *said, f"unit {signal.unit}"]) + "."


_SIZES = ", ".join(f"{s.name} [{s.dims}]" for s in _ARRAYS)
_SIGNAL_FIELDS = [
    (s.name, _NUMBERS[s.name], _TYPES[s.dtype].field, bool(s.dims), _sentence(s)) for s in _STORED
]
_SIGNAL_FIELDS.append(
    (SHAPES, _NUMBERS[SHAPES], _FIELD.TYPE_UINT32, True, f"Sizes of the dimensions of {_SIZES}")
)
_MATRIX_FIELDS = [
    ("t", 1, _FIELD.TYPE_SFIXED64, False, ""),
    ("columns", 2, _FIELD.TYPE_FIXED32, False, ""),
    ("values", 3, _FIELD.TYPE_DOUBLE, True, ""),
]


def define_message(
    schema: str, stem: str, fields: Sequence[tuple[str, int, Any, bool, str]]
) -> tuple[Any, bytes]:
    """A message's class, and its definition as a log stores it: a FileDescriptorSet.

    Args:
        schema: its full name.
        stem: of its .proto file.
        fields: of each the name, number, type, whether it is repeated, and a comment.
    """
    file = descriptor_pb2.FileDescriptorProto(
        name=f"cdmisfa/{stem}.proto", package="cdmisfa", syntax="proto3"
    )
    definition = file.message_type.add(name=schema.partition(".")[2])
    for place, (name, number, kind, repeated, comment) in enumerate(fields):
        label = _FIELD.LABEL_REPEATED if repeated else _FIELD.LABEL_OPTIONAL
        definition.field.add(name=name, number=number, type=kind, label=label)
        if comment:
            file.source_code_info.location.add(
                path=[4, 0, 2, place], span=[place, 0, 0], leading_comments=f" {comment}\n"
            )
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    made = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema))
    stored = descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString(deterministic=True)
    return made, stored


_SIGNALS, SIGNALS_DEFINITION = define_message(SIGNALS_SCHEMA, "block_signals", _SIGNAL_FIELDS)
_MATRIX, MATRIX_DEFINITION = define_message(MATRIX_SCHEMA, "matrix", _MATRIX_FIELDS)
