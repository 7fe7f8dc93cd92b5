"""`cdmisfa.Matrix`: rows of float64 from frame t on, exact to the bit.

It carries a block's vectors, a block's ground truth, and the abstraction's weights.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message, message_factory
from numpy.typing import NDArray

from cdmisfa.core.errors import LogDamagedError

MESSAGE = "cdmisfa.Matrix"
"""Full name of the message in the log's schema."""

_FIELD = descriptor_pb2.FieldDescriptorProto
_HEAD = struct.Struct("<BqBIBI")
"""Tag and value of t, of the number of columns, and the values' tag and length.

The length of the values is written as a varint of five bytes, which any reader
takes and which has a fixed place.
"""


def file_descriptor() -> descriptor_pb2.FileDescriptorProto:
    """The message's definition."""
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


def schema_data() -> bytes:
    """The definition as a log stores it: a FileDescriptorSet."""
    data: bytes = descriptor_pb2.FileDescriptorSet(file=[file_descriptor()]).SerializeToString(
        deterministic=True
    )
    return data


def encode(t: int, matrix: NDArray[np.float64]) -> bytes:
    """(rows, columns) values from frame t on as the bytes of a message."""
    values = np.asarray(matrix, dtype="<f8")
    return (
        _HEAD.pack(0x09, t, 0x15, values.shape[1], 0x1A, _padded_varint(values.nbytes))
        + bytes((values.nbytes >> 28 & 0x7F,))
        + values.tobytes()
    )


def decode(data: bytes, where: str = "record") -> tuple[int, NDArray[np.float64]]:
    """The frame counter and the (rows, columns) values of a message.

    Raises:
        LogDamagedError: the bytes are not such a message.
    """
    try:
        decoded = _CLASS.FromString(data)
    except message.DecodeError as error:
        raise LogDamagedError(f"{where}: not a {MESSAGE} message, see cdmisfa verify") from error
    values = np.array(decoded.values, dtype=np.float64)
    if values.size and (decoded.columns == 0 or values.size % decoded.columns):
        raise LogDamagedError(f"{where}: {values.size} values in rows of {decoded.columns}")
    rows = values.size // decoded.columns if decoded.columns else 0
    return decoded.t, values.reshape(rows, decoded.columns)


def _padded_varint(value: int) -> int:
    """The first four of a varint's five bytes, as a little-endian number."""
    number = 0
    for byte in range(4):
        number |= (value >> 7 * byte & 0x7F | 0x80) << 8 * byte
    return number


def _message_class() -> Any:
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file_descriptor())
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(MESSAGE))


_CLASS = _message_class()
