"""Curiosity-driven modular incremental slow feature analysis (CD-MISFA 2.0).

A learner learns from a source, and sinks are told of it:

    source = OscillatorySource()
    learner = CuriousLearner(LearnerConfig(), source.spec, seed=0)
    learn(source, learner)

What follows is the vocabulary; `cdmisfa.experiments` does whole runs and sweeps, `recorder`
records sources, `replay` reads and shows what was logged.
"""

from typing import TYPE_CHECKING, Any

from cdmisfa.core.exports import exports

if TYPE_CHECKING:
    from cdmisfa.agents.learner import CuriousLearner as CuriousLearner
    from cdmisfa.core.blocks import Block as Block
    from cdmisfa.core.blocks import FrameSource as FrameSource
    from cdmisfa.core.blocks import SeekableSource as SeekableSource
    from cdmisfa.core.blocks import SourceSpec as SourceSpec
    from cdmisfa.core.config import LearnerConfig as LearnerConfig
    from cdmisfa.core.errors import CdmisfaError as CdmisfaError
    from cdmisfa.core.learning import Learner as Learner
    from cdmisfa.core.learning import Sink as Sink
    from cdmisfa.core.signals import SIGNALS as SIGNALS
    from cdmisfa.core.signals import BlockSignals as BlockSignals
    from cdmisfa.estimators.batches import IncSFA as IncSFA
    from cdmisfa.estimators.batches import RecursiveSFA as RecursiveSFA
    from cdmisfa.experiments.loop import learn as learn
    from cdmisfa.experiments.recompute import Run as Run
    from cdmisfa.modules import Module as Module
    from cdmisfa.watching import WatchEnv as WatchEnv
    from recorder.cameras.stepped import ArraySource as ArraySource
    from recorder.cameras.stepped import GymSource as GymSource
    from recorder.images.recipe import Recipe as Recipe
    from recorder.images.recipe import make_frame as make_frame
    from recorder.world.oscillatory import OscillatorySource as OscillatorySource

    __version__: str

_load, __dir__, __all__ = exports(
    __name__,
    {
        "cdmisfa.agents.learner": "CuriousLearner",
        "cdmisfa.core.blocks": "Block FrameSource SeekableSource SourceSpec",
        "cdmisfa.core.config": "LearnerConfig",
        "cdmisfa.core.errors": "CdmisfaError",
        "cdmisfa.core.learning": "Learner Sink",
        "cdmisfa.modules": "Module",
        "cdmisfa.watching": "WatchEnv",
        "cdmisfa.core.signals": "SIGNALS BlockSignals",
        "cdmisfa.estimators.batches": "IncSFA RecursiveSFA",
        "cdmisfa.experiments.loop": "learn",
        "recorder.cameras.stepped": "ArraySource GymSource",
        "recorder.images.recipe": "Recipe make_frame",
        "recorder.world.oscillatory": "OscillatorySource",
        "cdmisfa.experiments.recompute": "Run",
    },
)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib import metadata

        return metadata.version(__name__)
    return _load(name)
