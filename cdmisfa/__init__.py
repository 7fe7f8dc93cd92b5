"""Slow features of streams, learned by curiosity.

From arrays, logs, scenes or cameras to a run, its signals as a table, and what was learned at work:

    run = learn("oscillatory", max_modules=1)
    table = run.signals.to_arrow()
    outputs = run.modules[0].transform(run.frames())

docs/how-to/python.md shows more. `cdmisfa.experiments` has the loop of every run, `recorder`
records sources, `replay` reads and shows what was logged.
"""

import os
from importlib.util import find_spec
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
    from cdmisfa.modules import Module as Module
    from cdmisfa.public.learning import learn as learn
    from cdmisfa.public.recording import Recording as Recording
    from cdmisfa.public.run import Run as Run
    from cdmisfa.watching import WatchEnv as WatchEnv
    from recorder.cameras.stepped import ArraySource as ArraySource
    from recorder.cameras.stepped import GymSource as GymSource
    from recorder.images.framing import Recipe as Recipe
    from recorder.images.framing import make_frame as make_frame
    from recorder.world.oscillatory import OscillatorySource as OscillatorySource

    __version__: str

_home = os.path.dirname(os.path.dirname(__file__))
for _name in ("recorder", "replay"):  # another project's package hides ours, or lies over it
    if _spec := find_spec(_name):
        _ours = os.path.dirname(_spec.origin or "") == f"{_home}/{_name}"
        if _ours:
            with open(_spec.origin or "", "rb") as _file:
                _ours = b"from cdmisfa" in _file.read()
        if not _ours:
            raise ImportError(
                f"{_name} is not cdmisfa's: {_spec.origin}; give cdmisfa an environment of its own"
            )

_load, __dir__, __all__ = exports(
    __name__,
    {
        "cdmisfa.core.errors": "CdmisfaError",
        "cdmisfa.core.learning": "Sink",
        "cdmisfa.core.signals": "SIGNALS",
        "cdmisfa.estimators.batches": "IncSFA RecursiveSFA",
        "cdmisfa.modules": "Module",
        "cdmisfa.public.learning": "learn",
        "cdmisfa.public.recording": "Recording",
        "cdmisfa.public.run": "Run",
        "cdmisfa.watching": "WatchEnv",
        "recorder.cameras.stepped": "GymSource",
        "recorder.images.framing": "Recipe make_frame",
    },
    beside={
        "cdmisfa.agents.learner": "CuriousLearner",
        "cdmisfa.core.blocks": "Block FrameSource SeekableSource SourceSpec",
        "cdmisfa.core.config": "LearnerConfig",
        "cdmisfa.core.learning": "Learner",
        "cdmisfa.core.signals": "BlockSignals",
        "recorder.cameras.stepped": "ArraySource",
        "recorder.world.oscillatory": "OscillatorySource",
    },
)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib import metadata

        return metadata.version(__name__)
    return _load(name)
