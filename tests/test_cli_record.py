"""`cdmisfa record` as a command: what it prints, and how it ends when it is stopped."""

from __future__ import annotations

import os
import pty
import signal
import sys
import time
from pathlib import Path

import psutil
import pytest
from conftest import Cdmisfa
from folders import contents
from waiting import started, wait_for

from recorder.recording import RecordingStoppedError, record_scene
from recorder.world.oscillatory import OscillatoryConfig


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)]
)
def test_a_signal_says_how_to_go_on(
    cdmisfa: Cdmisfa, tmp_path: Path, number: int, code: int
) -> None:
    folder = tmp_path / "rec"
    words = ("record", "oscillatory", "-o", folder, "--frames", 100000000)
    with started(*words) as recorder:
        wait_for((folder / "x3.mcap.partial").exists, 60, recorder)
        time.sleep(0.2)
        recorder.send_signal(number)
        error = recorder.communicate(timeout=60)[1]
    assert recorder.returncode == code
    line = f"cdmisfa: interrupted: {folder} is not finished: continue with --resume\n"
    assert error.lstrip("\n") == line  # behind the terminal's ^C
    assert not list(folder.glob("*.mcap"))
    assert cdmisfa("info", folder, "--json").json["complete"] is False


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_terminal_that_is_closed_ends_it_like_a_signal(tmp_path: Path, jobs: int) -> None:
    folder = tmp_path / "rec"
    words = ["record", "oscillatory", "-o", str(folder), "--frames", "100000000"]
    pid, terminal = pty.fork()
    if pid == 0:
        os.execv(sys.executable, [sys.executable, "-m", "cdmisfa", *words, "--jobs", str(jobs)])
    recorder = psutil.Process(pid)
    try:
        wait_for(
            lambda: sum(p.stat().st_size for p in folder.glob("*.mcap.partial")) >= 1 << 17, 60
        )
        os.close(terminal)
        assert recorder.wait(60) == 129
    finally:
        if recorder.is_running():
            recorder.kill()
    with pytest.raises(RecordingStoppedError):
        record_scene("oscillatory", folder, frames=100000000, resume=True, stop=lambda: True)


def test_going_on_needs_neither_scene_nor_seed_nor_split(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    words = ("--frames", 400, "--seed", 7, "--split", "5s")
    cdmisfa("record", "oscillatory", "-o", tmp_path / "whole", *words)
    folder = tmp_path / "rec"

    def stop(done: float) -> None:
        if done >= 100:
            raise OSError

    with pytest.raises(OSError):  # noqa: PT011 - what stops it is no matter
        record_scene(
            "oscillatory", folder, OscillatoryConfig(seed=7), frames=400, split=5.0, progress=stop
        )
    again = ("record", "--resume", "-o", folder)
    for wrong, what in (
        (("--seed", 8), "its seed is '7', not '8'"),
        (("--split", "4s"), "started with --split 5s, not --split 4s"),
        (("icub",), "belongs to another recording"),
    ):
        if wrong == ("icub",):
            pytest.importorskip("pybullet")
        refused = cdmisfa(*again, *wrong)
        assert (refused.code, what in refused.err) == (2, True), refused.err
    done = cdmisfa(*again)
    assert done.code == 0, done.err
    assert contents(folder) == contents(tmp_path / "whole")
    complete = cdmisfa(*again, "--json")
    assert (complete.code, complete.json["frames"]) == (0, 400)
    assert complete.err == f"{folder} is complete: there is nothing to resume\n"
    longer = cdmisfa("record", "oscillatory", *again[1:], *words[2:], "--frames", 450, "--json")
    assert longer.code == 0, longer.err
    assert (longer.json["frames"], longer.err) == (450, "")
    (folder / "x2-000.mcap").unlink()
    for unknown in (again, (*again, "--frames", 9)):
        assert cdmisfa(*unknown).code == 2
    nothing = cdmisfa("record", "--resume", "-o", tmp_path / "new")
    assert (nothing.code, "name a scene" in nothing.err) == (2, True)
