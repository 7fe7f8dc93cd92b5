"""Commands whose standard streams are closed, as a daemon's are, and what signals end them with."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from cdmisfa.cli.interrupts import interruptible, stoppable

CLOSED = ("<&-", ">&-", "2>&-", "<&- >&- 2>&-")


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


@pytest.mark.parametrize("closed", CLOSED)
def test_a_command_does_its_work_and_says_so(tmp_path: Path, closed: str) -> None:
    words = ("record", "oscillatory", "--frames", 128)
    open_ones = cdmisfa("", *words, "-o", tmp_path / "open")
    ended = cdmisfa(closed, *words, "-o", tmp_path / "closed")
    assert (open_ones.returncode, ended.returncode) == (0, 0)
    assert ended.stderr == ""
    assert bool(ended.stdout) == (">&-" not in closed.split())
    for file in (tmp_path / "open").glob("*.mcap"):
        assert (tmp_path / "closed" / file.name).read_bytes() == file.read_bytes()


@pytest.mark.parametrize("closed", CLOSED)
def test_processes_of_a_command_do_theirs(tmp_path: Path, closed: str) -> None:
    words = ("record", "oscillatory", "--frames", 256, "--jobs", 2, "-o", tmp_path / "a")
    ended = cdmisfa(closed, *words)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert len(list((tmp_path / "a").glob("*.mcap"))) == 3


@pytest.mark.parametrize("closed", CLOSED)
def test_an_error_keeps_its_exit_code(tmp_path: Path, closed: str) -> None:
    assert cdmisfa(closed, "info", tmp_path / "nothing").returncode == 2


def test_the_second_signal_is_the_one_that_the_exit_code_names() -> None:
    def told_twice() -> None:
        with stoppable(notice="") as inner:
            os.kill(os.getpid(), signal.SIGTERM)
            assert inner()
            os.kill(os.getpid(), signal.SIGHUP)
            time.sleep(5)

    with interruptible() as outer:
        with pytest.raises(KeyboardInterrupt):
            told_twice()
        assert outer.exit_code == 129


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
