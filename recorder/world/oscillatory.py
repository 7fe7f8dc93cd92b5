"""`OscillatorySource`: the paper's oscillatory streams."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.blocks import Block, ClockedSource, SourceSpec, check_request, freeze
from cdmisfa.core.clock import START_NS
from cdmisfa.core.errors import LogExhaustedError, Registry
from cdmisfa.kernels import cos, sin
from recorder.config import SceneConfig, check_view_names

# Frames after which every stream repeats, from the paper: theta_t = 2 pi t / 500.
PERIOD = 500


def x1(theta: FloatArray) -> FloatArray:
    """Return stream 1, (n, 2), at phases theta, (n,); its slow feature has frequency 4/500.

    Equation: 7
    """
    fast = cos(44 * theta)
    return np.stack([sin(4 * theta - np.pi / 4) - fast**2, fast], axis=1)


def x2(theta: FloatArray) -> FloatArray:
    """Return stream 2, (n, 2), at phases theta, (n,); its slow feature has frequency 3/500.

    Equation: 8
    """
    fast = cos(27 * theta)
    return np.stack([sin(3 * theta) + fast**2, fast], axis=1)


def x3(theta: FloatArray) -> FloatArray:
    """Return stream 3, (n, 2), at phases theta, (n,); its slow feature has frequency 2/500.

    Equation: 9
    """
    fast = cos(12 * theta)
    return np.stack([fast, cos(2 * theta) + fast**2], axis=1)


def zero(theta: FloatArray) -> FloatArray:
    """Return the zero stream, (n, 2), of the non-stationary environment."""
    return np.zeros((len(theta), 2))


_Signal = Callable[[FloatArray], FloatArray]
STREAMS: Registry[_Signal] = Registry(
    "oscillatory stream", {"x1": x1, "x2": x2, "x3": x3, "zero": zero}
)


def one_period(name: str) -> FloatArray:
    """Return all PERIOD frames of a stream, (500, 2).

    Blocks are taken from this table, so that their bits do not depend on how they are cut.

    Raises:
        UsageError: the stream does not exist.
    """
    theta = 2 * np.pi * np.arange(PERIOD) / PERIOD
    return freeze(np.ascontiguousarray(STREAMS[name](theta)))


@dataclass(frozen=True, slots=True)
class OscillatoryConfig(SceneConfig):
    """The oscillatory streams (keys `scene.*`).

    Attributes:
        streams: names of the streams: any of `x1`, `x2`, `x3` and `zero` (constant).
    """

    kind: Literal["oscillatory"] = "oscillatory"
    streams: tuple[str, ...] = ("x1", "x2", "x3")

    def __post_init__(self) -> None:
        SceneConfig.__post_init__(self)
        check_view_names(self.streams, "scene.streams")


class OscillatorySource(ClockedSource):
    """Source of the paper's oscillatory streams: two numbers a frame.

    Args:
        streams: names of streams: any of "x1", "x2", "x3" and "zero".
        fps: frames per second.
        start_ns: log time of frame 0 (ns).
        length: number of frames of the streams; None: endless.

    Raises:
        UsageError: a stream does not exist.

    Example:
        >>> source = OscillatorySource()
        >>> source.take(0, 100).frames.shape
        (100, 2)
    """

    def __init__(
        self,
        streams: Sequence[str] = ("x1", "x2", "x3"),
        *,
        fps: float = 50.0,
        start_ns: int = START_NS,
        length: int | None = None,
    ) -> None:
        self._names = list(streams)
        self._tables = [one_period(name) for name in streams]
        self._spec = SourceSpec(tuple(streams), (2,), "float64", ("theta",), fps, start_ns, length)

    def replace(self, stream: int, name: str) -> None:
        """Replace the signal of a stream from the next block on (an abrupt change)."""
        self._tables[stream] = one_period(name)
        self._names[stream] = name

    def take(self, stream: int, n: int) -> Block:
        """Return the next n frames of a stream; see `FrameSource.take`."""
        check_request(self._spec, stream, n)
        length = self._spec.length
        if length is not None and self._t + n > length:
            raise LogExhaustedError(f"the streams end at frame {length}, before {self._t + n}")
        index = (self._t + np.arange(n)) % PERIOD
        frames = self._tables[stream][index]
        block = Block(stream, self._t, freeze(frames), freeze(2 * np.pi * index[:, None] / PERIOD))
        self._t += n
        return block

    def describe(self) -> Mapping[str, Any]:
        """Return the kind and the present signals of the streams."""
        return {"kind": "oscillatory", "streams": list(self._names)}
