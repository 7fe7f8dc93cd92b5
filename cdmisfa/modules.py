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
from cdmisfa.core.blocks import PIXEL, UINT8, Described
from cdmisfa.core.errors import UsageError
from cdmisfa.core.expansion import expand, expanded_size

if TYPE_CHECKING:  # the mind knows no images: who saves a module adds how they became frames
    from recorder.images.framing import Recipe

# Frames that are expanded at once: as few as to stay in the processor's cache.
CHUNK = 1024


@dataclass(frozen=True, slots=True, repr=False)
class Module(Described):
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
        """Return outputs on frames or raw images, y = phi (x - mean), the same bits everywhere.

        Args:
            frames: see `rows`; where the recipe centres episodes, one whole episode.
            outputs: which of the outputs, from 0, the slowest first: the number of one, a slice, or
                a list of some; all where it is not given.

        Returns:
            (n, J), or as many columns as outputs were chosen, to the bit what the run that learned
            it recorded as y_frozen.

        Raises:
            UsageError: these are no frames as it learned from, or a value is no finite number.
            IndexError: it has no such outputs.
        """
        chosen = self.phi
        if outputs is not None:
            chosen = chosen[outputs if isinstance(outputs, slice) else np.atleast_1d(outputs)]
        phi = np.ascontiguousarray(chosen, np.float64)
        return _projected(
            self.rows(frames), self.expansion, phi, kernels.mean_output(phi, self._mean)
        )

    @property
    def _mean(self) -> NDArray[np.float64]:
        return np.ascontiguousarray(self.mean, np.float64)

    def rows(self, frames: Any, *, centre: bool = True) -> NDArray[Any]:
        """Return frames or raw images as rows of what the module learned from, (n, values).

        Args:
            frames: (n, *frame_shape), or these as rows, uint8 or values, or a table. A module with
                a recipe also takes images of any size as the source gave them; see `make_frame`.
            centre: subtract the mean of the episode, where the recipe says so.

        Raises:
            UsageError: these are no frames as it learned from, or a value is no finite number.
        """
        array = as_array(frames if self.recipe is None else self._by_recipe(frames, centre))
        own, shape = self.frame_shape, array.shape[1:]
        if own:
            fits = shape in (own, (prod(own),))
        else:
            fits = expanded_size(self.expansion, prod(shape)) == self.phi.shape[1]
        if array.ndim < 2 or not fits or (array.dtype != UINT8 and array.dtype.kind != "f"):
            wanted = ", ".join(map(str, own)) or "values"
            raise UsageError(
                f"frames of {array.dtype} {array.shape} given: give uint8 pixels or float values, "
                f"(n, {wanted})"
            )
        rows = array.reshape(len(array), prod(shape))
        if rows.dtype == UINT8:
            return rows if self.scale == PIXEL else rows.astype(np.float64)
        if not np.isfinite(rows).all():
            row, place = (int(indices[0]) for indices in np.nonzero(~np.isfinite(rows)))
            raise UsageError(
                f"frame {row} holds {rows[row, place]} at place {place}, which is no finite "
                "number: leave it out, or fill it in"
            )
        return rows.astype(np.float64)

    def _by_recipe(self, given: Any, centre: bool) -> Any:
        """Return frames from raw images; frames that the recipe made before stay as they are."""
        recipe, own = self.recipe, self.frame_shape
        assert recipe is not None
        given = without_table(given)
        shape = getattr(given, "shape", ())
        if centre and recipe.centre != "run":
            images = np.reshape(given, (-1, *own)) if shape[1:] == (prod(own),) else given
            frames = recipe.frames(images)
            return centred(frames, mean_of([frames])) if len(frames) else frames
        try:
            array = np.asarray(given)
        except ValueError:  # images of several sizes
            return recipe.frames(given)
        images = recipe.size is not None
        values = array.dtype == UINT8 or array.dtype.kind == "f"
        bounded = recipe.range is not None and not images and recipe.centre == "run"
        made = array.shape[1:] in (own, (prod(own),)) or array.shape == own
        if not made or not values or bounded:
            return recipe.frames(array if array.dtype.kind in "biuf" else given)
        if images and array.dtype.kind == "f" and (array > 1).any():
            raise UsageError(
                f"frames of {array.dtype} hold {array.max():g}: scale them to 0 to 1, or give uint8"
            )
        return array

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


def columns_of(modules: Sequence[Module]) -> Iterator[tuple[Module, slice]]:
    """Yield each module with its columns among the outputs of all."""
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
        """Return the outputs of all modules side by side, (n, R), each to the bit its own.

        Args:
            frames: see `Module.rows`; without the mean of their episode, where the modules
                learned from such.
        """
        rows = self.modules[0].rows(frames, centre=False)
        return _projected(rows, self.modules[0].expansion, self._phi, self._offset)


def _projected(
    rows: NDArray[Any], expansion: str, phi: NDArray[np.float64], offset: NDArray[np.float64]
) -> NDArray[np.float64]:
    y = np.empty((len(rows), len(phi)))
    for start in range(0, len(rows), CHUNK):
        x = expand(expansion, rows[start : start + CHUNK])
        y[start : start + CHUNK] = kernels.outputs(phi, offset, x)
    return y
