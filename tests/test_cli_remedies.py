"""What the command line says when it is asked for what it cannot do, or need not do."""

from __future__ import annotations

import importlib.util
import re
import tomllib
from pathlib import Path

import pytest
from conftest import Cdmisfa

ROOT = Path(__file__).parents[1]


HAS_SIMULATOR = importlib.util.find_spec("pybullet") is not None


@pytest.mark.skipif(not HAS_SIMULATOR, reason="PyBullet is missing: pip install pybullet")
def test_demo_replaces_an_earlier_one(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    recording, run = tmp_path / "recordings" / "demo-icub", tmp_path / "runs" / "demo-icub"
    assert cdmisfa("record", "icub", "-o", recording, "--frames", 80).code == 0
    assert cdmisfa("learn", recording, "-o", run, "--max-iterations", 2, "--no-rerun").code == 0
    words = ("demo", "-o", tmp_path, "--frames", 800, "--seed", 2, "--json")
    report = cdmisfa(*words).json
    assert report["live_equals_recorded"] is True
    first, second = report["modules"]
    assert (first["view"], first["follows"]) == ("left", "object1_y")
    assert (second["view"], second["follows"]) == ("right", "object3_y")
    assert min(first["correlation"], second["correlation"]) > 0.9
    assert (Path(report["run"]) / "run.rrd").stat().st_size > 0


def test_demo_without_the_simulator_records_oscillatory_streams(
    cdmisfa: Cdmisfa, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cdmisfa.studies.demo.find_spec", lambda _: None)
    done = cdmisfa("demo", "-o", tmp_path, "--frames", 2000, "--json")
    assert "of oscillatory, since pybullet is not installed" in done.err
    assert "live and recorded signals of 20 iterations are the same" in done.err
    assert done.json["recording"] == str(tmp_path / "recordings" / "demo-oscillatory")
    followed = [(module["view"], module["follows"]) for module in done.json["modules"]]
    assert followed == [(f"x{n}", f"sin({5 - n} theta + c)") for n in (1, 2, 3)]
    assert min(module["correlation"] for module in done.json["modules"]) > 0.99
    assert Path(done.json["report"]).parent == tmp_path / "runs" / "demo-oscillatory"


def test_the_citation_names_this_version() -> None:
    card = (ROOT / "CITATION.cff").read_text("utf-8")
    version = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["version"]
    assert f"\nversion: {version}\n" in card
    log = (ROOT / "CHANGELOG.md").read_text("utf-8")
    assert re.findall(r"^## \[(.+?)\]", log, re.MULTILINE)[:2] == ["Unreleased", version]
