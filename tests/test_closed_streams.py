"""Commands whose standard streams are closed, as a daemon's are, and what signals end them with."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from folders import contents

CLOSED = ("<&-", ">&-", "2>&-", "<&- >&- 2>&-")
RECORD = ("record", "oscillatory", "--frames", 256)


def cdmisfa(closed: str, *words: object) -> subprocess.CompletedProcess[str]:
    line = f'exec "$0" -m cdmisfa "$@" {closed}'
    return subprocess.run(
        ["sh", "-c", line, sys.executable, *map(str, words)],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """What a recording holds that a command with open streams made."""
    folder = tmp_path_factory.mktemp("open") / "rec"
    assert cdmisfa("", *RECORD, "-o", folder).returncode == 0
    return contents(folder)


@pytest.mark.parametrize("jobs", [1, 2])
@pytest.mark.parametrize("closed", CLOSED)
def test_a_command_and_its_processes_do_their_work_and_say_so(
    tmp_path: Path, recorded: dict[str, bytes], closed: str, jobs: int
) -> None:
    ended = cdmisfa(closed, *RECORD, "--jobs", jobs, "-o", tmp_path / "rec")
    assert (ended.returncode, ended.stderr) == (0, "")
    assert bool(ended.stdout) == (">&-" not in closed.split())
    assert contents(tmp_path / "rec") == recorded


@pytest.mark.parametrize("closed", CLOSED)
def test_an_error_keeps_its_exit_code(tmp_path: Path, closed: str) -> None:
    assert cdmisfa(closed, "info", tmp_path / "nothing").returncode == 2


def test_a_stop_inside_of_an_exec_ends_with_its_code_too(tmp_path: Path) -> None:
    (tmp_path / "stopped.py").write_text(
        "from cdmisfa.cli import app\n"
        "kill = 'import os, signal; os.kill(os.getpid(), signal.SIGTERM)'\n"
        "app.cli.main = lambda **words: exec(kill)\n"
        "app.main()\n"
    )
    ended = subprocess.run(
        [sys.executable, "-m", "stopped"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (ended.returncode, ended.stderr) == (143, "cdmisfa: interrupted\n")
