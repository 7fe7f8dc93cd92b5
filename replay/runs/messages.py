"""What is in a run's log, as protobuf messages of our own.

`cdmisfa.BlockSignals` is generated from the table of signals. The sizes of all arrays stand in
one more field: an empty array keeps its shape. A field's number never changes: those of a later
version of the record follow all of the versions before.

`cdmisfa.Matrix` holds rows of float64 from frame t on: a block's vectors, its ground truth, or
the abstraction's weights.

Every number has a fixed width, so what is read is, bit for bit, what was written.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message, message_factory
from numpy.typing import NDArray

from cdmisfa.core.errors import LogDamagedError
from cdmisfa.core.signals import SCHEMA_VERSION, SIGNALS, BlockSignals, Signal
from recorder.log.messages import varint
from replay.runs.wire import alike, column

SIGNALS_SCHEMA = "cdmisfa.BlockSignals"
MATRIX_SCHEMA = "cdmisfa.Matrix"

SHAPES = "shapes"
"""Field with the sizes of every dimension of every array, the oldest arrays first."""

_FIELD = descriptor_pb2.FieldDescriptorProto
_TYPES = {"float64": _FIELD.TYPE_DOUBLE, "int64": _FIELD.TYPE_SFIXED64, "bool": _FIELD.TYPE_BOOL}
_CODES = {"float64": "d", "int64": "q", "bool": "?"}
_WIRE = {"float64": 1, "int64": 1, "bool": 0}
_LENGTH_DELIMITED = 2

_BY_AGE = sorted(SIGNALS.values(), key=lambda s: s.since)
_SCALARS = tuple(s for s in _BY_AGE if not s.dims)
_ARRAYS = tuple(s for s in _BY_AGE if s.dims)
_FIRST = tuple(s.name for s in _BY_AGE if s.since == 1)
_LATER = tuple(s.name for s in _BY_AGE if s.since > 1)
NUMBERS = {name: number for number, name in enumerate((*_FIRST, SHAPES, *_LATER), start=1)}
"""Number of each signal's field."""

_HEAD = struct.Struct("<BqBIB5s")
"""Tag and value of t, of the number of columns, and the values' tag and length.

The length is a varint of five bytes, which any reader takes and which has a fixed place.
"""


def _signals_file() -> descriptor_pb2.FileDescriptorProto:
    """The definition of the signals' message, with what each of them is as its comment."""
    file = descriptor_pb2.FileDescriptorProto(
        name="cdmisfa/block_signals.proto", package="cdmisfa", syntax="proto3"
    )
    definition = file.message_type.add(name="BlockSignals")
    for place, signal in enumerate(_BY_AGE):
        definition.field.add(
            name=signal.name,
            number=NUMBERS[signal.name],
            type=_TYPES[signal.dtype],
            label=_FIELD.LABEL_REPEATED if signal.dims else _FIELD.LABEL_OPTIONAL,
        )
        _comment(file, place, _sentence(signal))
    definition.field.add(
        name=SHAPES, number=NUMBERS[SHAPES], type=_FIELD.TYPE_UINT32, label=_FIELD.LABEL_REPEATED
    )
    arrays = ", ".join(f"{s.name} [{s.dims}]" for s in _ARRAYS)
    _comment(file, len(_BY_AGE), f"Sizes of the dimensions of {arrays}")
    return file


def _matrix_file() -> descriptor_pb2.FileDescriptorProto:
    file = descriptor_pb2.FileDescriptorProto(
        name="cdmisfa/matrix.proto", package="cdmisfa", syntax="proto3"
    )
    definition = file.message_type.add(name="Matrix")
    for name, number, kind, label in (
        ("t", 1, _FIELD.TYPE_SFIXED64, _FIELD.LABEL_OPTIONAL),
        ("columns", 2, _FIELD.TYPE_FIXED32, _FIELD.LABEL_OPTIONAL),
        ("values", 3, _FIELD.TYPE_DOUBLE, _FIELD.LABEL_REPEATED),
    ):
        definition.field.add(name=name, number=number, type=kind, label=label)
    return file


def encode_signals(signals: BlockSignals) -> bytes:
    """A record as the bytes of its message."""
    scalars = list(_TAGGED)
    scalars[1::2] = [getattr(signals, s.name) for s in _SCALARS]
    parts = [_STRUCT.pack(*scalars)]
    shapes = []
    for name, dtype, tag in _ARRAY_TAGS:
        value = np.asarray(getattr(signals, name), dtype=dtype)
        shapes.append(value.shape)
        if value.size:
            parts.append(_length_prefix(tag, value.nbytes))
            parts.append(value.tobytes())
    key = tuple(shapes)
    if key not in _SHAPE_BYTES:
        sizes = b"".join(varint(size) for shape in key for size in shape)
        _SHAPE_BYTES[key] = _length_prefix(_tag(SHAPES, _LENGTH_DELIMITED), len(sizes)) + sizes
    parts.append(_SHAPE_BYTES[key])
    return b"".join(parts)


def encode_matrix(t: int, matrix: NDArray[np.float64]) -> bytes:
    """(rows, columns) values from frame t on as the bytes of a message."""
    values = np.asarray(matrix, dtype="<f8")
    length = bytes(values.nbytes >> 7 * k & 0x7F | (k < 4) << 7 for k in range(5))
    return _HEAD.pack(0x09, t, 0x15, values.shape[1], 0x1A, length) + values.tobytes()


def decode_matrix(data: bytes, where: str = "record") -> tuple[int, NDArray[np.float64]]:
    """The frame counter and the (rows, columns) values of a message.

    Raises:
        LogDamagedError: the bytes are not such a message.
    """
    decoded = parsed(_MATRIX, data, where)
    values = np.array(decoded.values, dtype=np.float64)
    if values.size and (decoded.columns == 0 or values.size % decoded.columns):
        raise LogDamagedError(f"{where}: {values.size} values in rows of {decoded.columns}")
    rows = values.size // decoded.columns if decoded.columns else 0
    return decoded.t, values.reshape(rows, decoded.columns)


def decode_matrices(
    messages: Sequence[bytes], where: str = "record"
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Frames and rows of matrix messages of one size, at once where `encode_matrix` made them.

    Raises:
        LogDamagedError: one of them is no such message.
    """
    t, first = decode_matrix(messages[0], where)
    values = _HEAD.size, len(messages[0])
    known = encode_matrix(t, first) == messages[0]
    table = alike(messages, [(1, 9), values]) if known else None
    if table is None:
        for data in messages:
            t, rows = decode_matrix(data, where)
            yield t + np.arange(len(rows)), rows
        return
    frames = column(table, (1, 9), "<i8") + np.arange(len(first))
    yield frames.reshape(-1), column(table, values, "<f8").reshape(frames.size, first.shape[1])


def missing(version: int) -> tuple[str, ...]:
    """Names of the signals that a version of the record lacks."""
    return tuple(s.name for s in SIGNALS.values() if s.since > version)


def decode_signals(
    data: bytes, where: str = "record", version: int = SCHEMA_VERSION
) -> BlockSignals:
    """The record in what `encode_signals` of a version made; NaN where that lacks a signal.

    Raises:
        LogDamagedError: the bytes are not such a message, or its sizes contradict its values.
    """
    decoded = parsed(_SIGNALS, data, where)
    sizes = iter(getattr(decoded, SHAPES))
    fields: dict[str, Any] = {
        s.name: getattr(decoded, s.name) if s.since <= version else math.nan for s in _SCALARS
    }
    known: dict[str, int] = {}
    for signal in _ARRAYS:
        if signal.since <= version:
            shape = tuple(size for _, size in zip(signal.dims, sizes, strict=False))
            fields[signal.name] = _array(getattr(decoded, signal.name), shape, signal, where)
            known.update(zip(signal.dims, shape, strict=True))
        else:
            shape = tuple(known[letter] for letter in signal.dims)
            if math.prod(shape) > len(data):
                raise LogDamagedError(f"{where}: sizes without values, see cdmisfa verify")
            fields[signal.name] = np.full(shape, math.nan)
    return BlockSignals(**fields)


def iteration_of(data: bytes, where: str = "record") -> int:
    """The iteration of the record in the bytes of a message."""
    return int(parsed(_SIGNALS, data, where).iteration)


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


def _array(values: Any, shape: tuple[int, ...], signal: Signal, where: str) -> NDArray[Any]:
    if len(shape) != len(signal.dims) or math.prod(shape) != len(values):
        raise LogDamagedError(
            f"{where}: {signal.name} has {len(values)} values for shape {shape}, see cdmisfa verify"
        )
    return np.array(values, dtype=signal.dtype).reshape(shape)


def _comment(file: descriptor_pb2.FileDescriptorProto, field: int, text: str) -> None:
    file.source_code_info.location.add(
        path=[4, 0, 2, field], span=[field, 0, 0], leading_comments=f" {text}\n"
    )


def _sentence(signal: Signal) -> str:
    parts = [signal.about.rstrip(".")]
    if signal.symbol:
        parts.append(f"symbol {signal.symbol}")
    if signal.equation:
        parts.append(f"equation {signal.equation}")
    if signal.dims:
        parts.append(f"dimensions {signal.dims}")
    return "; ".join([*parts, f"unit {signal.unit}"]) + "."


def _tag(name: str, wire_type: int) -> bytes:
    return varint(NUMBERS[name] << 3 | wire_type)


def _length_prefix(tag: bytes, length: int) -> bytes:
    return tag + (bytes((length,)) if length < 0x80 else varint(length))


def _message_class(file: descriptor_pb2.FileDescriptorProto, name: str) -> Any:
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))


_FILES = {SIGNALS_SCHEMA: _signals_file(), MATRIX_SCHEMA: _matrix_file()}
_SIGNALS, _MATRIX = (_message_class(file, name) for name, file in _FILES.items())

SCHEMAS: Mapping[str, bytes] = {
    name: descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString(deterministic=True)
    for name, file in _FILES.items()
}
"""Each message's definition as a log stores it: a FileDescriptorSet."""

_TAGGED: tuple[Any, ...] = tuple(
    part for s in _SCALARS for part in (_tag(s.name, _WIRE[s.dtype]), None)
)
_STRUCT = struct.Struct(
    "<"
    + "".join(
        f"{len(tag)}s{_CODES[s.dtype]}" for tag, s in zip(_TAGGED[::2], _SCALARS, strict=True)
    )
)
_ARRAY_TAGS = tuple(
    (s.name, np.dtype(s.dtype).newbyteorder("<"), _tag(s.name, _LENGTH_DELIMITED)) for s in _ARRAYS
)
_SHAPE_BYTES: dict[tuple[tuple[int, ...], ...], bytes] = {}
