"""Sources whose streams have frames of several kinds: cameras together with numbers."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from camera_files import RAW, raw
from conftest import Cdmisfa
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import Writer
from message_files import START

from cdmisfa import Recording, learn
from cdmisfa.agents.learners import open_learner
from cdmisfa.agents.progress.config import ProgressConfig
from cdmisfa.core.blocks import Block, SourceSpec
from cdmisfa.core.errors import UsageError
from cdmisfa.core.learning import Keyframe
from cdmisfa.watching import WatchEnv
from recorder.images.messages import MessageKind
from replay.runs.keyframes import decode_keyframe, encode_keyframe
from replay.runs.log import read_header
from replay.runs.run import StoredRun

FRAMES = 8000


def images(count: int = FRAMES, height: int = 12, width: int = 16) -> Any:
    """Return noisy images whose right side brightens slowly."""
    rng, t = np.random.default_rng(0), np.arange(count)
    bright = 60 * np.sin(t / 40)[:, None, None] * np.linspace(0, 1, width)
    return np.clip(rng.normal(100, 10, (count, height, width)) + bright, 0, 255).astype(np.uint8)


def joints(count: int = FRAMES) -> Any:
    """Return a slow sine, noise and a fast sine."""
    rng, t = np.random.default_rng(1), np.arange(count)
    slow = np.sin(t / 60) + rng.normal(0, 0.01, count)
    return np.stack([slow, rng.normal(size=count), np.sin(t / 3)], axis=1)


def arrays(count: int = FRAMES) -> dict[str, Any]:
    """Return a camera and numbers as arrays by stream."""
    return {"camera": images(count), "joints": joints(count)}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Return a run that learned a module of each kind, from a file."""
    folder = tmp_path_factory.mktemp("mixed")
    np.savez(folder / "log.npz", **arrays())
    return learn(folder / "log.npz", folder / "run", view=False)


def test_a_camera_and_numbers_are_learned_with_their_own_inputs(run: Any) -> None:
    spec = run.header.spec
    assert (spec.frame_shape, spec.dtype) == ((), "mixed")
    assert [spec.kind(s) for s in (0, 1)] == [((12, 16), "uint8"), ((3,), "float64")]
    by_stream = {module.stream: module for module in run.modules}
    assert by_stream["camera"].frame_shape == (12, 16)
    assert by_stream["camera"].expansion == "none"
    assert by_stream["joints"].frame_shape == (3,)
    assert by_stream["joints"].expansion == "quadratic"  # 9 inputs
    y = by_stream["joints"].transform(joints()[:6000])[:, 0]
    assert abs(np.corrcoef(y, np.sin(np.arange(6000) / 60))[0, 1]) > 0.99


def test_a_module_has_no_output_on_streams_of_another_kind(run: Any) -> None:
    streams, y = run.signals["stream"], run.signals["y_frozen"]
    for module in run.modules[: y.shape[1]]:
        own = np.isfinite(y[:, module.index - 1]).all(axis=(1, 2))
        later = run.signals["iteration"] > module.iteration
        np.testing.assert_array_equal(own, later & (streams == module.stream_index))


def test_runs_are_checked_resumed_viewed_and_reported(
    cdmisfa: Cdmisfa, run: Any, tmp_path: Path
) -> None:
    assert cdmisfa("check", run.path).code == 0
    log = run.path.parent / "log.npz"
    part = "learn", log, "-o", tmp_path / "part"
    cdmisfa(*part, "--max-iterations", 130)
    cdmisfa(*part, "--resume")
    ended = (StoredRun(place).result for place in (tmp_path / "part", run.path))
    assert len({result["signals_sha256"] for result in ended if result}) == 1
    page = (run.report(tmp_path / "page.html")).read_text()
    assert "camera" in page
    assert "joints" in page
    with pytest.raises(ValueError, match="frames of several shapes"):
        run.frames()
    run.view(tmp_path / "run.rrd")
    assert (tmp_path / "run.rrd").stat().st_size > 100_000


def test_a_keyframe_holds_modules_of_several_shapes(run: Any) -> None:
    learner = run.at(len(run.signals["iteration"]))
    keyframe = Keyframe(learner.iteration, 0, learner.state, {})
    again = decode_keyframe(encode_keyframe(keyframe)).state
    for module, restored in zip(learner.modules, again.modules, strict=True):
        np.testing.assert_array_equal(module.phi, restored.phi)
    assert {m.phi.shape for m in again.modules} == {(16, 9), (16, 192)}


@settings(max_examples=20, deadline=None)
@given(data=st.data(), other=st.sampled_from([(3,), (1,), (6, 5)]))
def test_a_stream_learns_the_same_whatever_the_kind_of_the_other(
    data: st.DataObject, other: tuple[int, ...]
) -> None:
    count, tau = 12, 40
    order = data.draw(st.lists(st.integers(0, 1), min_size=count, max_size=count))
    pixels, t = images(count * tau, 6, 5), 0
    kinds = [((6, 5), "uint8"), (other, "uint8" if len(other) == 2 else "float64")]
    config, rng = ProgressConfig(), np.random.default_rng(2)
    mixed = open_learner(config, SourceSpec.of_kinds(("a", "b"), kinds), 0)
    alone = open_learner(config, SourceSpec(("a", "b"), *kinds[0]), 0)
    for stream in order:
        for learner in (mixed, alone):
            learner.watch(stream)  # type: ignore[attr-defined]
        frames = pixels[t : t + tau]
        noise = rng.integers(0, 255, (tau, *kinds[1][0])).astype(kinds[1][1])
        one = mixed.step(Block(stream, t, noise if stream else frames, np.empty((tau, 0))))
        two = alone.step(
            Block(stream, t, frames[:, ::-1] if stream else frames, np.empty((tau, 0)))
        )
        t += tau
        if stream == 0:
            for name in ("y", "eta", "change", "tested", "fitted", "typical", "learning_error"):
                np.testing.assert_array_equal(getattr(one, name), getattr(two, name))


def test_the_papers_learners_refuse_streams_of_several_kinds() -> None:
    for algorithm in ("2.0", "1.0"):
        with pytest.raises(UsageError, match=f"learner {algorithm} takes one kind: add --algor"):
            learn(arrays(200), algorithm=algorithm, view=False)


def test_modules_of_both_are_applied_to_logs_of_one_and_to_datasets(
    cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    log, dataset = log_of_both(tmp_path / "log.mcap", 400), tmp_path / "data"
    chosen = log, "--topic", "/camera", "--topic", "/joints", "--align", "time"
    assert cdmisfa("convert", *chosen, "-o", tmp_path / "rec").code == 0
    assert cdmisfa("export", tmp_path / "rec", "--to", "lerobot", "-o", dataset).code == 0
    topics = "--topic", "observation.images.camera", "--topic", "observation.joints"
    learned = cdmisfa("learn", dataset, *topics, "-o", tmp_path / "run", "--no-rerun", "--json")
    assert {module["stream"] for module in learned.json["modules"]} >= {"observation.joints"}
    assert cdmisfa("apply", tmp_path / "run", dataset).code == 0
    np.savez(tmp_path / "numbers.npz", joints=joints(400))
    assert cdmisfa("apply", tmp_path / "run", tmp_path / "numbers.npz").code == 0


def test_an_environment_observes_only_the_outputs_of_such_a_source() -> None:
    with pytest.raises(UsageError, match="the streams differ in shape: set observe="):
        WatchEnv(Recording(arrays(200)).source())
    with contextlib.closing(WatchEnv(Recording(arrays(200)).source(), observe="outputs")) as env:
        env.reset(seed=0)
        for stream in (0, 1):
            assert env.observation_space.contains(env.step(stream)[0])


def test_the_json_of_sources_of_one_kind_has_no_kinds(tmp_path: Path) -> None:
    done = learn(joints(200), tmp_path / "run", max_iterations=2, view=False)
    assert "kinds" not in read_header(done.log).spec.as_json()
    both = Recording(arrays(50)).source().spec
    assert both.as_json()["kinds"] == (((12, 16), "uint8"), ((3,), "float64"))


def log_of_both(path: Path, seconds: int = 12) -> Path:
    """Write images at 20 Hz and joint states in JSON at 50 Hz to one log."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("")
        for topic, kind, rate, rows in (
            ("/camera", RAW, 20, map(raw, images(20 * seconds))),
            ("/joints", JOINTS, 50, map(state, joints(50 * seconds))),
        ):
            schema = writer.register_schema(kind.schema, kind.language, kind.definition)
            channel = writer.register_channel(topic, kind.encoding, schema)
            for i, data in enumerate(rows):
                writer.add_message(channel, START + i * 10**9 // rate, data, 0)
        writer.finish()
    return path


JOINTS = MessageKind("joints", "json", b"{}", "jsonschema")


def state(row: Any) -> bytes:
    """Return a message with a time, a name and numbers."""
    stamp = {"sec": 1, "nanosec": 2}
    message = {"header": {"stamp": stamp}, "name": "a", "at": {"x": row[0]}, "all": list(row[1:])}
    return json.dumps(message).encode()


def test_a_chosen_topic_without_images_is_read_as_numbers(tmp_path: Path) -> None:
    log, topics = log_of_both(tmp_path / "log.mcap"), ("/camera", "/joints")
    with Recording(log, topics=topics, align="time", rate=50).source() as source:
        assert source.spec.kinds == (((12, 16), "uint8"), ((3,), "float64"))
        assert [stream.fields for stream in source.streams] == [(), ("at.x", "all")]
        assert source.warnings == (f"{log}: /joints is read as its numbers at.x, all",)
        both = [block.frames for block in source.take_all(500)]
    np.testing.assert_array_equal(both[1], joints(600)[:500])
    np.testing.assert_array_equal(both[0], images(240)[np.arange(500) * 2 // 5])
    with Recording(log, topics=topics, fields=("all[0]",), align="time").source() as source:
        np.testing.assert_array_equal(source.take(1, 1).frames, joints(600)[:1, 1:2])
        assert source.spec.kinds[0] == ((12, 16), "uint8")
    with Recording(log, topics=("/cam*",)).source() as source:
        assert source.spec.images


def test_other_commands_take_a_log_of_both(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    log, rec = log_of_both(tmp_path / "log.mcap", 40), tmp_path / "rec"
    chosen = log, "--topic", "/camera", "--topic", "/joints", "--align", "time"
    few = "--max-iterations", 30, "--no-rerun"
    assert cdmisfa("learn", log, "--topic", "/camera", "--field", "all").code == 2
    assert cdmisfa("learn", *chosen, *few, "-o", tmp_path / "direct").code == 0
    assert cdmisfa("convert", *chosen, "-o", rec).code == 0
    assert cdmisfa("learn", rec, *few, "-o", tmp_path / "recorded").code == 0
    assert cdmisfa("compare", tmp_path / "direct", tmp_path / "recorded").code == 0
    assert cdmisfa("verify", rec).code == 0
    assert cdmisfa("export", rec, "--to", "mp4", "-o", tmp_path / "mp4").code == 2
    assert cdmisfa("export", rec, "--to", "lerobot", "--lossless", "-o", tmp_path / "lr").code == 0
    topics = "observation.images.camera", "observation.joints"
    kinds = Recording(tmp_path / "lr", topics=topics).spec.kinds
    assert sorted(kinds) == [((3,), "float64"), ((12, 16), "uint8")]


def test_a_module_is_applied_to_the_streams_with_its_frames(
    cdmisfa: Cdmisfa, run: Any, tmp_path: Path
) -> None:
    log = run.path.parent / "log.npz"
    assert cdmisfa("apply", run.path, log, "-o", tmp_path / "out.parquet").code == 0
    assert cdmisfa("apply", run.path, log, "-o", tmp_path / "out.mcap").code == 0
    table = pq.read_table(tmp_path / "out.parquet").to_pandas()
    for module in run.modules:
        outputs = table[f"module{module.index}_y0"].to_numpy()
        of_module = (table["stream"] == module.stream).to_numpy()
        expected = module.transform(arrays()[module.stream])[:, 0]
        np.testing.assert_array_equal(outputs[of_module], expected)
        assert np.isnan(outputs[~of_module]).all()
    (applied,) = cdmisfa("apply", run.path, log, "--json").json["logs"]
    pairs = {(row["stream"], row["module"]) for row in applied["modules"]}
    assert pairs == {(module.stream, module.index) for module in run.modules}


def test_export_names_the_topics_of_a_recording_that_fit_a_form(
    cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    np.savez(tmp_path / "both.npz", cam=images(9), arm=joints(9))
    cdmisfa("convert", tmp_path / "both.npz", "-o", tmp_path / "both")
    for form, topic in (("images", "/view/cam"), ("parquet", "/view/arm")):
        command = ("export", tmp_path / "both", "-o", tmp_path / form, "--to", form)
        assert f"with --topic {topic}" in cdmisfa(*command).err
        assert cdmisfa(*command, "--topic", topic).code == 0
