"""The view of a run across a gap: every frame stands at the iteration that watched it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from run_data import IMAGE, block_of, having, module_of, parts_of, run_of
from view_data import View

from recorder.config import RecordConfig
from recorder.log.manifest import RecordingSpec
from recorder.log.viewlog import ViewLog
from replay.open_sources import open_recording
from replay.runs.modules import load_modules, save_modules
from replay.runs.writer import RunWriter
from replay.view.build import build_view

ITERATIONS, TAU, EVERY = 15, 40, 20
GAP_AFTER, GAP = 4, 95
"""Blocks before the gap, and its frames: no multiple of a block."""


def after_the_gap(t: int) -> int:
    return t + (GAP if t >= GAP_AFTER * TAU else 0)


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """A run whose source had nothing to show for a while, its records, and the rows of its view."""
    folder = tmp_path_factory.mktemp("gap")
    recording = folder / "recording"
    recording.mkdir()
    identity = RecordingSpec("test", 0, IMAGE, {}, gaps=True)
    logs = [ViewLog(recording, name, identity, RecordConfig()) for name in IMAGE.streams]
    rng = np.random.default_rng(0)
    for s, log in enumerate(logs):
        for k in range(ITERATIONS):
            log.write(block_of(IMAGE, s, after_the_gap(k * TAU), TAU, rng))
        log.finish()
    with open_recording(recording, loop=True) as source:
        described = source.describe()
    learner = {"tau": TAU, "delta": 0.001}
    manifest = {"config": {"learner": learner}, "seed": 0, "source": described}
    writer, records, modules = RunWriter(folder / "run.mcap", IMAGE, manifest, phi_every=1), [], []
    for made, _ in run_of(IMAGE, ITERATIONS, tau=TAU, saves=True):
        t = after_the_gap(made.t)
        signals = dataclasses.replace(made, t=t, log_time=IMAGE.time_ns(t))
        phi = np.full((1, 12 * 16), float(signals.iteration))
        writer.block(block_of(IMAGE, signals.stream, t, TAU, rng), signals, having(phi))
        records.append(signals)
        if signals.saved:
            name = IMAGE.streams[signals.stream]
            place = (signals.iteration, phi, signals.stream, name)
            modules.append(module_of(len(modules) + 1, *place))
    writer.close()
    save_modules(folder / "modules.npz", modules)
    build_view(folder, folder / "run.rrd", every=EVERY)
    return folder, records, View(folder / "run.rrd").rows


def at(records, frame):
    """The record of the block that a frame is of."""
    return next(r for r in reversed(records) if r.t <= frame)


@pytest.mark.parametrize(
    "entity", ["/world/watched", "/world/truth", "/abstraction/phi", "/learned/1/followed"]
)
def test_what_was_watched_stands_at_its_iteration(shown, entity):
    _, records, rows = shown
    result = zip(rows[entity]["frame"], rows[entity]["iteration"], strict=True)
    shown = [(t, k) for t, k in result if t != GAP_AFTER * TAU]  # where lines end
    assert max(shown)[0] >= records[-1].t
    assert shown == [(t, at(records, t).iteration) for t, _ in shown]


def test_modules_stand_where_they_were_saved(shown):
    _, records, rows = shown
    saves = [record for record in records if record.saved]
    assert len(saves) == 3
    for number, save in enumerate(saves, 1):
        weights = rows[f"/modules/{number}/weights"]
        assert (weights["frame"], weights["iteration"]) == ([save.t], [save.iteration])


@pytest.mark.parametrize(
    "lane",
    [
        f"{s}/{t}_block{'s' * (t == 'most')}"
        for s in ("attended", "novelty")
        for t in ("each", "most")
    ],
)
def test_a_bar_ends_where_a_gap_begins(shown, lane):
    _, records, rows = shown
    frames, states = rows[f"/{lane}"]["frame"], rows[f"/{lane}"]["StateChange:state"]
    none = [t for t, state in zip(frames, states, strict=True) if state == [""]]
    assert none == [GAP_AFTER * TAU, records[-1].t + TAU]
    begin = frames.index(GAP_AFTER * TAU + GAP)
    assert begin == frames.index(none[0]) + 1
    if lane == "attended/each_block":
        assert states[begin] == [IMAGE.streams[records[GAP_AFTER].stream]]


@pytest.mark.parametrize("entity", ["/world/truth", "/signals/y", "/learned/1/followed"])
def test_a_line_of_every_frame_ends_where_a_gap_begins(shown, entity):
    _, _, rows = shown
    frames, values = rows[entity]["frame"], rows[entity]["Scalars:scalars"]
    assert frames == sorted(set(frames))
    here = frames.index(GAP_AFTER * TAU)
    assert frames[here + 1] == GAP_AFTER * TAU + GAP
    assert np.isnan(values[here]).all()
    if entity != "/signals/y":  # which nothing is there of at first
        assert np.isfinite([values[here - 1], values[here + 1]]).all()


@pytest.mark.parametrize("number", [1, 2])
def test_an_output_is_there_on_all_frames_of_its_own_stream_alone(shown, number):
    folder, records, rows = shown
    module = load_modules(folder)[number - 1]
    stream = module.stream_index
    output = rows[f"/modules/{number}/output"]
    y = dict(zip(output["frame"], output["Scalars:scalars"], strict=True))
    watched = parts_of(folder, "watched")
    frames = {t: image for part in watched for t, image in zip(*part, strict=True)}
    own = {t for r in records if r.stream == stream for t in range(r.t, r.t + TAU)}
    said = {t: value for t, (value,) in y.items() if np.isfinite(value)}
    remaining = [t for t in frames if t in own and t % EVERY == 0]
    assert min(remaining) < next(r.t for r in records if r.saved and r.module == number)
    assert sorted(said) == sorted(remaining)
    for t, value in said.items():
        assert value == pytest.approx(module.transform(frames[t][None])[0, 0])
    for end in (t for t in y if t not in said):  # a line ends where another stream was watched
        assert end not in own
