"""The world of a run on the first tab of its view: the scene in 3D, or a wall of its streams."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import rerun as rr

from recorder.log.scenery import Scenery
from replay.runs.log import Batch, RunHeader
from replay.view.world.known import world_of_run
from replay.view.world.learned import Lesson
from replay.view.world.scene import SceneView
from replay.view.world.wall import Bounds, WallView, bounds


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
    lessons: tuple[Lesson, ...] = ()


def first_of(
    header: RunHeader,
    scenery: Scenery | None,
    streams: Sequence[int],
    lessons: Sequence[Lesson] = (),
) -> First:
    """What the first tab of a run has to show.

    Args:
        header: of its log.
        scenery: what stood where, as far as that is known.
        streams: those that are shown.
        lessons: what its modules have learned.
    """
    spec = header.spec
    wall = spec.images and scenery is None
    return First(
        scene=scenery is not None,
        wall=bounds(len(streams), *spec.frame_shape) if wall else None,
        lessons=tuple(lessons),
    )


class WorldView:
    """Writes the world of a run.

    Args:
        recording: where it goes.
        header: of the run's log.
        run: its folder.
        streams: those that are shown.
        every: where things are is shown at every so many frames, as pictures are.
        learned_from: the recording that the run learned from, where that is known.
        body: of the robot, too.

    Attributes:
        notes: what a person should know of it.
    """

    def __init__(
        self,
        recording: rr.RecordingStream,
        header: RunHeader,
        run: Path,
        streams: Sequence[int],
        every: int,
        learned_from: Path | None = None,
        *,
        body: bool = True,
    ) -> None:
        self._header, self._streams, self._every = header, streams, every
        self._scene: SceneView | None = None
        self._wall: WallView | None = None
        self._scenery, unsure = world_of_run(header, run, learned_from)
        self.notes: list[str] = [] if unsure is None else [unsure]
        if self._scenery is not None:
            self._scene = SceneView(recording, header.spec, self._scenery)
            missing = self._scene.stand() if body else None
            self.notes += [] if missing is None else [missing]
        elif header.spec.images:
            self._wall = WallView(recording, header, streams)

    def take(self, batch: Batch) -> None:
        """Take what a log holds of some iterations."""
        if self._wall is not None:
            self._wall.take(batch)
        if self._scene is not None:
            for columns in batch.signals:
                self._scene.turn(columns)
            for frames, truth in batch.truth:
                kept = frames % self._every == 0
                self._scene.move(frames[kept], truth[kept])

    def flush(self) -> None:
        """Hand over everything that waits."""
        for view in (self._scene, self._wall):
            if view is not None:
                view.flush()

    def first(self, lessons: Sequence[Lesson] = ()) -> First:
        """What there is to show of it, and what was learned of it."""
        return first_of(self._header, self._scenery, self._streams, lessons)
