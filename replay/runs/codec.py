"""Messages of a run's log, as protobuf; the field of each signal follows from its declaration.

`cdmisfa.BlockSignals` has a field for each signal, and one with the sizes of all arrays, so that
an empty array keeps its shape.

`cdmisfa.Matrix` holds rows of float64 from frame t on: a block's vectors, its ground truth, or
the abstraction's weights.

Every number has a fixed width, so reading returns the written values bit for bit, and messages of
the same shapes differ in their values alone. `Layout` holds the place of each value and reads many
messages at once; protobuf's parser, which is slower, reads messages that another program laid out
differently.
"""

from __future__ import annotations

import dataclasses
import math
import struct
from collections.abc import Iterator, Mapping, Sequence
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

# Field with the sizes of every dimension of every array.
SHAPES = "shapes"

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

# Signals that were added after `SHAPES` was numbered. Their fields are numbered after it, because
# the numbers of fields must not change.
_BEHIND_SHAPES = (
    *("roc_error_inst", "roc_error", "roc_error_frozen", "change", "tested", "fitted"),
    *("learning_error", "interest", "state", "typical", "regret"),
)

_STORED = sorted(SIGNALS.values(), key=lambda s: s.name in _BEHIND_SHAPES)
_FIRST = [s.name for s in _STORED if s.name not in _BEHIND_SHAPES]
_NUMBERS = {name: n for n, name in enumerate((*_FIRST, SHAPES, *_BEHIND_SHAPES), start=1)}
_SCALARS = [s for s in _STORED if not s.dims]

# The signals in the order in which messages hold them: scalars, then arrays.
_ARRAYS = [s for s in _STORED if s.dims]

# Tag and value of t, of the number of columns, and the values' tag and length.
#
# The length is a varint of five bytes, which any reader takes and which has a fixed place.
_MATRIX_HEAD = struct.Struct("<BqBIB5s")


class Layout:
    """Places of the values in messages of the same shapes.

    Args:
        fields: name, numpy type and shape of each value, and the bytes before it.
        end: bytes after all values.
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
        """Return the values of n messages by name, (n, *shape); None if their layout differs."""
        size = len(self._template)
        if any(len(data) != size for data in messages):
            return None
        data = b"".join(messages)
        rows = np.frombuffer(data, np.uint8).reshape(len(messages), size)
        if (rows[:, self._fixed] != self._template[self._fixed]).any():
            return None
        records = np.frombuffer(data, self._rows)
        return {name: records[name].copy() for name in self.names}

    def write(self, count: int, values: Mapping[str, Any]) -> list[bytes]:
        """Return n messages of values by name, (n, *shape) or (*shape) for all messages."""
        records = np.frombuffer(bytearray(self._template.tobytes() * count), self._rows)
        for name in self.names:
            records[name] = values[name]
        data, size = records.tobytes(), records.itemsize
        return [data[start : start + size] for start in range(0, len(data), size)]


@lru_cache
def _around(shapes: tuple[tuple[int, ...], ...]) -> tuple[bytes, ...]:
    """Return the parts of a message whose arrays have these shapes.

    The parts are the scalars, then the bytes before each array and the array, then the end. The
    scalars (0) and the arrays (2, 4, ...) are left empty.
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
    """Return the layout of records whose arrays have these shapes."""
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

# The tag of each scalar, and a place for its value.
_TAGGED: list[Any] = [x for s in _SCALARS for x in (_tag(s), None)]
_SCALARS_STRUCT = struct.Struct(
    "<" + "".join(f"{len(_tag(s))}s{_TYPES[s.dtype].code}" for s in _SCALARS)
)


def encode_signals(signals: BlockSignals) -> bytes:
    """Encode a record as the bytes of its message."""
    scalars = _TAGGED.copy()
    scalars[1::2] = _SCALARS_OF(signals)
    arrays = list(map(np.ascontiguousarray, _ARRAYS_OF(signals), _ARRAY_TYPES))
    parts: list[Any] = list(_around(tuple(map(_SHAPE_OF, arrays))))
    parts[0] = _SCALARS_STRUCT.pack(*scalars)
    parts[2::2] = arrays
    return b"".join(parts)


def decode_signals(data: bytes, where: str = "record") -> BlockSignals:
    """Decode a record from the bytes that `encode_signals` made.

    Raises:
        LogDamagedError: the bytes are not such a message, or its sizes contradict its values.
    """
    decoded = parsed(_SIGNALS, data, where)
    sizes = iter(getattr(decoded, SHAPES))
    fields: dict[str, Any] = {s.name: getattr(decoded, s.name) for s in _SCALARS}
    for signal in _ARRAYS:
        shape = tuple(size for _, size in zip(signal.dims, sizes, strict=False))
        values = getattr(decoded, signal.name)
        if len(shape) != len(signal.dims) or math.prod(shape) != len(values):
            raise LogDamagedError(f"{where}: {signal.name} has {len(values)} values for {shape}")
        fields[signal.name] = np.array(values, dtype=signal.dtype).reshape(shape)
    return BlockSignals(**fields)


def decode_columns(messages: Sequence[bytes], where: str = "record") -> Iterator[SignalColumns]:
    """Yield the records in messages as arrays, with the same bits as `decode_signals`."""
    for _, group in groupby(messages, key=len):
        same_size = list(group)
        first = decode_signals(same_size[0], where)
        layout = _layout(tuple([array.shape for array in _ARRAYS_OF(first)]))
        arrays = layout.read(same_size)
        if arrays is None or any(v.dtype == np.uint8 and v.max() > 1 for v in arrays.values()):
            records = [decode_signals(data, where) for data in same_size]
            yield from columns_of_records(records)
            continue
        values = {}
        for name, signal in SIGNALS.items():
            if name in arrays:
                values[name] = arrays[name].astype(signal.dtype, copy=False)
            else:  # an empty array
                value = np.asarray(getattr(first, name), dtype=signal.dtype)
                values[name] = np.broadcast_to(value, (len(same_size), *value.shape))
        yield SignalColumns(values)


def iteration_of(data: bytes, where: str = "record") -> int:
    """Return the iteration of the record in the bytes of a message."""
    return int(parsed(_SIGNALS, data, where).iteration)


def encode_matrix(t: int, matrix: FloatArray) -> bytes:
    """Encode (rows, columns) values from frame t on as the bytes of a message."""
    values: Any = np.ascontiguousarray(matrix, dtype="<f8")
    return b"".join((_matrix_head(t, values.shape[1], values.nbytes), values))


@lru_cache
def _matrix_head(t: int, columns: int, size: int) -> bytes:
    five = bytes(size >> 7 * k & 0x7F | (k < 4) << 7 for k in range(5))
    return _MATRIX_HEAD.pack(0x09, t, 0x15, columns, 0x1A, five)


def decode_matrices(
    messages: Sequence[bytes], where: str = "record"
) -> Iterator[tuple[IntArray, FloatArray]]:
    """Yield first frames (n,) and values (n, rows, columns) of n messages of the same size.

    Raises:
        LogDamagedError: a message holds no matrix.
    """
    for size, group in groupby(messages, key=len):
        same_size = list(group)
        size -= _MATRIX_HEAD.size
        columns = _MATRIX_HEAD.unpack_from(same_size[0])[3] if size > 0 else 0
        if columns and size % (8 * columns) == 0:
            head, float64 = _matrix_head(0, columns, size), _TYPES["float64"].stored
            t = ("t", _TYPES["int64"].stored, (), head[:1])
            values = ("values", float64, (size // (8 * columns), columns), head[9:])
            if (arrays := Layout([t, values]).read(same_size)) is not None:
                yield arrays["t"], arrays["values"]
                continue
        for data in same_size:  # another program laid these out
            decoded = parsed(_MATRIX, data, where)
            matrix, columns = np.array(decoded.values, dtype=np.float64), decoded.columns
            if matrix.size % columns if columns else matrix.size:
                raise LogDamagedError(f"{where}: {matrix.size} values in rows of {columns}")
            rows = matrix.size // columns if columns else 0
            yield np.array([decoded.t], dtype=np.int64), matrix.reshape(1, rows, columns)


def parsed(kind: Any, data: bytes, where: str) -> Any:
    """Parse the bytes of a message of class `kind`.

    Raises:
        LogDamagedError: the bytes are not such a message.
    """
    try:
        return kind.FromString(data)
    except message.DecodeError as error:
        name = kind.DESCRIPTOR.full_name
        raise LogDamagedError(f"{where}: not a {name} message, see cdmisfa verify") from error


def _sentence(signal: Signal) -> str:
    facts = {"symbol": signal.symbol, "equation": signal.equation, "dimensions": signal.dims}
    known = [f"{name} {value}" for name, value in facts.items() if value]
    return "; ".join([signal.about.rstrip("."), *known, f"unit {signal.unit}"]) + "."


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
    """Return a message's class, and its definition as a log stores it, a FileDescriptorSet.

    Args:
        schema: full name of the message.
        stem: stem of its .proto file.
        fields: name, number, type, whether it is repeated, and comment of each field.
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
