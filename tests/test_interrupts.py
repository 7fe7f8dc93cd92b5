"""Signals end what a command does, once, wherever they come; closed streams end nothing."""

from __future__ import annotations

import pkgutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from conftest import Cdmisfa, Outcome
from folders import contents

from cdmisfa.core.interrupts import SIGNALS

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


@pytest.mark.parametrize(
    "last", ["replay.view.build.build_view", "cdmisfa.experiments.run_folder.save_modules"]
)
def test_an_interrupted_run_is_resumed(
    cdmisfa: Cdmisfa, tmp_path: Path, monkeypatch: Any, last: str
) -> None:
    out = tmp_path / "out"
    done = _signalled(cdmisfa, (*LEARN, "-o", out), last, 2, monkeypatch)
    assert done.code == 130
    said = f"cdmisfa: interrupted: {out} is not finished: continue with --resume"
    assert done.err.splitlines()[-1] == said
    assert cdmisfa("learn", "-o", out, "--resume").code == 0
    assert (out / "run.rrd").is_file()
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
    [("rtsp://{}/left", "learn", WAITING), ("gym:Pendulum-v1", "record", "gymnasium.make")],
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


CLOSED = (">&-", "<&- >&- 2>&-")
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


@pytest.mark.parametrize("closed", CLOSED)
def test_a_command_and_its_processes_do_their_work_and_say_so(
    tmp_path: Path, recorded: dict[str, bytes], closed: str
) -> None:
    ended = closed_streams(closed, *SCENE, "--jobs", 2, "-o", tmp_path / "rec")
    assert (ended.returncode, ended.stderr) == (0, "")
    assert bool(ended.stdout) == (">&-" not in closed.split())
    assert contents(tmp_path / "rec") == recorded
