"""A module: an abstraction that was learned, saved and frozen."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate, pairwise
from math import prod
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa import kernels
from cdmisfa.core.arrays import as_array, centred, mean_of, without_table
from cdmisfa.core.blocks import PIXEL, UINT8
from cdmisfa.core.errors import UsageError
from cdmisfa.core.expansion import expand, expanded_size
from cdmisfa.core.shown import Shown, weights

if TYPE_CHECKING:  # the mind knows no images: who saves a module adds how they became frames
    from recorder.images.framing import Recipe

CHUNK = 1024
"""Frames that are turned into values at once."""


@dataclass(frozen=True, slots=True, repr=False)
class Module(Shown):
    """A frozen abstraction with the policy that led to it.

    Attributes:
        index: order of learning, from 1.
        stream: name of the stream that was watched when it was saved.
        stream_index: that stream, from 0.
        iteration: iteration at whose end it was saved.
        phi: (J, I) weights; y = phi (x - mean), x after scaling and expansion.
        mean: (I,) mean of the input.
        band_mean: (J,) running mean of eta_inst; centre of the novelty band.
        band_sd: (J,) running standard deviation of eta_inst.
        eta: (J,) slowness of each output when saved, cycles per frame.
        policy: (S,) 0 stay, 1 switch, for each stream.
        centres: (S, C, tau, J) centres of the clusters; empty but for CD-MISFA 1.0.
        counts: (S, C) what each centre has seen; empty but for CD-MISFA 1.0.
        expansion: how its input was expanded.
        scale: what one step of a uint8 counts: 1/255, or 1 where it learned from values.
        frame_shape: of the frames it learned from, (height, width) or (values,); empty where that
            is not known, of a module made by hand.
        slow: (J,) 1 where an output is slow on frames that it had not learned from, 0 where it is
            not; empty but for the progress learner.
        recipe: what became of a raw picture before; None of a learner in memory.
    """

    index: int
    stream: str
    stream_index: int
    iteration: int
    phi: NDArray[np.float64]
    mean: NDArray[np.float64]
    band_mean: NDArray[np.float64]
    band_sd: NDArray[np.float64]
    eta: NDArray[np.float64]
    policy: NDArray[np.int64]
    centres: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0, 0, 0)))
    counts: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0)))
    expansion: str = "none"
    scale: float = PIXEL
    frame_shape: tuple[int, ...] = ()
    slow: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    recipe: Recipe | None = None

    def transform(
        self, frames: Any, outputs: int | slice | Sequence[int] | None = None
    ) -> NDArray[np.float64]:
        """Outputs on frames or raw pictures, y = phi (x - mean), the same bits on every machine.

        Args:
            frames: (n, *frame_shape), or these as rows (n, I), uint8 or values, tables too; it
                scales the former and expands both as it learned them. Where it has a recipe,
                pictures of any size as the source gave them, too; see `make_frame`. Where that
                centres episodes, one whole episode.
            outputs: which of the outputs, from 0, the slowest first: a number of one, a slice, or
                a list of some; all where it is not given.

        Returns:
            (n, J), or as many columns as outputs were chosen, to the bit what the run that learned
            it recorded as y_frozen.

        Raises:
            UsageError: these are no frames as it learned from, a value is no finite number, or it
                has no such outputs.
        """
        rows = self._inputs(self._episode(frames))
        phi = np.ascontiguousarray(self._chosen(outputs), np.float64)
        return _projected(rows, self.expansion, phi, kernels.mean_output(phi, self._mean))

    @property
    def _mean(self) -> NDArray[np.float64]:
        return np.ascontiguousarray(self.mean, np.float64)

    def _episode(self, given: Any) -> Any:
        """The frames of an episode without its mean, where it learned from such."""
        if self.recipe is None or self.recipe.centre == "run":
            return given
        given = without_table(given)
        if getattr(given, "shape", ())[1:] == (prod(self.frame_shape),):
            given = np.reshape(given, (-1, *self.frame_shape))
        frames = self.recipe.frames(given)
        return centred(frames, mean_of([frames])) if len(frames) else frames

    def _inputs(self, frames: Any) -> NDArray[Any]:
        """Frames or raw pictures as scaled rows; see `transform`."""
        array = self._frames(frames)
        if array.dtype != UINT8 and array.dtype.kind != "f":
            raise UsageError(f"frames of {array.dtype} given: give uint8 pixels or float values")
        rows = self._rows(array)
        if rows.dtype != UINT8 and not np.isfinite(rows).all():
            row, place = (int(found[0]) for found in np.nonzero(~np.isfinite(rows)))
            raise UsageError(
                f"frame {row} holds {rows[row, place]} at place {place}, which is no finite "
                "number: leave it out, or fill it in"
            )
        if rows.dtype != UINT8 or self.scale != PIXEL:
            rows = rows.astype(np.float64)
        return rows

    def _facts(self) -> Mapping[str, Any]:
        shape = "x".join(map(str, self.frame_shape)) or f"{self.phi.shape[1]} values"
        eta = ", ".join(f"{value:.3g}" for value in self.eta)
        return {
            "module": self.index,
            "of": self.stream,
            "saved at iteration": self.iteration,
            "frames": shape,
            "slowness": eta,
        }

    def _picture(self) -> NDArray[np.uint8] | None:
        """The weights of the slowest output."""
        own = self.frame_shape
        plain = len(own) == 2 and prod(own) == self.phi.shape[1]
        return weights(self.phi[0].reshape(own if plain else (1, -1)))

    def _frames(self, given: Any) -> NDArray[Any]:
        """Frames as they were given, or made of raw pictures."""
        if self.recipe is None:
            return as_array(given)
        own, given = self.frame_shape, without_table(given)
        try:
            array = np.asarray(given)
        except ValueError:  # of several sizes
            return self.recipe.frames(given)
        shaped = array.shape[1:] in (own, (prod(own),)) or array.shape == own
        plain = self.recipe.size is not None or self.recipe.centre == "episode"
        bounded = self.recipe.range is not None and not plain
        if shaped and (array.dtype == UINT8 or array.dtype.kind == "f") and not bounded:
            if self.recipe.size and array.dtype.kind == "f" and (array > 1).any():
                raise UsageError(
                    f"frames of {array.dtype} hold {array.max():g}: scale them to 0 to 1, or give "
                    "uint8"
                )
            return array
        return self.recipe.frames(array if array.dtype.kind in "biuf" else given)

    def _chosen(self, outputs: int | slice | Sequence[int] | None) -> NDArray[np.float64]:
        """The weights of some outputs, see `transform`."""
        if outputs is None:
            return self.phi
        try:
            return self.phi[outputs if isinstance(outputs, slice) else np.atleast_1d(outputs)]
        except (IndexError, TypeError) as error:
            raise UsageError(
                f"no outputs {outputs!r}: this module has {len(self.phi)}, counted from 0"
            ) from error

    def _rows(self, array: NDArray[Any]) -> NDArray[Any]:
        """Frames as rows."""
        shape, size, own = array.shape[1:], prod(array.shape[1:]), self.frame_shape
        right = not own or shape in (own, (prod(own),))
        if array.ndim > 1 and right and self._fits(size):
            return array.reshape(len(array), size)
        wanted = f"give ({', '.join(map(str, ('n', *(own or ('values',)))))})"
        if array.shape == own or (not own and self._fits(array.size)):
            raise UsageError(
                f"a single frame of shape {array.shape} given: {wanted}, as frame[None]"
            )
        if array.ndim < 2:
            raise UsageError(f"frames of shape {array.shape} given: {wanted}")
        if own:
            raise UsageError(
                f"frames of shape {shape} given: this module learned from {own}, {wanted}"
            )
        raise UsageError(
            f"frames of {size} values given: this module has {self.phi.shape[1]} weights an "
            "output, give frames of the size that it learned from"
        )

    def _fits(self, size: int) -> bool:
        """Whether frames of so many values expand to this module's inputs."""
        return bool(expanded_size(self.expansion, size) == self.phi.shape[1])


def columns_of(modules: Sequence[Module]) -> Iterator[tuple[Module, slice]]:
    """Each module with its columns among the outputs of all."""
    ends = accumulate((len(module.phi) for module in modules), initial=0)
    for module, (low, high) in zip(modules, pairwise(ends), strict=True):
        yield module, slice(low, high)


class Stack:
    """Several modules of one run side by side, whose outputs are computed in one pass.

    Args:
        modules: at least one.

    Attributes:
        modules: the same.
    """

    def __init__(self, modules: Sequence[Module]) -> None:
        self.modules = tuple(modules)
        self._phi = np.ascontiguousarray(np.concatenate([m.phi for m in modules]), np.float64)
        each = [np.ascontiguousarray(m.phi, np.float64) for m in modules]
        means = [kernels.mean_output(p, m._mean) for p, m in zip(each, modules, strict=True)]
        self._offset = np.concatenate(means)

    def transform(self, frames: Any) -> NDArray[np.float64]:
        """Outputs of each module, one beside the other, (n, R), to the bit those that it gives.

        Args:
            frames: see `Module.transform`, as for what it raises; without the mean of their
                episode, where they learned from such.
        """
        rows = self.modules[0]._inputs(frames)
        return _projected(rows, self.modules[0].expansion, self._phi, self._offset)


def _projected(
    rows: NDArray[Any], expansion: str, phi: NDArray[np.float64], offset: NDArray[np.float64]
) -> NDArray[np.float64]:
    y = np.empty((len(rows), len(phi)))
    for start in range(0, len(rows), CHUNK):
        x = expand(expansion, rows[start : start + CHUNK])
        y[start : start + CHUNK] = kernels.outputs(phi, offset, x)
    return y
