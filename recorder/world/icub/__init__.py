"""The iCub scene: a robot that watches three objects move on a table."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "recorder.world.icub.config": "IcubConfig",
        "recorder.world.icub.motions": "Motions",
        "recorder.world.icub.source": "IcubSource",
    },
)
