"""`cdmisfa episodes` finds planted faults, and only these; its measures have known answers."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from camera_files import encoded
from conftest import Cdmisfa
from hypothesis import given
from hypothesis import strategies as st

from replay.episodes.features import features_of
from replay.episodes.images import shift
from replay.episodes.lag import Lag, lag_column
from replay.episodes.measure import CameraMeter, Measured
from replay.episodes.numbers import column, longest
from replay.episodes.ranking import Ranked, compare, rank_episodes
from replay.episodes.reading import EpisodeLog
from replay.episodes.reasons import REASONS, scores

FPS, COUNT, KEY = 20, 120, "observation.images.cam"
IMAGES = {"shape": [48, 64, 3], "names": None}
NUMBERS = {"dtype": "float32", "shape": [2], "names": None}


def episode(number: int, fault: str = "", color: int = 90) -> tuple[np.ndarray, np.ndarray]:
    """Return images of a square that moves, and its positions, with a fault."""
    rng = np.random.default_rng(number)
    t, knots = np.arange(COUNT + 9) / FPS, np.arange(12)
    targets = rng.uniform(2, 38, (2, len(knots)))
    places = np.stack([np.interp(t, knots * 0.8, target) for target in targets], axis=1)
    scene = np.random.default_rng(99).integers(color - 30, color + 30, (48, 64, 3))
    images = np.repeat(scene[None].astype(np.uint8), len(t), axis=0)
    for image, (y, x) in zip(images, places.astype(int), strict=True):
        image[y : y + 8, x + 8 : x + 16] = (230, 120, 40)
    images = (images + rng.integers(0, 3, images.shape)).astype(np.uint8)
    late = 6 if fault == "lag" else 0
    images, places = images[9 - late :][:COUNT], places[9:]
    if fault == "frozen":
        images[30:55] = images[30]
    if fault == "black":
        images[50] = 0
    if fault == "jump":
        places[40] += 30
    if fault == "moved":
        images = np.roll(images, (4, 3), axis=(1, 2))
    return images, places + rng.normal(0, 0.02, places.shape)


def dataset(
    folder: Path,
    faults: Sequence[str],
    *,
    tasks: Sequence[str] = (),
    state: bool = True,
    video: bool = False,
) -> Path:
    """Write a LeRobot dataset of layout v2.1 with images in its tables, or in videos."""
    (folder / "data/chunk-000").mkdir(parents=True)
    (folder / "meta").mkdir()
    lines = []
    for number, fault in enumerate(faults):
        task = tasks[number] if tasks else "move"
        images, places = episode(number, fault, 140 if task == "other" else 90)
        columns: dict[str, list[Any]] = {"index": list(range(number * COUNT, (number + 1) * COUNT))}
        if video:
            write_film(folder / f"videos/{KEY}/0-{number}.mp4", images)
        else:
            columns[KEY] = [{"bytes": encoded(image), "path": ""} for image in images]
        columns |= {"observation.state": list(places.astype(np.float32))} if state else {}
        path = folder / f"data/chunk-000/episode_{number:06d}.parquet"
        pq.write_table(pa.table(columns), path)
        lines.append({"episode_index": number, "tasks": [task], "length": COUNT})
    info = {
        "codebase_version": "v2.1", "fps": FPS, "total_frames": COUNT * len(faults),
        "chunks_size": 1000,
        "video_path": "videos/{video_key}/{episode_chunk}-{episode_index}.mp4",
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "features": {KEY: IMAGES | {"dtype": "video" if video else "image"}}
        | ({"observation.state": NUMBERS} if state else {}),
    }  # fmt: skip
    (folder / "meta/info.json").write_text(json.dumps(info))
    (folder / "meta/episodes.jsonl").write_text("\n".join(map(json.dumps, lines)))
    return folder


FAULTS = ["", "", "frozen", "", "", "lag", "", "", "black", "", "jump", "", "", "moved", "", ""]
PLANTED = {number: fault for number, fault in enumerate(FAULTS) if fault}
WORDS = {"frozen": "behind a frozen image", "lag": "behind the joints", "black": "100% black",
         "jump": "the states jump", "moved": "the view is shifted by 5 pixels"}  # fmt: skip


def test_planted_faults_are_flagged_with_their_reasons_and_nothing_else(
    cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    data, out = dataset(tmp_path / "data", FAULTS), tmp_path / "out"
    found = cdmisfa("episodes", data, "-o", out, "--jobs", 1, "--json").json
    assert sorted(found["flagged"]) == sorted(PLANTED)
    for number, fault in PLANTED.items():
        assert any(WORDS[fault] in reason for reason in found["episodes"][number]["reasons"])
    assert found["remove"][0].endswith('--operation.episode_indices "[2, 5, 8, 10, 13]"')
    late = found["episodes"][5]["cam.lag"]
    assert abs(late - 6 / FPS) <= 1 / FPS
    assert pq.read_table(out / "episodes.parquet")["flagged"].to_pylist() == [
        bool(fault) for fault in FAULTS
    ]
    page = (out / "episodes.html").read_text()
    assert "src=" in page
    assert "http" not in page.replace("http-equiv", "")  # it needs no other file
    assert "5 of 16 episodes flagged" in page


def test_results_depend_neither_on_processes_nor_on_an_interruption(
    cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    data = dataset(tmp_path / "data", FAULTS[:9])
    out, again = tmp_path / "out", tmp_path / "again"
    assert rank_episodes([data], out, stop=lambda: True) is None
    assert 0 < len([*(out / "measured").iterdir()]) < 9
    assert cdmisfa("episodes", data, "-o", out, "--jobs", 2).code == 0
    expected = (out / "episodes.parquet").read_bytes()
    measured = sorted((out / "measured").iterdir())
    times = [file.stat().st_mtime_ns for file in measured]
    measured[3].unlink()
    measured[4].write_bytes(b"PK\3\4")
    assert cdmisfa("episodes", data, "-o", out, "--jobs", 1).code == 0
    assert (out / "episodes.parquet").read_bytes() == expected
    after = [file.stat().st_mtime_ns for file in sorted((out / "measured").iterdir())]
    assert [a == b for a, b in zip(times, after, strict=True)] == [
        i not in (3, 4) for i in range(9)
    ]
    assert cdmisfa("episodes", data, "-o", again, "--jobs", 1).code == 0
    assert (again / "episodes.parquet").read_bytes() == expected


def test_without_joint_states_images_alone_are_judged(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    faults = ["", "frozen", *[""] * 10]
    data = dataset(tmp_path / "data", faults, state=False, video=True)
    found = cdmisfa("episodes", data, "-o", tmp_path / "out", "--json").json
    assert found["flagged"] == [1]
    assert "behind a frozen image" in found["episodes"][1]["reasons"][0]
    assert found["notes"] == [
        "not judged, for lack of images, colors, states or actions: "
        "idle, lag, state, stuck, jump, noise"
    ]


def test_episodes_are_compared_within_their_tasks(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    tasks = ["other" if number % 3 == 0 else "move" for number in range(18)]
    data = dataset(tmp_path / "data", [""] * 18, tasks=tasks)
    found = cdmisfa("episodes", data, "-o", tmp_path / "out", "--json").json
    assert found["groups"] == {"task other": 6, "task move": 12}
    assert found["flagged"] == []
    refused = cdmisfa("episodes", data, "-o", tmp_path / "out", "--by", "operator")
    assert refused.code == 2
    assert "--by operator: the dataset has task" in refused.err
    absent = cdmisfa("episodes", tmp_path / "dat", "-o", tmp_path / "out")
    assert absent.code == 2
    assert f"dat: no such file or folder: did you mean {data}?" in absent.err


def test_an_episode_that_cannot_be_read_is_flagged(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    for number in range(8):
        images, _ = episode(number, "black" if number == 5 else "")
        write_film(tmp_path / f"takes/{number}.mp4", images)
    (tmp_path / "takes/3.mp4").write_bytes(b"no video")
    found = cdmisfa("episodes", tmp_path / "takes", "-o", tmp_path / "out", "--json").json
    assert found["flagged"] == [3, 5]
    assert found["episodes"][3]["reasons"][0].startswith("cannot be read: ")
    assert found["remove"] == [str(tmp_path / f"takes/{number}.mp4") for number in (3, 5)]


def write_film(file: Path, images: np.ndarray) -> None:
    av = pytest.importorskip("av")
    file.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(file), "w") as out:
        stream = out.add_stream("h264", rate=FPS)
        stream.height, stream.width, stream.pix_fmt = *images.shape[1:3], "yuv420p"
        for image in images:
            out.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        out.mux(stream.encode())


def log(late: int, seed: int) -> Measured:
    """Return measures of a log of 60 s: a square that moves as one of two joints, and is late."""
    rng, count = np.random.default_rng(seed), 1200
    steps = rng.normal(0, 1, (2, count + 8))
    joints = np.array([np.convolve(row, np.hanning(9), "valid") for row in steps])
    meter = CameraMeter(np.sort(np.arange(count) / FPS + rng.uniform(-0.004, 0.004, count)))
    for row in range(count):
        image = rng.integers(90, 96, (48, 64, 3)).astype(np.uint8)
        x = int(np.clip(28 + 8 * joints[0, max(row - late, 0)], 0, 56))
        image[20:28, x : x + 8] = (230, 120, 40)
        meter.add(row, image)
    camera = meter.result()
    assert camera is not None
    return Measured("log", {"cam": camera}, {"state": (np.arange(count) / FPS, joints.T)})


def lag_of(episode: Measured) -> Lag:
    cameras = [episode.cameras["cam"]]
    lag = lag_column([episode], "cam", features_of(cameras).slow)
    assert lag is not None
    return lag[2]


@pytest.mark.parametrize("late", [0, 6])
def test_the_lag_of_one_log_follows_from_the_joints_that_images_show(late: int) -> None:
    lag = lag_of(log(late, 1))
    assert lag.certain
    assert abs(lag.seconds - late / FPS) <= 1 / FPS


def test_no_lag_is_certain_if_images_show_other_motion() -> None:
    other = log(0, 3)
    other.numbers = log(0, 4).numbers
    assert not lag_of(other).certain


@given(st.integers(-6, 6), st.integers(-6, 6))
def test_a_shifted_view_is_found_exactly(y: int, x: int) -> None:
    scene = np.random.default_rng(1).random((60, 80))
    scene = sum(np.roll(scene, (a, b), axis=(0, 1)) for a in range(3) for b in range(3))
    moved = np.roll(scene, (y, x), axis=(0, 1))
    assert shift(moved[8:-8, 8:-8], scene[8:-8, 8:-8]) == pytest.approx(np.hypot(y, x))


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 5)), min_size=1, max_size=30))
def test_longest_sums_motion_within_equal_rows(rows: list[tuple[bool, int]]) -> None:
    best = run = 0
    for same, motion in rows:
        run = run + motion if same else 0
        best = max(best, run)
    same, motion = (np.array(values)[:, None] for values in zip(*rows, strict=True))
    assert longest(same, motion.astype(float))[0] == best


def test_a_reason_that_many_share_is_none_if_they_are_alike() -> None:
    rng = np.random.default_rng(0)
    x = rng.normal(0, 0.01, 40)
    x[:8] += 1  # another session
    x[39] += 1.5
    groups = [np.arange(40)]
    score, shared = scores(column("light", x), groups)
    assert [(place, alike.tolist()) for place, alike in shared] == [(0, list(range(8)))]
    assert np.flatnonzero(score >= 1).tolist() == [39]
    frozen, _ = scores(column("frozen", x), groups)  # a fault, however many have it
    assert np.flatnonzero(frozen >= 1).tolist() == [*range(8), 39]
    assert not REASONS["frozen"].relative


def compared(episodes: Sequence[Measured]) -> Ranked:
    logs = [EpisodeLog(f"{i}.mcap", (f"{i}.mcap",), (0, ""), {}) for i in range(len(episodes))]
    return compare(logs, [*episodes])


def part(episode: Measured, keep: np.ndarray) -> Measured:
    """Return an episode with some of its images."""
    cameras = {
        name: replace(
            camera,
            times=camera.times[keep],
            frames=camera.frames[keep],
            thumbnails=camera.thumbnails[keep],
        )
        for name, camera in episode.cameras.items()
    }
    return Measured(episode.name, cameras, episode.numbers)


def test_lost_images_and_a_late_camera_are_reasons_beside_the_lag_of_the_others() -> None:
    episodes = [log(7 if seed == 4 else 1, seed) for seed in range(10)]
    lost = np.random.default_rng(0).random(1200) < 0.75
    ranked = compared([part(one, lost) if i == 2 else one for i, one in enumerate(episodes)])
    assert {2, 4} <= {*ranked.flagged}
    assert any("of images are missing" in words for words, _ in ranked.reasons(2))
    (late,) = (words for words, _ in ranked.reasons(4) if "behind the joints" in words)
    assert re.search(r"camera \+0\.3\d s behind the joints, the others \+0\.0[4-7] s", late)
    lags = np.array([ranked.lags[i, "cam"].seconds for i in range(10)])
    assert np.all(np.abs(np.delete(lags, 4) - 1 / FPS) <= 1 / FPS)


def test_few_episodes_and_other_joints_are_compared_with_a_note() -> None:
    other = log(0, 1)
    times, joints = other.numbers["state"]
    other.numbers["state"] = times, joints[:, :1]
    ranked = compared([log(0, 0), other])
    assert not ranked.flagged
    assert any("it needs 10 or more" in note for note in ranked.notes)


def test_verify_names_a_missing_video_once(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    data = dataset(tmp_path / "data", [""] * 3, video=True)
    film = data / f"videos/{KEY}/0-1.mp4"
    film.unlink()
    done = cdmisfa("verify", data, "--json")
    assert done.code == 3
    missing = {"where": str(film), "what": "this file of the dataset is missing"}
    assert done.json["problems"] == [missing]
