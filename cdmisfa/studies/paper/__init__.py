"""The experiments of the paper: `cdmisfa reproduce`."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {"cdmisfa.studies.paper.experiment": "Experiment Findings Request Trial"},
)
