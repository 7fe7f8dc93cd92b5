"""What is chosen of many logs: planted events and no noise, within a budget, as `cut` takes it."""

from __future__ import annotations

import csv
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from camera_files import write_images
from conftest import Cdmisfa

from cdmisfa import Run
from recorder.mcap.reader import LogReader
from replay.corpus.choosing import described, disorder, rarity, scale, spread_out

FPS = 20
SECONDS = 30
LOGS = 10
SIZE = 48, 64


def scene(rng: np.random.Generator, event: int | None) -> np.ndarray:
    """A square that drifts over a gray slope, and a bright bar that crosses in an event."""
    count = FPS * SECONDS
    slope = np.broadcast_to(np.linspace(60.0, 100.0, SIZE[1]), SIZE)
    frames = np.repeat(slope[None], count, axis=0)
    phase = rng.uniform(0, 2 * np.pi)
    for t in range(count):
        left = int(20 + 14 * np.sin(phase + t / 15))
        frames[t, 14:30, left : left + 12] += 90
        if event is not None and event <= t < event + 2 * FPS:
            row = 4 + (t - event) % 36
            frames[t, row : row + 8, :] = 240
    noisy = frames + rng.normal(0, 4, frames.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8)


def planted(folder: Path, seed: int) -> dict[str, int]:
    """Logs of one scene, four with an event, two of noise: in which, the frame it begins at."""
    rng = np.random.default_rng(seed)
    events: dict[str, int] = {}
    folder.mkdir()
    for i in range(LOGS):
        event = int(rng.integers(0, FPS * (SECONDS - 3))) if i % 3 == 0 else None
        name = f"day-{i}.mcap"
        if event is not None:
            events[name] = event
        frames = scene(rng, event)
        ms = ((t * 1000 // FPS, frame) for t, frame in enumerate(frames))
        write_images(folder / name, {"/camera": ms})
    for i in range(2):
        noise = rng.integers(0, 256, (FPS * SECONDS, *SIZE), np.uint8)
        ms = ((t * 1000 // FPS, frame) for t, frame in enumerate(noise))
        write_images(folder / f"noise-{i}.mcap", {"/camera": ms})
    shutil.copy(folder / "day-0.mcap", folder / "zz-copy.mcap")
    return events


def found_events(document: dict, events: dict[str, int]) -> int:
    """How many events lie in a segment by half of their time."""
    found = 0
    for name, event in events.items():
        wanted = event / FPS, event / FPS + 2
        shared = 0.0
        for segment in document["segments"]:
            if segment["log"] == name:
                low, high = segment["start"] / 1e9, segment["stop"] / 1e9
                shared += max(min(high, wanted[1]) - max(low, wanted[0]), 0)
        found += shared >= 1
    return found


@pytest.mark.parametrize("seed", [0, 1])
def test_planted_events_are_chosen_and_noise_and_doubles_are_not(
    cdmisfa: Cdmisfa, tmp_path: Path, seed: int
) -> None:
    events = planted(tmp_path / "logs", seed)
    assert cdmisfa("index", tmp_path / "logs").code == 0
    budget = LOGS * SECONDS / 10
    words = ("curate", tmp_path / "logs", "--budget", f"{budget}s", "-o", tmp_path / "out")
    done = cdmisfa(*words, "--json")
    assert done.code == 0, done.err
    document = done.json
    assert found_events(document, events) >= 0.9 * len(events)
    assert sum(segment["seconds"] for segment in document["segments"]) <= budget
    logs = {row["log"]: row for row in document["logs"]}
    assert logs["noise-0.mcap"]["noise"] == pytest.approx(SECONDS, abs=2)
    assert (logs["noise-0.mcap"]["new"], logs["noise-1.mcap"]["new"]) == (0, 0)
    assert logs["zz-copy.mcap"]["problem"] == "holds the same as day-0.mcap"
    assert {*list(logs)[: len(events)]} == {*events}  # ranked by what is new


def test_the_segments_are_cut_out_and_shown(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    planted(tmp_path / "logs", 2)
    cdmisfa("record", "oscillatory", "--frames", 300, "-o", tmp_path / "logs" / "waves")
    (tmp_path / "logs" / "text.mcap").write_text("no log")
    np.save(tmp_path / "logs" / "short.npy", np.zeros((2, 3)))
    cdmisfa("index", tmp_path / "logs")
    out = tmp_path / "out"
    words = ("curate", tmp_path / "logs", "-o", out, "--budget", "20s")
    done = cdmisfa(*words)
    assert done.code == 0, done.err
    assert "text.mcap: " not in done.out
    with (out / "segments.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert rows
    assert all((out / row["path"]).is_file() for row in rows)
    assert {Path(row["path"]).name for row in rows} >= {"x1.mcap", "x2.mcap", "x3.mcap"}
    assert cdmisfa("cut", "--segments", out / "segments.csv", "-o", tmp_path / "cut").code == 0
    camera = next(row for row in rows if row["path"].endswith("day-0.mcap"))
    with LogReader(tmp_path / "cut" / "day-0.mcap") as reader:
        times = [message.log_time for message in reader.messages()]
    assert int(camera["start"]) <= times[0] < times[-1]
    page = (out / "index.html").read_text("utf-8")
    assert page.count("<section") == len(json.loads((out / "curated.json").read_text())["segments"])
    assert page.count("data:image/jpeg") > 3
    blocks = pq.read_table(out / "blocks.parquet").to_pylist()
    assert {block["verdict"] for block in blocks} == {"novel", "noise"}
    assert cdmisfa(*words).code == 2  # it is there
    assert cdmisfa(*words, "--force").code == 0
    again = json.loads((out / "curated.json").read_text())
    assert again["logs"][0]["log"] in {row["log"] for row in again["segments"]}


def test_what_a_run_knows_is_not_chosen(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    logs = tmp_path / "logs"
    cdmisfa("record", "oscillatory", "--frames", 6000, "-o", logs / "waves")
    cdmisfa("index", logs)
    learned = ("--algorithm", "progress", "--no-rerun", "-o", tmp_path / "run")
    assert cdmisfa("learn", logs / "waves", *learned).code == 0
    words = ("curate", logs, "--known", tmp_path / "run", "--budget", "1min", "--json")
    assert cdmisfa(*words, "-o", tmp_path / "out").code == 0
    blocks = pq.read_table(tmp_path / "out" / "blocks.parquet").to_pylist()
    learned_from = {module.stream: module.index for module in Run(tmp_path / "run").modules}
    assert 0 < len(learned_from) < 3
    for block in blocks:
        module = learned_from.get(block["stream"])
        assert (block["verdict"], block["module"]) == ("known" if module else "novel", module)


def test_without_frames_there_is_nothing_to_choose(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    (tmp_path / "text.mcap").write_text("no log")
    cdmisfa("index", tmp_path)
    done = cdmisfa("curate", tmp_path, "-o", tmp_path / "out")
    assert (done.code, done.out) == (2, "")
    assert "no log in it shows frames" in done.err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("budget", "said"), [("10", "10min or 2h"), ("5MB", "10min or 2h")])
def test_a_budget_is_a_duration(cdmisfa: Cdmisfa, tmp_path: Path, budget: str, said: str) -> None:
    done = cdmisfa("curate", tmp_path, "-o", tmp_path / "out", "--budget", budget)
    assert (done.code, done.out) == (2, "")
    assert said in done.err


def test_noise_has_no_order_and_what_moves_has() -> None:
    rng = np.random.default_rng(0)
    white = rng.normal(size=(200, 8))
    assert disorder(white) == pytest.approx(1, abs=0.1)
    assert disorder(np.cumsum(white, axis=0)) < 0.05
    assert disorder(np.ones((5, 3))) == 0
    still = np.clip(100 + rng.normal(0, 4, (40, 48, 64)), 0, 255).astype(np.uint8)
    assert not described(still).noise  # a sensor's noise on what stands still
    assert described(rng.integers(0, 256, (40, 48, 64), np.uint8)).noise


def test_each_mode_is_chosen_before_any_is_chosen_twice() -> None:
    rng = np.random.default_rng(1)
    modes = rng.normal(size=(7, 5)) * 10
    which = rng.integers(0, 7, 300)
    features = (modes[which] + rng.normal(0, 0.1, (300, 5))).astype(np.float32)
    groups, windows = np.zeros(300, np.int64), np.arange(300)
    wanted = which != 3
    rare, unknown = rarity(features, groups, wanted), np.full(300, np.inf)
    found, all_seen = spread_out(
        features, groups, windows, wanted, rare, unknown, np.ones(300), np.inf
    )
    chosen = [window for window, _ in found]
    assert all_seen
    assert sorted(which[chosen[:6]].tolist()) == [0, 1, 2, 4, 5, 6]
    assert len(chosen) == len({*chosen})
    assert all(wanted[chosen])


def test_what_is_rare_comes_before_what_is_as_far_and_common() -> None:
    features = np.array([*[[0.1 * i] for i in range(20)], [4.0]], np.float32)
    groups, wanted = np.zeros(21, np.int64), np.ones(21, bool)
    rare = rarity(features, groups, wanted)
    assert rare[:20] == pytest.approx([0.3, 0.2, *[0.2] * 16, 0.2, 0.3], abs=1e-3)
    assert rare[20] == pytest.approx(2.3, abs=1e-3)


def test_noise_is_no_measure_of_what_differs() -> None:
    rng = np.random.default_rng(0)
    features = rng.normal(size=(50, 4)).astype(np.float32)
    with_noise = np.concatenate([features, 1000 * features[:9]])
    wanted, groups = np.arange(59) < 50, np.zeros(59, np.int64)
    scale(features, groups[:50], wanted[:50], [False])
    scale(with_noise, groups, wanted, [False])
    assert np.array_equal(with_noise[:50], features)
    assert 2 * features.var(axis=0).sum() == pytest.approx(1, abs=1e-5)


def test_what_looks_as_what_a_run_watched_comes_last(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    rng, logs = np.random.default_rng(0), tmp_path / "logs"
    logs.mkdir()
    for name, event in (("usual", None), ("again", None), ("event", 200)):
        ms = ((t * 1000 // FPS, frame) for t, frame in enumerate(scene(rng, event)))
        write_images(logs / f"{name}.mcap", {"/camera": ms})
    words = ("--loop", "--max-iterations", 200, "--no-rerun", "-o", tmp_path / "run")
    assert cdmisfa("learn", logs / "usual.mcap", "--topic", "/camera", *words).code == 0
    cdmisfa("index", logs)
    words = ("--known", tmp_path / "run", "--budget", "4s", "-o", tmp_path / "out", "--json")
    done = cdmisfa("curate", logs, *words)
    assert done.code == 0, done.err
    assert done.json["segments"][0]["log"] == "event.mcap"


def test_what_does_not_fit_into_the_budget_is_passed_over_for_what_does() -> None:
    features = np.array([[0], [9], [4], [1]], np.float32)
    windows, seconds = np.array([0, 1, 2, 3]), np.array([2.0, 5.0, 2.0, 1.0])
    groups, wanted, unknown = np.zeros(4, np.int64), np.ones(4, bool), np.full(4, np.inf)
    known = features, groups, windows, wanted, np.zeros(4), unknown, seconds
    assert spread_out(*known, 4.5) == ([(2, 1.0), (0, 4.0)], False)
    assert spread_out(*known, 5.0) == ([(2, 1.0), (0, 4.0), (3, 1.0)], False)
    assert spread_out(*known, 10.0) == ([(2, 1.0), (1, 5.0), (0, 4.0), (3, 1.0)], True)


def test_how_many_processes_judge_changes_nothing(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    logs, found = tmp_path / "logs", []
    for seed in range(5):
        words = ("--frames", 600, "--seed", seed, "-o", logs / str(seed))
        assert cdmisfa("record", "oscillatory", *words).code == 0
    (logs / "3" / "x1.mcap").write_bytes((logs / "3" / "x1.mcap").read_bytes()[:5000])
    cdmisfa("index", logs)
    learned = ("--algorithm", "progress", "--no-rerun", "--max-iterations", 60)
    assert cdmisfa("learn", logs / "0", *learned, "--loop", "-o", tmp_path / "run").code == 0
    for jobs in (1, 2):
        out = tmp_path / f"out-{jobs}"
        words = ("curate", logs, "--known", tmp_path / "run", "--budget", "5s", "-o", out)
        assert cdmisfa(*words, "--jobs", jobs).code == 0
        found.append([(out / name).read_bytes() for name in ("blocks.parquet", "curated.json")])
    assert found[0] == found[1]


def test_a_double_by_its_messages_is_left_out_where_the_index_knows_them(
    cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    logs = tmp_path / "logs"
    cdmisfa("record", "oscillatory", "--frames", 300, "-o", logs / "a")
    again = ("record", "oscillatory", "--frames", 300, "--set", "record.compression=lz4")
    assert cdmisfa(*again, "-o", logs / "b").code == 0
    for deep, problem in (((), None), (("--deep",), "holds the same as a")):
        cdmisfa("index", logs, *deep)
        done = cdmisfa("curate", logs, "-o", tmp_path / "out", "--force", "--json")
        assert {row["log"]: row["problem"] for row in done.json["logs"]} == {
            "a": None,
            "b": problem,
        }


def test_the_double_of_a_damaged_log_is_judged(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    logs = tmp_path / "logs"
    for name in "abc":
        cdmisfa("record", "oscillatory", "--frames", 300, "-o", logs / name)
    shutil.copytree(logs / "c", logs / "d")
    cdmisfa("index", logs)
    for file in (logs / "a").iterdir():
        file.write_text("no log")
    done = cdmisfa("curate", logs, "-o", tmp_path / "out", "--json")
    problems = {row["log"]: row["problem"] or "" for row in done.json["logs"]}
    assert "not an MCAP file" in problems.pop("a")
    assert problems == {"b": "", **dict.fromkeys("cd", "holds the same as b")}


def test_force_replaces_no_folder_with_other_files(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    cdmisfa("record", "oscillatory", "--frames", 300, "-o", tmp_path / "logs" / "a")
    cdmisfa("index", tmp_path / "logs")
    done = cdmisfa("curate", tmp_path / "logs", "-o", tmp_path / "logs", "--force")
    assert (done.code, "holds other files, such as a: choose" in done.err) == (2, True)
    assert (tmp_path / "logs" / "a" / "x1.mcap").exists()


def test_it_says_what_is_left_of_the_budget_and_what_can_be_cut(
    cdmisfa: Cdmisfa, tmp_path: Path
) -> None:
    still = np.random.default_rng(0).integers(0, 255, (1, 48, 64), np.uint8)
    logs, out = tmp_path / "logs", tmp_path / "out"
    logs.mkdir()
    np.save(logs / "still.npy", still.repeat(100, axis=0))
    (logs / "text.mcap").write_text("no log")
    shutil.copy(logs / "still.npy", logs / "twice.npy")
    cdmisfa("index", logs)
    words = ("curate", logs, "--force", "-o")
    done = cdmisfa(*words, out, "--budget", "60s")
    assert done.code == 0, done.err
    assert "s of the budget of 60.0 s: nothing else is new" in done.out
    assert f"1 segment written to {out}" in done.out
    assert re.search(r"^twice.npy +- +- +- +-$", done.out, re.MULTILINE)
    assert "none can be cut out" in done.err
    assert "cdmisfa cut" not in done.err + (out / "index.html").read_text("utf-8")
    write_images(logs / "day.mcap", {"/camera": [(t * 50, still[0] // 2) for t in range(80)]})
    cdmisfa("index", logs)
    assert "cut out 1 of 2: cdmisfa cut" in cdmisfa(*words, out, "--budget", "60s").err
    done = cdmisfa(*words, out, "--budget", "1s")
    assert "0 segments" in done.out
    assert "no other block that is new fits" in done.out
    assert "cut" not in done.err.replace(str(tmp_path), "")
