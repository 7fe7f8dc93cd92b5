"""The arena: learners compared on sets of streams, each made anew where it is run."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "cdmisfa.arena.contestants": "CONTESTANTS",
        "cdmisfa.arena.sets": "ArenaSet SETS",
        "cdmisfa.arena.source": "ArenaSource",
        "cdmisfa.arena.pictures": "Shown",
        "cdmisfa.arena.streams": "Kind STREAMS",
    },
)
