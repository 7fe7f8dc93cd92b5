"""Cameras on one clock: what is shown, what is missing, and that a recording gives the same."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Cdmisfa
from contracts.sources import same
from live_cameras import BEGIN, SHAPE, Arrival, Hand, ScriptedReaders, bar
from waiting import wait_for

from cdmisfa.agents.progress.config import ProgressConfig
from cdmisfa.core.blocks import FrameSource, SeekableSource
from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.errors import LogExhaustedError, UsageError
from cdmisfa.experiments.run_folder import RunResult
from cdmisfa.experiments.session import run_session
from recorder.cameras.live import LiveSource, Steady
from recorder.cameras.readers import Readers
from recorder.live import COUNTS, LiveRecorder, record_live
from replay.integrity.info import describe
from replay.integrity.verify import check_log
from replay.open_sources import open_recording

FPS = 30.0


def flat(value: int) -> Any:
    return np.full(SHAPE, value, np.uint8)


def steady(stream: int, start: float, count: int, fps: float = FPS) -> list[Arrival]:
    return [Arrival(start + k / fps, stream, flat(k % 256)) for k in range(count)]


def opened(script: Sequence[Arrival], streams: int = 1, **options: Any) -> LiveSource:
    names = ("left", "right", "third")[:streams]
    rate = options.pop("states", FPS)
    return LiveSource(ScriptedReaders(script, streams, rate), names, {}, **options)


def values(source: FrameSource, n: int) -> list[tuple[int, int, list[int]]]:
    blocks = source.take_all(n)
    return [(b.stream, b.t, b.frames[:, 0, 0].tolist()) for b in blocks]


def late() -> list[Arrival]:
    """Pictures 10 to 25 are taken in time, but half a second on their way."""
    script = steady(0, 0, 60)
    for k in range(10, 26):
        script[k] = script[k]._replace(comes=10 / FPS + 0.5 + (k - 10) * 1e-6, taken=k / FPS)
    return script


def disordered() -> list[Arrival]:
    script = steady(0, 0, 30)
    script[8] = script[8]._replace(comes=9.5 / FPS, taken=8 / FPS)
    return script


PAUSED = [arrival for arrival in steady(0, 0, 90) if not 1 < arrival.comes < 2]
EACH_TICK = {
    "steady": (
        [steady(0, 0, 40), steady(1, 0.01, 40)],
        {},
        [(0, 0, [*range(13)]), (1, 0, [*range(13)])],
        {"left repeated": 0, "left dropped": 0, "left missing": 0, "right repeated": 0},
    ),
    "a slower one repeats, a faster one drops": (
        [steady(0, 0, 60), steady(1, 0, 20, 10), steady(2, 0, 120, 60)],
        {},
        [(0, 0, [0, 1, 2, 3, 4, 5]), (1, 0, [0, 0, 0, 1, 1, 1]), (2, 0, [1, 3, 5, 7, 9, 11])],
        {"right repeated": 4, "third dropped": 6},
    ),
    "a stall is a gap, no picture that stands still": (
        [PAUSED, steady(1, 0, 90)],
        {"hold": 0.1},
        [(0, 0, [*range(31), 30, 30]), (0, 60, [*range(60, 70)]), (1, 0, [*range(70)])],
        {"left missing": 27, "left repeated": 2},
    ),
    # it waits 0.2 s for picture 10, 11 ... of which those are late whose ticks had to be decided
    "too late a picture changes no tick and keeps its time": (
        [late(), steady(1, 0, 60)],
        {"hold": 0.02},
        [(0, 0, [*range(10)]), (0, 19, [*range(19, 40)]), (1, 0, [*range(40)])],
        {"left late": 9, "left missing": 9},
    ),
    "in the wrong order they are not shown": (
        [disordered()],
        {"hold": 1.0},
        [(0, 0, [0, 1, 2, 3, 4, 5, 6, 7, 7, 9, 10, 11])],
        {"left disordered": 1},
    ),
}


@pytest.mark.parametrize(
    ("scripts", "options", "shown", "counts"), EACH_TICK.values(), ids=EACH_TICK
)
def test_each_tick_shows_the_last_picture_at_or_before_it(
    scripts: list[list[Arrival]], options: Any, shown: Any, counts: dict[str, int]
) -> None:
    source = opened([arrival for script in scripts for arrival in script], len(scripts), **options)
    assert isinstance(source, FrameSource)
    assert not isinstance(source, SeekableSource)
    ticks = max(t + len(frames) for _, t, frames in shown)
    assert values(source, ticks) == shown
    assert source.t == ticks
    for what, count in counts.items():
        stream, counted = what.split()
        assert source.alignment[stream][counted] == count


def test_a_block_is_unbroken_and_the_clock_goes_on_behind_it() -> None:
    source = opened([*PAUSED, *steady(1, 0, 90)], 2, hold=0.02)
    assert source.take(0, 20).t == 0
    block = source.take(0, 20)
    assert (block.t, source.t) == (60, 80)
    assert block.frames[:, 0, 0].tolist() == list(range(60, 80))


def test_the_clock_has_the_rate_that_is_stated_measured_or_asked_for() -> None:
    two = opened([*steady(0, 0, 40), *steady(1, 0.01, 40)], 2)
    # it begins half a tick after the first picture of the last camera
    assert (two.spec.start_ns, two.spec.fps) == (BEGIN + 10**7 + round(1e9 / 60), FPS)
    assert opened(steady(0, 0, 30, 12.5), states=None).spec.fps == 12.5
    assert opened(steady(0, 0, 30), rate=7.5).spec.fps == 7.5
    with pytest.raises(UsageError, match="states no rate: set one with --rate"):
        opened(steady(0, 0, 1), states=None)


def test_it_ends_with_the_first_camera_that_ends() -> None:
    source = opened([*steady(0, 0, 30), *steady(1, 0, 60)], 2)
    source.take_all(28)
    with pytest.raises(LogExhaustedError, match="camera 0 ended"):
        source.take_all(3)
    assert source.t == 28
    assert values(source, 2) == [(0, 28, [28, 29]), (1, 28, [28, 29])]


def rough(seconds: float = 40.0) -> list[Arrival]:
    """Three cameras with jitter, lost pictures, stalls, late and disordered ones."""
    rng = np.random.default_rng(5)
    script = []
    for stream, fps in enumerate((30.0, 30.0, 25.0)):
        for k in range(int(seconds * fps)):
            taken = k / fps + 0.004 * rng.random()
            delay = 0.01 + (0.4 if rng.random() < 0.02 else 0.01) * rng.random()
            stalled = stream == k // 200 % 4 and k % 200 < 40
            held_up = stream == 1 and taken % 10 < 0.5  # all of half a second comes at once
            comes = taken - taken % 10 + 0.5 + k * 1e-6 if held_up else taken + delay
            if not stalled and rng.random() > 0.01:
                script.append(Arrival(comes, stream, bar(stream, k), taken))
    return script


CONFIGS = [
    LearnerConfig(tau=20, components=3, expansion="none", warm_up=3),
    ProgressConfig(tau=20, components=3, outputs=1),
]


def learned(source: FrameSource, config: Any) -> RunResult:
    result = run_session(source, config, max_modules=99)
    assert result.ended == "log_exhausted"
    return result


@pytest.mark.parametrize(
    ("config", "split"),
    [(CONFIGS[0], None), (CONFIGS[1], 9.0)],
    ids=["curious", "progress in parts"],
)
def test_what_is_learned_live_is_learned_again_from_the_recording(
    tmp_path: Path, config: Any, split: float | None
) -> None:
    with LiveRecorder(opened(rough(), 3), tmp_path / "rec", split=split) as live:
        first = learned(live, config)
    counts = live.alignment
    for name in ("repeated", "dropped", "missing", "late", "disordered"):
        assert sum(count[name] for count in counts.values()) > 0, name
    with open_recording(tmp_path / "rec") as source:
        again = learned(source, config)
    assert again.signals_sha256 == first.signals_sha256
    assert again.iterations == first.iterations > 20
    assert check_log(tmp_path / "rec").ok
    held = {file.name: 0 for file in live.files}
    for file in live.files:
        held[file.name] += file.frames
    for name, count in counts.items():
        assert held[name] + count["missing"] == pytest.approx(live.t, abs=20)
    stated = describe(tmp_path / "rec").metadata
    last = {name: records[COUNTS] for name, records in stated.items() if COUNTS in records}
    assert [int(last[name]["missing"]) for name in sorted(last)] == [
        counts[name]["missing"] for name in sorted(counts)
    ]


def test_a_live_run_that_ends_within_a_block_is_checked_by_its_recording(
    tmp_path: Path, cdmisfa: Cdmisfa
) -> None:
    script = [*steady(0, 0, 100), *steady(0, 5, 30)]  # a gap, and less than a block behind it
    with LiveRecorder(opened(script), tmp_path / "rec") as live:
        run_session(
            live, ProgressConfig(tau=40, components=3, outputs=1), tmp_path / "run", rerun=False
        )
    assert live.t > 100
    checked = cdmisfa("check", tmp_path / "run", "--source", tmp_path / "rec")
    assert (checked.code, checked.out) == (
        0,
        "iterations 0 to 1: learned again, they are identical, bit for bit\n",
    )


class Cameras:
    """Real threads that read cameras handed pictures by the test."""

    def __init__(self, count: int = 2, **options: Any) -> None:
        self.said: list[str] = []
        self.hands = [Hand(name) for name in ("left", "right")[:count]]
        self.readers = Readers(self.hands, say=self.said.append, **options)

    def source(self) -> LiveSource:
        for hand in self.hands:
            hand.give(flat(0))
        names = [hand.name for hand in self.hands]
        return LiveSource(self.readers, names, {})

    def close(self, source: LiveSource) -> None:
        for hand in self.hands:
            hand.give(*[None] * 4)
        source.close()

    def show(self, n: int, *which: int) -> Callable[[], None]:
        """Let cameras show n pictures at their rate, in the background."""

        def shows() -> None:
            for k in range(n):
                time.sleep(0.02)
                for number in which:
                    self.hands[number].give(flat(k))

        thread = threading.Thread(target=shows)
        thread.start()
        return thread.join


GONE, HANGS = "right is lost: unplugged", "right: no image for 0.3 s"


@pytest.mark.parametrize(
    ("on_loss", "why", "then"),
    [
        ("reconnect", GONE, ": reconnecting"),
        ("reconnect", HANGS, ": reconnecting"),
        ("wait", GONE, ": the other cameras continue without it"),
        ("wait", HANGS, ": waiting"),
        ("end", GONE, ""),
        ("end", HANGS, ""),
    ],
)
def test_a_camera_that_is_lost_is_a_gap_or_the_end(on_loss: Any, why: str, then: str) -> None:
    cameras = Cameras(stall=0.3, on_loss=on_loss)
    source, right = cameras.source(), cameras.hands[1]
    join = cameras.show(60, 0)
    if why == GONE:
        right.give(OSError("unplugged"))
    if on_loss == "end":
        with pytest.raises(LogExhaustedError, match=why):
            source.take_all(200)
    else:
        source.take_all(40)
        if on_loss == "reconnect":
            wait_for(lambda: right.opened >= 2, seconds=20)
        if (on_loss, why) != ("wait", GONE):
            right.give(*[flat(7)] * 3)
        if why == HANGS:
            wait_for(lambda: "right delivers images again" in cameras.said, seconds=20)
        assert cameras.said[0] == why + then
        assert (right.opened > 1) is (on_loss == "reconnect")
        assert source.alignment["right"]["missing"] > 0
    join()
    cameras.close(source)


def test_a_full_queue_is_emptied_and_says_so() -> None:
    cameras = Cameras(1, queue_bytes=10 * flat(0).nbytes)
    source = cameras.source()
    cameras.hands[0].give(*[flat(k) for k in range(25)])
    wait_for(lambda: source.alignment["left"]["lost"] == 20, seconds=20)
    lost = "left: discarded 10 images: they came faster than they were used"
    assert cameras.said == [lost, lost]
    cameras.close(source)


def test_a_recording_with_gaps_is_shown_with_its_gaps(tmp_path: Path) -> None:
    source = opened([*PAUSED, *steady(1, 0, 90)], 2, hold=0.02)
    record_live(LiveRecorder(source, tmp_path / "rec"), frames=90)
    assert check_log(tmp_path / "rec").ok
    with open_recording(tmp_path / "rec", loop=True) as looped:
        looped.seek(85)
        block = looped.take(0, 10)
        # it goes on at its beginning without a cut, as a programme that starts again
        assert (block.t, block.frames[:, 0, 0].tolist()) == (85, [*range(85, 90), *range(5)])
        live = opened([*PAUSED, *steady(1, 0, 90)], 2, hold=0.02)
        looped.seek(0)
        for n in (1, 40, 30):
            for one, two in zip(live.take_all(n), looped.take_all(n), strict=True):
                same(one, two)


def test_frames_are_stamped_by_their_presentation_times_and_not_by_their_coming() -> None:
    steady = Steady()
    rng = np.random.default_rng(1)
    presented = np.arange(3000) / 30
    comes = (
        presented * (1 + 1e-4) + 100 + 0.005 + 0.04 * rng.random(3000) * (rng.random(3000) < 0.5)
    )
    taken = [now - steady.age(now, at) / 1e9 for now, at in zip(comes, presented, strict=True)]
    error = (np.array(taken) - (presented * (1 + 1e-4) + 100.005))[10:]
    assert -1e-9 <= error.min() <= error.max() < 2e-3
    later, last = comes[-1] + 7, presented[-1]
    # held up for long, they keep their times; after a pause, they begin anew
    ages = [steady.age(later + k / 30, last + k / 30) for k in range(80)]
    assert min(ages[:50]) > 6.9e9
    assert max(ages[70:]) < 1e7
    assert steady.age(later + 3, last + 30) == 0
    assert steady.age(0.0, None) == 0
