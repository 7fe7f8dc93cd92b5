"""The view of a run holds every signal of every iteration, and what a person needs besides."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from run_data import DELTA, IMAGE, VECTOR, module_of, run_of, write_run
from view_data import View, scalars

from cdmisfa.core.blocks import SourceSpec
from cdmisfa.core.signals import SIGNALS
from replay.runs.modules import save_modules
from replay.runs.run import read_outline
from replay.view.build import build_view
from replay.view.summary import summary_text

ITERATIONS = 24
TAU = 40


@pytest.fixture(scope="module", params=[IMAGE, VECTOR], ids=["images", "vectors"])
def shown(request, tmp_path_factory):
    """A run, its records, and the rows of its view."""
    folder = tmp_path_factory.mktemp("run")
    records = write_run(folder / "run.mcap", request.param, ITERATIONS, phi_every=10)
    size = int(np.prod(request.param.frame_shape))
    save_modules(folder / "modules.npz", [module_of(1, 8, np.ones((1, size)))])
    build_view(folder, folder / "run.rrd", every=20)
    view = View(folder / "run.rrd")
    return request.param, records, view.rows, view


def test_every_signal_of_every_iteration_is_there(shown):
    """Each curve equals the log."""
    _, records, rows, _ = shown
    for name, signal in SIGNALS.items():
        values = [np.asarray(getattr(s, name)) for s in records]
        if name in ("iteration", "t", "log_time", "R", "Q"):
            continue
        count = TAU if "T" in signal.dims else 1
        expected = {f"/signals/{name}": [v.reshape(count, -1) for v in values]}
        if signal.dims.startswith("M"):
            expected = {
                f"/signals/{name}/{m + 1}": [v[m].reshape(-1, 1) for v in values if len(v) > m]
                for m in (0, 1)
            }
        else:
            entity = rows[f"/signals/{name}"]
            assert entity["iteration"] == [s.iteration for s in records for _ in range(count)]
            assert entity["frame"] == [s.t + i for s in records for i in range(count)]
        for entity, result in expected.items():
            np.testing.assert_array_equal(scalars(rows[entity]), np.concatenate(result))


def test_every_frame_has_the_log_time_of_the_log_at_any_rate(tmp_path):
    """At 29.97 frames a second, rounding the frame's length first moves 9 of 200,000 frames."""
    spec = dataclasses.replace(VECTOR, fps=29.97)
    write_run(tmp_path / "run.mcap", spec, 9, tau=14_985)
    build_view(tmp_path, tmp_path / "run.rrd")
    rows = View(tmp_path / "run.rrd", only="/signals/y").rows["/signals/y"]
    assert rows["frame"] == list(range(9 * 14_985))
    assert rows["message_log_time"] == [spec.time_ns(t) for t in rows["frame"]]


def test_what_was_watched_is_there(shown):
    spec, _, rows, _ = shown
    frames = np.concatenate([block.frames for _, block in run_of(spec, ITERATIONS)])
    entity = rows["/world/watched"]
    if spec is IMAGE:
        assert entity["frame"] == list(range(0, ITERATIONS * TAU, 20))
        for t, (pixels,) in zip(entity["frame"], entity["Image:buffer"], strict=True):
            assert bytes(pixels) == frames[t].tobytes()
    else:
        np.testing.assert_array_equal(scalars(entity), frames)
    truth = np.concatenate([block.truth for _, block in run_of(spec, ITERATIONS)])
    np.testing.assert_array_equal(scalars(rows["/world/truth"]), truth)


def test_lanes_say_what_was_the_case(shown):
    spec, records, rows, _ = shown

    def at(entity, t):
        states = zip(rows[entity]["frame"], rows[entity]["StateChange:state"], strict=True)
        return [state for frame, state in states if frame <= t][-1]

    for s in records:
        assert at("/attended/each_block", s.t) == [spec.streams[s.stream]]
        verdict = "novel" if s.novel else f"explained by module {s.known_by}"
        verdict = verdict if s.novel or s.known_by > 0 else "constant"
        assert at("/novelty/each_block", s.t) == [verdict]
        did = "switch" if s.action else f"stay on {spec.streams[s.stream]}"
        assert at("/action", s.t) == [did]
        for i, name in enumerate(spec.streams):
            assert at(f"/policy/{i + 1}_{name}", s.t) == [["stay", "switch"][s.policy[i]]]


def test_eyes_get_threshold_band_weights_and_events(shown):
    spec, records, rows, view = shown
    assert set(np.ravel(scalars(rows["/thresholds/eta_dot"]))) == {np.log10(DELTA)}
    band = scalars(rows["/gate/band/1"])
    np.testing.assert_allclose(band, np.tile([0.008, 0.012], (len(band), 1)))
    assert rows["/abstraction/phi"]["iteration"] == [0, 10, 20]
    assert rows["/modules/1/weights"]["iteration"] == [8]
    assert rows["/events"]["TextLog:text"] == [["stopped: the test is over"]]
    assert "/summary" in view.static
    stay = scalars(rows[f"/decision/R_stay/2_{spec.streams[1]}"])[:, 0]
    np.testing.assert_allclose(stay, [1000 * s.R[1, 0, 1] for s in records])
    fell = [np.log10(s.eta_dot[0]) for s in records]
    np.testing.assert_array_equal(scalars(rows["/abstraction/log_eta_dot"])[:, 0], fell)
    advantage = scalars(rows[f"/decision/advantage/2_{spec.streams[1]}"])[:, 0]
    np.testing.assert_allclose(advantage, [1000 * (s.Q[1, 0] - s.Q[1, 1]) for s in records])


def test_the_summary_says_what_was_not_saved_and_why_it_ended(tmp_path):
    written = write_run(tmp_path / "run.mcap", VECTOR, ITERATIONS)
    text = summary_text(read_outline(tmp_path), "run", ["ended: nothing was left"])
    last = [s for s in written if s.module == written[-1].module]
    assert f"Module {last[0].module} was not saved: " in text
    assert f"of its {len(last)} blocks" in text
    novel = [s.stream for s in last if s.novel]
    most = max(set(novel), key=novel.count)
    name = VECTOR.streams[most]
    share = f"{novel.count(most) / len(novel):.0%} of the novel blocks came from {name}."
    assert 0 < len(novel) < len(last)
    assert share in text
    assert "Stopped: nothing was left." in text


def test_many_streams_show_the_most_watched(tmp_path, monkeypatch):
    monkeypatch.setattr("replay.view.build.MOST_STREAMS", 5)
    spec = SourceSpec(tuple(f"s{i}" for i in range(70)), (2,), "float64", (), 50.0, 0)
    records = write_run(tmp_path / "run.mcap", spec, 30)
    build_view(tmp_path, tmp_path / "run.rrd")
    rows = View(tmp_path / "run.rrd").rows
    lanes = {entity for entity in rows if entity.startswith("/policy/")}
    assert len(lanes) == 5
    visits = np.bincount([s.stream for s in records], minlength=70)
    shown = [int(entity.split("s")[-1]) for entity in lanes]
    assert min(visits[shown]) >= np.sort(visits)[-5]


def test_an_empty_run_has_a_view_too(tmp_path):
    write_run(tmp_path / "run.mcap", VECTOR, 0)
    build_view(tmp_path, tmp_path / "empty.rrd")
    assert "/signals/y" not in View(tmp_path / "empty.rrd").rows
