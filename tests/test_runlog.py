"""A run's log gives back what was written, to the bit, whole or cut anywhere."""

from __future__ import annotations

import contextlib
import os

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from run_data import IMAGE, VECTOR, parts_of, read_signals, rows_of, run_of, signals_of, write_run

from cdmisfa.core.blocks import SourceSpec
from cdmisfa.core.errors import LogDamagedError
from cdmisfa.core.signals import SIGNALS, canonical_bytes
from cdmisfa.public.run import Run
from replay.runs.codec import decode_matrices, decode_signals, encode_matrix, encode_signals
from replay.runs.log import read_header


@given(
    seed=st.integers(0, 2**32),
    streams=st.integers(1, 70),
    tau=st.integers(3, 60),
    modules=st.integers(0, 4),
    outputs=st.integers(1, 3),
    k=st.integers(0, 10_000),
)
def test_a_record_of_any_shape_comes_back_to_the_bit(seed, streams, tau, modules, outputs, k):
    spec = SourceSpec(tuple(f"s{i}" for i in range(streams)), (2,), "float64")
    rng = np.random.default_rng(seed)
    signals = signals_of(spec, k, rng, tau=tau, modules=modules, outputs=outputs)
    back = decode_signals(encode_signals(signals))
    assert canonical_bytes(back) == canonical_bytes(signals)


@given(bits=st.lists(st.integers(0, 2**64 - 1), min_size=1, max_size=8))
def test_every_pattern_of_bits_of_a_number_survives(bits):
    rng = np.random.default_rng(0)
    signals = signals_of(VECTOR, 1, rng, tau=len(bits), modules=0)
    y = np.array(bits, dtype=np.uint64).view(np.float64)[:, None]
    signals = type(signals)(**{n: getattr(signals, n) for n in SIGNALS if n != "y"}, y=y)
    back = decode_signals(encode_signals(signals))
    assert back.y.tobytes() == y.tobytes()


@given(data=st.binary(max_size=300))
def test_bytes_that_are_no_record_fail_in_words_or_not_at_all(data):
    with contextlib.suppress(LogDamagedError):
        decode_signals(data, "here")
    with contextlib.suppress(LogDamagedError):
        list(decode_matrices([data], "here"))


@pytest.mark.parametrize("spec", [IMAGE, VECTOR], ids=["images", "vectors"])
def test_a_run_reads_back_as_written(spec, tmp_path):
    path = tmp_path / "run" / "run.mcap"
    path.parent.mkdir()
    written = write_run(path, spec, 30, watched_every=7, phi_every=10)
    back = list(read_signals(path.parent))
    assert [canonical_bytes(s) for s in back] == [canonical_bytes(s) for s in written]
    header = read_header(path)
    assert header.spec == spec
    assert header.setting("learner", "tau") == 40
    assert header.manifest["seed"] == 0
    blocks = [block for _, block in run_of(spec, 30)]
    frames = np.concatenate([b.frames for b in blocks])
    if spec.images:
        frames = frames[::7]
        watched = np.concatenate([at for at, _ in parts_of(path, "watched")])
        assert watched.tolist() == list(range(0, 1200, 7))
    assert rows_of(path, "watched").tobytes() == frames.tobytes()
    truth = np.concatenate([at for at, _ in parts_of(path, "truth")])
    assert truth.tolist() == list(range(1200))
    assert rows_of(path, "truth").tobytes() == b"".join(b.truth.tobytes() for b in blocks)
    phi = [(t, weights[0, 0]) for t, weights in parts_of(path, "phi")]
    assert phi == [(0, 0.0), (400, 10.0), (800, 20.0)]
    (event,) = parts_of(path, "events")
    assert (event.t, event.iteration, event.level) == (1200, 29, "INFO")
    assert event.text == "stopped: the test is over"


def test_the_same_run_is_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        write_run(tmp_path / name, VECTOR, 12)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_the_log_opens_without_us_and_tells_its_units(tmp_path):
    path = tmp_path / "run.mcap"
    written = write_run(path, IMAGE, 5)
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True)
        messages = list(reader.iter_messages(["/signals"]))
    assert [m.log_time for _, _, m in messages] == [s.log_time for s in written]
    schema = messages[0][0]
    assert (schema.name, schema.encoding) == ("cdmisfa.BlockSignals", "protobuf")
    assert "η̇".encode() in schema.data
    assert b"unit 1/frame" in schema.data


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("fps", 0.0, "frames a second: give"),
        ("fps", "often", "not supported"),
        ("streams", 3, "not iterable"),
        ("colour", 1, "unexpected keyword"),
        *((None, version, "") for version in ("0", "-1", "two", "9" * 5000)),
    ],
)
def test_a_header_or_a_version_that_cannot_be_is_damage(tmp_path, monkeypatch, key, value, words):
    path = tmp_path / "run.mcap"
    with monkeypatch.context() as patch:
        if key is None:
            patch.setattr("replay.runs.writer.SCHEMA_VERSION", value)
        else:
            stated = VECTOR.as_json() | {key: value}
            patch.setattr(SourceSpec, "as_json", lambda spec: stated)
        write_run(path, VECTOR, 2)
    with pytest.raises(LogDamagedError, match=f"metadata cdmisfa.run is broken.*{words}"):
        list(read_signals(path))


def test_a_partial_log_reads_wherever_it_was_cut(tmp_path, monkeypatch):
    monkeypatch.setattr("replay.runs.writer.CHUNK_BYTES", 4096)
    whole = tmp_path / "whole.mcap"
    expected = [canonical_bytes(s) for s in write_run(whole, VECTOR, 20)]
    data = whole.read_bytes()
    cut = tmp_path / "run.mcap.partial"
    lengths = []
    for size in np.linspace(len(data) // 2, len(data) - 1, 12).astype(int):
        cut.write_bytes(data[:size])
        back = [canonical_bytes(s) for s in read_signals(tmp_path)]
        assert back == expected[: len(back)]
        lengths.append(len(back))
    assert lengths == sorted(lengths)
    assert 5 < lengths[0] < lengths[-1] == 20
    os.truncate(whole, len(data) // 2)
    with pytest.raises(LogDamagedError, match="cut short"):
        list(read_signals(whole))


def test_a_message_does_not_depend_on_how_arrays_lie_in_memory():
    rng = np.random.default_rng(1)
    signals = signals_of(VECTOR, 3, rng, tau=6, modules=2, outputs=2)
    fields = {name: getattr(signals, name) for name in SIGNALS}
    fields |= {
        "R": np.asfortranarray(signals.R),
        "Q": signals.Q.astype(">f8"),
        "policy": signals.policy.astype(np.int32),
        "y": np.repeat(signals.y, 2, axis=0)[::2],
    }
    assert encode_signals(type(signals)(**fields)) == encode_signals(signals)
    wide = rng.standard_normal((4, 6))
    for matrix in (wide, wide[:, ::2], np.asfortranarray(wide), wide.astype(">f8"), wide[:0]):
        ((t, back),) = decode_matrices([encode_matrix(7, matrix)])
        assert t == [7]
        np.testing.assert_array_equal(back[0], matrix)


ITERATIONS = 20


@pytest.fixture
def folder(tmp_path):
    return tmp_path, write_run(tmp_path / "run.mcap", VECTOR, ITERATIONS, saves=True)


def test_signals_are_columns_over_all_iterations(folder):
    path, records = folder
    run = Run(path)
    assert run.streams == VECTOR.streams
    assert set(run.signals) == set(SIGNALS)
    assert "etta" not in run.signals
    for name, about in SIGNALS.items():
        column = run.signals[name]
        assert (column.dtype, len(column)) == (np.dtype(about.dtype), ITERATIONS)
        for k, record in enumerate(records):
            expected = np.asarray(getattr(record, name))
            inner = tuple(slice(size) for size in expected.shape)
            np.testing.assert_array_equal(column[k][inner], expected)
            if about.dims.startswith("M"):
                assert np.isnan(column[k][len(expected) :]).all()
