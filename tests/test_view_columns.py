"""Records read many at once are, bit for bit, those read one by one."""

from __future__ import annotations

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from run_data import IMAGE, VECTOR, run_of, write_run

from cdmisfa.core.signals import SIGNALS
from replay.runs.codec import (
    MATRIX_DEFINITION,
    SIGNALS_DEFINITION,
    decode_columns,
    decode_matrices,
    encode_matrix,
    encode_signals,
)
from replay.runs.columns import columns_of_records
from replay.runs.log import read_batches, read_header
from replay.runs.run import read_outline

ITERATIONS = 30


def records(outputs=1):
    return [s for s, _ in run_of(VECTOR, ITERATIONS, outputs=outputs, saves=True)]


def rewritten(definition, data):
    """A message as protobuf writes it, which knows it from the definition in the log alone."""
    (file,) = descriptor_pb2.FileDescriptorSet.FromString(definition).file
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    kind = pool.FindMessageTypeByName(f"{file.package}.{file.message_type[0].name}")
    return message_factory.GetMessageClass(kind).FromString(data).SerializeToString()


def bits(value):
    array = np.ascontiguousarray(value)
    return array.dtype.kind, array.shape, array.tobytes()


def same(columns, expected):
    """Whether pieces of columns hold these records, every NaN and every empty array too."""
    pieces = list(columns)
    assert sum(map(len, pieces)) == len(expected)
    at = 0
    for piece in pieces:
        for i in range(len(piece)):
            for name, signal in SIGNALS.items():
                value = np.asarray(getattr(expected[at + i], name), dtype=signal.dtype)
                assert bits(piece[name][i]) == bits(value), name
        at += len(piece)
    return len(pieces)


@pytest.mark.parametrize("outputs", [1, 3])
def test_messages_become_columns_bit_for_bit(outputs):
    written = records(outputs)
    messages = [encode_signals(s) for s in written]
    assert same(decode_columns(messages), written) == 3  # 0, 1 and 2 modules
    assert same(columns_of_records(written), written) == 3


def test_messages_laid_out_otherwise_are_decoded_one_by_one():
    """Protobuf allows fields in any order, and leaves out numbers that are zero."""
    written = records()[:8]
    ours = [encode_signals(s) for s in written]
    theirs = [rewritten(SIGNALS_DEFINITION, data) for data in ours]
    same(decode_columns([*ours[:3], *theirs[3:6], *ours[6:]]), written)
    turned = [*ours]
    turned[1] = ours[1][9:] + ours[1][:9]  # the iteration is last, and the size the same
    same(decode_columns(turned), written)


@pytest.mark.parametrize("spec", [IMAGE, VECTOR], ids=["images", "vectors"])
def test_one_pass_reads_records_in_batches_and_the_frames_asked_for(tmp_path, monkeypatch, spec):
    monkeypatch.setattr("replay.runs.log.BATCH_ITERATIONS", 7)
    log = tmp_path / "run.mcap"
    written = write_run(log, spec, ITERATIONS, phi_every=10)
    result = list(read_batches(log, read_header(log)))
    assert [sum(map(len, s.signals)) for s in result] == [7, 7, 7, 7, 2]
    same((columns for s in result for columns in s.signals), written)
    some = read_batches(log, read_header(log), every=30)
    times = [t for s in some for frames, _ in s.watched for t in frames.tolist()]
    assert times == list(range(0, ITERATIONS * 40, 30 if spec is IMAGE else 1))


def test_an_outline_sums_the_records_up(tmp_path):
    written = write_run(tmp_path / "run.mcap", VECTOR, ITERATIONS, saves=True)
    outline = read_outline(tmp_path)
    assert outline.iterations == ITERATIONS
    assert [s.iteration for s in outline.saved] == [s.iteration for s in written if s.saved]
    phase = [s for s in written if s.module == written[-1].module]
    assert (outline.last.blocks, outline.last.novel) == (len(phase), sum(s.novel for s in phase))
    expected = np.bincount([s.stream for s in phase if s.novel], minlength=3)
    np.testing.assert_array_equal(outline.last.novel_of, expected)
    np.testing.assert_array_equal(outline.lines["xi"], [s.xi for s in written])


def test_matrices_of_one_size_are_read_bit_for_bit_however_they_are_laid_out():
    rng = np.random.default_rng(0)
    rows = rng.standard_normal((4, 5, 3))
    rows[1, 2] = np.array([0x7FF8_0000_0000_0001, 1 << 63, 0], np.uint64).view(np.float64)
    ours = [encode_matrix(5 * i, values) for i, values in enumerate(rows)]
    plain = [rewritten(MATRIX_DEFINITION, data) for data in ours]
    for messages, pieces, first in ((ours, 1, 0), (plain[1:], 3, 1)):
        matrices = list(decode_matrices(messages))
        assert len(matrices) == pieces
        t = np.concatenate([t for t, _ in matrices])
        np.testing.assert_array_equal(t, 5 * np.arange(first, len(rows)))
        values = np.concatenate([values for _, values in matrices])
        assert values.tobytes() == rows[first:].tobytes()
    empty = list(decode_matrices([encode_matrix(7, rows[0, :0])] * 2))
    assert [(t.tolist(), values.shape) for t, values in empty] == [([7], (1, 0, 3))] * 2
