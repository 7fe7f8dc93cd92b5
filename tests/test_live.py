"""A run can be watched while it learns, and is none the worse for it."""

from __future__ import annotations

import contextlib
import http.client
import os
import signal
import socket
import sys
import threading
from dataclasses import replace
from pathlib import Path
from urllib.error import URLError
from urllib.parse import urljoin, urlsplit
from urllib.request import urlopen

import numpy as np
import pytest
import rerun as rr
from PIL import Image
from rerun.chunk import RrdReader
from run_data import IMAGE, VECTOR, having, read_signals, run_of
from test_view_world import LIVE as SCENE_SOURCE
from test_view_world import SCENE, without_models
from waiting import wait_for

from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.errors import CdmisfaError
from cdmisfa.experiments.session import run
from recorder.world.oscillatory import OscillatorySource
from replay.runs.writer import RunWriter
from replay.view.bindings import viewer_client, viewer_program
from replay.viewer import headless, live, program
from replay.viewer.broadcast import Pieces
from replay.viewer.live import LiveView
from replay.viewer.web import DATA

MANIFEST = {"config": {"learner": {"delta": 0.0008}}, "seed": 0}


def feed(view, spec, iterations=30, tau=40):
    for signals, block in run_of(spec, iterations, saves=True):
        view.block(block, signals, having(np.ones((1, int(np.prod(spec.frame_shape))))))
    view.event(iterations * tau, iterations - 1, "the end")


@pytest.fixture
def sent(monkeypatch):
    """What viewers are handed, in the order in which it is: the values of each line by its path."""
    found = {}

    def keep(self, times, values):
        found.setdefault(self.path, []).append(np.array(values).reshape(-1))

    monkeypatch.setattr("replay.view.columns.Column.send", keep)
    monkeypatch.setattr(live, "MOST_BLOCKS", 7)
    return found


@pytest.mark.parametrize("spec", [IMAGE, VECTOR], ids=["images", "vectors"])
def test_every_record_is_handed_over(spec, sent):
    """What the server is given equals what a finished run's view is given."""
    with LiveView(spec, MANIFEST, 40, 1) as view:
        feed(view, spec)
    records = [signals for signals, _ in run_of(spec, 30, saves=True)]
    for name in ("epsilon", "y", "xi"):
        expected = np.concatenate([np.ravel(getattr(s, name)) for s in records])
        np.testing.assert_array_equal(np.concatenate(sent[f"signals/{name}"]), expected)
    assert len(sent["signals/epsilon"]) == 5


def test_the_progress_learner_is_shown_by_its_streams(sent):
    table = {"algorithm": "progress", "settled": 0.05, "agreement": 0.25}
    with LiveView(VECTOR, {"config": {"learner": table}}, 40, 1) as view:
        feed(view, VECTOR)
    records = [signals for signals, _ in run_of(VECTOR, 30, saves=True)]
    for s, name in enumerate(VECTOR.streams):
        found = np.concatenate(sent[f"streams/log_learning_error/{s + 1}_{name}"])
        expected = [np.log10(r.learning_error) for r in records if r.stream == s]
        np.testing.assert_array_equal(found[np.isfinite(found)], expected)
    assert not any(path.startswith("policy/") for path in sent)


def test_the_robot_turns_to_what_is_watched(tmp_path, monkeypatch):
    """As in the view of a finished run, whose first tab a live view has, too."""
    without_models(monkeypatch)
    sent = {}

    def keep(self, path, times, columns, **_):
        sent.setdefault(path, []).append(times)

    monkeypatch.setattr("rerun.RecordingStream.send_columns", keep)
    with LiveView(SCENE, {**MANIFEST, "source": SCENE_SOURCE}, 40, 1) as view:
        feed(view, SCENE)
    assert {"scene/watching", "scene/box", "scene/ball", "scene/cylinder"} <= set(sent)
    with LiveView(IMAGE, MANIFEST, 40, 1) as view:
        feed(view, IMAGE)
    assert {"wall/frame", *(f"wall/{s + 1}_{n}" for s, n in enumerate(IMAGE.streams))} <= set(sent)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads Linux's table of sockets")
def test_it_listens_on_this_machine_only():
    with LiveView(VECTOR, MANIFEST, 40, 1) as view:
        port = urlsplit(view.broadcast.address).port
        with socket.create_connection(("127.0.0.1", port), timeout=5):
            pass
        listening = Path("/proc/net/tcp").read_text("utf-8")
        rows = [row.split() for row in listening.splitlines()[1:]]
        places = {row[1] for row in rows if row[3] == "0A" and row[1].endswith(f":{port:04X}")}
        assert places == {f"0100007F:{port:04X}"}


def test_only_who_has_the_address_is_given_the_run(tmp_path):
    """All of it, until its end; nothing to another name that leads here, nor without the token."""
    with LiveView(VECTOR, MANIFEST, 40, 1) as view:
        feed(view, VECTOR)
        address = urljoin(view.broadcast.address, DATA)
        port, place = urlsplit(address).port, urlsplit(address).path
        for path, host, status in (
            (f"/{DATA}", f"127.0.0.1:{port}", 403),
            (place, f"example.org:{port}", 403),
            (place, "example.org", 403),
            (place.replace("run", "other"), f"127.0.0.1:{port}", 404),
            (place.replace(DATA, ""), f"127.0.0.1:{port}", 200),
        ):
            connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
            connection.request("GET", path, headers={"Host": host})
            assert connection.getresponse().status == status, (path, host)
            connection.close()
        taken = []
        reader = threading.Thread(target=lambda: taken.append(urlopen(address).read()))
        reader.start()
    reader.join()
    (data,) = taken
    (tmp_path / "a.rrd").write_bytes(data[data.rindex(data[:8]) :])  # the last piece
    paths = {chunk.entity_path for chunk in RrdReader(str(tmp_path / "a.rrd")).stream()}
    assert {"/signals/epsilon", "/events"} <= paths
    with pytest.raises(URLError):
        urlopen(address, timeout=10)


def test_what_does_not_fit_goes_from_behind_the_beginning():
    pieces = Pieces(50)
    early, late = pieces.read(), pieces.read()
    for number in range(4):
        pieces.add(bytes([number]) * 10)
    assert [next(early)[0] for _ in range(4)] == [0, 1, 2, 3]
    for number in range(4, 9):
        pieces.add(bytes([number]) * 10)
    pieces.end(0)
    assert [piece[0] for piece in early] == [6, 7, 8]
    assert [piece[0] for piece in late] == [0, 1, 6, 7, 8]


@pytest.mark.skipif(bool(program.missing_driver()), reason=program.missing_driver())
def test_a_window_shows_the_run_as_it_grows_and_nobody_the_address(tmp_path, monkeypatch):
    """It is given no address, whose data it would take for 30 s; and has no screen here."""
    real, words = viewer_program(), tmp_path / "words"
    monkeypatch.setattr("replay.viewer.program.viewer_program", lambda: tmp_path / "viewer")
    script = f"""#!/bin/sh
    echo $$ "$@" > {words}
    exec {real} --headless --window-size 300x200 "$@"
    """
    (tmp_path / "viewer").write_text(script)
    (tmp_path / "viewer").chmod(0o755)

    def given():
        return words.read_text().split()

    def place():
        return f"{given()[given().index('--bind') + 1]}:{given()[given().index('--port') + 1]}"

    def shows(frame):
        """Whether the window has come so far."""
        with contextlib.suppress(OSError, RuntimeError):
            state = viewer_client().connect(f"rerun+http://{place()}/proxy").get_state()
            return any(line.end >= frame for r in state.recordings for line in r.timelines)

    with LiveView(VECTOR, MANIFEST, 40, 1) as view:
        view.broadcast.open_window()
        for iterations in (30, 60):
            feed(view, VECTOR, iterations)
            view.flush()
            wait_for(lambda last=iterations * 40 - 1: shows(last), 60)
    os.kill(int(given()[0]), signal.SIGTERM)
    assert place().startswith("127.")
    assert urlsplit(view.broadcast.address).path.split("/")[1] not in words.read_text()


def test_a_run_gives_the_same_with_and_without(tmp_path):
    said, folder = [], tmp_path / "run"
    quiet = run(OscillatorySource(), LearnerConfig(), None, max_iterations=60)
    how = {"max_iterations": 60, "live": True, "announce": said.append}
    shown = run(OscillatorySource(), LearnerConfig(), folder, **how)
    assert shown.signals_sha256 == quiet.signals_sha256
    assert (folder / "run.rrd").is_file()
    assert len(said) == 1


def test_a_resumed_run_shows_what_went_before(tmp_path, sent):
    """All of a resumed run is handed over, each record once, and in order."""
    folder, how = tmp_path / "run", {"rerun": False}
    run(OscillatorySource(), LearnerConfig(), folder, max_iterations=30, **how)
    how |= {"resume": True, "live": True}
    run(OscillatorySource(), LearnerConfig(), folder, max_iterations=50, **how)
    expected = [s.epsilon for s in read_signals(folder)]
    assert len(expected) == 50
    np.testing.assert_array_equal(np.concatenate(sent["signals/epsilon"]), expected)


def test_what_went_before_has_a_picture_of_each_block(tmp_path, monkeypatch):
    """Also where a block begins at no multiple of its length, as after a gap."""
    sent, spec, tau = [], IMAGE, 15

    def keep(self, times, values):
        if self.path == "world/watched":
            sent.extend(times[0].as_arrow_array().to_pylist())

    writer, begins = RunWriter(tmp_path / "run.mcap", spec, MANIFEST, watched_every=2), []
    for signals, block in run_of(spec, 30, tau=tau):
        t = block.t + (37 if signals.iteration >= 10 else 0)
        moved = replace(signals, t=t, log_time=spec.time_ns(t))
        writer.block(replace(block, t=t), moved, having(np.ones((1, 192))))
        begins.append(t)
    writer.finish()
    monkeypatch.setattr("replay.view.columns.Column.send", keep)
    with LiveView(spec, MANIFEST, tau, 1) as view:
        view.earlier(tmp_path)
    assert sent == [t + t % 2 for t in begins]


def test_rerun_switched_off_is_said(monkeypatch):
    monkeypatch.setattr(rr, "is_enabled", lambda recording: False)
    with pytest.raises(CdmisfaError, match="RERUN"):
        LiveView(VECTOR, MANIFEST, 40, 1)


@pytest.mark.skipif(bool(program.missing_driver()), reason=program.missing_driver())
def test_a_viewer_that_connects_shows_it(tmp_path):
    with LiveView(IMAGE, MANIFEST, 40, 1) as view, headless.headless_viewer("900x600") as opened:
        feed(view, IMAGE)
        view.flush()

        def connected(client):
            views = client.get_state().views
            return views if any(v.name == "Summary" for v in views) else None

        viewer = opened.ask(lambda client: client)

        def open_it():  # waits for what never ends to be loaded
            with contextlib.suppress(OSError):
                viewer.open(urljoin(view.broadcast.address, DATA))

        threading.Thread(target=open_it, daemon=True).start()
        views = opened.ask(connected, seconds=30)
        assert [v.reports for v in views] == [[]] * len(views)
        (tmp_path / "s.png").write_bytes(opened.ask(lambda c: c.take_screenshot()))
    with Image.open(tmp_path / "s.png") as picture:
        assert len(np.unique(np.asarray(picture.convert("L")))) > 20
