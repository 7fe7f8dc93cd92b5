"""Streams that show as much as is asked for: iterators of frames, one step at a time together."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence, Sized
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.blocks import Block, ForwardSource, SourceSpec, as_array, check_request, freeze
from cdmisfa.core.clock import START_NS
from cdmisfa.core.errors import LogExhaustedError, UsageError

Step = tuple[Sequence[Any], NDArray[np.float64]]
"""The frame of each stream, and what the world knows at it, (D,) float64."""


class SteppedSource(ForwardSource):
    """Streams that are iterators, on one clock; it ends with the first of them.

    It cannot go back. A class that derives from it adds `describe`.

    Args:
        spec: what the source delivers.
        steps: what is shown, frame by frame.
    """

    def __init__(self, spec: SourceSpec, steps: Iterator[Step]) -> None:
        self._spec, self._steps = spec, steps
        self._ahead: list[Step] = []

    def take(self, stream: int, n: int) -> Block:
        """See `FrameSource`."""
        check_request(self._spec, stream, n)
        return self.take_all(n)[stream]

    def take_all(self, n: int) -> tuple[Block, ...]:
        """See `FrameSource`."""
        check_request(self._spec, 0, n)
        self._ahead += islice(self._steps, n - len(self._ahead))
        if len(self._ahead) < n:
            raise LogExhaustedError(
                f"{len(self._ahead)} frames are left at frame {self._t}, {n} are needed"
            )
        shown, self._ahead = self._ahead[:n], self._ahead[n:]
        truth = freeze(np.stack([values for _, values in shown]))
        blocks = [
            Block(stream, self._t, freeze(np.stack([frames[stream] for frames, _ in shown])), truth)
            for stream in range(len(self._spec.streams))
        ]
        self._t += n
        return tuple(blocks)


class ArraySource(SteppedSource):
    """Frames that the caller has, or makes, as streams.

    Args:
        streams: for each stream, by its name, an array (n, height, width) of uint8 or (n, I) of
            float64, or any iterable of such frames.
        fps: frames a second.
        start_ns: log time of frame 0, in nanoseconds.

    Raises:
        UsageError: a stream is empty, or frames are of other sizes or types than pixels or values.
    """

    def __init__(
        self,
        streams: Mapping[str, Iterable[Any]],
        *,
        fps: float = 50.0,
        start_ns: int = START_NS,
    ) -> None:
        if not streams:
            raise UsageError("no stream given: name one at least")
        lengths = [len(s) if isinstance(s, Sized) else None for s in streams.values()]
        known = [length for length in lengths if length is not None]
        shown = {name: iter(frames) for name, frames in streams.items()}
        firsts = {name: as_array(next(frames, ())) for name, frames in shown.items()}
        for name, first in firsts.items():
            if (str(first.dtype), first.ndim) not in (("uint8", 2), ("float64", 1)):
                raise UsageError(
                    f"{name} shows {first.dtype} of shape {first.shape}: give frames (height, "
                    "width) of uint8 or (I,) of float64"
                )
        first = next(iter(firsts.values()))
        spec = SourceSpec(
            tuple(streams),
            first.shape,
            str(first.dtype),
            fps=fps,
            start_ns=start_ns,
            length=min(known) if len(known) == len(lengths) else None,
        )
        steps = [_checked(name, firsts[name], frames, spec) for name, frames in shown.items()]
        nothing = np.empty(0)
        super().__init__(spec, ((frames, nothing) for frames in zip(*steps, strict=False)))

    def describe(self) -> Mapping[str, Any]:
        """That the frames are the caller's."""
        return {"kind": "arrays", "streams": list(self._spec.streams)}


def _checked(name: str, first: Any, frames: Iterator[Any], spec: SourceSpec) -> Iterator[Any]:
    """The frames of a stream, the first of which was looked at."""
    frame = first
    while True:
        if frame.shape != spec.frame_shape or frame.dtype != spec.dtype:
            raise UsageError(
                f"{name} shows {frame.dtype} of shape {frame.shape}, not {spec.dtype} of "
                f"{spec.frame_shape} as the first stream does: give frames of one size and type"
            )
        yield frame
        try:
            frame = as_array(next(frames))
        except StopIteration:
            return
