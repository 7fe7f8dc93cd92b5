"""A report: one HTML page that says what a run learned, and needs nothing but a browser."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "replay.report.page": "report_of_run report_of_runs",
    },
)
