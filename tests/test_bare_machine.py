"""Commands where there is nobody: no HOME, no entry of the user, no TERM, no language, no PATH."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from waiting import python

pytestmark = pytest.mark.xdist_group("bare_machine")  # one process makes what all of them share

NOBODY = """
import pwd

def unknown(*_):
    raise KeyError("getpwuid(): uid not found")

pwd.getpwuid = pwd.getpwnam = unknown
from cdmisfa.cli import main
main()
"""


def alone(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    environment = {"PYTHONPATH": str(Path(__file__).parents[1]), "TMPDIR": str(folder)}
    return python("-c", NOBODY, *words, cwd=folder, env=environment, stdin=subprocess.DEVNULL)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("alone")
    done = alone(folder, "learn", "oscillatory", "--max-iterations", "20", "-o", "run")
    assert (done.returncode, done.stderr) == (0, "")
    return folder


@pytest.mark.parametrize(
    "line",
    [
        "doctor",
        "verify run",
        "check run",
        "view run --save view.rrd",
        "export run -o signals.parquet",
        "record oscillatory --frames 50 --jobs 2 -o rec",
        "learn oscillatory --max-iterations 20 --live-view -o live",
    ],
)
def test_a_command_works_where_there_is_nobody(place: Path, line: str) -> None:
    done = alone(place, *line.split())
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
