"""Sweeps from Python take what `learn` takes, and give a table with types."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from conftest import Cdmisfa

from cdmisfa import GymSource, Recording, Sweep, learn, sweep
from cdmisfa.core.errors import UsageError

T = np.arange(400) / 20
NUMBERS = np.stack([np.sin(T), np.cos(3 * T), np.sin(7 * T)], axis=1)
FEW: dict[str, Any] = {"seeds": [0], "max_iterations": 8, "tau": 20}


def test_arrays_are_learned_from_as_by_learn(tmp_path: Path) -> None:
    given = {"file": NUMBERS, "b": NUMBERS[::-1]}
    found = sweep(given, tmp_path / "s", grid={"outputs": [1, 2]}, keep_logs=True, **FEW)
    table = found.to_arrow()
    for outputs, run in zip(
        *(table[k].to_pylist() for k in ("learner.outputs", "run")), strict=True
    ):
        alone = learn(given, max_iterations=8, tau=20, outputs=outputs)
        assert (
            json.loads((Path(run) / "run.json").read_text())["result"]["signals_sha256"]
            == (dict(alone.result or {})["signals_sha256"])
        )
    (written,) = (tmp_path / "s").glob("*.npz")
    before = written.stat().st_mtime_ns
    again = sweep(given, tmp_path / "s", grid={"outputs": [1, 2]}, **FEW)
    assert again.to_arrow()["iterations"].to_pylist() == [8, 8]
    assert written.stat().st_mtime_ns == before


@pytest.mark.parametrize("kind", ["npz", "recording", "list"])
def test_files_and_recordings_are_swept(kind: str, tmp_path: Path) -> None:
    np.savez(tmp_path / "x.npz", a=NUMBERS, b=NUMBERS)
    path = str(tmp_path / "x.npz")
    given: Any = {"npz": path, "recording": Recording(path, topics=["b"]), "list": [path]}[kind]
    found = sweep(given, tmp_path / "s", **FEW)
    assert found.points[0].done == 1
    assert not list((tmp_path / "s").glob("*.npz"))


def test_the_table_keeps_types_and_says_what_failed(tmp_path: Path) -> None:
    grid = {"tau": [20, 4000], "explore": [0, 0.5], "attention": ["progress"]}
    how = {"seeds": [0, 1], "max_iterations": 5}
    found = sweep(NUMBERS, tmp_path / "s", grid=grid, **how)
    table = found.to_arrow()
    types = {name: table.schema.field(name).type for name in table.column_names}
    assert types["learner.tau"] == pa.int64()
    assert types["learner.explore"] == pa.float64()
    assert types["learner.attention"] == pa.string()
    assert types["slowness"] == pa.list_(pa.float64())
    assert table["status"].to_pylist() == ["done"] * 4 + ["failed"] * 4
    assert table["iterations"].to_pylist() == [5] * 4 + [None] * 4
    assert "4000 are needed" in table["error"].to_pylist()[-1]
    assert dict(found.differs) == {"learner.tau": [20, 4000], "learner.explore": [0, 0.5]}
    assert "failed 4" in repr(found)
    assert "learner.tau" in found._repr_html_()


def test_a_sweep_of_the_command_line_has_numbers_as_numbers(
    cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    words = ["--grid", "learner.nu=0.04,0.05", "--grid", "learner.tau=40", "--seeds", "0:2"]
    cdmisfa("sweep", "oscillatory", *words, "--max-iterations", 3, "-o", tmp_path / "s")
    table = Sweep(tmp_path / "s").to_arrow()
    assert table["learner.nu"].to_pylist() == [0.04, 0.04, 0.05, 0.05]
    assert table["learner.tau"].to_pylist() == [40] * 4
    shown = cdmisfa("results", tmp_path / "s")
    assert shown.err == "learner.nu differs: 0.04, 0.05\n"
    document = cdmisfa("results", tmp_path / "s", "--json").json
    assert document["differ"] == {"learner.nu": ["0.04", "0.05"]}


@pytest.mark.parametrize(
    ("given", "how", "said"),
    [
        (NUMBERS, {"grid": {"tua": [20]}}, "unknown key learner.tua"),
        (NUMBERS, {"grid": {"tau": 20}}, "give a list of values"),
        (NUMBERS, {"grid": {"tau": ["many"]}}, "learner.tau is 'many'"),
        (NUMBERS, {"seeds": 3}, "seeds is 3"),
        ([[1.0, np.nan]], {}, "no finite number"),
        ((row for row in NUMBERS), {}, "opens its source anew"),
        ("camera:/dev/video9", {}, "record it first"),
        ("nowhere", {}, "no such file"),
    ],
)
def test_what_cannot_be_swept_is_one_line_and_leaves_nothing(
    given: Any, how: Any, said: str, tmp_path: Path
) -> None:
    with pytest.raises(UsageError, match=said):
        sweep(given, tmp_path / "s", **how)
    assert not (tmp_path / "s").exists()


def test_a_folder_of_other_files_stays_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("kept")
    with pytest.raises(UsageError, match=r"holds mine\.txt, and no sweep"):
        sweep(NUMBERS, tmp_path, **FEW)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_an_open_source_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("gymnasium")
    with GymSource(["CartPole-v1"]) as source, pytest.raises(UsageError, match="anew"):
        sweep(source, tmp_path / "s")
