"""Signals end what a command does, once, wherever they come; closed streams end nothing."""

from __future__ import annotations

import os
import pkgutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import pytest
from conftest import Cdmisfa, Outcome
from folders import contents
from waiting import python

from cdmisfa.cli import app
from cdmisfa.cli.app import run
from cdmisfa.cli.interrupts import SIGNALS, interruptible, stoppable


def wait() -> None:
    """Long enough for anything that comes again."""
    time.sleep(5)


class Late:
    """Gets a signal when it is let go of, where Python passes no exception on."""

    def __init__(self, number: signal.Signals) -> None:
        self._number = number

    def __del__(self) -> None:
        signal.raise_signal(self._number)


@pytest.mark.parametrize("number", SIGNALS)
def test_an_interrupt_that_a_destructor_drops_comes_again(number: signal.Signals) -> None:
    with interruptible() as stop:
        Late(number)
        with pytest.raises(KeyboardInterrupt):
            wait()
    assert stop.exit_code == 128 + number


def test_the_second_signal_interrupts_although_a_destructor_drops_it(capfd: Any) -> None:
    with interruptible() as outer, stoppable() as stop:
        signal.raise_signal(signal.SIGTERM)
        assert stop()
        Late(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            wait()
    assert outer.exit_code == 130
    assert capfd.readouterr().err == "finishing what is begun; again to stop at once\n"


AT_THE_END = """
import os, sys
from cdmisfa.cli.app import main

class Last:
    def __del__(self, kill=os.kill, own=os.getpid(), number=int(sys.argv.pop())):
        kill(own, number)

sys.argv.append("--version")
sys.last = Last()
main()
"""


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_while_python_ends_leaves_the_exit_code(number: signal.Signals) -> None:
    done = python("-c", AT_THE_END, int(number))
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("cdmisfa ")


IN_THE_BEGINNING = """
import signal, sys

class Finder:
    def find_spec(self, name, *_):
        if name == "click":
            signal.raise_signal(int(sys.argv.pop()))

sys.meta_path.insert(0, Finder())
from cdmisfa.cli import main
main()
"""


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_while_the_command_line_is_imported_says_so(number: signal.Signals) -> None:
    done = python("-c", IN_THE_BEGINNING, int(number))
    assert (done.returncode, done.stderr) == (128 + number, "cdmisfa: interrupted\n")


def test_what_else_a_destructor_raises_is_told(capsys: Any, monkeypatch: Any) -> None:
    told: list[Any] = []
    monkeypatch.setattr("sys.unraisablehook", told.append)

    class Broken:
        def __del__(self) -> None:
            raise ValueError("broken")

    with interruptible():
        Broken()
    assert [what.exc_type for what in told] == [ValueError]


def test_a_line_that_is_told_at_the_end_is_told_whole(monkeypatch: Any, capsys: Any) -> None:
    echo = click.echo

    def interrupted(*args: Any, **options: Any) -> None:
        for number in SIGNALS:
            signal.raise_signal(number)
        echo(*args, **options)

    monkeypatch.setattr(click, "echo", interrupted)
    assert run(["info", "not/there"]) == 2
    assert capsys.readouterr().err.startswith("cdmisfa: not/there")


LEARN = ("learn", "oscillatory", "--set", "learner.tau=10", "--max-iterations", 3)
RECORD = ("record", "oscillatory", "--frames", 20, "--view", "x1")
LIVE = ("record", "gym:Pendulum-v1", "--frames", 3)


@pytest.mark.parametrize(
    ("words", "last"),
    [
        (LEARN, "replay.view.build.build_view"),
        (RECORD, "recorder.log.viewlog.ViewLog.write"),
        (LIVE, "recorder.log.viewlog.ViewLog.finish"),
    ],
    ids=["learn", "record", "live"],
)
def test_a_signal_that_changes_nothing_any_more_is_no_failure(
    cdmisfa: Cdmisfa, tmp_path: Path, monkeypatch: Any, words: tuple[Any, ...], last: str
) -> None:
    done = _signalled(cdmisfa, (*words, "-o", tmp_path / "out"), last, 1, monkeypatch)
    assert done.code == 0, done.err
    assert not list((tmp_path / "out").glob("*.partial"))


def test_an_interrupt_says_what_is_missing_of_a_run(
    cdmisfa: Cdmisfa, tmp_path: Path, monkeypatch: Any
) -> None:
    out = tmp_path / "out"
    words = (*LEARN, "-o", out)
    done = _signalled(cdmisfa, words, "replay.view.build.build_view", 2, monkeypatch)
    assert done.code == 130
    missing, _, remedy = done.err.splitlines()[-1].partition("make it again with cdmisfa ")
    assert missing == f"cdmisfa: interrupted: all of {out} is there but its view: "
    assert cdmisfa(*remedy.split()).code == 0
    assert cdmisfa("verify", out).code == 0

    words = (*LEARN, "-o", out, "--force", "--no-rerun")
    done = _signalled(cdmisfa, words, "cdmisfa.experiments.run_folder.save_modules", 2, monkeypatch)
    assert done.code == 130
    said = f"cdmisfa: interrupted: {out} is not finished: go on with --resume"
    assert done.err.splitlines()[-1] == said
    assert cdmisfa("learn", "-o", out, "--resume", "--no-rerun").code == 0
    assert cdmisfa("verify", out).code == 0


@pytest.fixture
def silent() -> Iterator[str]:
    """The place of a server that takes connections and never answers."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield f"127.0.0.1:{server.getsockname()[1]}"


WAITING = "recorder.cameras.readers.Readers.wait"


@pytest.mark.parametrize("number", SIGNALS)
@pytest.mark.parametrize(
    ("source", "command", "where"),
    [
        ("tcp://{}", "record", WAITING),
        ("rtsp://{}/left", "learn", WAITING),
        ("http://{}/left.mjpg", "convert", WAITING),
        ("foxglove://{}/left", "record", WAITING),
        ("gym:Pendulum-v1", "record", "gymnasium.make"),
        ("gym:Pendulum-v1", "learn", "gymnasium.make"),
    ],
)
def test_while_a_source_is_opened_nothing_else_is_blamed(
    cdmisfa: Cdmisfa,
    silent: str,
    tmp_path: Path,
    monkeypatch: Any,
    source: str,
    command: str,
    where: str,
    number: signal.Signals,
) -> None:
    words = (command, source.format(silent), "-o", tmp_path / "out")
    done = _signalled(cdmisfa, words, where, 1, monkeypatch, number)
    assert (done.code, done.err.strip()) == (128 + number, "cdmisfa: interrupted")
    assert list(tmp_path.iterdir()) == []


def test_an_interrupt_that_python_makes_another_error_is_one(monkeypatch: Any, capsys: Any) -> None:
    class Named:
        def __set_name__(self, owner: type, name: str) -> None:
            signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(app.cli, "main", lambda **words: type("Made", (), {"name": Named()}))
    assert run([]) == 143
    assert capsys.readouterr().err == "cdmisfa: interrupted\n"


def _signalled(
    cdmisfa: Cdmisfa,
    words: tuple[Any, ...],
    last: str,
    times: int,
    monkeypatch: Any,
    number: signal.Signals = signal.SIGINT,
) -> Outcome:
    """What a command says to signals that come when it does the last of its work."""
    work = pkgutil.resolve_name(last)

    def signalled(*args: Any, **options: Any) -> Any:
        monkeypatch.undo()
        for _ in range(times):
            signal.raise_signal(number)
        return work(*args, **options)

    monkeypatch.setattr(last, signalled)
    return cdmisfa(*words)


CLOSED = ("<&-", ">&-", "2>&-", "<&- >&- 2>&-")
SCENE = ("record", "oscillatory", "--frames", 256)


def closed_streams(closed: str, *words: object) -> subprocess.CompletedProcess[str]:
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
    assert closed_streams("", *SCENE, "-o", folder).returncode == 0
    return contents(folder)


@pytest.mark.parametrize("jobs", [1, 2])
@pytest.mark.parametrize("closed", CLOSED)
def test_a_command_and_its_processes_do_their_work_and_say_so(
    tmp_path: Path, recorded: dict[str, bytes], closed: str, jobs: int
) -> None:
    ended = closed_streams(closed, *SCENE, "--jobs", jobs, "-o", tmp_path / "rec")
    assert (ended.returncode, ended.stderr) == (0, "")
    assert bool(ended.stdout) == (">&-" not in closed.split())
    assert contents(tmp_path / "rec") == recorded


@pytest.mark.parametrize("closed", CLOSED)
def test_an_error_keeps_its_exit_code(tmp_path: Path, closed: str) -> None:
    assert closed_streams(closed, "info", tmp_path / "nothing").returncode == 2


def test_a_stop_inside_of_an_exec_ends_with_its_code_too(tmp_path: Path) -> None:
    (tmp_path / "stopped.py").write_text(
        "from cdmisfa.cli import app\n"
        "kill = 'import os, signal; os.kill(os.getpid(), signal.SIGTERM)'\n"
        "app.cli.main = lambda **words: exec(kill)\n"
        "app.main()\n"
    )
    root = str(Path(__file__).parents[1])
    ended = python("-m", "stopped", cwd=tmp_path, env={**os.environ, "PYTHONPATH": root})
    assert (ended.returncode, ended.stderr) == (143, "cdmisfa: interrupted\n")
