"""The one record: its table, its version, its canonical bytes."""

from __future__ import annotations

import dataclasses
import hashlib
from typing import Any

import numpy as np
import pytest

from cdmisfa.core.signals import (
    MISSING,
    SCHEMA_VERSION,
    SIGNALS,
    BlockSignals,
    SignalsHash,
    canonical_bytes,
    signal_table,
    values,
)

SIZES = {"T": 4, "J": 2, "M": 3, "S": 3, "A": 2}

GOLDEN = {
    1: "iteration:int64: t:int64: log_time:int64: stream:int64: module:int64: novel:bool: "
    "known_by:int64: saved:bool: share:float64: novel_blocks:int64: y:float64:TJ "
    "y_frozen:float64:MTJ eta:float64:J eta_dot:float64:J variance:float64:J "
    "eta_inst:float64:J gate_mean:float64:J gate_sd:float64:J eta_inst_frozen:float64:MJ "
    "band_mean:float64:MJ band_sd:float64:MJ xi:float64: xi_dot:float64: curiosity:float64: "
    "expert:float64: reward:float64: R:float64:SAS Q:float64:SA policy:int64:S "
    "epsilon:float64: explored:bool: action:int64: next_stream:int64:",
    2: "iteration:int64: t:int64: log_time:int64: stream:int64: module:int64: novel:bool: "
    "known_by:int64: saved:bool: share:float64: novel_blocks:int64: y:float64:TJ "
    "y_frozen:float64:MTJ eta:float64:J eta_dot:float64:J variance:float64:J "
    "eta_inst:float64:J gate_mean:float64:J gate_sd:float64:J eta_inst_frozen:float64:MJ "
    "band_mean:float64:MJ band_sd:float64:MJ roc_error_inst:float64: roc_error:float64: "
    "roc_error_frozen:float64:M xi:float64: xi_dot:float64: curiosity:float64: "
    "expert:float64: reward:float64: R:float64:SAS Q:float64:SA policy:int64:S "
    "epsilon:float64: explored:bool: action:int64: next_stream:int64:",
    3: "iteration:int64: t:int64: log_time:int64: stream:int64: module:int64: novel:bool: "
    "known_by:int64: saved:bool: share:float64: novel_blocks:int64: y:float64:TJ "
    "y_frozen:float64:MTJ eta:float64:J eta_dot:float64:J variance:float64:J "
    "eta_inst:float64:J gate_mean:float64:J gate_sd:float64:J eta_inst_frozen:float64:MJ "
    "band_mean:float64:MJ band_sd:float64:MJ roc_error_inst:float64: roc_error:float64: "
    "roc_error_frozen:float64:M xi:float64: xi_dot:float64: curiosity:float64: "
    "expert:float64: reward:float64: R:float64:SAS Q:float64:SA policy:int64:S "
    "epsilon:float64: explored:bool: action:int64: next_stream:int64: "
    "change:float64: tested:float64: fitted:float64: learning_error:float64: "
    "interest:float64:S state:int64:S",
}
"""What each version of the record consists of; old entries are never changed."""


def example(seed: int = 0) -> BlockSignals:
    """A record with distinct values everywhere."""
    rng = np.random.default_rng(seed)
    filled: dict[str, Any] = {}
    for signal in signal_table():
        shape = tuple(SIZES[d] for d in signal.dims)
        if signal.dtype == "bool":
            filled[signal.name] = bool(rng.integers(2))
        elif signal.dtype == "int64":
            value = rng.integers(0, 1000, shape)
            filled[signal.name] = value if shape else int(value)
        else:
            filled[signal.name] = rng.standard_normal(shape) if shape else float(rng.random())
    return BlockSignals(**filled)


def test_changing_the_fields_means_raising_the_version() -> None:
    now = " ".join(f"{s.name}:{s.dtype}:{s.dims}" for s in signal_table())
    assert max(GOLDEN) == SCHEMA_VERSION, "add the new version's fields to GOLDEN"
    assert now == GOLDEN[SCHEMA_VERSION], "the fields changed: raise SCHEMA_VERSION, extend GOLDEN"


@pytest.mark.parametrize("version", list(GOLDEN))
def test_since_says_what_each_version_holds(version: int) -> None:
    held = " ".join(f"{s.name}:{s.dtype}:{s.dims}" for s in signal_table() if s.since <= version)
    assert held == GOLDEN[version]


def test_a_later_signal_can_be_missing() -> None:
    assert {s.dtype for s in signal_table() if s.since > 1} <= set(MISSING)


def test_every_signal_is_described() -> None:
    assert list(SIGNALS) == [f.name for f in dataclasses.fields(BlockSignals)]
    for signal in SIGNALS.values():
        assert signal.about.endswith("."), signal.name
        assert signal.unit
        assert signal.dtype in ("float64", "int64", "bool")
        assert set(signal.dims) <= set(SIZES)
        assert signal.equation in ("", "1", "2", "3", "4", "5", "6")
        assert signal.show in ("line", "lane", "heat", "text", "hidden")
        assert signal.show != "heat" or len(signal.dims) >= 2


def test_every_equation_of_the_learner_has_its_signal() -> None:
    assert {s.equation for s in SIGNALS.values()} - {""} == {"1", "2", "3", "4", "5", "6"}


def test_values_come_as_arrays_of_the_documented_type() -> None:
    for signal, value in values(example()):
        assert value.dtype == np.dtype(signal.dtype)
        assert value.ndim == len(signal.dims)


@pytest.mark.parametrize("name", list(SIGNALS))
def test_every_element_of_every_field_counts(name: str) -> None:
    record = example()
    before = canonical_bytes(record)
    value = np.array(getattr(record, name))
    flat = value.reshape(-1)
    for k in range(flat.size):
        changed = flat.copy()
        changed[k] = not changed[k] if value.dtype == bool else np.nextafter(changed[k], np.inf)
        if value.dtype.kind == "i":
            changed[k] = flat[k] + 1
        other = dataclasses.replace(record, **{name: changed.reshape(value.shape)})
        assert canonical_bytes(other) != before, (name, k)


def test_the_shape_counts_too() -> None:
    record = example()
    other = dataclasses.replace(record, y=record.y.reshape(2, 4))
    assert canonical_bytes(other) != canonical_bytes(record)
    some = dataclasses.replace(record, eta=np.empty(0))
    none = dataclasses.replace(record, eta=np.empty((0, 2)))
    assert canonical_bytes(some) != canonical_bytes(none)


def test_memory_layout_and_byte_order_do_not_count() -> None:
    record = example()
    other = dataclasses.replace(
        record,
        R=np.asfortranarray(record.R),
        Q=record.Q.astype(">f8"),
        policy=record.policy.astype(">i8"),
        y=np.repeat(record.y, 2, axis=0)[::2],
        stream=np.int64(record.stream),
    )
    assert canonical_bytes(other) == canonical_bytes(record)


def test_the_bytes_are_the_documented_ones() -> None:
    record = example()
    data = canonical_bytes(record)
    assert data[:8] == np.array(record.iteration, "<i8").tobytes()
    at = data.index(np.array(record.R.shape, "<i8").tobytes() + record.R.astype("<f8").tobytes())
    assert at > 0
    fields = [(s, v) for s, v in values(record)]
    assert len(data) == sum(8 * v.ndim + v.size * v.itemsize for _, v in fields)


def plain_bytes(record: BlockSignals, version: int) -> bytes:
    """The canonical bytes, field by field, as `SignalsHash` describes them."""
    parts = []
    for _, value in values(record, version):
        parts.append(np.array(value.shape, dtype="<i8").tobytes())
        if value.dtype.kind == "f":
            value = np.where(np.isnan(value), np.nan, value)
        parts.append(np.ascontiguousarray(value, dtype=value.dtype.newbyteorder("<")).tobytes())
    return b"".join(parts)


@pytest.mark.parametrize("version", list(GOLDEN))
@pytest.mark.parametrize("seed", range(4))
def test_the_bytes_are_those_of_the_plain_way(version: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    record = example(seed)
    for signal, value in values(record):
        if signal.dtype == "float64":
            odd = np.where(
                rng.random(value.shape) < 0.4, [np.nan, -np.nan, np.inf, -0.0][seed], value
            )
            empty = odd[:0] if signal.dims and rng.random() < 0.3 else odd
            given = np.asfortranarray(empty).astype(">f8") if signal.dims else float(empty)
            record = dataclasses.replace(record, **{signal.name: given})
    assert canonical_bytes(record, version) == plain_bytes(record, version)


def test_nan_equals_nan_but_not_a_number() -> None:
    record = dataclasses.replace(example(), reward=float("nan"))
    again = dataclasses.replace(example(), reward=np.float64("nan"))
    assert canonical_bytes(record) == canonical_bytes(again)
    assert canonical_bytes(record) != canonical_bytes(dataclasses.replace(record, reward=0.0))


def test_every_nan_is_the_same_nan() -> None:
    """Whether a NaN carries a sign depends on the processor, not on the learner."""
    record = dataclasses.replace(example(), eta=np.array([np.nan, 1.0]), reward=float("nan"))
    negative = np.copysign(np.nan, -1.0)
    again = dataclasses.replace(record, eta=np.array([negative, 1.0]), reward=float(negative))
    assert canonical_bytes(record) == canonical_bytes(again)


def test_the_hash_is_over_all_records_in_order() -> None:
    first, second = example(1), example(2)
    digest = SignalsHash()
    empty = digest.hexdigest()
    digest.add(first)
    digest.add(second)
    both = canonical_bytes(first) + canonical_bytes(second)
    assert digest.hexdigest() == hashlib.sha256(both).hexdigest()
    assert digest.count == 2
    swapped = SignalsHash()
    swapped.add(second)
    swapped.add(first)
    assert len({empty, digest.hexdigest(), swapped.hexdigest()}) == 3
