"""Streams on disk: made once, mapped into memory, with what batch SFA finds in each.

FOLDER/NAME-SEED/ holds a stream, K-EXPANSION.npz in it a reference. `ArenaSource` puts streams on
one clock.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.blocks import (
    PIXEL,
    UINT8,
    Block,
    ClockedSource,
    SourceSpec,
    check_request,
    freeze,
)
from cdmisfa.core.errors import CdmisfaError, UsageError
from cdmisfa.core.expansion import expand
from cdmisfa.core.untrusted import read_json
from cdmisfa.experiments.documents import write_json
from cdmisfa.features.following import batch_outputs
from cdmisfa.features.sfa import slowness
from cdmisfa.modules import Module
from cdmisfa.studies.arena.pictures import FITTED, PARTS, Footage, Part
from cdmisfa.studies.arena.streams import CHANGE, STREAMS, Showing, make_footage, parse
from recorder.log.files import atomic_write
from replay.storage.arrays import read_arrays

RECIPE: Final = 4
"""Rises when streams or references are made in another way: those on disk are made anew."""

BEGIN_APART: Final = 997
"""Frames between the beginnings of a stream shown twice."""

_DAMAGED: Final = (OSError, EOFError, ValueError, KeyError)
"""What is raised for files that hold no array, or less of it than they say."""


@dataclass(frozen=True, slots=True)
class Reference:
    """What batch SFA finds in the frames that a learner is shown, the cut of a loop with them.

    Attributes:
        slowness: of its slowest output, on the frames that follow and on those it was fitted to.
        slowest: the slowest output.
        components: the leading principal components of the same frames.
    """

    slowness: Mapping[Part, float]
    slowest: Module
    components: Module


class Library:
    """The streams in a folder.

    Args:
        folder: where they are; made where it does not exist.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def has(self, name: str, seed: int, components: int, expansion: str) -> bool:
        """Whether a stream is there, and its reference where it is learnable."""
        path = self._reference(name, seed, components, expansion)
        return self._is_made(name, seed) and (not parse(name)[0].learnable or path.is_file())

    def prepare(self, name: str, seed: int, components: int, expansion: str) -> None:
        """Make what is not there yet; only one process at a time may make a stream.

        Raises:
            UsageError: it needs a package that is missing.
        """
        self._make(name, seed)
        path = self._reference(name, seed, components, expansion)
        if parse(name)[0].learnable and not path.is_file():
            arrays = refer(self.stream(name, seed), components, expansion)
            with atomic_write(path, sync=False) as partial, open(partial, "wb") as file:
                np.savez(file, **arrays)

    def stream(self, name: str, seed: int) -> Footage:
        """A stream that was made before.

        Args:
            name: as `Showing.name` has it.
            seed: of its frames.

        Raises:
            UsageError: it was not.
        """
        folder = self._folder(name, seed)
        try:
            frames, state = _mapped(folder)
        except _DAMAGED as error:
            raise UsageError(f"{folder} is damaged: delete it, and it is made anew") from error
        loops = STREAMS[parse(name)[0].kind].loops
        return Footage(np.asarray(frames), np.asarray(state), loops=loops)

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
            return Reference(dict(zip(PARTS, arrays["slowness"].tolist(), strict=True)), *both)
        except _DAMAGED as error:
            raise UsageError(f"{path} is damaged: delete it, and it is made anew") from error

    def _make(self, name: str, seed: int) -> None:
        if self._is_made(name, seed):
            return
        (showing,) = parse(name)
        plain = None
        if showing.camera:
            self._make(showing.kind, seed)
            plain = self.stream(showing.kind, seed)
        made = make_footage(name, seed, plain)
        with atomic_write(self._folder(name, seed)) as partial:
            partial.mkdir(parents=True)
            np.save(partial / "frames.npy", made.frames)
            np.save(partial / "state.npy", made.state)
            about = {"recipe": RECIPE, "name": name, "seed": seed, "state": list(made.names)}
            write_json(partial / "about.json", about)

    def _is_made(self, name: str, seed: int) -> bool:
        """Whether there is a whole stream that was made as streams are now."""
        folder = self._folder(name, seed)
        try:
            recipe = read_json(folder / "about.json", "delete it")["recipe"]
            _mapped(folder)
        except (CdmisfaError, TypeError, *_DAMAGED):
            return False
        return bool(recipe == RECIPE)

    def _folder(self, name: str, seed: int) -> Path:
        return self.folder / f"{name.replace(':', '-')}-{seed}"

    def _reference(self, name: str, seed: int, components: int, expansion: str) -> Path:
        return self._folder(name, seed) / f"{components}-{expansion}.npz"


def _mapped(folder: Path) -> tuple[NDArray[Any], ...]:
    """Frames and states of the stream in a folder; a file that was cut short is refused."""
    return tuple(np.load(folder / f"{name}.npy", "r") for name in ("frames", "state"))


def refer(stream: Footage, components: int, expansion: str) -> dict[str, Any]:
    """Batch SFA within the leading principal components of what a learner is shown.

    Args:
        stream: the stream.
        components: K, as many as the learner has.
        expansion: the learner's.

    Returns:
        The arrays of a `Reference`: slowness of each of `PARTS`, phi (1, I), directions (K, I),
        mean (I,), scale.
    """
    shown = stream.part(FITTED)
    x = expand(expansion, shown.reshape(len(shown), -1))
    scale = PIXEL if shown.dtype == UINT8 else 1.0
    phi, mean, directions = batch_outputs([(x, False)], len(x), components, outputs=1)
    slowest = linear(phi, mean, expansion, scale)
    slow = [slowness(slowest.transform(stream.part(part)))[0] for part in PARTS]
    found = {"slowness": np.array(slow), "phi": phi, "directions": directions}
    return {**found, "mean": mean, "scale": scale}


def linear(phi: FloatArray, mean: FloatArray, expansion: str, scale: float) -> Module:
    """Weights (J, I) of a centred frame as a module that was never watched for."""
    none = np.zeros(len(phi))
    policy = np.zeros(0, np.int64)
    return Module(
        0, "", 0, 0, phi, mean, none, none, none, policy, expansion=expansion, scale=scale
    )


class ArenaSource(ClockedSource):
    """Streams from a library on one clock; each begins again where its frames are over.

    The cut where a stream begins again is not told, nor is the change of one.

    Args:
        words: what each stream shows, see `parse`.
        library: where the streams are.
        seed: of the streams.
        change: frame at which streams of two words change.

    Raises:
        UsageError: no such stream, it was not made, or its frames are not as those of the others.
    """

    def __init__(
        self, words: Sequence[str], library: Library, seed: int, *, change: int = CHANGE
    ) -> None:
        self.phases = [parse(word) for word in words]
        self._change, self._seed = change, seed
        names = {showing.name for phases in self.phases for showing in phases}
        self.streams = {name: library.stream(name, seed) for name in sorted(names)}
        kinds = {(s.frames.shape[1:], str(s.frames.dtype)) for s in self.streams.values()}
        if len(kinds) != 1:
            raise UsageError(f"{', '.join(words)}: frames of one size and type can be a set")
        ((shape, dtype),) = kinds
        self._spec = SourceSpec(tuple(words), shape, dtype)

    def begins(self, phase: int) -> int:
        """First frame at which streams show what stands at a place in their words."""
        return phase * self._change

    def shown(self, stream: int, t: int) -> Showing:
        """What a stream shows at frame t."""
        phases = self.phases[stream]
        return phases[min(t // self._change, len(phases) - 1)]

    def take(self, stream: int, n: int) -> Block:
        """The next n frames of a stream; see `FrameSource.take`."""
        check_request(self._spec, stream, n)
        clock = np.arange(self._t, self._t + n)
        frames = np.empty((n, *self._spec.frame_shape), self._spec.dtype)
        phases = self.phases[stream]
        of_phase = np.minimum(clock // self._change, len(phases) - 1)
        for phase, showing in enumerate(phases):
            here = of_phase == phase
            source = self.streams[showing.name].shown
            frames[here] = source[(clock[here] + showing.apart * BEGIN_APART) % len(source)]
        block = Block(stream, self._t, freeze(frames), freeze(np.zeros((n, 0))))
        self._t += n
        return block

    def describe(self) -> Mapping[str, Any]:
        """The streams and their seed."""
        return {"kind": "arena", "streams": list(self._spec.streams), "seed": self._seed}
