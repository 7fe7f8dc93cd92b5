"""The demonstration tells the truth about what was learned."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest
from conftest import Cdmisfa

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
    assert first["policy"] == ["stay", "switch", "switch"]
    assert second["policy"] == ["switch", "switch", "stay"]
    assert min(first["correlation"], second["correlation"]) > 0.9
    for file in (*report["figures"], Path(report["run"]) / "run.rrd"):
        assert Path(file).stat().st_size > 0
