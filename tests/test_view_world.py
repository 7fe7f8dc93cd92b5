"""The first tab: the robot and the objects where they were, what was learned, or the streams."""

from __future__ import annotations

import dataclasses
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from run_data import IMAGE, PROGRESS, VECTOR, save_modules_of, write_run
from view_data import View, scalars

from cdmisfa.core.blocks import SourceSpec
from cdmisfa.core.config import section_table
from cdmisfa.core.signals import STATE_WORDS
from recorder.log.scenery import scenery_of, turned
from recorder.mcap.reader import LogReader
from recorder.world.icub.config import IcubConfig
from recorder.world.icub.eyes import eye_matrix
from recorder.world.icub.head import NECK
from recorder.world.icub.source import TRUTH
from replay.palette import colour, packed
from replay.view.build import build_view
from replay.view.image_grid import grid_positions
from replay.view.modules import LAST_BLOCKS

CONFIG = section_table(IcubConfig())
SCENE = SourceSpec(("left", "center", "right"), (12, 32), "uint8", TRUTH, 50.0, IMAGE.start_ns)
LIVE = {"kind": "icub", "seed": 0, "scene": CONFIG}
ITERATIONS, TAU, EVERY = 12, 40, 20


def without_models(monkeypatch):
    """As on a machine without the robots' models; it is also quicker."""
    monkeypatch.setitem(sys.modules, "icub_models", None)


@pytest.mark.parametrize("yaw", [45.0, 0.0, -20.0])
def test_eyes_stand_where_those_of_the_simulator_stand(yaw):
    config = IcubConfig(eyes=dataclasses.replace(IcubConfig().eyes, yaw=(yaw,), views=("a",)))
    (gaze,) = scenery_of(section_table(config)).gazes
    for side, eye in zip((1, -1), gaze.eyes, strict=True):
        view = np.array(eye_matrix(config.eyes, np.array(NECK), yaw, side)).reshape(4, 4).T
        right, up, back = view[:3, :3]
        np.testing.assert_allclose(-view[:3, :3].T @ view[:3, 3], eye.place, atol=1e-12)
        for axis, there in (((1, 0, 0), right), ((0, 1, 0), -up), ((0, 0, 1), -back)):
            np.testing.assert_allclose(turned(eye.turn, axis), there, atol=1e-12)
        half = math.atan(eye.height / 2 / eye.focal)
        assert math.degrees(2 * half) == pytest.approx(config.eyes.vertical_fov)
    np.testing.assert_allclose(np.mean([e.place for e in gaze.eyes], axis=0), gaze.middle.place)


def test_objects_stand_where_the_world_knew_them_and_the_head_looks_at_what_is_watched(tmp_path):
    records = write_run(tmp_path / "run.mcap", SCENE, ITERATIONS, source=LIVE)
    build_view(tmp_path, tmp_path / "run.rrd", every=EVERY)
    rows = View(tmp_path / "run.rrd").rows
    t = np.arange(0, ITERATIONS * TAU, EVERY)
    truth = np.sin(t[:, None] / 50 + np.arange(len(TRUTH)))
    for i, name in enumerate(("box", "cylinder", "ball")):
        assert rows[f"/scene/{name}"]["frame"] == t.tolist()
        result = np.array([p for (p,) in rows[f"/scene/{name}"]["Transform3D:translation"]])
        expected = truth[:, 2 * i : 2 * i + 2] * (1, -1)
        np.testing.assert_allclose(result[:, :2], expected, atol=1e-6)
    turns = [
        r for b, r in zip([None, *records], records, strict=False) if not b or b.stream != r.stream
    ]
    scenery = scenery_of(CONFIG)
    watching, neck = rows["/scene/watching"], rows["/scene/neck"]
    assert watching["frame"] == neck["frame"] == [r.t for r in turns]
    for i, record in enumerate(turns):
        gaze = scenery.gazes[record.stream]
        np.testing.assert_allclose(
            watching["Transform3D:quaternion"][i][0], gaze.middle.turn, atol=1e-6
        )
        edges = rows["/scene/watching/edges"]
        assert set(edges["LineStrips3D:colors"][i]) == {packed(colour(record.stream))}
        angle = 2 * math.acos(min(neck["Transform3D:quaternion"][i][0][3], 1.0))
        assert math.degrees(angle) == pytest.approx(abs(gaze.yaw), abs=0.1)
    assert View(tmp_path / "run.rrd").titles().count("World") == 1


def test_what_was_learned_is_the_output_over_what_it_follows(tmp_path):
    records = write_run(tmp_path / "run.mcap", VECTOR, 30, saves=True)
    saves = [record for record in records if record.saved]
    save_modules_of(tmp_path, VECTOR, records)
    build_view(tmp_path, tmp_path / "run.rrd")
    view = View(tmp_path / "run.rrd")
    for number, save in enumerate(saves, 1):
        own = [r for r in records if r.stream == save.stream]
        before = [r for r in own if r.module == number and r.t <= save.t and np.isfinite(r.y).all()]
        expected = {r.t: r.y[:, 0] for r in before[-LAST_BLOCKS:]}
        expected |= {r.t: r.y_frozen[number - 1, :, 0] for r in own if r.t > save.t}
        y = np.concatenate(list(expected.values()))
        t = np.concatenate([start + np.arange(TAU) for start in expected])
        output = view.rows[f"/learned/{number}/output"]
        result = dict(zip(output["frame"], scalars(output)[:, 0], strict=True))
        np.testing.assert_array_equal([result[frame] for frame in t.tolist()], y)
        assert np.isfinite(list(result.values())).sum() == len(y)
        followed = scalars(view.rows[f"/learned/{number}/followed"])[:, 0]
        assert len(followed) == len(records) * TAU
        r = f"{np.corrcoef(followed[t], y)[0, 1]:.2f}"
        titles = [name for name in view.titles() if name.startswith(f"Module {number} (")]
        assert len(titles) == 1
        assert r in titles[0]


@pytest.mark.parametrize("algorithm", ["2.0", "progress"])
def test_streams_without_a_world_hang_on_a_wall(tmp_path, algorithm):
    learner = {**PROGRESS, "algorithm": algorithm}
    records = write_run(tmp_path / "run.mcap", IMAGE, 15, saves=True, learner=learner)
    build_view(tmp_path, tmp_path / "run.rrd", every=EVERY)
    rows = View(tmp_path / "run.rrd").rows
    height, width = IMAGE.frame_shape
    hang = grid_positions(3, width, height)
    for s, name in enumerate(IMAGE.streams):
        own = [r for r in records if r.stream == s]
        pictures = rows[f"/latest_frames/{s + 1}_{name}"]
        assert pictures["frame"] == [r.t + EVERY for r in own]  # the last one of each block
        for (image,) in pictures["Image:buffer"]:
            assert {40 * s + 20, 250} == set(image)
        texts = rows[f"/latest_frames/{s + 1}_{name}/state"]
        said = dict(zip(texts["frame"], (x for (x,) in texts["Points2D:labels"]), strict=True))
        state = None
        for record in records:
            state = said.get(record.t, state)
            if algorithm == "progress":
                code = record.state[s]
                word = f": {STATE_WORDS[code]}" if code >= 0 else ""
                assert state == f"{name}{word}"
        saves = [r.module for r in own if r.saved]
        if algorithm == "2.0":
            assert state == (f"{name}: module {saves[-1]}" if saves else name)
    framed, frame = rows["/latest_frames/frame"], None
    centres = dict(zip(framed["frame"], (c for (c,) in framed["Boxes2D:centers"]), strict=True))
    for record in records:
        frame = centres.get(record.t, frame)
        x, y = hang[record.stream]
        assert frame == pytest.approx([x + width / 2, y + height / 2])


def test_a_recording_shows_its_world(tmp_path, monkeypatch):
    without_models(monkeypatch)
    sample = Path(__file__).parents[1] / "sample_logs" / "icub"
    build_view(sample, tmp_path / "r.rrd", every=50)
    rows = View(tmp_path / "r.rrd").rows
    with LogReader(sample / "left.mcap") as reader:
        truth = [entry.data for entry in reader.messages(["/truth"])]
    assert rows["/scene/ball"]["frame"] == list(range(0, len(truth), 50))
    known = scalars(rows["/world/truth"])[::50]
    (x, y), places = (
        (TRUTH.index(f"object3_{axis}") for axis in "xy"),
        np.array([p for (p,) in rows["/scene/ball"]["Transform3D:translation"]]),
    )
    np.testing.assert_allclose(places[:, :2], known[:, [x, y]] * (1, -1), atol=1e-6)
    assert {"World", "Views"} <= set(View(tmp_path / "r.rrd").titles())
    assert not [entity for entity in View(tmp_path / "r.rrd").names if "watching" in entity]
    said = [text for (text,) in rows["/events"]["TextLog:text"]]
    assert any("icub-models" in text for text in said)


def test_the_body_of_the_robot_is_shown(tmp_path):
    write_run(tmp_path / "run.mcap", SCENE, 3, source=LIVE)
    build_view(tmp_path, tmp_path / "run.rrd")
    entities = View(tmp_path / "run.rrd").names
    assert {r"\/" in e for e in entities} == {False}  # no name has an escaped slash
    parts = {e.split("/")[2] for e in entities if e.startswith("/scene/")}
    assert {"body", "joints", "neck", "stands", "box"} <= parts
