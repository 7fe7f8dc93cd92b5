"""Every command of the pages that lead through the program works, with nothing prepared."""

from __future__ import annotations

import importlib.util
import re
import shlex
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
from conftest import Cdmisfa
from waiting import python

ROOT = Path(__file__).parents[1]
HOW_TO = ROOT / "docs" / "how-to"
README = (ROOT / "README.md").read_text("utf-8")
RECORD, TOUR, APPLYING = (
    (HOW_TO / f"{name}.md").read_text("utf-8") for name in ("record", "tour", "applying")
)
HAS_SIMULATOR = importlib.util.find_spec("pybullet") is not None


def blocks(language: str, page: str = README) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)


def commands() -> list[list[str]]:
    pages = (README, RECORD, TOUR, APPLYING)
    lines = "".join(block for page in pages for block in blocks("sh", page)).splitlines()
    return [shlex.split(line, comments=True) for line in lines]


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sample_logs").symlink_to(ROOT / "sample_logs")
    return tmp_path


def test_first_lines_are_targets_of_the_makefile() -> None:
    makefile = (ROOT / "Makefile").read_text("utf-8")
    targets = re.findall(r"^make (\w+)", blocks("")[0], re.MULTILINE)
    assert targets == ["demo", "test"]
    assert all(re.search(rf"^{target}:", makefile, re.MULTILINE) for target in targets)


@pytest.mark.skipif(not HAS_SIMULATOR, reason="PyBullet is missing: pip install pybullet")
def test_every_command_works(cdmisfa: Cdmisfa, elsewhere: Path) -> None:
    for program, *args in commands():
        assert program == "cdmisfa"
        done = cdmisfa(*args)
        assert done.code == 0, f"cdmisfa {shlex.join(args)}: {done.err}"
    for made in (
        "live.rrd",
        "report.html",
        "runs/live/report.html",
        "signals.parquet",
        "left-again.mcap",
        "runs/icub/run.rrd",
        "applied/view.rrd",
        "applied/all/icub.parquet",
    ):
        assert (elsewhere / made).stat().st_size > 0
    if shutil.which("git") is None:
        return
    (elsewhere / ".gitignore").write_text((ROOT / ".gitignore").read_text("utf-8"))
    subprocess.run(["git", "init", "-q"], cwd=elsewhere, check=True)
    status = ["git", "status", "--porcelain", "--untracked-files=all"]
    left = subprocess.run(status, cwd=elsewhere, capture_output=True, text=True, check=True)
    assert left.stdout.split() == ["??", ".gitignore", "??", "sample_logs"]
    found: dict[str, Any] = {}
    exec("".join(blocks("python", APPLYING)), found)
    assert found["outputs"].shape == (200, 8)


def test_python_example_works(elsewhere: Path) -> None:
    (example,) = blocks("python")
    shown = "\nprint(run.modules[0].stream, len(outputs) == 100 * len(table))"
    done = python("-c", example + shown)
    assert (done.returncode, done.stdout.strip()) == (0, "x1 True"), done.stderr
