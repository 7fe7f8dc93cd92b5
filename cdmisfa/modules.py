"""`Module`: slow features that a run learned and saved; `Stack`: several of them at once."""

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

if TYPE_CHECKING:  # learners must not import image code; who saves a module adds its recipe
    from recorder.images.framing import Recipe

# Frames that are expanded at once, few enough to stay in the processor's cache. It changes the
# speed only.
CHUNK = 1024

# Kinds of the outputs of a module.
SLOW, PRINCIPAL = "slow", "principal"


@dataclass(frozen=True, slots=True, repr=False)
class Module(Described):
    """Slow features that are saved and no longer change.

    Attributes:
        index: number of the module, from 1.
        stream: name of the stream from which it was saved.
        stream_index: index of that stream, from 0.
        iteration: iteration after which it was saved.
        phi: (J, I) weights; y = phi (x - mean), where x is a frame after scaling and expansion.
        mean: (I,) mean of the input.
        band_mean: (J,) running mean of the slowness in a block (cycles a frame).
        band_sd: (J,) running standard deviation of it.
        eta: (J,) slowness of each output when it was saved (cycles a frame).
        policy: (S,) policy for each stream: 0 stay, 1 switch.
        centres: (S, C, tau, J) cluster centres; empty except for CD-MISFA 1.0.
        counts: (S, C) counts of the clusters; empty except for CD-MISFA 1.0.
        expansion: expansion of the frames, a name in `EXPANSIONS`.
        scale: value of one gray level: 1/255, or 1 if it learned from values.
        frame_shape: shape of the frames, (height, width) or (values,); empty if unknown, for a
            module that was not learned.
        slow: (J,) 1 where a slow output is slow on frames that it had not learned from, else 0;
            empty except for the progress learner.
        kinds: kind of each output: `SLOW`, or `PRINCIPAL` for a principal component of variance 1;
            by default all are slow.
        recipe: how a raw image becomes a frame; None while the module is in a learner.
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
    kinds: tuple[str, ...] = ()
    recipe: Recipe | None = None

    def __post_init__(self) -> None:
        """Make the kinds a tuple, and call all outputs slow unless their kinds are given."""
        kinds = tuple(map(str, self.kinds)) or (SLOW,) * len(self.phi)
        object.__setattr__(self, "kinds", kinds)

    def transform(
        self, frames: Any, outputs: int | slice | Sequence[int] | None = None
    ) -> NDArray[np.float64]:
        """Return the outputs y = phi (x - mean) on frames or raw images, the same bits everywhere.

        Args:
            frames: see `rows`; if the recipe centres episodes, give one whole episode.
            outputs: indices of the outputs, the slowest first: a number, a slice or a list;
                None: all.

        Returns:
            (n, J), or one column for each chosen output; the same bits as the signal `y_frozen` of
            the run.

        Raises:
            UsageError: the frames have another shape or type, or a value is not finite.
            IndexError: the module does not have such an output.
        """
        chosen = self.phi
        if outputs is not None:
            chosen = chosen[outputs if isinstance(outputs, slice) else np.atleast_1d(outputs)]
        phi = np.ascontiguousarray(chosen, np.float64)
        offset = kernels.mean_output(phi, self._mean)
        return _projected(self.rows(frames), self.expansion, phi, offset)

    @property
    def labels(self) -> list[str]:
        """Number of each output from 1, and `slow`, `not slow` or `principal` if that is known."""
        if not len(self.slow):
            return [str(j) for j in range(1, len(self.phi) + 1)]
        kinds = zip(self.kinds, self.slow, strict=True)
        texts = [kind if is_slow or kind != SLOW else "not slow" for kind, is_slow in kinds]
        return [f"{j} {text}" for j, text in enumerate(texts, 1)]

    @property
    def _mean(self) -> NDArray[np.float64]:
        return np.ascontiguousarray(self.mean, np.float64)

    def rows(self, frames: Any, *, centre: bool = True) -> NDArray[Any]:
        """Return frames or raw images as rows of the values that the module learned from.

        Args:
            frames: (n, *frame_shape), or the same as rows, uint8 or float, or a table. A module
                with a recipe also takes raw images of any size, see `make_frame`.
            centre: True to subtract the mean of the episode if the recipe does so.

        Returns:
            (n, values).

        Raises:
            UsageError: the frames have another shape or type, or a value is not finite.
        """
        array = as_array(frames if self.recipe is None else self._by_recipe(frames, centre))
        expected, shape = self.frame_shape, array.shape[1:]
        if expected:
            fits = shape in (expected, (prod(expected),))
        else:
            fits = expanded_size(self.expansion, prod(shape)) == self.phi.shape[1]
        if array.ndim < 2 or not fits or (array.dtype != UINT8 and array.dtype.kind != "f"):
            sizes = ", ".join(map(str, expected)) or "values"
            raise UsageError(
                f"frames are {array.dtype} {array.shape}: give uint8 pixels or float values, "
                f"(n, {sizes})"
            )
        rows = array.reshape(len(array), prod(shape))
        if rows.dtype == UINT8:
            return rows if self.scale == PIXEL else rows.astype(np.float64)
        if not np.isfinite(rows).all():
            row, place = (int(indices[0]) for indices in np.nonzero(~np.isfinite(rows)))
            raise UsageError(
                f"frame {row} holds {rows[row, place]} at index {place}, which is not finite: "
                "leave the frame out, or fill the value in"
            )
        return rows.astype(np.float64)

    def _by_recipe(self, data: Any, centre: bool) -> Any:
        """Return frames from raw images; frames that the recipe made already do not change."""
        recipe, expected = self.recipe, self.frame_shape
        assert recipe is not None
        data = without_table(data)
        shape = getattr(data, "shape", ())
        if centre and recipe.centre != "run":
            rows = shape[1:] == (prod(expected),)
            frames = recipe.frames(np.reshape(data, (-1, *expected)) if rows else data)
            return centred(frames, mean_of([frames])) if len(frames) else frames
        try:
            array = np.asarray(data)
        except ValueError:  # images of several sizes
            return recipe.frames(data)
        images = recipe.size is not None
        values = array.dtype == UINT8 or array.dtype.kind == "f"
        bounded = recipe.range is not None and not images and recipe.centre == "run"
        framed = array.shape[1:] in (expected, (prod(expected),)) or array.shape == expected
        if not framed or not values or bounded:
            return recipe.frames(array if array.dtype.kind in "biuf" else data)
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
    """Yield each module with the slice of its columns among the outputs of all modules."""
    ends = accumulate((len(module.phi) for module in modules), initial=0)
    for module, (low, high) in zip(modules, pairwise(ends), strict=True):
        yield module, slice(low, high)


class Stack:
    """Several modules of one run, whose outputs are computed in one pass.

    Args:
        modules: at least one module.

    Attributes:
        modules: the modules.
    """

    def __init__(self, modules: Sequence[Module]) -> None:
        self.modules = tuple(modules)
        by_shape: dict[tuple[int, ...], list[tuple[Module, slice]]] = {}
        for module, columns in columns_of(modules):
            by_shape.setdefault(module.frame_shape, []).append((module, columns))
        self._parts: list[tuple[Module, NDArray[np.intp], Any, Any]] = []
        for part in by_shape.values():
            weights = [np.ascontiguousarray(m.phi, np.float64) for m, _ in part]
            pairs = zip(weights, part, strict=True)
            means = [kernels.mean_output(phi, module._mean) for phi, (module, _) in pairs]
            places = np.concatenate([np.arange(c.start, c.stop) for _, c in part])
            stacked = np.concatenate(weights), np.concatenate(means)
            self._parts.append((part[0][0], places, *stacked))

    def transform(self, frames: Any) -> NDArray[np.float64]:
        """Return the outputs of all modules side by side, (n, R), equal to those of each module.

        Of modules for frames of several shapes, those for another shape have NaN.

        Args:
            frames: see `Module.rows`; without the mean of their episode if the modules learned
                from centred frames.
        """
        y = np.full((len(frames), sum(len(places) for _, places, _, _ in self._parts)), np.nan)
        for module, places, phi, offset in self._parts:
            if len(self._parts) == 1 or np.shape(frames)[1:] == module.frame_shape:
                rows = module.rows(frames, centre=False)
                y[:, places] = _projected(rows, module.expansion, phi, offset)
        return y


def _projected(
    rows: NDArray[Any], expansion: str, phi: NDArray[np.float64], offset: NDArray[np.float64]
) -> NDArray[np.float64]:
    y = np.empty((len(rows), len(phi)))
    for start in range(0, len(rows), CHUNK):
        x = expand(expansion, rows[start : start + CHUNK])
        y[start : start + CHUNK] = kernels.outputs(phi, offset, x)
    return y
