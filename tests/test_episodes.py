"""Many logs as episodes of one source, and what differs between them alone left out."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from camera_files import START_MS, write_images
from conftest import Cdmisfa
from folders import flip
from message_files import write_table

import cdmisfa as package
from cdmisfa.core.arrays import GRAY, centred, mean_of
from replay.corpus.episode_source import EpisodeSource
from replay.open_sources import locations
from replay.stored_source import PAUSE

STEP_MS = 50
SIZE = 16, 24
QUICK = ("--set", "learner.tau=10", "--no-rerun")


def scenes(count: int, frames: int, seed: int = 0) -> list[np.ndarray]:
    """Episodes of a square that moves before a background, in each another one, and noise."""
    rng, t = np.random.default_rng(seed), np.arange(frames)
    result = []
    for _ in range(count):
        background = rng.uniform(20, 200, (SIZE[0] // 2, SIZE[1] // 2))
        shown = np.repeat(np.kron(background, np.ones((2, 2)))[None], frames, axis=0)
        left = (9 + 9 * np.sin(rng.uniform(0, 2 * np.pi) + t / 12)).astype(int)
        for i, at in enumerate(left):
            shown[i, 5:11, at : at + 6] += 70
        shown += rng.normal(0, 6, shown.shape)
        result.append(np.clip(shown, 0, 255).astype(np.uint8))
    return result


def write_log(path: Path, images: np.ndarray, first: int = 0, topic: str = "/cam") -> Path:
    """A log whose first image is the so manieth since its start."""
    path.parent.mkdir(exist_ok=True)
    each = ((START_MS + (first + i) * STEP_MS, image) for i, image in enumerate(images))
    return write_images(path, {topic: each})


def corpus(
    cdmisfa: Cdmisfa, folder: Path, episodes: Sequence[np.ndarray], name: str = "ep{}.mcap"
) -> Path:
    """An indexed folder of logs that begin in the order of the episodes."""
    for i, images in enumerate(episodes):
        write_log(folder / name.format(i), images, i * 1000)
    assert cdmisfa("index", folder).code == 0
    return folder


def opened(*paths: Path, **how: bool) -> EpisodeSource:
    return EpisodeSource([[place] for place in locations(paths)], **how)


def test_episodes_are_learned_as_one_log_with_pauses_is(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    episodes = scenes(4, 45)
    folder = corpus(cdmisfa, tmp_path / "logs", episodes)
    first = [i * (45 + PAUSE) for i in range(4)]
    each = zip(first, episodes, strict=True)
    times = [(START_MS + (at + i) * STEP_MS, x) for at, own in each for i, x in enumerate(own)]
    one = write_images(tmp_path / "one.mcap", {"/cam": times})
    run = tmp_path / "run"
    learned = cdmisfa("learn", folder, *QUICK, "--json", "--passes", 1, "-o", run)
    alike = cdmisfa("learn", one, *QUICK, "--json", "--passes", 1)
    assert (learned.code, learned.json["iterations"]) == (0, 16)
    assert learned.json["signals_sha256"] == alike.json["signals_sha256"]
    assert "4 episodes, ordered by start time, then by path: ep0.mcap to ep3.mcap" in learned.err
    source = json.loads((run / "run.json").read_text())["source"]
    assert [(file["file"], file["frames"]) for file in source["files"]] == [
        (f"ep{i}.mcap", [at, at + 45]) for i, at in enumerate(first)
    ]
    assert cdmisfa("check", run).code == 0
    named = cdmisfa(
        "learn", "--episodes", *sorted(folder.glob("*.mcap"))[::-1], *QUICK, "--json", "--passes", 1
    )
    assert named.json["signals_sha256"] == learned.json["signals_sha256"]
    by_index = cdmisfa("learn", folder / "corpus.parquet", *QUICK, "--json", "--passes", 1)
    assert by_index.json["signals_sha256"] == learned.json["signals_sha256"]
    result = package.learn(str(folder), tau=10, passes=1)
    assert result.result["signals_sha256"] == learned.json["signals_sha256"]
    (folder / "ep2.mcap").unlink()
    without = cdmisfa("check", run, "--json")
    assert (without.code, without.json["other_files"]) == (4, ["ep2.mcap"])


def test_streams_of_the_same_name_are_one_and_a_missing_one_is_a_gap(tmp_path: Path) -> None:
    one, two = scenes(2, 30)
    first = write_log(tmp_path / "1.mcap", one)
    second = tmp_path / "2.mcap"
    times = [START_MS + (1000 + i) * STEP_MS for i in range(30)]
    each = {"/cam": zip(times, two, strict=True), "/other": zip(times, one, strict=True)}
    write_images(second, each)
    cameras = package.Recording(first, second, episodes=True, topics=["/*"])
    assert (cameras.spec.streams, cameras.spec.length) == (("cam", "other"), 60 + PAUSE)
    with cameras.source() as source:
        assert source.spans(0, 0, 80) == [(0, 30), (50, 80)]
        assert source.spans(1, 0, 80) == [(50, 80)]
        assert (source.take(1, 5).t, source.t) == (50, 55)
        source.seek(0)
        both = source.take_all(60)
        assert [(b.stream, b.t, len(b)) for b in both] == [(0, 0, 30), (0, 50, 10), (1, 50, 10)]
        np.testing.assert_array_equal(both[2].frames, one[:10])


def test_of_episodes_one_log_is_open_at_a_time(tmp_path: Path) -> None:
    paths = [write_log(tmp_path / f"{i}.mcap", x, i * 100) for i, x in enumerate(scenes(30, 12))]
    with opened(*paths) as source:
        for _ in range(30):
            source.take(0, 12)
            held = [os.readlink(f"/proc/self/fd/{fd}") for fd in os.listdir("/proc/self/fd")
                    if os.path.exists(f"/proc/self/fd/{fd}")]  # fmt: skip
            assert sum(str(tmp_path) in path for path in held) <= 1


def test_a_looped_corpus_has_a_gap_before_it_begins_again(tmp_path: Path) -> None:
    one, two = scenes(2, 30)
    paths = write_log(tmp_path / "1.mcap", one), write_log(tmp_path / "2.mcap", two, 1000)
    with opened(*paths, loop=True) as source:
        lap = 2 * (30 + PAUSE)
        starts = [source.take(0, 20).t for _ in range(5)]
        assert starts == [0, 50, lap, lap + 50, 2 * lap]
        source.centre = "episode"
        source.seek(lap)
        mean = mean_of([one])
        np.testing.assert_array_equal(source.take(0, 20).frames, centred(one, mean)[:20])


# What is left out


def test_bad_logs_are_left_out_and_said_and_the_rest_is_learned(
    cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    episodes = scenes(5, 45)
    folder = corpus(cdmisfa, tmp_path / "logs", episodes)
    whole = cdmisfa("learn", folder, *QUICK, "--json").json
    write_log(folder / "large.mcap", np.zeros((20, 32, 48), np.uint8), 9000)
    write_table(folder / "table.csv", {"text": ["a", "b"]})
    write_log(folder / "gone.mcap", episodes[0], 9100)
    (folder / "text.mcap").write_text("no log")
    assert cdmisfa("index", folder).code == 0
    (folder / "gone.mcap").unlink()
    done = cdmisfa("learn", folder, *QUICK, "--json")
    assert done.code == 3
    assert done.json["signals_sha256"] == whole["signals_sha256"]
    for name in ("large.mcap", "table.csv", "gone.mcap", "text.mcap"):
        assert f"{name}" in done.err
    assert done.err.count("skipped") == 4
    assert done.err.count("--size and --rate make logs alike") == 1
    assert "Traceback" not in done.err


def test_a_log_damaged_in_the_middle_is_left_out_from_there_on(
    cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    folder = corpus(cdmisfa, tmp_path / "logs", scenes(4, 60))
    damaged = folder / "ep1.mcap"
    flip(damaged, damaged.stat().st_size // 2)
    run = tmp_path / "run"
    done = cdmisfa("learn", folder, *QUICK, "--json", "--passes", 1, "-o", run)
    assert done.code == 3, done.err
    assert "the rest of this log is skipped" in done.err
    assert 18 <= done.json["iterations"] < 24
    assert cdmisfa("check", run).code == 0
    centre = ("--set", "input.centre=episode", "--json", "--passes", 1)
    without = cdmisfa("learn", folder, *QUICK, *centre)
    assert (without.code, without.json["iterations"]) == (3, 18)  # its mean is not known
    assert "this log is skipped" in without.err


def test_each_pass_over_a_damaged_log_ends_at_the_damage(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    folder = corpus(cdmisfa, tmp_path / "logs", scenes(2, 60))
    damaged = folder / "ep0.mcap"
    flip(damaged, damaged.stat().st_size // 2)
    paths = damaged, folder / "ep1.mcap"
    with opened(*paths) as source, opened(*paths) as resumed:
        first: list[int] = []
        for one in (source, resumed):
            one.repeat(2)
        while source.t < source.lap:
            source.seek(source.t + 3)  # as if streams took turns
            first.append(source.take(0, 10).t)
        assert source.left_out
        resumed.seek(source.lap)
        source.seek(source.lap)
        for _ in range(6):
            a, b = source.take(0, 10), resumed.take(0, 10)
            assert a.t == b.t
            np.testing.assert_array_equal(a.frames, b.frames)
        assert source.left_out == resumed.left_out


# Stopped and resumed


def test_stopped_in_the_middle_of_many_episodes_it_is_resumed_with_the_same_signals(
    cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    rng, t = np.random.default_rng(0), np.arange(25)
    folder, run = tmp_path / "logs", tmp_path / "run"
    folder.mkdir()
    for i in range(150):
        x = np.stack([np.sin((t + 40 * i) / 30), *rng.normal(size=(3, 25))]) + rng.normal()
        np.save(folder / f"ep{i}.npy", x.T)
    assert cdmisfa("index", folder).code == 0
    words = (folder, *QUICK, "--set", "learner.watch=9999", "--set", "input.centre=episode")
    words = (*words, "--set", "input.holdout=0", "--passes", 1, "--json")
    whole = cdmisfa("learn", *words).json
    assert whole["iterations"] == 300
    assert cdmisfa("learn", *words, "-o", run, "--max-iterations", 151).code == 0
    resume = ("learn", "--resume", "-o", run, "--no-rerun", "--max-iterations", 300, "--json")
    done = cdmisfa(*resume)
    assert done.code == 0, done.err
    assert done.json["signals_sha256"] == whole["signals_sha256"]
    np.save(folder / "ep149.npy", np.zeros((25, 4)))
    changed = cdmisfa(*resume)
    assert (changed.code, "source.files" in changed.err) == (2, True)


# The mean of an episode


def test_the_mean_of_an_episode_does_not_depend_on_how_it_is_read() -> None:
    rng = np.random.default_rng(3)
    for frames in (rng.integers(70, 190, (50, 3, 4), np.uint8), rng.normal(size=(50, 7))):
        whole = mean_of([frames])
        for cut in (1, 7, 49):
            pieces = [frames[at : at + cut] for at in range(0, 50, cut)]
            np.testing.assert_array_equal(mean_of(pieces), whole)
        np.testing.assert_allclose(whole, frames.mean(axis=0), atol=0.5 + 1e-9)
        once = centred(frames, whole)
        np.testing.assert_allclose(centred(once, mean_of([once])), once, atol=1e-12)
    assert mean_of([np.array([[0], [1]], np.uint8)]).tolist() == [1]
    shown = centred(np.array([[0], [100], [255]], np.uint8), np.array([100], np.int16))
    assert shown.ravel().tolist() == [28, GRAY, 255]


@pytest.fixture(scope="module")
def backgrounds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A corpus of scenes, and the run learned from them without their means."""
    from cdmisfa.cli import run

    folder = tmp_path_factory.mktemp("backgrounds")
    for i, images in enumerate(scenes(110, 45)):
        write_log(folder / "logs" / f"ep{i}.mcap", images, i * 1000)
    assert run(["index", str(folder / "logs")]) == 0
    words = [
        "learn",
        str(folder / "logs"),
        "--set",
        "input.centre=episode",
        "-o",
        str(folder / "run"),
    ]
    assert run([*words, "--no-rerun"]) == 0
    return folder


def test_centred_episodes_show_what_moves_before_backgrounds_that_change(
    cdmisfa: Cdmisfa, backgrounds: Path, tmp_path: Path
) -> None:
    assert "no module was learned" in cdmisfa("learn", backgrounds / "logs").out
    run = backgrounds / "run"
    (module,) = package.Run(run).modules
    assert module.recipe is not None
    assert (module.recipe.centre, module.slow[0]) == ("episode", 1)
    assert cdmisfa("check", run).code == 0
    (new,) = scenes(1, 200, seed=9)
    log = write_log(tmp_path / "new.mcap", new)
    assert cdmisfa("apply", run, log, "-o", tmp_path / "out.csv").code == 0
    applied = np.genfromtxt(tmp_path / "out.csv", delimiter=",", names=True)["module1_y0"]
    y = module.transform(new)[:, 0]
    np.testing.assert_array_equal(applied, y)
    shown = package.Recording(log, centre="episode").frames()
    for same in (shown, new.reshape(200, -1), new / 255):
        np.testing.assert_array_equal(module.transform(same)[:, 0], y)
    t = np.arange(200) / 12
    waves = np.stack([np.sin(t), np.cos(t), np.ones(200)], axis=1)
    rest = y - waves @ np.linalg.lstsq(waves, y, rcond=None)[0]
    assert rest.var() < 0.2 * y.var()  # it tells where the square is
    live = cdmisfa("apply", run, "av:lavfi:testsrc=size=24x16")
    assert live.code == 2
    assert "the modules need the mean of each episode" in live.err


def test_apply_takes_each_log_of_a_corpus_as_an_episode(
    cdmisfa: Cdmisfa, backgrounds: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    done = cdmisfa("apply", backgrounds / "run", backgrounds / "logs", "-o", out, "--json")
    assert (done.code, len(done.json["logs"])) == (0, 110)
    y = pq.read_table(out / "ep7.mcap.parquet")["module1_y0"].to_numpy()
    (module,) = package.Run(backgrounds / "run").modules
    np.testing.assert_array_equal(module.transform(scenes(8, 45)[7])[:, 0], y)


def test_episodes_of_a_dataset_are_its_own(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    episodes = scenes(3, 30)
    each = zip((0, 1000, 2000), episodes, strict=True)
    times = [(START_MS + (at + i) * STEP_MS, x) for at, own in each for i, x in enumerate(own)]
    write_images(tmp_path / "log.mcap", {"/cam": times})
    assert cdmisfa("convert", tmp_path / "log.mcap", "-o", tmp_path / "rec").code == 0
    words = ("--to", "lerobot", "--lossless", "-o", tmp_path / "data")
    assert cdmisfa("export", tmp_path / "rec", *words).code == 0
    wanted = np.concatenate([centred(one, mean_of([one])) for one in episodes])
    for logs in ([tmp_path / "data"], [tmp_path / "log.mcap"]):
        shown = package.Recording(*logs, centre="episode").frames()
        np.testing.assert_array_equal(shown, wanted)
    both = package.Recording(tmp_path / "data", tmp_path / "data", episodes=True, centre="episode")
    np.testing.assert_array_equal(both.frames("cam"), np.concatenate([wanted, wanted]))


def test_what_is_held_out_are_whole_episodes_where_one_fits(tmp_path: Path) -> None:
    paths = [write_log(tmp_path / f"{i}.mcap", x, i * 100) for i, x in enumerate(scenes(6, 30))]
    with opened(*paths) as source:
        source.hold_out(110)
        assert (source.held_out, source.end) == (80, 4 * (30 + PAUSE))
        source.hold_out(20)
        assert source.held_out == 20
        assert [len(b) for b in source.pieces(0, 260, 280, 16)] == [16, 4]
