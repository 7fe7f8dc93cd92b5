"""The arena: learners compared on sets of streams, each made anew where it is run."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "cdmisfa.studies.arena.arena": "CONTESTANTS run_arena",
        "cdmisfa.studies.arena.library": "ArenaSource",
        "cdmisfa.studies.arena.pictures": "Footage",
        "cdmisfa.studies.arena.streams": "SETS STREAMS ArenaSet Kind",
    },
)
