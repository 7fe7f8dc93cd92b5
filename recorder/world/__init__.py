"""Simulated worlds: what their streams show at every t."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "recorder.world.icub.config": "IcubConfig",
        "recorder.world.icub.motions": "Motions",
        "recorder.world.icub.source": "IcubSource",
        "recorder.world.oscillatory": "OscillatoryConfig OscillatorySource",
        "recorder.world.scenes": "SCENES Scene open_scene",
    },
)
