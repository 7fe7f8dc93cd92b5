"""Studies of many runs: the paper's experiments, the arena, and the demonstration."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(__name__, {"cdmisfa.studies.demo": "Report"})
