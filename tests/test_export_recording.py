"""A recording as images, videos and a LeRobot dataset, read back by others' programs."""

from __future__ import annotations

import json
import re
import shlex
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from folders import contents
from PIL import Image

from cdmisfa.core.blocks import Block, SourceSpec, freeze
from cdmisfa.core.errors import CdmisfaError, UsageError
from recorder.config import RecordConfig
from recorder.log.manifest import RecordingSpec
from recorder.log.viewlog import ViewLog
from replay.export import frames
from replay.export.forms import export
from replay.inputs import open_recording

ROOT = Path(__file__).parents[1]
FRAMES = 53
FIRST = 7
TRUTH = ("ball_x", "ball_y")


def record_images(folder, shape=(24, 40), views=("left", "right"), fps=50.0, *, inverted=False):
    """A recording of white noise: its pixels (views, frames, height, width), its truth."""
    folder.mkdir()
    spec = SourceSpec(views, shape, "uint8", TRUTH, fps, 10**18, None)
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 256, (len(views), FRAMES, *shape), dtype=np.uint8)
    pixels = 255 - pixels if inverted else pixels
    truth = rng.standard_normal((FRAMES, 2))
    for stream, view in enumerate(views):
        log = ViewLog(folder, view, RecordingSpec("test", 3, spec, {}), RecordConfig())
        log.write(Block(stream, 0, freeze(pixels[stream].copy()), freeze(truth.copy())))
        log.finish()
    return pixels, truth


@pytest.fixture(autouse=True)
def _small_pieces(monkeypatch):
    monkeypatch.setattr(frames, "PIECE", 20)


def decoded(file):
    """Frames of a video (n, height, width), when each is shown, and the stream's facts."""
    av = pytest.importorskip("av", reason="PyAV is not installed: pip install 'cdmisfa[video]'")
    with av.open(str(file)) as container:
        pictures = list(container.decode(video=0))
        stream = container.streams.video[0]
        facts = (stream.codec.canonical_name, stream.average_rate, container.metadata)
        values = np.array([p.to_ndarray(format="gray") for p in pictures])
        return values, [p.time for p in pictures], facts


def test_a_recording_becomes_images(tmp_path):
    pixels, _ = record_images(tmp_path / "r")
    assert export(tmp_path / "r", tmp_path / "images", "images") == 2 * FRAMES
    for stream, view in enumerate(("left", "right")):
        files = sorted((tmp_path / "images" / view).iterdir())
        assert [f.name for f in files] == [f"{t:08d}.png" for t in range(FRAMES)]
        for t in (0, FIRST, FRAMES - 1):
            with Image.open(files[t]) as image:
                np.testing.assert_array_equal(np.asarray(image), pixels[stream, t])


@pytest.mark.parametrize("shape", [(24, 40), (25, 41)], ids=["even", "odd"])
def test_a_lossless_video_holds_every_pixel(shape, tmp_path):
    pixels, _ = record_images(tmp_path / "r", shape, fps=30000 / 1001)
    assert export(tmp_path / "r", tmp_path / "films", "mp4", lossless=True) == 2 * FRAMES
    assert sorted(p.name for p in (tmp_path / "films").iterdir()) == ["left.mp4", "right.mp4"]
    for stream, view in enumerate(("left", "right")):
        found, times, (codec, rate, about) = decoded(tmp_path / "films" / f"{view}.mp4")
        np.testing.assert_array_equal(found, pixels[stream])
        assert (codec, str(rate)) == ("h264", "30000/1001")
        np.testing.assert_allclose(times, np.arange(FRAMES) * 1001 / 30000, atol=1e-9)
        comment = json.loads(about["comment"])
        assert (comment["view"], comment["first_frame"]) == (view, 0)
        assert comment["first_time_ns"] == 10**18


def test_a_video_is_near_what_was_seen_and_smaller(tmp_path):
    record_images(tmp_path / "r", views=("left",))
    export(tmp_path / "r", tmp_path / "near.mp4", "mp4")
    export(tmp_path / "r", tmp_path / "same.mp4", "mp4", lossless=True)
    near, _, _ = decoded(tmp_path / "near.mp4")
    same, _, _ = decoded(tmp_path / "same.mp4")
    assert (tmp_path / "near.mp4").stat().st_size < (tmp_path / "same.mp4").stat().st_size
    assert 0 < np.abs(near.astype(int) - same).mean() < 8  # of white noise, the worst case
    # Which frame it is can still be told: none is missing, doubled or moved.
    far = np.abs(near[:, None].astype(int) - same[None]).mean(axis=(2, 3))
    np.testing.assert_array_equal(far.argmin(axis=1), np.arange(FRAMES))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """A LeRobot dataset, the pixels and the truth that are in it."""
    pytest.importorskip("av", reason="PyAV is not installed: pip install 'cdmisfa[video]'")
    folder = tmp_path_factory.mktemp("lerobot")
    pixels, truth = record_images(folder / "r")
    assert export(folder / "r", folder / "robot", "lerobot", lossless=True) == FRAMES
    return folder / "robot", pixels, truth


def test_a_dataset_has_the_published_layout(dataset):
    folder, pixels, truth = dataset
    files = {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}
    videos = {f"videos/observation.images.{v}/chunk-000/file-000.mp4" for v in ("left", "right")}
    assert files == videos | {
        "data/chunk-000/file-000.parquet",
        "meta/episodes/chunk-000/file-000.parquet",
        "meta/info.json",
        "meta/stats.json",
        "meta/tasks.parquet",
    }
    info = json.loads((folder / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    assert (info["fps"], info["total_frames"], info["total_episodes"]) == (50, FRAMES, 1)
    data = pq.read_table(folder / info["data_path"].format(chunk_index=0, file_index=0))
    numbers = {k for k, f in info["features"].items() if f["dtype"] != "video"}
    assert set(data.column_names) == numbers
    for key in numbers:
        feature, values = info["features"][key], data[key].combine_chunks()
        width = feature["shape"][0]
        kind = values.type if width == 1 else values.type.value_type
        assert str(kind) == {"float32": "float"}.get(feature["dtype"], feature["dtype"])
    known = np.array(data["observation.environment_state"].to_pylist(), dtype=np.float32)
    np.testing.assert_array_equal(known, truth.astype(np.float32))
    assert info["features"]["observation.environment_state"]["names"] == list(TRUTH)
    for stream, view in enumerate(("left", "right")):
        key = f"observation.images.{view}"
        assert info["features"][key]["shape"] == [24, 40, 3]
        file = info["video_path"].format(video_key=key, chunk_index=0, file_index=0)
        found, times, _ = decoded(folder / file)
        np.testing.assert_array_equal(found, pixels[stream])
        # LeRobot refuses a frame that is further than 0.1 ms from its row's time.
        np.testing.assert_allclose(times, data["timestamp"].to_numpy(), atol=1e-4)


def test_a_dataset_s_statistics_are_those_of_its_numbers(dataset):
    folder, pixels, truth = dataset
    stats = json.loads((folder / "meta/stats.json").read_text())
    known = truth.astype(np.float32).astype(np.float64)
    found = stats["observation.environment_state"]
    np.testing.assert_allclose(found["mean"], known.mean(axis=0))
    np.testing.assert_allclose(found["std"], known.std(axis=0))
    np.testing.assert_allclose(found["q90"], np.quantile(known, 0.9, axis=0))
    image = stats["observation.images.right"]
    expected = pixels[1] / 255
    for name, value in (
        ("mean", expected.mean()),
        ("std", expected.std()),
        ("min", expected.min()),
        ("max", expected.max()),
        ("q50", np.quantile(expected, 0.5, method="inverted_cdf")),
    ):
        np.testing.assert_allclose(image[name], np.full((3, 1, 1), value))
    assert image["count"] == [FRAMES]
    (episode,) = pq.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert (episode["length"], episode["dataset_to_index"]) == (FRAMES, FRAMES)
    assert episode["videos/observation.images.left/to_timestamp"] == FRAMES / 50
    assert episode["stats/observation.images.right/mean"] == image["mean"]


def test_rerun_opens_the_dataset(dataset):
    from rerun.experimental import LeRobotReader

    folder, _, truth = dataset
    reader = LeRobotReader(str(folder))
    assert reader.episodes() == [0]
    samples, known, tasks = {"left": 0, "right": 0}, {}, set()
    for chunk in reader.stream(0):
        batch = chunk.to_record_batch()
        names, view = batch.schema.names, chunk.entity_path.rpartition(".")[2]
        if "VideoStream:sample" in names:
            samples[view] += chunk.num_rows
        if "TextDocument:text" in names:
            tasks |= {text for row in batch["TextDocument:text"].to_pylist() for text in row}
        if chunk.entity_path == "/observation.environment_state" and not chunk.is_static:
            rows = batch["Scalars:scalars"].to_pylist()
            known |= dict(zip(batch["frame_index"].to_pylist(), rows, strict=True))
    assert samples == {"left": FRAMES, "right": FRAMES}
    assert tasks == {"what test shows"}
    np.testing.assert_array_equal([known[t] for t in range(FRAMES)], truth.astype(np.float32))


def test_several_recordings_become_episodes_of_a_dataset(cdmisfa, tmp_path):
    pytest.importorskip("av", reason="PyAV is not installed: pip install 'cdmisfa[video]'")
    paths = [tmp_path / "one", tmp_path / "two"]
    pixels = [record_images(path, inverted=path.name == "two")[0] for path in paths]
    out = tmp_path / "robot"
    words = (*paths, "--to", "lerobot", "--lossless", "-o", out, "--json")
    assert cdmisfa("export", *words).json["rows"] == 2 * FRAMES
    data = pq.read_table(out / "data/chunk-000/file-000.parquet").to_pydict()
    assert data["index"] == list(range(2 * FRAMES))
    assert data["episode_index"] == [0] * FRAMES + [1] * FRAMES
    assert data["frame_index"] == [*range(FRAMES), *range(FRAMES)]
    episodes = pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    stats = json.loads((out / "meta/stats.json").read_text())
    for stream, view in enumerate(("left", "right")):
        key = f"observation.images.{view}"
        for episode, shown in zip(episodes, pixels, strict=True):
            chunk, file = (episode[f"videos/{key}/{what}_index"] for what in ("chunk", "file"))
            found, _, _ = decoded(out / f"videos/{key}/chunk-{chunk:03d}/file-{file:03d}.mp4")
            np.testing.assert_array_equal(found, shown[stream])
        every = np.concatenate([shown[stream] for shown in pixels]) / 255
        np.testing.assert_allclose(stats[key]["mean"], np.full((3, 1, 1), every.mean()))
        np.testing.assert_allclose(stats[key]["std"], np.full((3, 1, 1), every.std()))
    before = contents(out)
    assert export(paths, out, "lerobot", force=True, lossless=True) == 2 * FRAMES
    assert contents(out) == before
    record_images(tmp_path / "three", (24, 42))
    with pytest.raises(UsageError, match="three has the frame_shape"):
        export([paths[0], tmp_path / "three"], tmp_path / "wrong", "lerobot")
    assert not (tmp_path / "wrong").exists()


def test_tasks_become_states_actions_and_episodes(cdmisfa, tmp_path):
    pytest.importorskip("gymnasium", reason="pip install 'cdmisfa[gym]'")
    pytest.importorskip("av", reason="PyAV is not installed: pip install 'cdmisfa[video]'")
    words = ("record", "gym:CartPole-v1", "--frames", 80, "--size", "40x30")
    assert cdmisfa(*words, "-o", tmp_path / "r").code == 0
    assert export(tmp_path / "r", tmp_path / "robot", "lerobot") == 80
    with open_recording(tmp_path / "r") as source:
        truth = source.take(0, 80).truth.astype(np.float32)
    data = pq.read_table(tmp_path / "robot/data/chunk-000/file-000.parquet")
    np.testing.assert_array_equal(data["observation.state"].to_pylist(), truth[:, :4])
    np.testing.assert_array_equal(data["action"], truth[:, 4])
    begins = data["frame_index"].to_numpy() == 0
    np.testing.assert_array_equal(begins, truth[:, 5] == 1)
    assert begins.sum() > 1
    (task,) = pq.read_table(tmp_path / "robot/meta/tasks.parquet").to_pylist()
    assert task == {"task_index": 0, "__index_level_0__": "CartPole-v1"}


def test_an_export_that_fails_leaves_nothing(tmp_path, monkeypatch):
    record_images(tmp_path / "r")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(frames, "_video_frames", full)
    for log, out, form in (
        ("r", "out", "mp4"),
        ("r", "out", "lerobot"),
        ("r/left.mcap", "out.mp4", "mp4"),
    ):
        with pytest.raises(CdmisfaError, match="No space left on device"):
            export(tmp_path / log, tmp_path / out, form)
    assert [p.name for p in tmp_path.iterdir()] == ["r"]


REFUSED = {
    "has 2 streams: name a folder": ("mp4", "one.mp4", {}),
    "convert --rate": ("lerobot", "out", {}),
    r"there\.mp4 exists": ("mp4", "there.mp4", {}),
    "did you mean npz": ("npy", "out", {}),
    r"mine holds other files, such as thesis\.tex": ("lerobot", "mine", {"force": True}),
    r"pip install 'cdmisfa\[video\]'": ("mp4", "out", {}),
}


@pytest.mark.parametrize("why", REFUSED)
def test_an_error_names_the_reason_and_leaves_every_file(why, tmp_path, monkeypatch):
    form, out, options = REFUSED[why]
    record_images(tmp_path / "r", fps=29.97)
    (tmp_path / "there.mp4").write_text("mine")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("mine")
    if "pip" in why:
        monkeypatch.setitem(sys.modules, "av", None)
    before = contents(tmp_path)
    with pytest.raises(UsageError, match=why):
        export(tmp_path / "r", tmp_path / out, form, **options)
    assert contents(tmp_path) == before


def test_every_command_of_the_page_on_datasets_works(cdmisfa, tmp_path, monkeypatch):
    pytest.importorskip("gymnasium", reason="pip install 'cdmisfa[gym]'")
    pytest.importorskip("av", reason="PyAV is not installed: pip install 'cdmisfa[video]'")
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "how-to" / "export.md").read_text("utf-8")
    _, _, section = page.partition("## A LeRobot dataset\n")
    (block,) = re.findall(r"^```sh\n(.*?)^```$", section, re.MULTILINE | re.DOTALL)
    for line in block.splitlines():
        program, *words = shlex.split(line)
        done = cdmisfa(*words)
        assert (program, done.code) == ("cdmisfa", 0), f"{line}: {done.err}"
