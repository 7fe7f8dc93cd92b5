"""A set of streams as a source of frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from cdmisfa.arena.library import Library
from cdmisfa.arena.streams import BEGIN_APART, Signal, parse
from cdmisfa.core.blocks import Block, ClockedSource, SourceSpec, check_request, freeze
from cdmisfa.core.errors import UsageError

CHANGE: Final = 60_000
"""Frame from which on a stream that changes shows something else."""


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
        names = {signal.name for phases in self.phases for signal in phases}
        self.streams = {name: library.stream(name, seed) for name in sorted(names)}
        kinds = {(s.frames.shape[1:], str(s.frames.dtype)) for s in self.streams.values()}
        if len(kinds) != 1:
            raise UsageError(f"{', '.join(words)}: frames of one size and type can be a set")
        ((shape, dtype),) = kinds
        self._spec = SourceSpec(tuple(words), shape, dtype)

    def begins(self, phase: int) -> int:
        """First frame at which streams show what stands at a place in their words."""
        return phase * self._change

    def shown(self, stream: int, t: int) -> Signal:
        """What a stream shows at frame t."""
        phases = self.phases[stream]
        return phases[min(t // self._change, len(phases) - 1)]

    def take(self, stream: int, n: int) -> Block:
        """The next n frames of a stream; see `FrameSource.take`."""
        check_request(self._spec, stream, n)
        clock = np.arange(self._t, self._t + n)
        frames = np.empty((n, *self._spec.frame_shape), self._spec.dtype)
        last = len(self.phases[stream]) - 1
        of_phase = np.minimum(clock // self._change, last)
        for phase, signal in enumerate(self.phases[stream]):
            here = of_phase == phase
            source = self.streams[signal.name].learned_from
            frames[here] = source[(clock[here] + signal.apart * BEGIN_APART) % len(source)]
        block = Block(stream, self._t, freeze(frames), freeze(np.zeros((n, 0))))
        self._t += n
        return block

    def describe(self) -> Mapping[str, Any]:
        """The streams and their seed."""
        return {"kind": "arena", "streams": list(self._spec.streams), "seed": self._seed}
