"""Runs on disk: signals, modules, and what they came to."""

from cdmisfa.core.faces import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "replay.runs.log": "RunWriter read_header read_signals run_log",
        "replay.runs.columns": "SignalColumns",
        "replay.runs.stretches": "read_columns read_stretches",
        "replay.runs.outline": "Outline read_outline",
        "replay.runs.compare": "Difference",
        "replay.runs.modules": "load_modules save_modules",
        "replay.runs.transformer": "SlowFeatures",
    },
)
