"""Runs of a former arithmetic: readable, compared up to rounding, and not gone on with."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from conftest import Cdmisfa

from cdmisfa.core.errors import NotReproducedError
from cdmisfa.experiments.session import Session
from cdmisfa.kernels import ARITHMETIC
from replay.runs.compare import computed_otherwise
from replay.runs.log import read_header

ROOT = Path(__file__).parent.parent
SAMPLE = ROOT / "sample_logs" / "icub"
LEARN = {
    1: ("learn", "oscillatory", "--max-iterations", 12),
    2: ("learn", SAMPLE, "--max-iterations", 6),
}


@pytest.fixture(params=LEARN)
def former(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A run with seed 3 of a version that computed with this arithmetic, on one processor."""
    name = f"arithmetic_{request.param}"
    shutil.copytree(ROOT / "tests" / "data" / name, tmp_path / name)
    return tmp_path / name


def _number(run: Path) -> int:
    return int(run.name.rpartition("_")[2])


def _source(run: Path) -> tuple[str, ...]:
    return () if _number(run) == 1 else (str(SAMPLE),)


def test_runs_say_with_which_arithmetic_they_were_learned(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    for name, words in LEARN.items():
        run = tmp_path / str(name)
        assert cdmisfa(*words, "--no-rerun", "-o", run).code == 0
        assert json.loads((run / "run.json").read_text())["arithmetic"] == ARITHMETIC
        assert read_header(run).arithmetic == ARITHMETIC


def test_check_compares_up_to_rounding_and_says_why(cdmisfa: Cdmisfa, former: Path) -> None:
    words = [word for source in _source(former) for word in ("--source", source)]
    checked = cdmisfa("check", former, *words)
    then = _number(former)
    why = f"the run was learned with arithmetic {then}, this version computes with {ARITHMETIC}"
    assert checked.code == 0, checked.err
    assert f"they are the same up to rounding ({why})" in checked.out
    told = cdmisfa("check", former, *words, "--json").json
    assert (told["identical"], told["same_up_to_rounding"]) == (False, True)
    log = former / "run.mcap"
    log.write_bytes(
        log.read_bytes().replace(b'"nu": 0.05', b'"nu": 0.04').replace(b'"nu": 0.01', b'"nu": 0.02')
    )
    differs = Session.check(former, _source(former))
    assert differs.difference is not None
    assert str(differs).endswith(why)


def test_a_state_is_exact_at_keyframes_alone(former: Path) -> None:
    assert Session.at(former, 0, _source(former)).learner.iteration == 0
    if _number(former) == 1:
        assert Session.at(former, 6).learner.iteration == 6
    with pytest.raises(
        NotReproducedError,
        match=r"was learned with arithmetic .* only states at its keyframes are exact",
    ):
        Session.at(former, 5, _source(former))


def test_a_run_of_a_former_arithmetic_is_not_gone_on_with(
    cdmisfa: Cdmisfa, tmp_path: Path, former: Path
) -> None:
    sources = _source(former) or ("oscillatory",)
    more = ("--max-iterations", 20, "--no-rerun", "--seed", 3)
    resumed = cdmisfa("learn", *sources, "--resume", "-o", former, *more)
    assert resumed.code == 2
    assert f"was made with arithmetic = {_number(former)}, not {ARITHMETIC}" in resumed.err
    source = ("--source", sources[0]) if _number(former) == 2 else ()
    for at in (0, 3):
        forked = cdmisfa("fork", former, "--at", at, "-o", tmp_path / "fork", "--no-rerun", *source)
        assert forked.code == 2
        assert f"was learned with arithmetic {_number(former)}, this version" in forked.err


def test_compare_names_the_arithmetic(cdmisfa: Cdmisfa, tmp_path: Path, former: Path) -> None:
    now = tmp_path / "now"
    learned = cdmisfa(*LEARN[_number(former)], "--seed", 3, "--no-rerun", "-o", now)
    assert learned.code == 0
    why = f"arithmetic {_number(former)} against {ARITHMETIC}"
    assert why in computed_otherwise(former, now)
    compared = cdmisfa("compare", former, now)
    assert compared.code == 4
    assert why in compared.out


def test_the_former_key_of_portable_bits_is_accepted(cdmisfa: Cdmisfa) -> None:
    words = ("learn", "oscillatory", "--max-iterations", "2", "--json")
    plain = cdmisfa(*words).json["signals_sha256"]
    for former in (("--portable",), ("--set", "learner.portable=true")):
        done = cdmisfa(*words, *former)
        assert done.json["signals_sha256"] == plain
        name = former[-1].removesuffix("=true")
        assert done.err.startswith(f"warning: {name} does nothing any more, and the next version")
    assert "portable" not in cdmisfa("learn", "--help").out
