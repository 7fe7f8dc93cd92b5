"""The first tab of a run's view: its world, what it has learned of it, and what happened."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import rerun as rr

from replay.runs.log import RunHeader
from replay.runs.outline import Outline
from replay.runs.stretches import Frames, Stretch
from replay.view.world.known import world_of_run
from replay.view.world.learned import Lesson, write_learned
from replay.view.world.scene import SceneView
from replay.view.world.wall import WallView

Bounds = tuple[tuple[float, float], tuple[float, float]]


@dataclass(frozen=True, slots=True)
class First:
    """What a first tab has to show.

    Attributes:
        scene: there is a world in 3D.
        wall: ranges of x and y of a wall of pictures, where there is one.
        lessons: what each module has learned.
    """

    scene: bool
    wall: Bounds | None
    lessons: tuple[Lesson, ...]


class FirstTab:
    """Writes what the first tab shows, which other tabs do not.

    Args:
        recording: where it goes.
        header: of the run's log.
        log: the file.
        streams: those that are shown.
        every: where things are is shown at every so many frames, as pictures are.
        learned_from: the recording that the run learned from, where that is known.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        header: RunHeader,
        log: Path,
        streams: Sequence[int],
        every: int,
        learned_from: Path | None,
    ) -> None:
        self._recording, self._log, self._every = recording, log, every
        self._scene: SceneView | None = None
        self._wall: WallView | None = None
        self._truth: list[Frames] = []
        scenery, unsure = world_of_run(header, log, learned_from)
        self.notes: list[str] = [] if unsure is None else [unsure]
        if scenery is not None:
            self._scene = SceneView(recording, header.spec, scenery)
            missing = self._scene.stand()
            self.notes += [] if missing is None else [missing]
        elif header.spec.images:
            self._wall = WallView(recording, header, streams)

    def take(self, stretch: Stretch) -> None:
        """Take what a log holds of some iterations."""
        self._truth += stretch.truth
        if self._wall is not None:
            self._wall.take(stretch)
        if self._scene is not None:
            for columns in stretch.signals:
                self._scene.turn(columns)
            for frames, truth in stretch.truth:
                kept = frames % self._every == 0
                self._scene.move(frames[kept], truth[kept])

    def finish(self, outline: Outline) -> First:
        """Write what is known at the end, and hand over everything that waits.

        Args:
            outline: the run in short.
        """
        for view in (self._scene, self._wall):
            if view is not None:
                view.flush()
        return First(
            scene=self._scene is not None,
            wall=self._wall.bounds if self._wall is not None else None,
            lessons=tuple(write_learned(self._recording, self._log, outline, self._truth)),
        )
