"""The scenes there are, opened by name."""

from __future__ import annotations

import difflib

from cdmisfa.core.blocks import SeekableSource
from cdmisfa.core.errors import UsageError
from recorder.config import RecordConfig, SceneConfig
from recorder.world.oscillatory import OscillatorySource

SCENES = ("icub", "oscillatory")
"""Names of the live scenes."""


def open_scene(
    kind: str, scene: SceneConfig | None = None, record: RecordConfig | None = None
) -> SeekableSource:
    """A live source of a scene's streams.

    Args:
        kind: one of `SCENES`.
        scene: the world; by default the preset's, with seed 0.
        record: the clock of the frames.

    Raises:
        UsageError: no such scene, or a scene that cannot be built.
        CdmisfaError: the scene needs a simulator that is not installed.
    """
    scene = scene if scene is not None else SceneConfig()
    record = record if record is not None else RecordConfig()
    if kind == "oscillatory":
        return OscillatorySource(scene.streams, fps=record.fps, start_ns=record.start_ns)
    if kind == "icub":
        from recorder.world.live import LiveSource

        return LiveSource(scene, record)
    match = difflib.get_close_matches(kind, SCENES, n=1, cutoff=0.5)
    hint = f"did you mean {match[0]}?" if match else f"there are {', '.join(SCENES)}"
    raise UsageError(f"no scene {kind!r}: {hint}")
