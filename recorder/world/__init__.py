"""Simulated worlds: what their streams show at every t."""

from cdmisfa.core.faces import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "recorder.world.icub_config": "IcubConfig",
        "recorder.world.oscillatory": "OscillatoryConfig OscillatorySource",
        "recorder.world.live": "LiveSource",
        "recorder.world.motions": "Motions",
        "recorder.world.scenes": "SCENES Scene open_scene",
    },
)
