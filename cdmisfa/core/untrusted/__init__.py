"""Reading what others may have written: which files, how long, and with how much memory."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "cdmisfa.core.untrusted.memory": "budget parse_json",
        "cdmisfa.core.untrusted.regular": "check_regular read_json read_regular",
    },
)
