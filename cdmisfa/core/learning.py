"""Interfaces of learners and of sinks, the consumers of a run's iterations.

`cdmisfa.experiments.loop.learn_blocks` connects a source, a learner and sinks through these
members only.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

if TYPE_CHECKING:  # the command line imports this module without numpy, to start quickly
    import numpy as np
    from numpy.typing import NDArray

    from cdmisfa.core.blocks import Block
    from cdmisfa.core.signals import BlockSignals
    from cdmisfa.modules import Module


@dataclass(frozen=True, slots=True)
class LearnerState:
    """State of a learner, from which it can be restored.

    Attributes:
        arrays: the learner's arrays, by name.
        modules: the saved modules.
        policy_rng: state of the random generator, as its `bit_generator.state`.
    """

    arrays: Mapping[str, NDArray[Any]]
    modules: tuple[Module, ...]
    policy_rng: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Keyframe:
    """The state of a run after some iterations, from which it can be resumed.

    Attributes:
        iteration: number of iterations done.
        t: number of the source's next frame.
        state: state of the learner.
        versions: versions of the packages that computed the run.
    """

    iteration: int
    t: int
    state: LearnerState
    versions: Mapping[str, str]


@runtime_checkable
class Learner(Protocol):
    """Interface of a learner: the same blocks give the same signals, bit for bit."""

    @property
    def stream(self) -> int:
        """Index of the stream of the next block."""

    @property
    def tau(self) -> int:
        """Number of frames in each block."""

    @property
    def iteration(self) -> int:
        """Number of iterations done."""

    @property
    def modules(self) -> Sequence[Module]:
        """The modules saved so far."""

    @property
    def events(self) -> Sequence[str]:
        """Events of the last iteration, one line each."""

    @property
    def phi(self) -> NDArray[np.float64]:
        """(J, I) weights of the feature being learned, a copy."""

    @property
    def over(self) -> str:
        """Reason to end, a key of `outcomes.END_REASONS`; "" while there is something to learn."""

    @property
    def max_modules(self) -> int | None:
        """Number of modules after which a run ends by default; None if only `over` ends it."""

    def step(self, block: Block) -> BlockSignals:
        """Do one iteration: learn from a block, and choose the next stream.

        Raises:
            ValueError: the block is not the one that the learner asked for.
            CdmisfaError: the block holds a value that is not finite.
        """

    @property
    def state(self) -> LearnerState:
        """A copy of the learner's state."""

    def restore(self, state: LearnerState) -> None:
        """Restore the state of a learner with the same configuration, spec and seed.

        Raises:
            ValueError: the state belongs to a different learner.
        """

    def summary(self) -> Mapping[str, Any]:
        """Return the learner's part of a run's result, as JSON values."""


# Key of a run's manifest: `arithmetic_of` its learner.
ARITHMETIC = "arithmetic"


def arithmetic_of(learner: Learner) -> int:
    """Return the version of a learner's arithmetic: a different version gives different last bits.

    It is the learner's attribute `arithmetic`, or 1 if there is none.
    """
    return int(getattr(learner, "arithmetic", 1))


@runtime_checkable
class Sink(Protocol):
    """Consumer of a run's iterations and events, in order: a log, a view, a hash, a progress bar.

    A derived class defines `block` and may define the other methods.
    """

    def block(self, block: Block, signals: BlockSignals, learner: Learner) -> None:
        """Handle a finished iteration.

        Args:
            block: the block of the iteration.
            signals: the signals of the iteration.
            learner: the learner after the iteration; do not change it.
        """

    def event(self, t: int, iteration: int, text: str, level: str = "INFO") -> None:
        """Handle an event that a person wants to read.

        Args:
            t: number of the frame.
            iteration: number of the last iteration.
            text: one line.
            level: "INFO" or "WARNING".
        """
        return

    def finish(self) -> None:
        """Handle the end of a run that ended without an error."""
        return


def overwrite(current: Mapping[str, NDArray[Any]], stored: Mapping[str, NDArray[Any]]) -> None:
    """Copy stored arrays into a learner's arrays of the same names, all or none of them.

    Raises:
        ValueError: an array is missing or has a different shape or type.
    """
    for name, array in current.items():
        new = stored.get(name)
        if new is None or new.shape != array.shape or new.dtype != array.dtype:
            raise ValueError(f"{name} is missing or has a different shape or type")
    for name, array in current.items():
        array[...] = stored[name]


def weights_after(signals: BlockSignals, learner: Learner) -> NDArray[np.float64]:
    """Return the weights (J, I) after the last iteration, those of the module if it was saved."""
    return learner.modules[-1].phi if signals.saved else learner.phi
