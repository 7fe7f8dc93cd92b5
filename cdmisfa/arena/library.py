"""Streams on disk: made once, mapped into memory, with what batch SFA finds in each.

FOLDER/NAME-SEED/ holds a stream, K-EXPANSION.npz in it a reference.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cdmisfa.arena.pictures import Shown
from cdmisfa.arena.streams import LEARNED_FROM, STREAMS, make, parse
from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.blocks import PIXEL, UINT8
from cdmisfa.core.errors import CdmisfaError, UsageError
from cdmisfa.core.expansion import expand
from cdmisfa.core.modules import Module
from cdmisfa.core.untrusted.regular import read_json
from cdmisfa.experiments.documents import write_json
from cdmisfa.features.sfa import batch_sfa, leading_directions, slowness
from recorder.log.files import atomic_write
from replay.storage.arrays import read_arrays

RECIPE: Final = 2
"""Rises when streams are made in another way, so that those on disk are made anew."""

_DAMAGED: Final = (OSError, EOFError, ValueError)
"""What is raised for files that hold no array, or less of it than they say."""


@dataclass(frozen=True, slots=True)
class Stream:
    """A stream that was made.

    Attributes:
        name: what it shows, `Signal.name`.
        frames: (n, *frame_shape), all of them.
        state: (n, C) float64.
        loops: see `Kind`.
    """

    name: str
    frames: NDArray[Any]
    state: FloatArray
    loops: bool

    @property
    def learned_from(self) -> NDArray[Any]:
        """The frames that a learner is shown, over and over, (n, *frame_shape)."""
        return self.frames if self.loops else self.frames[:LEARNED_FROM]

    @property
    def held_out(self) -> NDArray[Any]:
        """The frames on which it is judged, (n, *frame_shape).

        Of one that loops they are a round, with the cut of it.
        """
        if self.loops:
            return np.concatenate([self.frames, self.frames[:1]])
        return self.frames[LEARNED_FROM:]


@dataclass(frozen=True, slots=True)
class Reference:
    """What batch SFA finds in the frames that a learner is shown, the cut of a loop with them.

    Attributes:
        slowness: of its slowest output, on the held-out frames.
        slowest: the slowest output.
        components: the leading principal components of the same frames.
    """

    slowness: float
    slowest: Module
    components: Module


@dataclass(frozen=True, slots=True)
class Wanted:
    """A stream to have on disk, with references.

    Attributes:
        name: `Signal.name`.
        seed: of its frames.
        references: (K, expansion) of each.
    """

    name: str
    seed: int
    references: tuple[tuple[int, str], ...]


class Library:
    """The streams in a folder.

    Args:
        folder: where they are; made where it does not exist.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def has(self, wanted: Wanted) -> bool:
        """Whether nothing of it is left to make."""
        learnable = parse(wanted.name)[0].learnable
        return _is_made(self._folder(wanted.name, wanted.seed)) and all(
            self._reference(wanted.name, wanted.seed, *each).is_file()
            for each in wanted.references
            if learnable
        )

    def prepare(self, wanted: Wanted) -> None:
        """Make what is not there yet; only one process at a time may make a stream.

        Raises:
            UsageError: it needs a package that is missing.
        """
        self._make(wanted.name, wanted.seed)
        if parse(wanted.name)[0].learnable:
            for components, expansion in wanted.references:
                path = self._reference(wanted.name, wanted.seed, components, expansion)
                if not path.is_file():
                    found = refer(self.stream(wanted.name, wanted.seed), components, expansion)
                    _save(path, found)

    def stream(self, name: str, seed: int) -> Stream:
        """A stream that was made before.

        Raises:
            UsageError: it was not.
        """
        folder = self._folder(name, seed)
        try:
            frames, state = _mapped(folder)
        except _DAMAGED as error:
            raise UsageError(f"{folder} is damaged: delete it, and it is made anew") from error
        (signal,) = parse(name)
        return Stream(name, np.asarray(frames), np.asarray(state), STREAMS[signal.kind].loops)

    def reference(self, name: str, seed: int, components: int, expansion: str) -> Reference:
        """What batch SFA found in a stream, see `refer`.

        Raises:
            UsageError: it is not there.
        """
        path = self._reference(name, seed, components, expansion)
        try:
            arrays = read_arrays(path)
            scale, mean = float(arrays["scale"]), arrays["mean"]
            both = [linear(arrays[k], mean, expansion, scale) for k in ("phi", "directions")]
            return Reference(float(arrays["slowness"]), *both)
        except (OSError, ValueError, KeyError) as error:
            raise UsageError(f"{path} is damaged: delete it, and it is made anew") from error

    def _make(self, name: str, seed: int) -> None:
        folder = self._folder(name, seed)
        if _is_made(folder):
            return
        (signal,) = parse(name)
        plain = None
        if signal.camera:
            self._make(signal.kind, seed)
            good = self.stream(signal.kind, seed)
            plain = Shown(good.frames, good.state)
        shown = make(name, seed, plain)
        with atomic_write(folder) as partial:
            partial.mkdir(parents=True)
            np.save(partial / "frames.npy", shown.frames)
            np.save(partial / "state.npy", shown.state)
            about = {"recipe": RECIPE, "name": name, "seed": seed, "state": list(shown.names)}
            write_json(partial / "about.json", about)

    def _folder(self, name: str, seed: int) -> Path:
        return self.folder / f"{name.replace(':', '-')}-{seed}"

    def _reference(self, name: str, seed: int, components: int, expansion: str) -> Path:
        return self._folder(name, seed) / f"{components}-{expansion}.npz"


def refer(stream: Stream, components: int, expansion: str) -> Reference:
    """Batch SFA within the leading principal components of what a learner is shown.

    Args:
        stream: the stream.
        components: K, as many as the learner has.
        expansion: the learner's.
    """
    scale = PIXEL if stream.frames.dtype == UINT8 else 1.0
    shown = stream.held_out if stream.loops else stream.learned_from
    rows = shown.reshape(len(shown), -1)
    x = expand(expansion, rows.astype(np.float64) * scale)
    mean = x.mean(axis=0)
    x = x - mean
    directions = leading_directions(x, components)
    phi = batch_sfa(x @ directions, 1) @ directions.T
    slowest = linear(phi, mean, expansion, scale)
    eta = float(slowness(slowest.transform(stream.held_out))[0])
    return Reference(eta, slowest, linear(directions.T, mean, expansion, scale))


def linear(phi: FloatArray, mean: FloatArray, expansion: str, scale: float) -> Module:
    """Weights (J, I) of a centred frame as a module that was never watched for."""
    none = np.zeros(len(phi))
    return Module(
        index=0,
        stream="",
        stream_index=0,
        iteration=0,
        phi=phi,
        mean=mean,
        band_mean=none,
        band_sd=none,
        eta=none,
        policy=np.zeros(0, np.int64),
        expansion=expansion,
        scale=scale,
    )


def _save(path: Path, found: Reference) -> None:
    with atomic_write(path, sync=False) as partial, open(partial, "wb") as file:
        np.savez(
            file,
            slowness=found.slowness,
            phi=found.slowest.phi,
            directions=found.components.phi,
            mean=found.slowest.mean,
            scale=found.slowest.scale,
        )


def _is_made(folder: Path) -> bool:
    """Whether a folder holds a whole stream that was made as streams are now."""
    try:
        recipe = read_json(folder / "about.json", "delete it")["recipe"]
        _mapped(folder)
    except (CdmisfaError, KeyError, TypeError, *_DAMAGED):
        return False
    return bool(recipe == RECIPE)


def _mapped(folder: Path) -> tuple[NDArray[Any], ...]:
    """Frames and states of the stream in a folder; a file that was cut short is refused."""
    return tuple(np.load(folder / f"{name}.npy", "r") for name in ("frames", "state"))
