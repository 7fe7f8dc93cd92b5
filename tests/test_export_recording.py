"""A recording as images, videos and a LeRobot dataset, read back by other programs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from camera_files import RAW, raw
from folders import contents
from mcap.writer import Writer
from PIL import Image

from cdmisfa.core.blocks import Block, SourceSpec, freeze
from cdmisfa.core.errors import UsageError
from recorder.config import RecordConfig
from recorder.images.messages import MessageKind
from recorder.log.manifest import RecordingSpec
from recorder.log.viewlog import ViewLog
from replay.export import frames
from replay.export.formats import export
from replay.open_sources import open_recording

ROOT = Path(__file__).parents[1]
FRAMES = 53
TRUTH = ("ball_x", "ball_y")
VIEWS = ("left", "right")
JOINTS, GRIP = MessageKind("JointState", "json"), MessageKind("Grip", "json")
NOTE = MessageKind("Note", "json")


def record_images(folder, shape=(24, 40), views=VIEWS, fps=50.0, seed=0):
    """A recording of white noise: its pixels (views, frames, height, width), its truth."""
    folder.mkdir()
    spec = SourceSpec(views, shape, "uint8", TRUTH, fps, 10**18, None)
    rng = np.random.default_rng(seed)
    pixels = rng.integers(0, 256 >> seed, (len(views), FRAMES, *shape), dtype=np.uint8)
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
    import av

    with av.open(str(file)) as container:
        images = list(container.decode(video=0))
        stream = container.streams.video[0]
        facts = (stream.codec.canonical_name, stream.average_rate, container.metadata)
        values = np.array([image.to_ndarray(format="gray") for image in images])
        return values, [image.time for image in images], facts


def test_a_recording_becomes_images(tmp_path):
    pixels, _ = record_images(tmp_path / "r")
    assert export(tmp_path / "r", tmp_path / "images", "images") == 2 * FRAMES
    for stream, view in enumerate(VIEWS):
        files = sorted((tmp_path / "images" / view).iterdir())
        assert [f.name for f in files] == [f"{t:08d}.png" for t in range(FRAMES)]
        for file, expected in zip(files, pixels[stream], strict=True):
            with Image.open(file) as image:
                np.testing.assert_array_equal(np.asarray(image), expected)


@pytest.mark.parametrize("shape", [(24, 40), (25, 41)], ids=["even", "odd"])
def test_a_lossless_video_holds_every_pixel(shape, tmp_path):
    pixels, _ = record_images(tmp_path / "r", shape, fps=30000 / 1001)
    assert export(tmp_path / "r", tmp_path / "films", "mp4", lossless=True) == 2 * FRAMES
    assert sorted(p.name for p in (tmp_path / "films").iterdir()) == ["left.mp4", "right.mp4"]
    for stream, view in enumerate(VIEWS):
        values, times, (codec, rate, metadata) = decoded(tmp_path / "films" / f"{view}.mp4")
        np.testing.assert_array_equal(values, pixels[stream])
        assert (codec, str(rate)) == ("h264", "30000/1001")
        np.testing.assert_allclose(times, np.arange(FRAMES) * 1001 / 30000, atol=1e-9)
        comment = json.loads(metadata["comment"])
        assert (comment["view"], comment["first_frame"]) == (view, 0)
        assert comment["first_time_ns"] == 10**18


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """A LeRobot dataset of two recordings, the pixels and the truth of each."""
    folder = tmp_path_factory.mktemp("lerobot")
    paths = [folder / "one", folder / "two"]
    pixels, truth = zip(*(record_images(p, seed=i) for i, p in enumerate(paths)), strict=True)
    assert export(paths, folder / "robot", "lerobot", lossless=True) == 2 * FRAMES
    return folder / "robot", pixels, truth


def test_a_dataset_has_the_published_layout(dataset):
    folder, pixels, truth = dataset
    files = {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}
    keys = [f"observation.images.{view}" for view in VIEWS]
    assert files == {f"videos/{key}/chunk-000/file-00{i}.mp4" for key in keys for i in (0, 1)} | {
        "data/chunk-000/file-000.parquet",
        "meta/episodes/chunk-000/file-000.parquet",
        "meta/info.json",
        "meta/stats.json",
        "meta/tasks.parquet",
    }
    info = json.loads((folder / "meta/info.json").read_text())
    features = info["features"]
    assert info["codebase_version"] == "v3.0"
    assert (info["fps"], info["total_frames"], info["total_episodes"]) == (50, 2 * FRAMES, 2)
    data = pq.read_table(folder / info["data_path"].format(chunk_index=0, file_index=0))
    assert set(data.column_names) == {k for k, f in features.items() if f["dtype"] != "video"}
    for key in data.column_names:
        kind = data[key].type
        kind = kind if features[key]["shape"] == [1] else kind.value_type
        dtype = features[key]["dtype"]
        assert str(kind) == {"float32": "float"}.get(dtype, dtype)
    columns = data.to_pydict()
    assert columns["index"] == list(range(2 * FRAMES))
    assert columns["episode_index"] == [0] * FRAMES + [1] * FRAMES
    assert columns["frame_index"] == [*range(FRAMES), *range(FRAMES)]
    world = np.array(columns["observation.environment_state"], dtype=np.float32)
    np.testing.assert_array_equal(world, np.concatenate(truth).astype(np.float32))
    assert features["observation.environment_state"]["names"] == list(TRUTH)
    episodes = pq.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    for stream, key in enumerate(keys):
        assert features[key]["shape"] == [24, 40, 3]
        for episode, expected in zip(episodes, pixels, strict=True):
            place = {n: episode[f"videos/{key}/{n}"] for n in ("chunk_index", "file_index")}
            values, times, _ = decoded(folder / info["video_path"].format(video_key=key, **place))
            np.testing.assert_array_equal(values, expected[stream])
            # LeRobot refuses a frame that is further than 0.1 ms from its row's time.
            np.testing.assert_allclose(times, columns["timestamp"][:FRAMES], atol=1e-4)
            assert episode[f"videos/{key}/to_timestamp"] == FRAMES / 50


def test_a_dataset_s_statistics_are_those_of_its_numbers(dataset):
    folder, pixels, truth = dataset
    stats = json.loads((folder / "meta/stats.json").read_text())
    episodes = pq.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    numbers = [part.astype(np.float32).astype(np.float64) for part in truth]
    images = [part[1].reshape(-1, 1) / 255 for part in pixels]
    for key, parts, method in (
        ("observation.environment_state", numbers, "linear"),
        ("observation.images.right", images, "inverted_cdf"),
    ):
        shape = (2,) if parts is numbers else (3, 1, 1)
        stored = [{n: row[f"stats/{key}/{n}"] for n in stats[key]} for row in episodes]
        for values, of in zip([*stored, stats[key]], ([parts[0]], [parts[1]], parts), strict=True):
            whole = np.concatenate(of)
            expected = {n: getattr(whole, n)(axis=0) for n in ("min", "max", "mean", "std")}
            # LeRobot takes the mean of the episodes' quantiles for the whole dataset.
            quantiles = [np.quantile(part, 0.9, axis=0, method=method) for part in of]
            for name, value in (expected | {"q90": np.mean(quantiles, axis=0)}).items():
                np.testing.assert_allclose(values[name], np.broadcast_to(value, shape))
            assert values["count"] == [FRAMES * len(of)]


def test_rerun_opens_the_dataset(dataset):
    from rerun.experimental import LeRobotReader

    folder, _, truth = dataset
    reader = LeRobotReader(str(folder))
    assert reader.episodes() == [0, 1]
    samples, known, tasks = dict.fromkeys(VIEWS, 0), {}, set()
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
    assert samples == dict.fromkeys(VIEWS, FRAMES)
    assert tasks == {"what test shows"}
    np.testing.assert_array_equal([known[t] for t in range(FRAMES)], truth[0].astype(np.float32))


CARTPOLE = """\
record gym:CartPole-v1 --frames 100 -o recordings/one
record gym:CartPole-v1 --frames 100 --seed 1 -o recordings/two
export recordings/one recordings/two --to lerobot --lossless -o cartpole
learn cartpole --field observation.state --field action --set learner.tau=8
"""


def test_a_dataset_of_a_task_has_states_actions_and_episodes(cdmisfa, tmp_path, monkeypatch):
    pytest.importorskip("gymnasium", reason="pip install 'cdmisfa[gym]'")
    monkeypatch.chdir(tmp_path)
    for line in CARTPOLE.splitlines():
        done = cdmisfa(*line.split())
        assert done.code == 0, f"{line}: {done.err}"
    truth = []
    for name in ("one", "two"):
        with open_recording(tmp_path / "recordings" / name) as source:
            truth.append(source.take(0, 100).truth.astype(np.float32))
    expected = np.concatenate(truth)
    data = pq.read_table(tmp_path / "cartpole/data/chunk-000/file-000.parquet")
    np.testing.assert_array_equal(data["observation.state"].to_pylist(), expected[:, :4])
    np.testing.assert_array_equal(data["action"], expected[:, 4])
    begins = data["frame_index"].to_numpy() == 0
    np.testing.assert_array_equal(begins, expected[:, 5] == 1)
    assert begins.sum() > 2
    (task,) = pq.read_table(tmp_path / "cartpole/meta/tasks.parquet").to_pylist()
    assert task == {"task_index": 0, "__index_level_0__": "CartPole-v1"}


REFUSED = {
    "has 2 streams: choose a folder": ("r", "mp4", "one.mp4", {}),
    "resample with --rate 30": ("r", "lerobot", "out", {}),
    r"there\.mp4 exists": ("r", "mp4", "there.mp4", {}),
    "did you mean npz": ("r", "npy", "out", {}),
    r"mine has files that no export wrote, as thesis\.tex": (
        "r",
        "lerobot",
        "mine",
        {"force": True},
    ),
    "other has frame_shape": ("r other", "lerobot", "out", {}),
}


@pytest.mark.parametrize("why", REFUSED)
def test_an_error_names_the_reason_and_leaves_every_file(why, tmp_path):
    logs, form, out, options = REFUSED[why]
    fps = 50 if "other" in logs else 29.97
    record_images(tmp_path / "r", fps=fps)
    record_images(tmp_path / "other", (24, 42), fps=fps)
    (tmp_path / "there.mp4").write_text("mine")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("mine")
    before = contents(tmp_path)
    with pytest.raises(UsageError, match=why):
        export([tmp_path / log for log in logs.split()], tmp_path / out, form, **options)
    assert contents(tmp_path) == before


def test_force_replaces_an_earlier_export(tmp_path):
    pixels, _ = record_images(tmp_path / "r", views=("left",))
    for name in ("first", "second"):
        (tmp_path / "out" / name).mkdir(parents=True)
        (tmp_path / "out" / name / "00000000.png").touch()
    assert export(tmp_path / "r", tmp_path / "out", "images", force=True) == len(pixels[0])
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["left"]


def test_a_dataset_of_logs_has_every_numeric_topic_and_images_as_they_are(cdmisfa, tmp_path):
    count, step, start = 20, 20_000_000, 10**18
    colors = np.random.default_rng(0).integers(0, 256, (count, 90, 120, 3), dtype=np.uint8)
    kinds = {"/cam": RAW, "/joints": JOINTS, "/cmd": JOINTS, "/grip": GRIP, "/note": NOTE}
    for name, shift in (("a", 0), ("b", 5)):
        with open(tmp_path / f"{name}.mcap", "wb") as file:
            writer = Writer(file)
            writer.start()
            for topic, kind in kinds.items():
                schema = writer.register_schema(kind.schema, "protobuf", kind.definition)
                channel = writer.register_channel(topic, kind.encoding, schema)
                for i in range(count):
                    number = shift + i
                    data = raw(colors[i], "rgb8")
                    if kind is not RAW:
                        position = [number, number / 2] if topic == "/joints" else [-number, 1]
                        values = {"position": position, "velocity": [number * 3], "width": number}
                        data = json.dumps({"text": "x"} if kind is NOTE else values).encode()
                    late = 1_000_000 if topic == "/joints" else 0
                    writer.add_message(channel, start + i * step + late, data, 0)
            writer.finish()
    words = "--to", "lerobot", "--lossless", "--state", "/joints:position[0:1]"
    done = cdmisfa(
        "export", tmp_path, *words, "--state", "/grip:width", "-o", tmp_path / "d", "--json"
    )
    assert done.code == 0, done.err
    assert [line for line in done.json["warnings"] if "/note is left out" in line]
    data = pq.read_table(tmp_path / "d/data/chunk-000/file-000.parquet").to_pydict()
    numbers = [*range(count), *range(5, 5 + count)]
    assert data["episode_index"] == [0] * count + [1] * count
    assert data["observation.state"] == [[n, n] for n in numbers]
    assert data["action"] == [[-n, 1] for n in numbers]
    assert data["observation.joints"] == [[n, n / 2, n * 3, n] for n in numbers]
    import av

    for number in (0, 1):
        video = tmp_path / "d/videos/observation.images.cam/chunk-000" / f"file-00{number}.mp4"
        with av.open(str(video)) as container:
            images = [image.to_ndarray(format="rgb24") for image in container.decode(video=0)]
        np.testing.assert_array_equal(images, colors)
