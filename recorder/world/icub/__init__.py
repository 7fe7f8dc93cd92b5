"""The iCub scene: a robot that watches three objects move on a table."""

from cdmisfa.core.faces import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "recorder.world.icub.config": "IcubConfig",
        "recorder.world.icub.motions": "Motions",
        "recorder.world.icub.source": "IcubSource",
    },
)
