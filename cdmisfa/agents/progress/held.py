"""The candidates that a progress learner holds at once."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cdmisfa.agents.progress.candidate import Candidate
from cdmisfa.agents.progress.streams import LEARNING

HELD: Final = 32
"""At most; those of other streams are begun anew when they are watched."""

MEMORY: Final = 2 * 1024**3
"""Bytes that they may take together; where frames are large fewer of them are held."""


class Candidates(dict[int, Candidate]):
    """Those that are held, by their streams.

    Args:
        new: makes one.
        size: bytes of one.

    Attributes:
        most: held at once.
    """

    def __init__(self, new: Callable[[], Candidate], size: int) -> None:
        super().__init__()
        self._new = new
        self.most = max(2, min(HELD, MEMORY // size))

    def begun(self, stream: int, streams: NDArray[Any]) -> Candidate:
        """That of a stream, for which another may have to go.

        Args:
            stream: which.
            streams: the table of all, (S,) of `STREAM`.
        """
        if stream not in self:
            while len(self) >= self.most:
                idle = [s for s in self if streams["state"][s] != LEARNING]
                del self[min(idle or self, key=lambda s: streams["last"][s])]
            self[stream] = self._new()
        return self[stream]

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """Everything that changes in them, by name, a copy."""
        held = sorted(self)
        arrays = {
            f"candidate.{stream}.{name}": array.copy()
            for stream in held
            for name, array in self[stream].arrays.items()
        }
        return arrays | {"held": np.array(held, dtype=np.int64)}

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Hold what others did, of `arrays` among more.

        Raises:
            ValueError: an array is missing or of another shape or type.
        """
        self.clear()
        for stream in arrays.get("held", np.zeros(0, np.int64)).tolist():
            prefix = f"candidate.{stream}."
            parts = {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}
            self[stream] = self._new()
            self[stream].restore(parts)
