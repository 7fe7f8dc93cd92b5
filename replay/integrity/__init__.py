"""What is in a log, whether it is whole, and saving what can be saved."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "replay.integrity.info": "LogInfo describe kind_of",
        "replay.integrity.verify": "LogCheck check_log",
        "replay.integrity.recover": "Recovery recover_log",
        "recorder.mcap.records": "Problem",
    },
)
