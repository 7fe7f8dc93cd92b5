"""The world: simulated and live streams, and writing what any source shows."""

from cdmisfa.core.exports import exports

__getattr__, __dir__, __all__ = exports(
    __name__,
    {
        "recorder.cameras.stepped": "ArraySource GymSource",
        "recorder.config": "RecordConfig SceneConfig Split",
        "recorder.live": "RecordedWhileWatched record_watched",
        "recorder.recording": "RecordingStoppedError ViewRecording record record_scene",
        "recorder.world.scenes": "SCENES Scene open_scene",
    },
)
