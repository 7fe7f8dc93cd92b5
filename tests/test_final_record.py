"""A run proves itself: whatever of it is changed, cut or gone, verify names it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from folders import flip

from cdmisfa.core.config import LearnerConfig
from cdmisfa.experiments.session import run_session
from recorder.log.logfile import LogFile
from recorder.mcap.reader import LogReader
from recorder.world.oscillatory import OscillatorySource
from replay.integrity.verify import check_log
from replay.runs.folders import FINAL_METADATA

EASY = LearnerConfig(delta=1.0, eta_dot_window=3, min_variance=0.0, warm_up=0, tau=20)


@pytest.fixture(scope="module")
def learned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("final") / "run"
    result = run_session(OscillatorySource(), EASY, folder, max_iterations=400, max_modules=1)
    assert result.modules
    return folder


@pytest.fixture
def copy(learned: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(learned, tmp_path / "elsewhere"))


def edit(*keys: str, value: object) -> Callable[[Path], None]:
    def edited(folder: Path) -> None:
        document = json.loads((folder / "run.json").read_text())
        table = document
        for key in keys[:-1]:
            table = table[key]
        assert table[keys[-1]] != value
        table[keys[-1]] = value
        (folder / "run.json").write_text(json.dumps(document))

    return edited


def copied_log(folder: Path, *, drop: int = -1, final: bool = True) -> None:
    """Write a run's log again without an iteration's messages, or without its final record."""
    source = folder / "run.mcap"
    with LogReader(source) as reader, LogFile(folder / "new.mcap") as log:
        for record in reader.metadata:
            if final or record.name != FINAL_METADATA:
                log.add_metadata(record.name, record.metadata)
        known = {}
        for number, channel in sorted(reader.channels.items()):
            schema = reader.schemas[channel.schema_id]
            known[number] = log.add_channel(
                channel.topic, log.add_schema(schema.name, schema.encoding, schema.data)
            )
        for entry in reader.messages():
            if entry.sequence != drop:
                log.write(known[entry.channel.id], entry.log_time, entry.data, entry.sequence)
    (folder / "new.mcap").rename(source)


def test_a_run_is_whole_wherever_it_lies(copy: Path) -> None:
    result = check_log(copy)
    assert result.ok, result.problems
    (note,) = result.notes
    assert note.startswith(f"{copy / 'run.rrd'} was not checked: it has no checksum")
    assert check_log(copy / "run.mcap").ok


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (edit("seed", value=7), "run.json"),
        (edit("config", "learner", "nu", value=0.3), "run.json"),
        (edit("result", "signals_sha256", value="0" * 64), "run.json"),
        (edit("result", "iterations", value=3), "run.json"),
        (lambda folder: flip(folder / "modules.npz"), "modules.npz"),
        (lambda folder: (folder / "run.json").unlink(), "run.json"),
        (lambda folder: (folder / "modules.npz").unlink(), "modules.npz"),
        (lambda folder: (folder / "run.rrd").unlink(), "run.rrd"),
        (lambda folder: copied_log(folder, drop=17), "run.mcap"),
    ],
    ids=["seed", "nu", "sha", "iterations", "flip", "json", "npz", "rrd", "iteration"],
)
def test_what_was_changed_is_named(copy: Path, change: Callable[[Path], None], named: str) -> None:
    change(copy)
    result = check_log(copy)
    assert {Path(problem.where).name for problem in result.problems} == {named}


def test_a_run_from_before_is_whole_and_said_to_prove_nothing(copy: Path) -> None:
    copied_log(copy, final=False)
    result = check_log(copy)
    assert result.ok
    assert "no final record" in result.notes[-1]
    copied_log(copy, drop=17, final=False)
    problems = check_log(copy).problems
    assert {Path(problem.where).name for problem in problems} == {"run.mcap"}
    assert any("iterations 17 to 17 are missing" in problem.what for problem in problems)
