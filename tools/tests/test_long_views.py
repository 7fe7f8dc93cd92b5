"""A window shows what comes for longer than the 30 s after which Rerun ends a request."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from pathlib import Path
from typing import Any

import pytest
import rerun as rr

from replay.view.bindings import viewer_client, viewer_program
from replay.viewer import program
from replay.viewer.broadcast import Broadcast

SECONDS = 45


@pytest.mark.skipif(bool(program.missing_driver()), reason=program.missing_driver())
def test_a_window_shows_what_comes_after_half_a_minute(tmp_path: Path, monkeypatch: Any) -> None:
    words, viewer = tmp_path / "words", tmp_path / "viewer"
    script = f'#!/bin/sh\necho $$ "$@" > {words}\nexec {viewer_program()} --headless "$@"\n'
    viewer.write_text(script)
    viewer.chmod(0o755)
    broadcast, step = Broadcast("live"), 0
    monkeypatch.setattr("replay.viewer.program.viewer_program", lambda: viewer)
    broadcast.open_window()
    end = time.monotonic() + SECONDS
    while time.monotonic() < end:
        broadcast.recording.set_time("step", sequence=step)
        broadcast.recording.log("line", rr.Scalars([float(step)]))
        broadcast.hand_over()
        time.sleep(0.1)
        step += 1
    given, shown = words.read_text().split(), 0
    place = f"{given[given.index('--bind') + 1]}:{given[given.index('--port') + 1]}"
    until = time.monotonic() + 20
    while shown < step - 1 and time.monotonic() < until:
        with contextlib.suppress(OSError, RuntimeError):
            state = viewer_client().connect(f"rerun+http://{place}/proxy").get_state()
            shown = max(int(t.end) for r in state.recordings for t in r.timelines)
        time.sleep(0.2)
    broadcast.close()
    os.kill(int(given[0]), signal.SIGTERM)
    assert shown == step - 1
