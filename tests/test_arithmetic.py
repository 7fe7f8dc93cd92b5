"""Runs of another arithmetic: readable, and told apart from runs that differ."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from conftest import Cdmisfa
from test_moments import lying

from cdmisfa.core.errors import NotReproducedError
from cdmisfa.experiments.recompute.check import check_run, learner_after
from replay.runs.compare import computed_otherwise
from replay.runs.log import read_header

SAMPLE = Path(__file__).parent.parent / "sample_logs" / "icub"
LEARN = ("learn", SAMPLE, "--loop", "--no-rerun", "--max-iterations", "4")


@pytest.fixture
def older(cdmisfa: Cdmisfa, tmp_path: Path) -> Path:
    """A run that says it was computed by the arithmetic before, and whose bits are others."""
    run = tmp_path / "older"
    assert cdmisfa(*LEARN, "--seed", "3", "-o", run).code == 0
    assert read_header(run).arithmetic == 2
    lying(run, b'"arithmetic": 2', b'"arithmetic": 1')
    log = run / "run.mcap.partial"
    log.write_bytes(log.read_bytes().replace(b'"nu": 0.01', b'"nu": 0.02'))
    return run


def test_runs_of_images_say_which_arithmetic_they_had(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    for name, source, version in (("a", SAMPLE, 2), ("b", "oscillatory", 1)):
        run = tmp_path / name
        words = ("--loop",) if name == "a" else ()
        learned = cdmisfa("learn", source, *words, "--no-rerun", "--max-iterations", 2, "-o", run)
        assert learned.code == 0
        assert json.loads((run / "run.json").read_text())["arithmetic"] == version
        assert read_header(run).arithmetic == version


def test_compare_and_check_say_that_the_arithmetic_is_another(
    cdmisfa: Cdmisfa, tmp_path: Path, older: Path
) -> None:
    now = tmp_path / "now"
    assert cdmisfa(*LEARN, "--seed", "5", "-o", now).code == 0
    assert computed_otherwise(older, now) == ("arithmetic 1 against 2",)
    compared = cdmisfa("compare", older, now)
    assert compared.code == 4
    assert "computed otherwise, which may be why: arithmetic 1 against 2" in compared.out
    why = "the run was learned with arithmetic 1, this version computes with 2"
    checked = check_run(older)
    assert checked.difference is not None
    assert (checked.arithmetic, str(checked).endswith(why)) == ((1, 2), True)
    assert why in cdmisfa("check", older).out
    with pytest.raises(NotReproducedError, match=why):
        learner_after(older, 2)
    assert str(check_run(now)).endswith("identical, bit for bit")


def test_a_run_of_another_arithmetic_is_not_gone_on_with(
    cdmisfa: Cdmisfa, tmp_path: Path, older: Path
) -> None:
    resumed = cdmisfa("learn", "--resume", "-o", older, "--max-iterations", 6, "--no-rerun")
    assert resumed.code == 2
    assert "was made with arithmetic = 1, not 2" in resumed.err
    forked = cdmisfa("fork", older, "--at", 4, "-o", tmp_path / "fork", "--no-rerun")
    assert forked.code == 2
    assert "was learned with arithmetic 1, this version computes with 2" in forked.err
