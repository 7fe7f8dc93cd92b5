"""What is in a run's log, as protobuf messages of our own.

`cdmisfa.BlockSignals` is generated from the table of signals. The sizes of all arrays stand in
one more field: an empty array keeps its shape. A field's number never changes: those of a later
version of the record follow all of the versions before.

`cdmisfa.Matrix` holds rows of float64 from frame t on: a block's vectors, its ground truth, or
the abstraction's weights.

`cdmisfa.Keyframe` holds a learner's state after some iterations: the arrays one after the other
in `values`, and in the JSON text `facts` what each one is, and all else.

Every number has a fixed width, so what is read is, bit for bit, what was written. And messages
whose sizes are the same differ in their values alone: one says where the values of all stand.
"""

from __future__ import annotations

import dataclasses
import json
import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message, message_factory
from numpy.typing import NDArray

from cdmisfa.core.errors import LogDamagedError, one_line
from cdmisfa.core.learning import Keyframe, LearnerState
from cdmisfa.core.modules import Module
from cdmisfa.core.signals import (
    CODES,
    MISSING,
    SCHEMA_VERSION,
    SIGNALS,
    BlockSignals,
    Fields,
    Signal,
)
from cdmisfa.core.untrusted.memory import parse_json
from recorder.log.messages import varint
from recorder.mcap.records import MalformedRecord
from replay.storage.arrays import contents, stored_arrays

SIGNALS_SCHEMA = "cdmisfa.BlockSignals"
MATRIX_SCHEMA = "cdmisfa.Matrix"
KEYFRAME_SCHEMA = "cdmisfa.Keyframe"

KEYFRAME_VERSION = 1
"""Version of a keyframe; rises when the state of a learner changes its meaning."""

Span = tuple[int, int]
"""Where a value begins and ends in a message."""

SHAPES = "shapes"
"""Field with the sizes of every dimension of every array, the oldest arrays first."""

_Field = tuple[str, int, Any, bool, str]
"""A field's name, number and type, whether it is repeated, and its comment."""

_FIELD = descriptor_pb2.FieldDescriptorProto
_TYPES = {"float64": _FIELD.TYPE_DOUBLE, "int64": _FIELD.TYPE_SFIXED64, "bool": _FIELD.TYPE_BOOL}
_WIRE = {"float64": 1, "int64": 1, "bool": 0}
_VARINT, _LENGTH_DELIMITED = 0, 2
_MODULES = "modules."
_WIDTHS = {1: 8, 5: 4}
_LONGEST = 10  # bytes of a varint

_BY_AGE = sorted(SIGNALS.values(), key=lambda s: s.since)
_SCALARS = tuple(s for s in _BY_AGE if not s.dims)
_ARRAYS = tuple(s for s in _BY_AGE if s.dims)
_FIRST = tuple(s.name for s in _BY_AGE if s.since == 1)
_LATER = tuple(s.name for s in _BY_AGE if s.since > 1)
NUMBERS = {name: number for number, name in enumerate((*_FIRST, SHAPES, *_LATER), start=1)}
"""Number of each signal's field."""

_DOUBLE = np.dtype("<f8")
_HEAD = struct.Struct("<BqBIB5s")
"""Tag and value of t, of the number of columns, and the values' tag and length.

The length is a varint of five bytes, which any reader takes and which has a fixed place.
"""
_length = lru_cache(lambda size: bytes(size >> 7 * k & 0x7F | (k < 4) << 7 for k in range(5)))


def encode_signals(signals: BlockSignals) -> bytes:
    """A record as the bytes of its message."""
    scalars = list(_TAGGED)
    scalars[1::2] = _FIELDS.numbers(signals)
    arrays = _FIELDS.elements(signals)
    before, sizes = _around(tuple([array.shape for array in arrays]))
    parts: list[Any] = [_STRUCT.pack(*scalars), *before, sizes]
    parts[2:-1:2] = arrays
    return b"".join(parts)


@lru_cache
def _around(shapes: tuple[tuple[int, ...], ...]) -> tuple[list[bytes], bytes]:
    """What stands before each array, with room for it, and behind all; of no elements nothing."""
    before = [b""] * (2 * len(shapes))
    for i, (signal, shape) in enumerate(zip(_ARRAYS, shapes, strict=True)):
        if size := math.prod(shape) * np.dtype(signal.dtype).itemsize:
            before[2 * i] = _tag(signal.name, _LENGTH_DELIMITED) + varint(size)
    sizes = b"".join(varint(size) for shape in shapes for size in shape)
    return before, _tag(SHAPES, _LENGTH_DELIMITED) + varint(len(sizes)) + sizes


def encode_matrix(t: int, matrix: NDArray[np.float64]) -> bytes:
    """(rows, columns) values from frame t on as the bytes of a message."""
    values: Any = np.ascontiguousarray(matrix, dtype=_DOUBLE)
    return b"".join((_head(t, values.shape[1], values.nbytes), values))


def _head(t: int, columns: int, size: int) -> bytes:
    return _HEAD.pack(0x09, t, 0x15, columns, 0x1A, _length(size))


def decode_matrix(data: bytes, where: str = "record") -> tuple[int, NDArray[np.float64]]:
    """The frame counter and (rows, columns) values of a message; raises as `parsed` does."""
    if _as_encoded(data):
        _, t, _, columns, _, _ = _HEAD.unpack_from(data)
        return t, np.frombuffer(data, _DOUBLE, offset=_HEAD.size).reshape(-1, columns).copy()
    decoded = parsed(_MATRIX, data, where)
    values = np.array(decoded.values, dtype=np.float64)
    if values.size and (decoded.columns == 0 or values.size % decoded.columns):
        raise LogDamagedError(f"{where}: {values.size} values in rows of {decoded.columns}")
    rows = values.size // decoded.columns if decoded.columns else 0
    return decoded.t, values.reshape(rows, decoded.columns)


def _as_encoded(data: bytes) -> bool:
    """Whether a matrix is laid out as `encode_matrix` does it, and needs no parser."""
    size = len(data) - _HEAD.size
    _, t, _, columns, _, _ = _HEAD.unpack_from(data) if size >= 0 else (0,) * 6
    return columns > 0 and size % (8 * columns) == 0 and data.startswith(_head(t, columns, size))


def decode_matrices(
    messages: Sequence[bytes], where: str = "record"
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Frames and rows of messages of one size, see `decode_matrix`; at once where it can be."""
    t, first = decode_matrix(messages[0], where)
    values = _HEAD.size, len(messages[0])
    table = alike(messages, [(1, 9), values]) if _as_encoded(messages[0]) else None
    if table is None:
        for data in messages:
            t, rows = decode_matrix(data, where)
            yield t + np.arange(len(rows)), rows
        return
    frames = column(table, (1, 9), "<i8") + np.arange(len(first))
    yield frames.reshape(-1), column(table, values, "<f8").reshape(frames.size, first.shape[1])


def encode_keyframe(keyframe: Keyframe) -> bytes:
    """A keyframe as the bytes of a message."""
    state, arrays = keyframe.state, arrays_of(keyframe.state)
    facts = {
        "version": KEYFRAME_VERSION,
        "versions": keyframe.versions,
        "taken": keyframe.taken,
        "policy_rng": state.policy_rng,
        "arrays": contents(arrays),
    }
    encoded: bytes = _KEYFRAME(
        iteration=keyframe.iteration,
        t=keyframe.t,
        facts=json.dumps(facts),
        values=b"".join(array.tobytes() for array in arrays.values()),
    ).SerializeToString()
    return encoded


def arrays_of(state: LearnerState) -> dict[str, NDArray[Any]]:
    """All arrays of a state by name: its own, and one for each field of its modules."""
    fields = dataclasses.fields(Module)
    return dict(state.arrays) | {
        _MODULES + field.name: np.array([getattr(m, field.name) for m in state.modules])
        for field in fields
    }


def decode_keyframe(data: bytes, where: str = "record") -> Keyframe:
    """The keyframe in the bytes of a message, whose arrays are no larger than these.

    Raises:
        LogDamagedError: the bytes are not such a message, or one of another version.
    """
    decoded = parsed(_KEYFRAME, data, where)
    try:
        facts = parse_json(decoded.facts)
        if facts["version"] != KEYFRAME_VERSION:
            raise LogDamagedError(f"{where}: a keyframe of version {facts['version']!r}")
        arrays = stored_arrays(facts["arrays"], decoded.values)
        columns = {
            name.removeprefix(_MODULES): arrays.pop(name)
            for name in list(arrays)
            if name.startswith(_MODULES)
        }
        state = LearnerState(arrays, _modules(columns), dict(facts["policy_rng"]))
        taken = facts["taken"] if isinstance(facts["taken"], str) else None
        return Keyframe(decoded.iteration, decoded.t, state, dict(facts["versions"]), taken)
    except (LookupError, TypeError, ValueError, OverflowError) as error:
        raise LogDamagedError(f"{where}: not a keyframe ({one_line(error)})") from error


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
            fields[signal.name] = np.full(shape, MISSING[signal.dtype], dtype=signal.dtype)
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


def spans(data: bytes) -> dict[int, Span]:
    """Where the value of each field of a message stands, by the field's number.

    Raises:
        MalformedRecord: it is no message, or a field stands in it twice.
    """
    found: dict[int, Span] = {}
    at = 0
    while at < len(data):
        key, at = _varint(data, at)
        number, kind = key >> 3, key & 7
        if kind == _VARINT:
            end = _varint(data, at)[1]
        elif kind == _LENGTH_DELIMITED:
            length, at = _varint(data, at)
            end = at + length
        elif kind in _WIDTHS:
            end = at + _WIDTHS[kind]
        else:
            raise MalformedRecord("a field of no known kind")
        if end > len(data) or number in found:
            raise MalformedRecord("a field runs over the end, or stands there twice")
        found[number] = at, end
        at = end
    return found


def alike(messages: Sequence[bytes], values: Sequence[Span]) -> NDArray[np.uint8] | None:
    """Messages as (n, size) bytes, where they differ in these values alone; else None.

    Args:
        messages: at least one.
        values: of the first message, not its shape: everything else must be the same in all.
    """
    size = len(messages[0])
    if any(len(message) != size for message in messages):
        return None
    rows = np.frombuffer(b"".join(messages), np.uint8).reshape(len(messages), size)
    same = np.ones(size, dtype=bool)
    for start, stop in values:
        same[start:stop] = False
    return rows if (rows[:, same] == rows[0, same]).all() else None


def column(rows: NDArray[np.uint8], span: Span, dtype: str) -> NDArray[Any]:
    """The values that stand at one place of n messages, (n, values of that place)."""
    return np.ascontiguousarray(rows[:, span[0] : span[1]]).view(dtype)


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = 0
    for k, byte in enumerate(data[at : at + _LONGEST]):
        value |= (byte & 0x7F) << 7 * k
        if byte < 0x80:
            return value, at + k + 1
    raise MalformedRecord("a number runs over the end")


def _array(values: Any, shape: tuple[int, ...], signal: Signal, where: str) -> NDArray[Any]:
    if len(shape) != len(signal.dims) or math.prod(shape) != len(values):
        raise LogDamagedError(
            f"{where}: {signal.name} has {len(values)} values for shape {shape}, see cdmisfa verify"
        )
    return np.array(values, dtype=signal.dtype).reshape(shape)


def _modules(columns: Mapping[str, NDArray[Any]]) -> tuple[Module, ...]:
    values: Any = {
        name: column.tolist() if column.ndim == 1 else list(column)
        for name, column in columns.items()
    }
    rows = zip(*values.values(), strict=True)
    return tuple(Module(**dict(zip(values, row, strict=True))) for row in rows)


def _file(name: str, stem: str, fields: Sequence[_Field]) -> descriptor_pb2.FileDescriptorProto:
    """The definition of a message of our own, in a file of its own."""
    file = descriptor_pb2.FileDescriptorProto(
        name=f"cdmisfa/{stem}.proto", package="cdmisfa", syntax="proto3"
    )
    definition = file.message_type.add(name=name)
    for place, (field, number, kind, many, comment) in enumerate(fields):
        label = _FIELD.LABEL_REPEATED if many else _FIELD.LABEL_OPTIONAL
        definition.field.add(name=field, number=number, type=kind, label=label)
        if comment:
            file.source_code_info.location.add(
                path=[4, 0, 2, place], span=[place, 0, 0], leading_comments=f" {comment}\n"
            )
    return file


def _sentence(signal: Signal) -> str:
    facts = {"symbol": signal.symbol, "equation": signal.equation, "dimensions": signal.dims}
    said = [f"{name} {value}" for name, value in facts.items() if value]
    return "; ".join([signal.about.rstrip("."), *said, f"unit {signal.unit}"]) + "."


def _tag(name: str, wire_type: int) -> bytes:
    return varint(NUMBERS[name] << 3 | wire_type)


def _message_class(file: descriptor_pb2.FileDescriptorProto, name: str) -> Any:
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))


_SIZES = ", ".join(f"{s.name} [{s.dims}]" for s in _ARRAYS)
_SIGNAL_FIELDS: list[_Field] = [
    *((s.name, NUMBERS[s.name], _TYPES[s.dtype], bool(s.dims), _sentence(s)) for s in _BY_AGE),
    (SHAPES, NUMBERS[SHAPES], _FIELD.TYPE_UINT32, True, f"Sizes of the dimensions of {_SIZES}"),
]
_MATRIX_FIELDS: list[_Field] = [
    ("t", 1, _FIELD.TYPE_SFIXED64, False, ""),
    ("columns", 2, _FIELD.TYPE_FIXED32, False, ""),
    ("values", 3, _FIELD.TYPE_DOUBLE, True, ""),
]
_KEYFRAME_FIELDS: list[_Field] = [
    ("iteration", 1, _FIELD.TYPE_SFIXED64, False, "Iterations done"),
    ("t", 2, _FIELD.TYPE_SFIXED64, False, "Next frame"),
    ("facts", 3, _FIELD.TYPE_STRING, False, "JSON: name, type and shape of each array, and more"),
    ("values", 4, _FIELD.TYPE_BYTES, False, "The arrays, one after the other"),
]
_FILES = {
    SIGNALS_SCHEMA: _file("BlockSignals", "block_signals", _SIGNAL_FIELDS),
    MATRIX_SCHEMA: _file("Matrix", "matrix", _MATRIX_FIELDS),
    KEYFRAME_SCHEMA: _file("Keyframe", "keyframe", _KEYFRAME_FIELDS),
}
_SIGNALS, _MATRIX, _KEYFRAME = (_message_class(file, name) for name, file in _FILES.items())

SCHEMAS: Mapping[str, bytes] = {
    name: descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString(deterministic=True)
    for name, file in _FILES.items()
}
"""Each message's definition as a log stores it: a FileDescriptorSet."""

_TAGGED: tuple[Any, ...] = tuple(
    part for s in _SCALARS for part in (_tag(s.name, _WIRE[s.dtype]), None)
)
_LAYOUT = (f"{len(tag)}s{CODES[s.dtype]}" for tag, s in zip(_TAGGED[::2], _SCALARS, strict=True))
_STRUCT = struct.Struct("<" + "".join(_LAYOUT))
_FIELDS = Fields((*_SCALARS, *_ARRAYS))
