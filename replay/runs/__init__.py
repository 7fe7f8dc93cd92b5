"""Runs on disk: signals, modules, and what they came to."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "replay.runs.folders": "is_run is_sweep run_log runs_in",
        "replay.runs.log": "Event RunHeader read_header",
        "replay.runs.run": "Run",
        "replay.runs.writer": "RunWriter",
        "replay.runs.columns": "SignalColumns",
        "replay.runs.stretches": "read_columns read_stretches",
        "replay.runs.outline": "Outline read_outline",
        "replay.runs.compare": "Difference first_difference side_by_side",
        "replay.runs.modules": "load_modules save_modules",
        "replay.runs.transformer": "SlowFeatures",
    },
)
