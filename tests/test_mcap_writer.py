"""Our writer of MCAP, against that of the mcap package."""

import io
import random
from functools import partial

import lz4.frame
import pytest
from mcap.writer import CompressionType, Writer

from recorder.mcap.writer import McapWriter


@pytest.mark.parametrize("seed", range(24))
def test_the_bytes_are_those_of_the_mcap_package(seed, monkeypatch):
    independent = partial(lz4.frame.compress, block_linked=False)
    monkeypatch.setattr("mcap.writer.lz4.frame.compress", independent)
    rng = random.Random(seed)
    compression, size = ("zstd", "lz4", "none")[seed % 3], rng.choice([100, 1_000, 100_000])
    one, two = io.BytesIO(), io.BytesIO()
    theirs = Writer(
        one,
        chunk_size=size,
        compression=CompressionType[compression.upper()],
        enable_data_crcs=True,
    )
    theirs.start(profile="p", library="l")
    ours = McapWriter(two, library="l", profile="p", compression=compression, chunk_size=size)
    channels: list[int] = []
    for step in range(rng.randrange(80)):
        what, data = rng.random(), rng.randbytes(rng.randrange(300))
        if what < 0.1:
            schema = theirs.register_schema(f"n{step}", "protobuf", data)
            assert ours.add_schema(f"n{step}", "protobuf", data) == schema
        elif what < 0.2 or not channels:
            facts = {"unit": "ä"} if rng.random() < 0.5 else {}
            channels.append(theirs.register_channel("/t", "json", 0, facts))
            assert ours.add_channel("/t", 0, encoding="json", metadata=facts) == channels[-1]
        elif what < 0.25:
            theirs.add_metadata("m", {"é": "ü", "a": ""})
            ours.add_metadata("m", {"é": "ü", "a": ""})
        elif what < 0.3:
            theirs.add_attachment(3, 4, "file", "text/plain", data)
            ours.add_attachment("file", "text/plain", data, log_time=4, create_time=3)
        elif what < 0.35:
            theirs.flush()
            ours.end_chunk()
        else:
            messages = []
            for _ in range(rng.choice([1, 1, 2, 5])):
                time, number = rng.randrange(2**62), rng.randrange(2**32)
                messages.append((rng.choice(channels), time, data, time + 1, number))
                theirs.add_message(*messages[-1])
                data = rng.randbytes(rng.randrange(300))
            ours.add_messages(messages)
    theirs.finish()
    ours.end()
    assert two.getvalue() == one.getvalue()
