"""The learners, by the name that `learner.algorithm` takes."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from dataclasses import dataclass, is_dataclass
from typing import TYPE_CHECKING, Any

from cdmisfa.agents.progress.config import ProgressConfig
from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.errors import Registry, UsageError, one_line

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
        preset: the preset it takes where none is chosen; None for that of the scene, whose keys
            `learner.*` are not for the class of a user.
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
)
"""The learners of this package; `learner_entry` also finds a class of the user."""


def learner_entry(algorithm: str) -> LearnerEntry:
    """Return the learner of a name: one of `LEARNERS`, or a class as `package.module:Class`.

    Such a class has the members of `Learner`, takes a configuration, a spec and a seed, and names
    the dataclass of its keys in its attribute `configuration`.

    Raises:
        UsageError: there is no such learner, or its class cannot be used.
    """
    module, colon, name = algorithm.partition(":")
    if not colon:
        return LEARNERS[algorithm]
    try:
        # The name may come from a log: the standard library has modules that act when imported.
        if module.partition(".")[0] in sys.stdlib_module_names:
            raise ImportError(f"{module} is of the standard library")
        learner = getattr(importlib.import_module(module), name)
    except Exception as error:  # whatever importing code of the user raises
        raise UsageError(
            f"the learner {algorithm} cannot be imported ({type(error).__name__}: "
            f"{one_line(error)}): install its package, or name its folder in PYTHONPATH"
        ) from error
    configuration = getattr(learner, "configuration", None)
    if not (isinstance(configuration, type) and is_dataclass(configuration)):
        raise UsageError(
            f"the learner {algorithm} has no attribute configuration, the dataclass of its keys"
        )
    return LearnerEntry(configuration, learner)


def open_learner(config: Any, spec: SourceSpec, seed: int) -> Learner:
    """The learner that a configuration names, for a source.

    Args:
        config: of the class that the learner's entry names.
        spec: of the source.
        seed: seed of its random generators.

    Raises:
        UsageError: there is no such learner, or it cannot learn from such a source.
    """
    return learner_entry(config.algorithm).open(config, spec, seed)
