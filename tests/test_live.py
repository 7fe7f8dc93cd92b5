"""A run can be watched while it learns, and is none the worse for it."""

from __future__ import annotations

import contextlib
import socket
import sys
from contextlib import nullcontext
from urllib.parse import urlsplit

import numpy as np
import pytest
from headless import needs_driver, shown
from run_data import IMAGE, VECTOR, having, read_signals, run_of
from test_viewer import addresses

from cdmisfa.core.config import LearnerConfig
from cdmisfa.experiments.session import run_session
from recorder.world.oscillatory import OscillatorySource
from replay.view import live
from replay.view.live import LiveView

MANIFEST = {"config": {"learner": {"delta": 0.0008}}, "seed": 0}


def feed(view, spec, iterations=30, tau=40):
    for signals, block in run_of(spec, iterations, saves=True):
        view.block(block, signals, having(np.ones((1, int(np.prod(spec.frame_shape))))))
    view.event(iterations * tau, iterations - 1, "the end")


@pytest.fixture
def sent(monkeypatch):
    """What viewers are handed, in the order in which it is: the values of each line by its path."""
    result = {}

    def keep(self, path, at, columns):
        (values, *_) = columns
        if path.startswith(("signals/", "streams/")):
            result.setdefault(path, []).append(np.concatenate(values.as_arrow_array().to_pylist()))
        else:
            result.setdefault(path, [])

    monkeypatch.setattr("replay.view.writer.Writer.send", keep)
    monkeypatch.setattr(live, "MOST_BLOCKS", 7)
    return result


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


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads Linux's table of sockets")
def test_it_listens_on_this_machine_only():
    with LiveView(VECTOR, MANIFEST, 40, 1) as view:
        port = urlsplit(view.address).port
        with socket.create_connection(("127.0.0.1", port), timeout=5):
            pass
        assert addresses([port]) == {f"0100007F:{port:04X}"}


@needs_driver
def test_a_viewer_shows_the_run_as_it_grows_and_keeps_it():
    """The last block too, which is handed over when the run ends."""

    def end(client):
        return max(t.end for r in client.get_state().recordings for t in r.timelines[:1])

    with contextlib.ExitStack() as opened:
        with LiveView(IMAGE, MANIFEST, 40, 1) as view:
            feed(view, IMAGE)
            view.flush()
            ask = opened.enter_context(shown(view.address))
            ask(lambda client: end(client) >= 30 * 40 - 1)
            views = ask(lambda client: client.get_state().views)
            assert "Results" in {v.name for v in views}
            assert [v.reports for v in views] == [[]] * len(views)
            feed(view, IMAGE, 60)
        ask(lambda client: end(client) >= 60 * 40 - 1)


def test_a_run_gives_the_same_with_and_without(tmp_path):
    said, folder = [], tmp_path / "run"
    quiet = run_session(OscillatorySource(), LearnerConfig(), None, max_iterations=60)
    how = {"max_iterations": 60, "live": lambda address: said.append(address) or nullcontext()}
    shown = run_session(OscillatorySource(), LearnerConfig(), folder, **how)
    assert shown.signals_sha256 == quiet.signals_sha256
    assert (folder / "run.rrd").is_file()
    assert len(said) == 1


def test_a_resumed_run_shows_what_went_before(tmp_path, sent):
    """All of a resumed run is handed over, each record once, and in order."""
    folder, how = tmp_path / "run", {"rerun": False}
    run_session(OscillatorySource(), LearnerConfig(), folder, max_iterations=30, **how)
    how |= {"resume": True, "live": lambda address: nullcontext()}
    run_session(OscillatorySource(), LearnerConfig(), folder, max_iterations=50, **how)
    expected = [s.epsilon for s in read_signals(folder)]
    assert len(expected) == 50
    np.testing.assert_array_equal(np.concatenate(sent["signals/epsilon"]), expected)
