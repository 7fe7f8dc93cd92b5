"""Runs on disk: signals, modules, and what they came to."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "replay.runs.folders": "is_run run_log runs_in",
        "replay.runs.log": "Event RunHeader read_batches read_columns read_header",
        "replay.runs.run": "Outline Run read_outline",
        "replay.runs.writer": "RunWriter",
        "replay.runs.columns": "SignalColumns",
        "replay.runs.compare": "Difference first_difference side_by_side",
        "replay.runs.modules": "SlowFeatures load_modules save_modules",
    },
)
