"""The plugins do what cdmisfa expects of each kind."""

from __future__ import annotations

from cdmisfa_toy.camera import Bars
from cdmisfa_toy.export import CONTACT, REWARDS
from cdmisfa_toy.learner import Watcher, WatcherConfig
from cdmisfa_toy.scene import SwingConfig, Swings

from cdmisfa.core.blocks import SeekableSource, SourceSpec
from cdmisfa.core.learning import Learner
from cdmisfa.testing import CameraContract, FormContract, LearnerContract, SourceContract
from recorder import RecordConfig
from recorder.cameras import Camera


class TestSwings(SourceContract):
    def open(self) -> SeekableSource:
        return Swings(SwingConfig(seed=4), RecordConfig())


class TestBars(CameraContract):
    def open(self) -> Camera:
        return Bars("bars:5", "bars")


class TestWatcher(LearnerContract):
    def open(self, spec: SourceSpec, seed: int) -> Learner:
        return Watcher(WatcherConfig(), spec, seed)


class TestContact(FormContract):
    form = CONTACT


class TestRewards(FormContract):
    form = REWARDS
