"""Messages of a recording: what goes in comes out, at the bytes a fast reader looks at."""

import numpy as np
import pytest
from foxglove_schemas_protobuf import RawImage_pb2
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from hypothesis import given
from hypothesis import strategies as st

from cdmisfa.core.blocks import SourceSpec
from cdmisfa.core.errors import LogDamagedError
from recorder.log.manifest import RecordingSpec, ViewMetadata
from recorder.log.messages import (
    ImageEncoder,
    Payload,
    TruthEncoder,
    VectorEncoder,
    image_payload,
    truth_tags,
    vector_payload,
)

TIMES = st.integers(0, 2**62)
DOUBLES = st.lists(st.floats(), min_size=1, max_size=20)


def values(message: bytes, payload: Payload) -> bytes:
    end = len(message) - payload.tail
    start = end - payload.size
    assert message[start - len(payload.before) : start] == payload.before
    return message[start:end]


def decode(encoder, message: bytes):
    """Decode with nothing but the schema a log holds."""
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(encoder.schema_data()).file:
        pool.Add(file)
    described = pool.FindMessageTypeByName(encoder.schema)
    return message_factory.GetMessageClass(described).FromString(message)


@given(TIMES, st.integers(1, 40), st.integers(1, 200), st.sampled_from(["", "left", "é" * 90]))
def test_images(time, height, width, frame_id):
    wide = np.random.default_rng(0).integers(0, 256, (height, 2 * width), dtype=np.uint8)
    encoder = ImageEncoder(height, width, frame_id)
    edges = [0, 1, 127, 128, 2**21, 2**28 - 1, 2**28, 2**28 + 1, 999_999_999]
    for at in (time, *(s * 10**9 + n for s in (0, 1, 127, 128, 1_451_606_400) for n in edges)):
        frame = wide[:, ::2]
        message = encoder(at, frame)
        assert values(message, image_payload(height, width, frame_id)) == frame.tobytes()
        image = RawImage_pb2.RawImage.FromString(message)
        assert (image.height, image.width, image.step) == (height, width, width)
        assert (image.encoding, image.frame_id) == ("mono8", frame_id)
        assert image.timestamp.ToNanoseconds() == at
        assert message == image.SerializeToString()
    assert decode(encoder, message).data == frame.tobytes()


@given(TIMES, DOUBLES)
def test_vectors_are_exact_to_the_bit(time, numbers):
    frame = np.array(numbers)
    encoder = VectorEncoder()
    message = encoder(time, frame)
    assert values(message, vector_payload(len(frame))) == frame.astype("<f8").tobytes()
    decoded = decode(encoder, message)
    assert np.array(decoded.values).tobytes() == frame.tobytes()
    assert decoded.timestamp.ToNanoseconds() == time


@given(TIMES, DOUBLES)
def test_truth_has_one_layout_whatever_its_values(time, numbers):
    names = [f"object{i}_x" for i in range(len(numbers))]
    row = np.array(numbers)
    encoder = TruthEncoder(names)
    message = encoder(time, row)
    fields = [
        tag + row[i : i + 1].astype("<f8").tobytes() for i, tag in enumerate(truth_tags(names))
    ]
    assert message.endswith(b"".join(fields))
    decoded = decode(encoder, message)
    assert np.array([getattr(decoded, name) for name in names]).tobytes() == row.tobytes()


@given(
    shape=st.one_of(
        st.tuples(st.integers(1, 99)), st.tuples(st.integers(1, 99), st.integers(1, 99))
    ),
    fps=st.one_of(st.floats(1e-3, 1e6), st.integers(1, 1000)),
    truth=st.lists(st.sampled_from(["x", "y", "angle"]), unique=True),
    first=st.integers(0, 2**33),
)
def test_what_a_file_states_is_read_as_it_was_written(
    shape: tuple[int, ...], fps: float, truth: list[str], first: int
) -> None:
    dtype = "uint8" if len(shape) == 2 else "float64"
    spec = SourceSpec(("left", "right"), shape, dtype, tuple(truth), fps, 10**18)
    facts = RecordingSpec("icub", 3, spec, {"scene": {}}, ("pillow",)).metadata("right", first)
    values = facts.record()
    assert list(values)[:4] == ["schema", "scene", "view", "stream_index"]
    assert ViewMetadata.parse("x.mcap", values) == facts
    for key in ("view", "stream_index", "frame_shape", "dtype", "fps", "start_ns"):
        with pytest.raises(LogDamagedError, match=rf"x\.mcap: its metadata .*{key}"):
            ViewMetadata.parse("x.mcap", {k: v for k, v in values.items() if k != key})
