"""The one record: its table, its version, its canonical bytes."""

from __future__ import annotations

import dataclasses
import hashlib
from typing import Any

import numpy as np
import pytest

from cdmisfa.core.signals import (
    SCHEMA_VERSION,
    SIGNALS,
    BlockSignals,
    SignalsHash,
    canonical_bytes,
)

SIZES = {"T": 4, "J": 2, "M": 3, "S": 3, "A": 2}

FIELDS = """\
iteration:int64: t:int64: log_time:int64: stream:int64: module:int64:
novel:bool: known_by:int64: saved:bool: share:float64: novel_blocks:int64:
y:float64:TJ y_frozen:float64:MTJ eta:float64:J eta_dot:float64:J
variance:float64:J eta_inst:float64:J gate_mean:float64:J gate_sd:float64:J
eta_inst_frozen:float64:MJ band_mean:float64:MJ band_sd:float64:MJ
roc_error_inst:float64: roc_error:float64: roc_error_frozen:float64:M
xi:float64: xi_dot:float64: curiosity:float64: expert:float64: reward:float64:
R:float64:SAS Q:float64:SA policy:int64:S epsilon:float64: explored:bool:
action:int64: next_stream:int64: change:float64: tested:float64:
fitted:float64: learning_error:float64: interest:float64:S state:int64:S
typical:float64: regret:float64:
"""
"""What the record of version 4 consists of: name, type, dimensions."""


def example(seed: int = 0) -> BlockSignals:
    """A record with distinct values everywhere."""
    rng = np.random.default_rng(seed)
    filled: dict[str, Any] = {}
    for signal in SIGNALS.values():
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
    now = [f"{s.name}:{s.dtype}:{s.dims}" for s in SIGNALS.values()]
    assert now == FIELDS.split(), "the fields changed: raise SCHEMA_VERSION, change FIELDS"
    assert SCHEMA_VERSION == 4


def test_every_signal_is_described() -> None:
    assert list(SIGNALS) == [f.name for f in dataclasses.fields(BlockSignals)]
    assert {s.equation for s in SIGNALS.values()} == {"", "1", "2", "3", "4", "5", "6"}
    for signal in SIGNALS.values():
        assert signal.about.endswith("."), signal.name
        assert signal.unit
        assert set(signal.dims) <= set(SIZES)
        assert signal.show in ("line", "lane", "heat", "text", "hidden")
        assert signal.show != "heat" or len(signal.dims) >= 2


def plain_bytes(record: BlockSignals) -> bytes:
    """The canonical bytes, field by field, as `SignalsHash` describes them."""
    parts = []
    for signal in SIGNALS.values():
        value = np.asarray(getattr(record, signal.name), dtype=signal.dtype)
        assert value.dtype == np.dtype(signal.dtype)
        assert value.ndim == len(signal.dims)
        parts.append(np.array(value.shape, dtype="<i8").tobytes())
        if value.dtype.kind == "f":
            value = np.where(np.isnan(value), np.nan, value)
        parts.append(np.ascontiguousarray(value, dtype=value.dtype.newbyteorder("<")).tobytes())
    return b"".join(parts)


@pytest.mark.parametrize("seed", range(1, 5))
@pytest.mark.parametrize("odd", [np.nan, -np.nan, np.inf, -0.0])
def test_the_bytes_are_the_documented_ones_however_arrays_lie(seed: int, odd: float) -> None:
    rng = np.random.default_rng(seed)
    record = example(seed)
    for signal in SIGNALS.values():
        value = np.asarray(getattr(record, signal.name), dtype=signal.dtype)
        given: Any = value
        if signal.dtype == "float64":
            value = np.where(rng.random(value.shape) < 0.4, odd, value)
            empty = value[:0] if signal.dims and rng.random() < 0.3 else value
            given = np.asfortranarray(empty).astype(">f8") if signal.dims else float(empty)
        elif signal.dims:
            given = np.repeat(value.astype(">i8"), 2, axis=0)[::2]
        record = dataclasses.replace(record, **{signal.name: given})
    assert canonical_bytes(record) == plain_bytes(record)


def test_the_hash_is_over_all_records_in_order() -> None:
    first, second = example(1), example(2)
    digest, swapped = SignalsHash(), SignalsHash()
    for one, other in ((first, second), (second, first)):
        digest.add(one)
        swapped.add(other)
    both = canonical_bytes(first) + canonical_bytes(second)
    assert digest.hexdigest() == hashlib.sha256(both).hexdigest() != swapped.hexdigest()
    assert digest.count == 2
