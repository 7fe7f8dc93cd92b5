"""What is recorded when it is novel: all of it, with what was before and after, and no more."""

from __future__ import annotations

import itertools
import json
import re
import shlex
import signal
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Cdmisfa
from live_cameras import SHAPE, Arrival, ScriptedReaders
from waiting import python, started, wait_for

from cdmisfa import ArraySource, Run
from cdmisfa.agents.progress.config import ProgressConfig
from cdmisfa.core.blocks import Block, FrameSource
from cdmisfa.core.errors import LogExhaustedError, UsageError
from cdmisfa.experiments.apply import Application
from cdmisfa.experiments.session import run
from recorder.cameras.live import LiveSource
from recorder.config import Split
from recorder.live import SEGMENT, TRIGGERED, RecordedWhileWatched, record_watched
from replay.corpus.triggered import Trigger, TriggeredSource
from replay.integrity.info import describe
from replay.integrity.verify import check_log
from replay.recordings.source import RecordedSource

ROOT = Path(__file__).parents[1]
FPS = 30
TAU = 2 * FPS
TEST = "av:lavfi:testsrc=size=160x120:rate=30"


def pendulum(k: int, stream: int) -> np.ndarray[Any, Any]:
    """A bar that swings, once in two seconds."""
    picture = np.full(SHAPE, 60, np.uint8)
    picture[:, int(7.5 + 7 * np.sin(np.pi * k / FPS + stream))] = 160
    return picture


def cameras(
    seconds: int, events: Sequence[tuple[float, float]], lost: tuple[float, float] = (0, 0)
) -> LiveSource:
    """Two cameras; in the events the left one's light flickers, the right one loses pictures."""
    rng = np.random.default_rng(4)
    script = []
    for k in range(seconds * FPS):
        at = k / FPS
        for stream in (0, 1):
            picture = pendulum(k, stream)
            if stream == 0 and any(low <= at < high for low, high in events):
                picture = 255 - np.roll(picture, 3 * k, axis=0) // 2 * (k // 9 % 2)
            if not (stream == 1 and lost[0] <= at < lost[1]):
                script.append(Arrival(at + 0.004 * rng.random(), stream, picture, at))
    return LiveSource(ScriptedReaders(script, 2, FPS), ("left", "right"), {}, hold=0.1)


class Scripted:
    """Says that what is in some frames is novel."""

    def __init__(self, novel: Sequence[tuple[int, int]]) -> None:
        self.novel = novel

    def triggers(self, blocks: Sequence[Block]) -> Iterator[Trigger]:
        for low, high in self.novel:
            if blocks and blocks[0].t <= low < blocks[0].t + len(blocks[0]):
                yield Trigger("a", low, high, 2.0)


def all_of(source: FrameSource, n: int) -> list[Block]:
    """What a source shows until it ends, so many frames at a time."""
    blocks: list[Block] = []
    try:
        while True:
            blocks += source.take_all(n)
    except LogExhaustedError:
        return blocks


@pytest.mark.parametrize("seed", range(12))
def test_kept_is_the_union_of_what_is_around_the_triggers(seed: int) -> None:
    rng = np.random.default_rng(seed)
    before, after = (int(x) for x in rng.integers(0, 150, 2))
    frames, step = int(rng.integers(300, 1500)), int(rng.choice([1, 1, 7, 50]))
    values = np.arange(frames, dtype=float)[:, None]
    lows = sorted({int(x) for x in rng.integers(0, frames - 3, 5)})
    novel = [(low, min(low + 9, low - low % TAU + TAU, frames)) for low in lows]
    source = TriggeredSource(
        ArraySource({"a": values, "b": -values}, fps=FPS), before=before / FPS, after=after / FPS
    )
    source._novelty = Scripted(novel)  # type: ignore[assignment]
    shown = all_of(source, step)
    end = frames - frames % step  # as of any source, the last frames are no whole block
    wanted = {t for low, high in novel for t in range(low - before, high + after)} & {*range(end)}
    for stream, sign in ((0, 1), (1, -1)):
        own = [block for block in shown if block.stream == stream]
        held = [t for block in own for t in range(block.t, block.t + len(block))]
        assert held == sorted(wanted)  # each once and in order
        assert [x for block in own for x in (sign * block.frames[:, 0]).tolist()] == held
    kept = {t for segment in source.segments for t in range(segment.start, segment.stop)}
    assert kept & {*range(end)} == wanted
    assert source.held <= step
    assert source.triggered()["watched"] == frames


def test_no_more_is_held_than_what_is_before_and_a_block() -> None:
    most = 0
    frames = np.random.default_rng(0).normal(size=(3000, 4))  # noise
    source = TriggeredSource(ArraySource({"a": frames}, fps=FPS), before=3, after=0)
    for _ in range(2000):
        assert source.take_all(1) == ()
        most = max(most, source.held)
    assert most == 3 * FPS + TAU - 1
    assert source.segments == []


@pytest.mark.parametrize("kind", ["noise", "still", "a sensor before what is still"])
def test_noise_and_what_stands_still_never_trigger(kind: str) -> None:
    rng = np.random.default_rng(1)
    frames = rng.integers(0, 256, (600, *SHAPE), np.uint8)
    if kind != "noise":
        step = np.zeros((600, 1, 1)) if kind == "still" else rng.normal(0, 3, (600, 12, 16))
        frames = (frames[:1] // 2 + 60 + step).astype(np.uint8)
    source = TriggeredSource(ArraySource({"a": frames}, fps=FPS), before=5, after=5)
    assert all_of(source, 1) == []


def joined(ranges: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Ranges, those that go on in the next part as one."""
    ends = [0, *(i for i in range(1, len(ranges)) if ranges[i - 1][1] < ranges[i][0]), len(ranges)]
    return [(ranges[a][0], ranges[b - 1][1]) for a, b in itertools.pairwise(ends)]


EVENTS = [(30.0, 32.0), (61.0, 62.5)]


@pytest.mark.parametrize("split", [None, Split.parse("9s")], ids=["whole", "in parts"])
def test_planted_events_are_recorded_with_all_around_them(
    tmp_path: Path, split: Split | None
) -> None:
    said: list[str] = []
    live = cameras(90, EVENTS, lost=(31.0, 31.5))
    source = TriggeredSource(live, before=3, after=2, say=said.append)
    record_watched(RecordedWhileWatched(source, tmp_path / "rec", split=split))
    segments = source.segments
    assert len(segments) == 3  # the first is what is usual here
    for (low, high), segment in zip(EVENTS, segments[1:], strict=True):
        assert segment.start <= (low - 2.9) * FPS
        assert segment.stop >= (high + 1.9) * FPS
        assert segment.triggers[0].stream == "left"
    novel = [(x.start, x.stop) for segment in segments for x in segment.triggers]
    wanted = {t for low, high in novel for t in range(max(low - 90, 0), high + 60)}
    whole = cameras(90, EVENTS, lost=(31.0, 31.5))
    shown = {(b.stream, b.t): b for b in all_of(whole, 1)}
    with RecordedSource(tmp_path / "rec") as recorded:
        held = recorded.coverage()
        ranges = [(segment.start, segment.stop) for segment in segments]
        assert joined(held["left"]) == ranges
        right = {t for low, high in held["right"] for t in range(low, high)}
        assert right == {t for stream, t in shown if stream == 1 and t in wanted}
        assert len(joined(held["right"])) == 4  # its own gap, too
        for low, high in ranges:
            recorded.seek(low)
            block = recorded.take(0, high - low)
            assert block.t == low
            assert [recorded.spec.time_ns(t) for t in (low, high)] == [
                whole.spec.time_ns(t) for t in (low, high)
            ]
            for t, frame in enumerate(block.frames, low):
                assert np.array_equal(frame, shown[0, t].frames[0])
    assert check_log(tmp_path / "rec").ok
    assert [line.partition(" at ")[0] for line in said if line.startswith("novel")] == ["novel"] * 3
    stated = [r for r in describe(tmp_path / "rec").metadata.values() if TRIGGERED in r]
    assert len(stated) == 2  # in each view
    for records in stated:
        told = {k: json.loads(v) for k, v in records[TRIGGERED].items() if k != "when"}
        assert told["segments"] == source.triggered()["segments"]
        assert (told["watched"], told["kept"]) == (live.t, len(wanted))
    begun = {k: r[k] for r in describe(tmp_path / "rec").metadata.values() for k in r}
    assert [int(begun[f"{SEGMENT}{i}"]["start"]) for i in range(3)] == [low for low, _ in ranges]


def test_live_and_from_the_recording_the_same_is_learned(tmp_path: Path) -> None:
    config = ProgressConfig(tau=20, components=3, outputs=1)
    source = TriggeredSource(cameras(90, EVENTS, lost=(31.0, 31.5)), before=3, after=2)
    with RecordedWhileWatched(source, tmp_path / "rec") as live:
        first = run(live, config, max_modules=99)
    with RecordedSource(tmp_path / "rec") as recorded:
        again = run(recorded, config, max_modules=99)
    assert again.signals_sha256 == first.signals_sha256
    assert again.iterations == first.iterations > 20


def test_a_stop_keeps_what_is_held_and_is_novel() -> None:
    values = np.sin(np.arange(900)[:, None] / 7 + np.arange(3))
    source = TriggeredSource(ArraySource({"a": values}, fps=FPS), before=3, after=9)
    given = [block for _ in range(35) for block in source.take_all(1)]
    source.stop = lambda: True
    given += all_of(source, 1)
    assert sum(map(len, given)) == source.triggered()["kept"] == TAU
    assert [block.t for block in given] == [*range(TAU)]


def test_more_than_fits_is_refused_with_what_fits() -> None:
    frames = np.zeros((2, 480, 640), np.uint8)
    source = ArraySource({"a": frames, "b": frames}, fps=FPS)
    TriggeredSource(source, before=56.2, after=1e9)
    what = (
        "--before 60s holds 1,800 frames of 640x480 of 2 streams in memory, 1.14 GB: ask for 56.2s"
    )
    with pytest.raises(UsageError, match=what):
        TriggeredSource(source, before=60, after=0)


REFUSED = {
    "record oscillatory -o x --before 2s": "--before goes with --when novel",
    "record oscillatory -o x --known run": "--known goes with --when novel",
    "record oscillatory -o x --when novel --before 5": "is no duration: write 90s, 10min or 2h",
    "record oscillatory -o x --when novel --known nothing": "nothing",
    "record oscillatory -o x --when novel --resume": "leave out --resume",
    "record oscillatory -o x --when novel --before 9000h": "in memory",
    "record oscillatory -o x --when novel --size 32x24": "--size is for cameras",
    "record here.mcap -o x --when novel": "is a log, no scene",
    "record -o x --when novel": "name the SCENE",
}


@pytest.mark.parametrize(("words", "why"), REFUSED.items())
def test_what_cannot_be_is_refused_in_one_line(
    cdmisfa: Cdmisfa, tmp_path: Path, words: str, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "here.mcap").touch()
    refused = cdmisfa(*words.split())
    assert refused.code == 2
    assert why in refused.err.splitlines()[-1]
    assert [path.name for path in tmp_path.iterdir()] == ["here.mcap"]


def test_what_a_run_knows_is_not_recorded(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    run_of = ("--algorithm", "progress", "--no-rerun", "-o", tmp_path / "run")
    cdmisfa("record", "oscillatory", "--frames", 6000, "-o", tmp_path / "all")
    assert cdmisfa("learn", tmp_path / "all", *run_of).code == 0
    known = {module.stream for module in Run(tmp_path / "run").modules}
    words = ("record", "oscillatory", "--when", "novel", "--known", tmp_path / "run", "--json")
    words = (*words, "--frames", 2000, "--before", "1s", "--after", "1s")
    done = cdmisfa(*words, "-o", tmp_path / "rec")
    assert done.code == 0, done.err
    by = {t["stream"] for s in done.json["triggered"]["segments"] for t in s["triggers"]}
    assert by == {"x1", "x2", "x3"} - known != set()
    assert "kept 2000 of 2000 frames" in done.err
    alone = f"scene.streams={','.join(sorted(known))}"
    done = cdmisfa(*words, "-o", tmp_path / "none", "--set", alone)
    assert (done.code, done.json["triggered"]["segments"]) == (0, []), done.err
    assert "kept 0 of 2000 frames (0.0%) in 0 segments" in done.err
    shown = cdmisfa("info", tmp_path / "none")
    assert shown.code == 0
    assert "only what is novel: 0 segments, 0 of 2000 frames" in shown.out
    empty = cdmisfa("learn", tmp_path / "none")
    assert (empty.code != 0, empty.err.count("\n")) == (True, 1)


def test_larger_pictures_are_judged_as_the_run_saw_them(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    small = np.stack([pendulum(k, 0) for k in range(6000)])
    np.save(tmp_path / "small.npy", small)
    words = ("learn", tmp_path / "small.npy", "--algorithm", "progress", "--max-modules", 1)
    done = cdmisfa(*words, "--no-rerun", "-o", tmp_path / "run")
    assert done.code == 0, done.err
    application = Application(tmp_path / "run")
    n = application.tau

    def judged(frames: np.ndarray[Any, Any]) -> Any:
        source = ArraySource({"a": frames}, fps=FPS)
        (applied,) = application.judge(source.spec)(source.take_all(n))
        return applied.y

    assert np.array_equal(judged(small[:n].repeat(3, 1).repeat(3, 2)), judged(small[:n]))
    with pytest.raises(UsageError, match="is smaller than the frames"):
        judged(small[:n, ::2, ::2])


def novel(rec: Path, number: int, least: int) -> tuple[int, str]:
    """The exit code and words of such a recording that is sent a signal once it has some bytes."""
    partial = rec / "lavfi_testsrc.mcap.partial"
    with started("record", TEST, "-o", rec, "--when", "novel", "--size", "80x60") as process:
        wait_for(lambda: partial.exists() and partial.stat().st_size > least, 60, process)
        time.sleep(0.3)
        process.send_signal(number)
        _, said = process.communicate(timeout=60)
    return process.returncode, said


def test_ctrl_c_finishes_it(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    code, said = novel(tmp_path / "rec", signal.SIGINT, 8000)
    assert code == 0, said
    assert "novel at frame 0 (0.0 s): lavfi_testsrc (nothing before); kept from frame 0" in said
    assert "in 1 segment" in said
    shown = cdmisfa("info", tmp_path / "rec").out
    assert "only what is novel: 1 segment, " in shown
    assert "triggered by lavfi_testsrc at frame 0" in shown


def test_killed_it_can_be_read_and_says_why(cdmisfa: Cdmisfa, tmp_path: Path) -> None:
    novel(tmp_path / "rec", signal.SIGKILL, 8000)
    shown = cdmisfa("info", tmp_path / "rec")
    assert "only what is novel: 1 segment so far, triggered by lavfi_testsrc at" in shown.out
    refused = cdmisfa("record", "-o", tmp_path / "rec", "--resume")
    assert (refused.code, "cannot go back" in refused.err) == (2, True)
    cdmisfa("recover", tmp_path / "rec", "-o", tmp_path / "saved")
    with RecordedSource(tmp_path / "saved") as source:
        assert source.frames > 0


def test_a_disk_that_is_full_is_one_line(tmp_path: Path) -> None:
    code = (
        "import resource, sys\n"
        "from cdmisfa.cli import main\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (30_000, -1))\n"
        "main()\n"
    )
    words = ("record", "oscillatory", "-o", tmp_path / "rec", "--when", "novel", "--frames", 3000)
    done = python("-c", code, *words)
    assert done.returncode == 1
    assert "cannot be written: File too large" in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr
    with RecordedSource(tmp_path / "rec") as source:
        assert source.frames > 0


def test_the_commands_of_the_page_work(
    cdmisfa: Cdmisfa, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = (ROOT / "docs" / "how-to" / "novel.md").read_text("utf-8")
    monkeypatch.chdir(tmp_path)
    lines = "".join(re.findall(r"^```sh\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)).splitlines()
    assert lines
    for program, *words in map(shlex.split, lines):
        assert program == "cdmisfa"
        done = cdmisfa(*words)
        assert done.code == 0, done.err
