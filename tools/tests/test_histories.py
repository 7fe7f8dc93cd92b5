"""Whatever happens to a recording and to a run of it: its signals are those of its files."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from folders import contents
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from tools.torture.histories import MOST, TAU, WORLDS, History

worlds = st.sampled_from(WORLDS)
splits = st.sampled_from((None, "1s", "3s"))
frames = st.integers(2, MOST // 10).map(lambda tens: 10 * tens)
calls = st.none() | st.integers(0, 50)
"""Before which call of those that write the process is killed."""


class Histories(RuleBasedStateMachine):
    """Record, split, kill, resume, force, follow, learn and verify in any order."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp(prefix="history-"))
        self.history = History(self.folder)

    def teardown(self) -> None:
        self.history.leave()
        shutil.rmtree(self.folder)

    @rule(world=worlds, frames=frames, split=splits, force=st.booleans(), die=calls)
    def record(self, world: tuple[str, int], frames: int, split: str | None, **how: object) -> None:
        self.history.record(world, frames, split, **how)  # type: ignore[arg-type]

    @rule(die=calls)
    def resume(self, die: int | None) -> None:
        self.history.resume(die)

    @rule(
        iterations=st.integers(1, MOST // TAU - 1),
        how=st.sampled_from(("new", "force", "resume")),
        follow=st.booleans(),
        die=calls,
    )
    def learn(self, iterations: int, how: str, *, follow: bool, die: int | None) -> None:
        self.history.learn(iterations, how=how, follow=follow, die=die)

    @rule(frames=st.integers(1, 90))
    def follow(self, frames: int) -> None:
        self.history.follow(frames)

    @rule()
    def leave(self) -> None:
        self.history.leave()

    @rule()
    def verify(self) -> None:
        self.history.verify()

    @invariant()
    def the_run_is_of_one_world(self) -> None:
        self.history.check_run()


TestHistories = Histories.TestCase
TestHistories.settings = settings(
    max_examples=12,
    stateful_step_count=10,
    deadline=None,
    derandomize=True,
    suppress_health_check=list(HealthCheck),
)


def test_a_whole_run_stays_as_it_is_where_it_cannot_be_gone_back_to(tmp_path: Path) -> None:
    world = ("unseeded", 1)
    history = History(tmp_path)
    history.record(world, MOST, None, force=False)
    history.learn(18, how="new", follow=True)
    before = contents(history.run)
    history.record(world, MOST - 80, None, force=True)
    history.learn(19, how="resume", follow=True)
    assert history.errors == 1
    assert contents(history.run) == before
    history.verify()
