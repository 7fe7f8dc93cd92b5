"""The view of a run holds every signal of every iteration, and what a person needs besides."""

from __future__ import annotations

import dataclasses
import math
import re
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from rerun.chunk import RrdReader
from run_data import DELTA, IMAGE, VECTOR, run_of, write_run

from cdmisfa.core.blocks import SourceSpec
from cdmisfa.core.errors import CdmisfaError, UsageError
from cdmisfa.core.modules import Module
from cdmisfa.core.signals import SIGNALS
from recorder.recording import record_scene
from recorder.world.oscillatory import OscillatoryConfig
from replay.runs.modules import save_modules
from replay.runs.run import read_outline
from replay.view import run as run_view
from replay.view.build import build_view
from replay.view.columns import image_column, images, named_tensors, tensors
from replay.view.layouts import WorldTab
from replay.view.panels import run_layout
from replay.view.summary import summary_text

REPLAY = Path(__file__).parents[1] / "replay"
ITERATIONS = 24
TAU = 40


@pytest.fixture(autouse=True)
def _strict(monkeypatch):
    """Rerun drops data that it does not understand, with a warning only, unless told so."""
    monkeypatch.setenv("RERUN_STRICT", "1")


def rows_of(path):
    """Per entity: its columns over all chunks in the order of frames."""
    chunks = defaultdict(list)
    for chunk in RrdReader(str(path)).stream():
        if not chunk.is_static:
            chunks[chunk.entity_path].append(chunk.to_record_batch())
    entities = {}
    for entity, batches in chunks.items():
        columns = {}
        for name in batches[0].schema.names:
            values = [
                batch.column(name).to_pylist() for batch in batches if name in batch.schema.names
            ]
            columns[name] = [v for part in values for v in part]
        if "frame" in columns:
            order = np.argsort(columns["frame"], kind="stable")
            columns = {name: [c[i] for i in order] for name, c in columns.items()}
        entities[entity] = columns
    return entities


def views_of(layout):
    """The views of a layout or a container, in order."""
    root = getattr(layout, "root_container", layout)
    if not hasattr(root, "contents") or not hasattr(root, "kind"):
        return [root]
    return [view for part in root.contents for view in views_of(part)]


def statics_of(path):
    return {chunk.entity_path for chunk in RrdReader(str(path)).stream() if chunk.is_static}


def scalars(entity):
    return np.array(entity["Scalars:scalars"], dtype=np.float64)


@pytest.fixture(scope="module", params=[IMAGE, VECTOR], ids=["images", "vectors"])
def shown(request, tmp_path_factory):
    """A run, its records, and the rows of its view."""
    folder = tmp_path_factory.mktemp("run")
    records = write_run(folder / "run.mcap", request.param, ITERATIONS, phi_every=10)
    size = int(np.prod(request.param.frame_shape))
    module = Module(
        index=1,
        stream="a",
        stream_index=0,
        iteration=8,
        phi=np.ones((1, size)),
        mean=np.zeros(size),
        band_mean=np.zeros(1),
        band_sd=np.ones(1),
        eta=np.ones(1),
        policy=np.array([0, 1, 1]),
    )
    save_modules(folder / "modules.npz", [module])
    build_view(folder, folder / "run.rrd", every=20)
    return request.param, records, rows_of(folder / "run.rrd"), folder


@pytest.mark.parametrize(
    "name", [n for n in SIGNALS if n not in ("iteration", "t", "log_time", "R", "Q")]
)
def test_every_signal_of_every_iteration_is_there(name, shown):
    _, records, rows, _ = shown
    if SIGNALS[name].dims.startswith("M"):
        for module in (1, 2):
            expected = [
                getattr(s, name)[module - 1].reshape(-1, 1)
                for s in records
                if len(s.y_frozen) >= module
            ]
            found = scalars(rows[f"/signals/{name}/{module}"])
            np.testing.assert_array_equal(found, np.concatenate(expected))
        return
    per_frame = SIGNALS[name].dims.startswith("T")
    values = [np.asarray(getattr(s, name), dtype=float) for s in records]
    expected = [v.reshape(TAU if per_frame else 1, -1) for v in values]
    entity = rows[f"/signals/{name}"]
    np.testing.assert_array_equal(scalars(entity), np.concatenate(expected))
    repeat = TAU if per_frame else 1
    assert entity["iteration"] == [s.iteration for s in records for _ in range(repeat)]
    assert entity["frame"] == [s.t + i for s in records for i in range(repeat)]


@pytest.mark.parametrize("name", ["R", "Q"])
def test_tensors_are_there(name, shown):
    _, records, rows, _ = shown
    found = rows[f"/signals/{name}"]["Tensor:data"]
    for signals, (tensor,) in zip(records, found, strict=True):
        expected = getattr(signals, name)
        assert tensor["shape"] == list(expected.shape)
        np.testing.assert_array_equal(np.reshape(tensor["buffer"], expected.shape), expected)


def test_all_stand_on_the_clock_of_the_log(shown):
    spec, records, rows, _ = shown
    times = rows["/signals/xi"]["message_log_time"]
    found = [np.datetime64(t, "ns").astype(int) for t in times]
    assert found == [s.log_time for s in records]
    times = rows["/signals/y"]["message_log_time"]
    assert np.datetime64(times[-1], "ns").astype(int) == spec.time_ns(ITERATIONS * TAU - 1)


def test_every_frame_has_the_log_time_of_the_log_at_any_rate(tmp_path):
    """At 29.97 frames a second, rounding the frame's length first moves 9 of 200,000 frames."""
    spec = dataclasses.replace(VECTOR, fps=29.97)
    write_run(tmp_path / "run.mcap", spec, 9, tau=14_985)
    build_view(tmp_path, tmp_path / "run.rrd")
    times = {}
    for chunk in RrdReader(str(tmp_path / "run.rrd")).stream():
        if chunk.entity_path == "/signals/y" and not chunk.is_static:
            batch = chunk.to_record_batch()
            log_times = batch.column("message_log_time").cast("int64").to_pylist()
            times |= dict(zip(batch.column("frame").to_pylist(), log_times, strict=True))
    frames = range(9 * 14_985)
    assert [t for t in frames if times[t] != spec.time_ns(t)] == []


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
        assert at("/attends", s.t) == [spec.streams[s.stream]]
        verdict = "novel" if s.novel else f"known by {s.known_by}" if s.known_by > 0 else "constant"
        assert at("/novelty", s.t) == [verdict]
        did = "switch" if s.action else f"stay on {spec.streams[s.stream]}"
        assert at("/does", s.t) == [did]
        for i, name in enumerate(spec.streams):
            assert at(f"/policy/{i + 1}_{name}", s.t) == [["stay", "switch"][s.policy[i]]]


def test_eyes_get_threshold_band_weights_and_events(shown):
    spec, records, rows, folder = shown
    assert set(np.ravel(scalars(rows["/abstraction/delta"]))) == {np.log10(DELTA)}
    band = scalars(rows["/gate/band/1"])
    np.testing.assert_allclose(band, np.tile([0.008, 0.012], (len(band), 1)))
    assert rows["/abstraction/phi"]["iteration"] == [0, 10, 20]
    assert rows["/modules/1/weights"]["iteration"] == [8]
    assert rows["/events"]["TextLog:text"] == [["stopped: the test is over"]]
    assert "/summary" in statics_of(folder / "run.rrd")
    stay = scalars(rows[f"/decision/R_stay/2_{spec.streams[1]}"])[:, 0]
    np.testing.assert_allclose(stay, [1000 * s.R[1, 0, 1] for s in records])
    fell = [np.log10(s.eta_dot[0]) for s in records]
    np.testing.assert_array_equal(scalars(rows["/abstraction/log_eta_dot"])[:, 0], fell)
    (first, *_) = rows["/decision/table"]["TextDocument:text"]
    assert f"| {spec.streams[1]} | {1000 * records[0].Q[1, 0]:.3f} |" in first[0]


def test_the_share_of_the_recent_blocks_is_there(shown, monkeypatch):
    spec, records, _, folder = shown
    monkeypatch.setattr(run_view, "RECENT", 5)
    monkeypatch.setattr("replay.runs.log.BATCH_ITERATIONS", 4)
    build_view(folder, folder / "short.rrd", every=20)
    found = scalars(rows_of(folder / "short.rrd")["/decision/attention"])
    streams = np.array([s.stream for s in records])
    for k in range(len(records)):
        recent = streams[max(0, k - 4) : k + 1]
        share = np.bincount(recent, minlength=len(spec.streams)) / len(recent)
        np.testing.assert_allclose(found[k], share)


def test_the_summary_says_what_was_not_saved_and_why_it_ended(tmp_path):
    written = write_run(tmp_path / "run.mcap", VECTOR, ITERATIONS)
    text = summary_text(read_outline(tmp_path), "run", ["ended: nothing was left"])
    last = [s for s in written if s.module == written[-1].module]
    assert f"Module {last[0].module} was not saved: " in text
    assert f"of its {len(last)} blocks" in text
    assert "It ended: nothing was left." in text


def test_the_file_has_a_layout_and_properties(shown):
    *_, folder = shown
    reader = RrdReader(str(folder / "run.rrd"))
    assert len(reader.blueprints()) == 1
    properties = {c.entity_path for c in reader.stream() if "__properties" in c.entity_path}
    assert {"/__properties/learner", "/__properties/result"} <= properties


def test_the_overview_of_the_first_version_shows_its_clustering_error(tmp_path):
    names = {}
    for algorithm in ("1.0", "2.0"):
        run = tmp_path / algorithm
        run.mkdir()
        table = {"algorithm": algorithm, "roc_error": 0.25}
        write_run(run / "run.mcap", VECTOR, 3, learner=table)
        layout = run_layout(read_outline(run), WorldTab())
        (names[algorithm],) = (
            v.name for v in views_of(layout) if v.name.startswith("What it feels")
        )
    assert "clustering error's mean is below 0.25" in names["1.0"]
    assert "below δ" in names["2.0"]


def test_many_streams_show_the_most_watched(tmp_path, monkeypatch):
    monkeypatch.setattr("replay.view.build.MOST_STREAMS", 5)
    spec = SourceSpec(tuple(f"s{i}" for i in range(70)), (2,), "float64", (), 50.0, 0)
    records = write_run(tmp_path / "run.mcap", spec, 30)
    build_view(tmp_path, tmp_path / "run.rrd")
    rows = rows_of(tmp_path / "run.rrd")
    lanes = {entity for entity in rows if entity.startswith("/policy/")}
    assert len(lanes) == 5
    visits = np.bincount([s.stream for s in records], minlength=70)
    shown = [int(entity.split("s")[-1]) for entity in lanes]
    assert min(visits[shown]) >= np.sort(visits)[-5]


def test_an_empty_and_a_torn_run_have_a_view_too(tmp_path, monkeypatch):
    monkeypatch.setattr("replay.runs.writer.CHUNK_BYTES", 4096)
    write_run(tmp_path / "run.mcap", VECTOR, 0)
    build_view(tmp_path, tmp_path / "empty.rrd")
    assert "/signals/y" not in rows_of(tmp_path / "empty.rrd")
    data = (tmp_path / "run.mcap").read_bytes()
    assert len(data) > 0
    torn = tmp_path / "torn"
    torn.mkdir()
    write_run(torn / "run.mcap", VECTOR, 20)
    whole = (torn / "run.mcap").read_bytes()
    (torn / "run.mcap").unlink()
    (torn / "run.mcap.partial").write_bytes(whole[: len(whole) // 2])
    build_view(torn, torn / "run.rrd")
    assert 3 < len(rows_of(torn / "run.rrd")["/signals/xi"]["frame"]) < 20


def test_tensors_are_encoded_as_rerun_does():
    block = np.arange(24.0).reshape(2, 3, 2, 2)
    names = ("stream", "action", "next stream")
    (found,) = named_tensors(block, names)
    for row, tensor in zip(found.as_arrow_array().to_pylist(), block, strict=True):
        batch = rr.Tensor(tensor, dim_names=names).as_component_batches()[0]
        assert row == batch.as_arrow_array().to_pylist()
    bars = [
        rr.BarChart(values).as_component_batches()[0].as_arrow_array().to_pylist()
        for values in (block.reshape(-1), tensors(block.reshape(1, -1)))
    ]
    assert bars[0] == bars[1]


def test_images_are_encoded_as_rerun_does():
    pixels = np.arange(24, dtype=np.uint8).reshape(4, 6)
    (theirs,) = rr.Image.columns(buffer=pixels)
    (found,) = images(pixels)
    assert found.component_descriptor() == theirs.component_descriptor()
    assert found.as_arrow_array().equals(theirs.as_arrow_array())


def test_many_images_are_handed_over_in_pieces(monkeypatch):
    """Of a few of them at once Rerun makes a view in half the time of very many."""
    sent = []

    def keep(self, times, values):
        sent.append(([column.as_arrow_array().to_pylist() for column in times], values.copy()))

    monkeypatch.setattr("replay.view.columns.Column.send", keep)
    monkeypatch.setattr("replay.view.columns.MAX_BYTES", 3 * math.prod(IMAGE.frame_shape))
    pixels = np.random.default_rng(0).integers(0, 256, (8, *IMAGE.frame_shape), np.uint8)
    frames, iterations = np.arange(8) * 10, np.arange(8) // 2
    with rr.RecordingStream("test") as recording:
        column = image_column(recording, IMAGE, "world/watched")
        column.add(frames, iterations, pixels)
    assert [len(values) for _, values in sent] == [3, 3, 2]
    np.testing.assert_array_equal(np.concatenate([values for _, values in sent]), pixels)
    for place, expected in ((0, frames), (2, iterations)):
        assert [t for times, _ in sent for t in times[place]] == expected.tolist()


def test_private_names_of_rerun_are_taken_in_one_place():
    private = re.compile(r"\b(rerun_\w+|rerun\.experimental|rerun\._\w+|rrb?\.(\w+\.)*_\w+)\b")
    files = [file for room in ("view", "viewer") for file in (REPLAY / room).glob("*.py")]
    users = [file.name for file in files if private.search(file.read_text("utf-8"))]
    assert users == ["bindings.py"]


def test_an_existing_view_is_kept_and_nothing_half_done_is_left(tmp_path):
    write_run(tmp_path / "run.mcap", VECTOR, 2)
    out = tmp_path / "run.rrd"
    out.write_bytes(b"mine")
    with pytest.raises(UsageError, match="--force"):
        build_view(tmp_path, out, force=False)
    assert out.read_bytes() == b"mine"
    with pytest.raises(CdmisfaError, match="cannot be written"):
        build_view(tmp_path, tmp_path / "nowhere" / "run.rrd")
    with pytest.raises(UsageError, match="does not exist"):
        build_view(tmp_path / "nothing", tmp_path / "b.rrd")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.mcap", "run.rrd"]


def test_a_recording_has_a_view(tmp_path):
    folder = tmp_path / "recording"
    record_scene("oscillatory", folder, OscillatoryConfig(), frames=120)
    build_view(folder, tmp_path / "r.rrd")
    rows = rows_of(tmp_path / "r.rrd")
    for name in ("1_x1", "2_x2", "3_x3"):
        assert rows[f"/views/{name}"]["frame"] == list(range(120))
    assert len(rows["/world/truth"]["frame"]) == 120


def test_a_view_that_cannot_be_built_is_refused_with_the_reason(tmp_path):
    write_run(tmp_path / "run.mcap", VECTOR, 2)
    with pytest.raises(UsageError, match=r"there is no folder .*nowhere$"):
        build_view(tmp_path, tmp_path / "nowhere" / "v.rrd")
    with pytest.raises(UsageError, match="at least 1"):
        build_view(tmp_path, tmp_path / "v.rrd", every=0)
