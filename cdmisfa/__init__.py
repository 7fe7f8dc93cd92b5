"""Learn slow features from arrays, logs, simulated scenes or cameras:

    run = learn("oscillatory", max_modules=1)
    table = run.signals.to_arrow()
    features = run.modules[0].transform(run.frames())

docs/start/python.md has more examples.
"""

import os
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cdmisfa.core.errors import CdmisfaError as CdmisfaError
    from cdmisfa.core.learning import Sink as Sink
    from cdmisfa.core.signals import SIGNALS as SIGNALS
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

# Module of each public name; it is imported on first use, so that commands start quickly.
_MODULES = {
    "CdmisfaError": "cdmisfa.core.errors",
    "Sink": "cdmisfa.core.learning",
    "SIGNALS": "cdmisfa.core.signals",
    "IncSFA": "cdmisfa.estimators.batches",
    "RecursiveSFA": "cdmisfa.estimators.batches",
    "Module": "cdmisfa.modules",
    "learn": "cdmisfa.public.learning",
    "Recording": "cdmisfa.public.recording",
    "Run": "cdmisfa.public.run",
    "WatchEnv": "cdmisfa.watching",
    "ArraySource": "recorder.cameras.stepped",
    "GymSource": "recorder.cameras.stepped",
    "Recipe": "recorder.images.framing",
    "make_frame": "recorder.images.framing",
    "OscillatorySource": "recorder.world.oscillatory",
}
__all__ = sorted(_MODULES)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib import metadata

        return metadata.version(__name__)
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_MODULES[name]), name)
    return value


def __dir__() -> list[str]:
    return __all__


# A package `recorder` or `replay` of another project may be found first, or be mixed with ours.
_HOME = os.path.dirname(os.path.dirname(__file__))
for _name in ("recorder", "replay"):
    if _spec := find_spec(_name):
        _ours = os.path.dirname(_spec.origin or "") == f"{_HOME}/{_name}"
        if _ours:
            with open(_spec.origin or "", "rb") as _file:
                _ours = b"cdmisfa" in _file.read()
        if not _ours:
            raise ImportError(
                f"{_name} is a package of another project: {_spec.origin}: install cdmisfa in an "
                "environment of its own"
            )
