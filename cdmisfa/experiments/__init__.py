"""One run, or many: sources, learners and logs put together."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "cdmisfa.experiments.loop": "ENDINGS Digest learn",
        "cdmisfa.experiments.recompute": "Checked",
        "cdmisfa.experiments.results": "PointResult",
        "cdmisfa.experiments.run_folder": "RunExhaustedError RunResult",
        "cdmisfa.experiments.session": "Session run",
        "cdmisfa.experiments.sources": "Configuration configure open_source",
        "replay.camera_logs.options": "CameraOptions",
        "cdmisfa.experiments.store": "SweepReport TrialStore",
        "cdmisfa.experiments.sweep": "SweepTrial",
        "cdmisfa.experiments.trial": "run_trial",
    },
)
