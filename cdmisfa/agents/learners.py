"""The learners there are, by the name that `learner.algorithm` takes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from cdmisfa.agents.progress.config import ProgressConfig
from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.registry import Registry

if TYPE_CHECKING:  # the command line names the learners without numpy
    from cdmisfa.core.blocks import SourceSpec
    from cdmisfa.core.learning import Learner


@dataclass(frozen=True, slots=True)
class LearnerEntry:
    """How a learner is told what to do, and opened.

    Attributes:
        configuration: the dataclass of its keys `learner.*`; it has a field `algorithm`, whose
            default is the learner's name or that of a version of it.
        open: makes a learner from a configuration of that class, a source's spec and a seed.
        preset: the preset it takes where none is chosen; None for that of the scene.
    """

    configuration: type[Any]
    open: Callable[[Any, SourceSpec, int], Learner]
    preset: str | None = None


def _curious(config: LearnerConfig, spec: SourceSpec, seed: int) -> Learner:
    from cdmisfa.agents.learner import CuriousLearner  # not needed to read a key

    return CuriousLearner(config, spec, seed)


def _progress(config: ProgressConfig, spec: SourceSpec, seed: int) -> Learner:
    from cdmisfa.agents.progress.learner import ProgressLearner

    return ProgressLearner(config, spec, seed)


LEARNERS: Registry[LearnerEntry] = Registry(
    "learner.algorithm",
    {
        "2.0": LearnerEntry(LearnerConfig, _curious),
        "1.0": LearnerEntry(LearnerConfig, _curious),
        "progress": LearnerEntry(ProgressConfig, _progress, preset="cameras"),
    },
    group="cdmisfa.learners",
)
"""Every learner; `LEARNERS.add` and entry points `cdmisfa.learners` add others."""


def open_learner(config: Any, spec: SourceSpec, seed: int) -> Learner:
    """The learner that a configuration names, for a source.

    Args:
        config: of the class that the learner's entry names.
        spec: of the source.
        seed: seed of its random generators.

    Raises:
        UsageError: there is no such learner, or it cannot learn from such a source.
    """
    return LEARNERS[config.algorithm].open(config, spec, seed)
