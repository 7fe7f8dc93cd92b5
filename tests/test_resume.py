"""A run that was stopped, in whatever way, goes on as if it never had been."""

from __future__ import annotations

import contextlib
import json
import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import Cdmisfa
from folders import contents
from run_data import parts_of, read_signals
from waiting import running, wait_for

from cdmisfa.agents.learner import CuriousLearner
from cdmisfa.core.blocks import Block, FrameSource
from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.errors import CdmisfaError, LogDamagedError, UsageError
from cdmisfa.core.learning import Keyframe, Learner, Sink
from cdmisfa.core.signals import BlockSignals
from cdmisfa.experiments.loop import Keyframes
from cdmisfa.experiments.run_folder import SET_ASIDE, RunResult
from cdmisfa.experiments.session import run_session
from recorder.config import RecordConfig
from recorder.mcap.reader import LogReader
from recorder.recording import record_scene
from recorder.world.icub.config import IcubConfig
from recorder.world.oscillatory import OscillatorySource
from replay.open_sources import open_recording
from replay.runs.compare import first_difference
from replay.runs.folders import run_log
from replay.runs.keyframes import KEYFRAME_TOPIC, read_keyframe

CONFIG = LearnerConfig(
    tau=40, eta_dot_window=8, warm_up=3, delta=1.0, min_variance=1e-6, novel_share=0.0
)
"""Saves its first module at iteration 8 and its second at 42."""

LENGTH = 90
EVERY = 20


class ForwardOnly:
    """The oscillatory streams as a camera would show them."""

    def __init__(self) -> None:
        source = OscillatorySource()
        self.spec, self.take, self.take_all = source.spec, source.take, source.take_all
        self.t, self.describe, self.close = 0, source.describe, source.close


class Told(Sink):
    """Calls a function with the learner after every block."""

    def __init__(self, tell: Callable[[Learner], object]) -> None:
        self.tell = tell

    def block(self, block: Block, signals: BlockSignals, learner: Learner) -> None:
        self.tell(learner)


def keyframes(out: Path) -> list[int]:
    """Iterations after which a run's log holds keyframes."""
    with LogReader(run_log(out)) as reader:
        return [m.sequence for m in reader.messages([KEYFRAME_TOPIC])]


def go(
    source: FrameSource, out: Path | None, iterations: int, config: LearnerConfig = CONFIG, **more
) -> RunResult:
    more = {"max_modules": 99, "seed": 3, "rerun": False, "keyframes": EVERY} | more
    return run_session(source, config, out, max_iterations=iterations, **more)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that was never stopped."""
    out = tmp_path_factory.mktemp("whole") / "run"
    modules = go(OscillatorySource(), out, LENGTH).modules
    assert [module.iteration for module in modules] == [8, 42]
    return out


@pytest.mark.parametrize("stopped", [1, EVERY - 1, EVERY, 43, 47, LENGTH])
def test_a_stopped_run_goes_on_bit_for_bit(whole: Path, tmp_path: Path, stopped: int) -> None:
    out = tmp_path / "run"
    go(OscillatorySource(), out, stopped)
    result = go(OscillatorySource(), out, LENGTH, resume=True)
    assert first_difference(whole, out) is None
    assert result.signals_sha256 == go(OscillatorySource(), None, LENGTH).signals_sha256
    assert not list(out.glob("*.partial"))
    assert keyframes(out) == sorted({*range(EVERY, LENGTH + 1, EVERY), stopped, LENGTH})
    assert f"resumed at iteration {stopped}" in [e.text for e in parts_of(out, "events")]


def test_a_recording_that_ended_goes_on_to_the_same_end(tmp_path: Path) -> None:
    record_scene("oscillatory", tmp_path / "log", frames=30 * CONFIG.tau)
    source = open_recording(tmp_path / "log")
    for resume in (False, True):
        result = go(source, tmp_path / "run", LENGTH, resume=resume)
        assert (result.ended, result.iterations) == ("log_exhausted", 30)
    assert len(list(read_signals(tmp_path / "run"))) == 30
    source.close()


def test_a_simulator_goes_on(tmp_path: Path) -> None:
    pytest.importorskip("pybullet")
    from recorder.world.scenes import open_scene

    def live() -> FrameSource:
        return open_scene("icub", IcubConfig(seed=1), RecordConfig())

    config = LearnerConfig(tau=10, components=3, expansion="none")
    source = live()
    straight = go(source, None, 10, config)
    source.close()
    for iterations, resume in ((6, False), (10, True)):
        source = live()
        result = go(source, tmp_path / "run", iterations, config, keyframes=4, resume=resume)
        source.close()
    assert result.signals_sha256 == straight.signals_sha256


SLOW = """
import sys, time
from pathlib import Path
import test_resume as case
from recorder.world.oscillatory import OscillatorySource
case.go(OscillatorySource(), Path(sys.argv[1]), case.LENGTH, resume=sys.argv[2] == "resume",
        sinks=[case.Told(lambda _: time.sleep(.02))])
"""


def killed_when(out: Path, resume: bool, ready: Callable[[], bool]) -> None:
    """Run `SLOW` and kill -9 it once something has happened."""
    mode = "resume" if resume else "new"
    here = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    with running("-c", SLOW, out, mode, env=here) as process:
        wait_for(ready, 60, process)
    assert process.returncode == -signal.SIGKILL


def test_kill_9_anywhere_loses_nothing(whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    partial = out / "run.mcap.partial"

    def reached(iteration: int) -> Callable[[], bool]:
        def has() -> bool:
            with contextlib.suppress(CdmisfaError):  # the log is just being begun
                actual = read_keyframe(out)
                return actual is not None and actual.iteration >= iteration
            return False

        return has

    killed_when(out, False, lambda: partial.exists() and partial.stat().st_size > 20_000)
    killed_when(out, True, reached(2 * EVERY))
    result = go(OscillatorySource(), out, LENGTH, resume=True)
    assert first_difference(whole, out) is None
    assert result.signals_sha256 == go(OscillatorySource(), None, LENGTH).signals_sha256


def cut(share: float) -> Callable[[Path], None]:
    """Leave a part of the log, as a kill or a crash does."""

    def left(out: Path) -> None:
        go(OscillatorySource(), out, 57)
        log = (out / "run.mcap").read_bytes()
        (out / "run.mcap").unlink()
        (out / "run.mcap.partial").write_bytes(log[: int(len(log) * share)])

    return left


def killed_while_resuming(out: Path) -> None:
    go(OscillatorySource(), out, 50)
    half = (out / "run.mcap").read_bytes()
    (out / "run.mcap").rename(out / SET_ASIDE)
    (out / "run.mcap.partial").write_bytes(half[: len(half) // 3])


def killed_at_once(out: Path) -> None:
    out.mkdir()
    (out / "run.mcap.partial").write_bytes(b"")


@pytest.mark.parametrize(
    ("leave", "resumed_at"),
    [
        (cut(0.2), None),
        (cut(0.5), 20),
        (cut(0.8), 40),
        (cut(0.95), 57),
        (killed_while_resuming, 50),
        (killed_at_once, None),
    ],
)
def test_whatever_is_left_of_a_run_goes_on_from_its_newest_keyframe(
    whole: Path, tmp_path: Path, leave: Callable[[Path], None], resumed_at: int | None
) -> None:
    out = tmp_path / "run"
    leave(out)
    go(OscillatorySource(), out, LENGTH, resume=True)
    assert first_difference(whole, out) is None
    said = [event.text for event in parts_of(out, "events") if "resumed" in event.text]
    assert said == ([] if resumed_at is None else [f"resumed at iteration {resumed_at}"])


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"config": LearnerConfig(tau=40, nu=0.07)}, "learner.nu = 0.05, not 0.07"),
        ({"seed": 4}, "seed = 3, not 4"),
        ({"source": OscillatorySource(("x1", "x2"))}, "streams"),
        ({"source": OscillatorySource(fps=25.0)}, "spec.fps = 50.0, not 25.0"),
    ],
)
def test_a_changed_run_is_refused_and_left_alone(
    tmp_path: Path, change: dict[str, object], named: str
) -> None:
    out = tmp_path / "run"
    config = LearnerConfig(tau=40)
    go(OscillatorySource(), out, 20, config)
    before = contents(out)
    changed = {"source": OscillatorySource(), "config": config} | change
    with pytest.raises(UsageError, match=named):
        go(out=out, iterations=30, resume=True, **changed)
    assert contents(out) == before


def test_a_source_that_cannot_go_back_is_refused_and_the_run_left_alone(tmp_path: Path) -> None:
    out = tmp_path / "run"
    go(OscillatorySource(), out, 30)
    before = contents(out)
    with pytest.raises(UsageError, match=r"oscillatory cannot go back .* resume from a recording"):
        go(ForwardOnly(), out, 40, resume=True)
    assert contents(out) == before


def test_a_run_that_is_still_going_is_left_alone(tmp_path: Path) -> None:
    out = tmp_path / "run"
    refused: list[str] = []

    def meddle(_: Learner) -> None:
        for how in ({"resume": True}, {"force": True}):
            with pytest.raises(UsageError, match="in use by another process") as error:
                go(OscillatorySource(), out, 30, **how)
            refused.append(str(error.value))

    result = go(OscillatorySource(), out, 2, sinks=[Told(meddle)])
    assert len(refused) == 4
    assert result.signals_sha256 == go(OscillatorySource(), None, 2).signals_sha256


class RoomyLog:
    """Grows by so many bytes a block, and by so many a keyframe."""

    def __init__(self, block: int, keyframe: int) -> None:
        self.size, self.each, self.kept = 0, (block, keyframe), list[tuple[int, int]]()

    def keyframe(self, keyframe: Keyframe) -> None:
        self.size += self.each[1]
        self.kept.append((keyframe.iteration, self.size))

    def flush(self) -> None: ...


@pytest.mark.parametrize(
    ("block", "size", "every", "expected"),
    [
        (10**6, 10, None, [100, 200, 300]),
        (1000, 30_000, None, [100, 300]),
        (1, 30_000, None, []),
        (1, 30_000, 150, [150, 300]),
        (1, 30_000, 0, []),
    ],
)
def test_keyframes_wait_until_the_log_has_room_for_them(
    block: int, size: int, every: int | None, expected: list[int]
) -> None:
    source = OscillatorySource()
    learner = CuriousLearner(CONFIG, source.spec, 0)
    log = RoomyLog(block, size)
    keep = Keyframes(log, source, learner, {}, every)
    for _ in range(300):
        shown = source.take(learner.stream, learner.tau)
        signals = learner.step(shown)
        log.size += block
        keep.block(shown, signals, learner)
    assert [iteration for iteration, _ in log.kept] == expected


class TestWithoutItsSource:
    """`cdmisfa learn --resume -o RUN` takes the source, and how it was opened, from the run."""

    WORDS = ("--set", "learner.tau=25", "--seed", 4, "--loop", "--no-rerun", "--json")

    def test_it_goes_on_as_it_was_begun(
        self,
        cdmisfa: Cdmisfa,
        oscillatory_recording: Path,
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        run = tmp_path / "a" / "run"
        words = (oscillatory_recording, *self.WORDS)
        started = cdmisfa("learn", *words, "-o", run, "--max-iterations", 6)
        assert started.code == 0, started.err
        monkeypatch.chdir(run.parent)
        gone_on = cdmisfa(
            "learn", "--resume", "-o", "run", "--max-iterations", 30, "--no-rerun", "--json"
        )
        assert gone_on.code == 0, gone_on.err
        whole = cdmisfa("learn", *words, "--max-iterations", 30).json
        assert gone_on.json["signals_sha256"] == whole["signals_sha256"]
        assert gone_on.json["source"] == whole["source"]
        command = json.loads((run / "run.json").read_text())["command"]
        assert (command["seed"], command["loop"]) == (4, True)

    @pytest.mark.parametrize("limit", [("--max-iterations", 9), ("--max-modules", 1)])
    def test_it_ends_where_it_was_to_end(
        self, tmp_path: Path, cdmisfa: Cdmisfa, limit: tuple[str, int]
    ) -> None:
        words = ("oscillatory", *self.WORDS[:2], *limit)
        whole = cdmisfa("learn", *words, "-o", tmp_path / "run", "--no-rerun", "--json").json
        ended = cdmisfa("learn", "--resume", "-o", tmp_path / "run", "--no-rerun", "--json")
        assert ended.json["signals_sha256"] == whole["signals_sha256"]
        more = ("--resume", "-o", tmp_path / "run", limit[0], limit[1] + 1, "--max-iterations", 12)
        assert cdmisfa("learn", *more, "--no-rerun", "--json").json["iterations"] > 9

    def test_a_run_that_does_not_say(self, tmp_path: Path, cdmisfa: Cdmisfa) -> None:
        go(OscillatorySource(), tmp_path / "run", 3)
        refused = cdmisfa("learn", "--resume", "-o", tmp_path / "run")
        assert (refused.code, "does not state its source: name the" in refused.err) == (2, True)
        assert "--source" not in refused.err
        assert cdmisfa("learn", "--resume", "-o", tmp_path / "none").code == 2


def test_a_damaged_log_is_refused_before_anything_is_replaced(tmp_path: Path) -> None:
    go(OscillatorySource(), tmp_path, 60, force=True)
    data = bytearray((tmp_path / "run.mcap").read_bytes())
    data[len(data) // 4] ^= 255
    (tmp_path / "run.mcap").write_bytes(data)
    before = contents(tmp_path)
    with pytest.raises(LogDamagedError):
        go(OscillatorySource(), tmp_path, 90, resume=True)
    assert contents(tmp_path) == before
