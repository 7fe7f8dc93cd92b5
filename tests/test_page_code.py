"""The Python of every page works, block after block, in a folder with what the page stands on."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cdmisfa
from recorder.recording import record_scene
from replay.corpus.index import index_logs

ROOT = Path(__file__).parents[1]
Ran = dict[str, Any]


def blocks(page: Path) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```$", page.read_text("utf-8"), re.MULTILINE | re.DOTALL)


@pytest.fixture
def ran(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Ran]:
    """Runs a page's Python, given names, and gives all names; `printed` is what it printed."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sample_logs").symlink_to(ROOT / "sample_logs")

    def run(page: str, **given: Any) -> Ran:
        words = io.StringIO()
        with contextlib.redirect_stdout(words):
            exec("\n".join(blocks(ROOT / "docs" / "how-to" / page)), given)
        return {**given, "printed": words.getvalue()}

    return run


def test_every_page_with_python_is_run_here() -> None:
    here = Path(__file__).read_text("utf-8")
    pages = [page.name for page in (ROOT / "docs").rglob("*.md") if blocks(page)]
    assert [page for page in pages if f'ran("{page}"' not in here] == []


def test_from_python(ran: Callable[..., Ran]) -> None:
    pytest.importorskip("gymnasium")
    found = ran("python.md")
    assert abs(np.corrcoef(found["slowest"][:, 0], found["frames"][:, 0])[0, 1]) > 0.9
    assert len(found["rewards"]) == 50
    assert found["left"].shape == (100, 48, 128)


def test_corpus(ran: Callable[..., Ran], tmp_path: Path) -> None:
    pytest.importorskip("duckdb")
    pytest.importorskip("polars")
    record_scene("oscillatory", tmp_path / "recordings" / "monday", frames=500)
    (tmp_path / "recordings" / "empty.mcap").touch()
    index_logs([tmp_path / "recordings"])
    found = ran("corpus.md")
    assert found["printed"].count("empty, nothing was written") >= 1
    assert "9.98" in found["printed"]


def test_estimators(ran: Callable[..., Ran]) -> None:
    pytest.importorskip("river")
    found = ran("estimators.md")
    slow = np.sin(found["t"] / 50)
    assert abs(np.corrcoef(found["y"][:, 0], slow)[0, 1]) > 0.99
    assert abs(np.corrcoef(found["online"], slow[2000:])[0, 1]) > 0.99


def test_watching(ran: Callable[..., Ran]) -> None:
    pytest.importorskip("gymnasium")
    found = ran("watching.md")
    assert found["seen"].shape == found["env"].observation_space.shape
    assert found["env"].learner.iteration == 1


def test_sweeps(ran: Callable[..., Ran]) -> None:
    *points, claim = ran("sweeps.md")["printed"].splitlines()
    assert [point.split()[0] for point in points] == ["0.04", "0.05"]
    assert "'holds': True" in claim


def test_moments(ran: Callable[..., Ran]) -> None:
    cdmisfa.learn("oscillatory", "runs/live", max_iterations=30)
    assert ran("moments.md")["learner"].iteration == 25


def of_a_box(out: str) -> cdmisfa.Run:
    """A run on a shade that comes and goes."""
    drift = 128 + 100 * np.sin(np.arange(3000) / 60)[:, None, None] * np.linspace(0, 1, 128)
    return cdmisfa.learn(np.repeat(drift.astype(np.uint8), 48, axis=1), out, max_modules=1)


def test_applying(ran: Callable[..., Ran]) -> None:
    pytest.importorskip("sklearn")
    (module,) = of_a_box("runs/cameras").modules
    found = ran("applying.md")
    assert module.recipe is not None
    frames = np.stack([cdmisfa.make_frame(each, module.recipe) for each in found["pictures"]])
    np.testing.assert_array_equal(found["outputs"], module.transform(frames))
    assert found["model"].predict(found["left"]).shape == (500,)
