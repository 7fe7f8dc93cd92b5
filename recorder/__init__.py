"""The world: simulated streams, and writing what any source shows."""

from cdmisfa.core.faces import face

__getattr__, __dir__, __all__ = face(
    __name__,
    {
        "recorder.config": "RecordConfig SceneConfig",
        "recorder.log.split": "Split",
        "recorder.recording": "RecordingStoppedError ViewRecording record record_scene",
        "recorder.world.scenes": "SCENES Scene open_scene",
    },
)
