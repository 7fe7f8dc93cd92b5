"""A run of the first version of the record opens like any other, what it lacks is NaN.

`data/signals_v1` holds 8 iterations of CD-MISFA 1.0 written by that version.
"""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from run_data import VECTOR, having, parts_of, read_signals, rows_of, write_run
from view_data import tabs_of, views_of

from cdmisfa.core.blocks import Block
from cdmisfa.core.errors import LogDamagedError, UsageError
from cdmisfa.core.learning import ARITHMETIC
from cdmisfa.core.signals import NO_STATE, SCHEMA_VERSION, SIGNALS, BlockSignals, canonical_bytes
from cdmisfa.experiments.resume import refuse_difference
from replay.runs.codec import decode_signals, encode_signals
from replay.runs.compare import first_difference
from replay.runs.log import read_header
from replay.runs.writer import RunWriter

OLD = Path(__file__).parent / "data" / "signals_v1"
SIGNALS_SHA256 = "b86ab92af6b8ba255cb239dd54c187a1adbdccc9b43f096a348ad4f83bd85a2f"
"""What the version that wrote it said of its signals."""

LACKS = (
    "roc_error_inst",
    "roc_error",
    "roc_error_frozen",
    "change",
    "tested",
    "fitted",
    "learning_error",
    "interest",
    "state",
    "typical",
    "regret",
)


def test_every_bit_of_the_old_signals_is_read() -> None:
    digest = hashlib.sha256()
    for signals in read_signals(OLD):
        digest.update(canonical_bytes(signals, 1))
    assert digest.hexdigest() == SIGNALS_SHA256


def test_what_it_lacks_is_nan_in_its_shape() -> None:
    assert read_header(OLD).missing == LACKS
    records = list(read_signals(OLD))
    assert [len(s.roc_error_frozen) for s in records] == [len(s.y_frozen) for s in records]
    assert sorted({len(s.y_frozen) for s in records}) == [0, 1]
    for record in records:
        for name in LACKS:
            value = np.asarray(getattr(record, name))
            assert value.dtype == SIGNALS[name].dtype
            assert value.ndim == len(SIGNALS[name].dims)
            assert (np.isnan(value) | (value == NO_STATE)).all()


def test_info_says_so(cdmisfa) -> None:
    assert "signals of version 1: roc_error_inst, roc_error, " in cdmisfa("info", OLD).out
    signals = cdmisfa("info", OLD, "--json").json["signals"]
    assert signals == {"version": 1, "missing": list(LACKS)}


def test_it_can_be_shown_and_exported(cdmisfa, tmp_path) -> None:
    for words in (
        ("view", OLD, "--save", tmp_path / "old.rrd"),
        ("export", OLD, "-o", tmp_path / "old.parquet"),
    ):
        assert cdmisfa(*words).code == 0, words
    assert (tmp_path / "old.rrd").stat().st_size > 10_000
    table = pq.read_table(tmp_path / "old.parquet")
    assert table.num_rows == 8
    assert table["roc_error"].null_count == len(table)
    assert table["epsilon"].null_count == 0


def written(folder: Path, records: list[BlockSignals]) -> Path:
    """The same run, as this version writes it."""
    header = read_header(OLD)
    watched = np.split(rows_of(OLD, "watched"), len(records))
    truth = np.split(rows_of(OLD, "truth"), len(records))
    _, phi = parts_of(OLD, "phi")[0]
    folder.mkdir()
    writer = RunWriter(folder / "run.mcap", header.spec, header.manifest)
    for signals, x, world in zip(records, watched, truth, strict=True):
        writer.block(Block(signals.stream, signals.t, x, world), signals, having(phi))
    writer.finish()
    return folder


def test_two_versions_differ_by_that_and_nothing_else(cdmisfa, tmp_path) -> None:
    new = written(tmp_path / "new", list(read_signals(OLD)))
    difference = first_difference(OLD, new)
    assert difference is not None
    assert str(difference) == (
        f"signals of version 1 against {SCHEMA_VERSION}; of those in both: all the same, "
        "bit for bit"
    )
    assert difference.as_json()["versions"] == [1, SCHEMA_VERSION]
    assert first_difference(OLD, OLD) is None
    assert first_difference(new, new) is None
    said = cdmisfa("compare", OLD, new)
    assert (said.code, said.out.splitlines()) == (
        4,
        ["the same was learned, at the same iterations", f"first difference: {difference}"],
    )
    table = cdmisfa("compare", OLD, new, OLD, "--save", tmp_path / "both.rrd")
    assert table.code == 0
    assert "of those in both: all the same" in table.out


def test_two_versions_that_differ_elsewhere_too(tmp_path) -> None:
    records = list(read_signals(OLD))
    records[5] = replace(records[5], epsilon=0.5)
    new = written(tmp_path / "new", records)
    difference = first_difference(OLD, new)
    assert difference is not None
    assert (difference.iteration, difference.signal) == (5, "epsilon")
    assert difference.versions == (1, SCHEMA_VERSION)
    assert str(difference).startswith("signals of version 1 against 4; of those in both: iteration")


@pytest.mark.parametrize("command", ["view", "compare"])
def test_a_later_version_is_refused_in_one_line(cdmisfa, tmp_path, monkeypatch, command) -> None:
    with monkeypatch.context() as patch:
        patch.setattr("replay.runs.writer.SCHEMA_VERSION", 9)
        newer = written(tmp_path / "newer", list(read_signals(OLD)))
    more = {"view": ["--save", tmp_path / "x.rrd"], "compare": [OLD]}[command]
    refused = cdmisfa(command, newer, *more)
    error = refused.err
    assert refused.code == 2
    assert "was written with version 9 of the signals" in error
    assert "install a newer cdmisfa" in error
    assert len(error.strip().splitlines()) == 1


def test_a_run_does_not_go_on_in_another_version() -> None:
    header = read_header(OLD)
    with pytest.raises(UsageError, match=f"signals = 1, not {SCHEMA_VERSION}: "):
        refuse_difference(OLD / "run.mcap", header, header.spec, {ARITHMETIC: 1, **header.manifest})


def test_sizes_without_values_allocate_nothing() -> None:
    rows = 2**31
    records = list(read_signals(OLD))
    empty = {"y_frozen": (rows, 0, 0), "eta_inst_frozen": (rows, 0)}
    empty |= {"band_mean": (rows, 0), "band_sd": (rows, 0)}
    fields = {name: np.empty(shape) for name, shape in empty.items()}
    hostile = replace(records[0], **fields, roc_error_frozen=np.empty(0))
    with pytest.raises(LogDamagedError, match="sizes without values"):
        decode_signals(encode_signals(hostile), version=1)


VERDICT = "Verdict on each block: the last 50 blocks"
RULES = "Rule 2: share of novel blocks from 0 on", "Rule 3: recent variance from 0 on"


def gate_of(run: Path) -> list[str]:
    """Titles in the gate's tab of a run's layout."""
    return [view.name for view in views_of(tabs_of(run)["Gate"])]


def test_the_gate_of_1_0_shows_its_clusters_where_the_log_has_them(tmp_path) -> None:
    assert gate_of(OLD)[1:] == [VERDICT, *RULES]
    write_run(tmp_path / "run.mcap", VECTOR, 3, learner={"algorithm": "1.0", "roc_error": 3.0})
    assert gate_of(tmp_path)[1:] == [
        VERDICT,
        "Clustering error by module 1: known below 3",
        "Clustering error by module 2: known below 3",
        "Rule 1: clustering error of the block and its mean, saved below the line",
        *RULES,
    ]


def test_the_gate_of_2_0_shows_its_bands(tmp_path) -> None:
    write_run(tmp_path / "run.mcap", VECTOR, 12)
    shown = gate_of(tmp_path)
    assert any("in the band of 2 SD" in name for name in shown)
    assert not any("Clustering" in name for name in shown)


@pytest.mark.parametrize("algorithm", ["1.0", "2.0"])
def test_the_overview_shows_what_decides_until_a_save(tmp_path, algorithm) -> None:
    write_run(tmp_path / "run.mcap", VECTOR, 3, learner={"algorithm": algorithm, "roc_error": 0.25})
    (rules,) = (view for view in views_of(tabs_of(tmp_path)["Overview"]) if "rules" in view.name)
    assert list(rules.contents) == ["/rules/**"]
