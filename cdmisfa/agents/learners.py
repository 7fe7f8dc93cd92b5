"""Registry of the learners, by their name in `learner.algorithm`."""

from __future__ import annotations

import importlib
import sys
from dataclasses import is_dataclass
from typing import Any

from cdmisfa.agents.learner import CuriousLearner
from cdmisfa.agents.progress.learner import ProgressLearner
from cdmisfa.core.blocks import SourceSpec
from cdmisfa.core.errors import Registry, UsageError, one_line
from cdmisfa.core.learning import Learner

LEARNERS: Registry[type[Any]] = Registry(
    "learner.algorithm", {"2.0": CuriousLearner, "1.0": CuriousLearner, "progress": ProgressLearner}
)


def learner_class(algorithm: str) -> type[Any]:
    """Return the learner class of a name: one of `LEARNERS`, or `package.module:Class`.

    A learner class has the members of `Learner` and takes a configuration, a spec and a seed. Its
    attribute `configuration` is the dataclass of its keys `learner.*`, with a field `algorithm`.
    Its attribute `preset`, if any, names its preset.

    Raises:
        UsageError: the learner does not exist, or its class cannot be used.
    """
    module, colon, name = algorithm.partition(":")
    if not colon:
        return LEARNERS[algorithm]
    try:
        # The name may come from an untrusted log, and importing some modules of the standard
        # library has effects.
        if module.partition(".")[0] in sys.stdlib_module_names:
            raise ImportError(f"{module} belongs to the standard library")
        learner: type[Any] = getattr(importlib.import_module(module), name)
        configuration = getattr(learner, "configuration", None)
        if not (isinstance(configuration, type) and is_dataclass(configuration)):
            raise TypeError("it has no attribute `configuration`, the dataclass of its keys")
    except Exception as error:  # a user's module may raise anything when it is imported
        raise UsageError(
            f"the learner {algorithm} cannot be imported ({type(error).__name__}: "
            f"{one_line(error)}): install its package, or name its folder in PYTHONPATH"
        ) from error
    return learner


def open_learner(config: Any, spec: SourceSpec, seed: int) -> Learner:
    """Return the learner that a configuration names, for a source.

    Raises:
        UsageError: the learner does not exist, or cannot learn from such a source.
    """
    learner: Learner = learner_class(config.algorithm)(config, spec, seed)
    return learner
