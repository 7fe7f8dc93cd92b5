"""The interfaces of learners and of sinks, which take the results of a run.

`cdmisfa.experiments.loop.learn_blocks` brings a source, a learner and sinks together, and
uses these members alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

if TYPE_CHECKING:  # sinks of the command line are imported without numpy
    import numpy as np
    from numpy.typing import NDArray

    from cdmisfa.core.blocks import Block
    from cdmisfa.core.signals import BlockSignals
    from cdmisfa.modules import Module


@dataclass(frozen=True, slots=True)
class LearnerState:
    """Everything that changes in a learner, from which it can be restored.

    Attributes:
        arrays: the learner's memory, by name.
        modules: the saved modules.
        policy_rng: state of the policy's random generator, as its `bit_generator.state`.
    """

    arrays: Mapping[str, NDArray[Any]]
    modules: tuple[Module, ...]
    policy_rng: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Keyframe:
    """The state of a run after some iterations, from which it can be resumed.

    Attributes:
        iteration: iterations done.
        t: the source's next frame.
        state: of the learner.
        versions: of the packages that computed it.
    """

    iteration: int
    t: int
    state: LearnerState
    versions: Mapping[str, str]


@runtime_checkable
class Learner(Protocol):
    """Blocks in, signals out. The same blocks give the same signals, bit for bit."""

    @property
    def stream(self) -> int:
        """The stream it wants to watch next."""

    @property
    def tau(self) -> int:
        """Frames it wants in each block."""

    @property
    def iteration(self) -> int:
        """Iterations so far."""

    @property
    def modules(self) -> Sequence[Module]:
        """The modules saved so far."""

    @property
    def events(self) -> Sequence[str]:
        """Messages about the last iteration, one line each."""

    @property
    def phi(self) -> NDArray[np.float64]:
        """Weights of the abstraction being learned, (J, I), a copy."""

    @property
    def over(self) -> str:
        """Why it has nothing left to learn, a key of `loop.ENDINGS`; "" where it has."""

    @property
    def max_modules(self) -> int | None:
        """Modules after which a run ends by default; None: when it is over."""

    def step(self, block: Block) -> BlockSignals:
        """Do one iteration: look at tau frames, learn, and choose the next stream.

        Raises:
            ValueError: it is not the block that was asked for.
            CdmisfaError: it holds a value that is no finite number.
        """

    @property
    def state(self) -> LearnerState:
        """Everything that changes in it, a copy."""

    def restore(self, state: LearnerState) -> None:
        """Go to a state of a learner with the same configuration, spec and seed.

        Raises:
            ValueError: the state is not one of such a learner.
        """

    def summary(self) -> Mapping[str, Any]:
        """Return the learner's part of a run's result, as JSON values."""


# Key of a run's manifest: `arithmetic_of` its learner.
ARITHMETIC = "arithmetic"


def arithmetic_of(learner: Learner) -> int:
    """Version of how a learner computes: with another one all is the same but for the last bits.

    It is the learner's attribute `arithmetic`, 1 of a learner that has none.
    """
    return int(getattr(learner, "arithmetic", 1))


@runtime_checkable
class Sink(Protocol):
    """Takes the iterations and events of a run, in order: a log, a view, a hash, a progress bar.

    A class that derives from it needs `block`, and may define the others.
    """

    def block(self, block: Block, signals: BlockSignals, learner: Learner) -> None:
        """Handle a finished iteration.

        Args:
            block: the watched block.
            signals: of the iteration.
            learner: as it is now; not to be changed.
        """

    def event(self, t: int, iteration: int, text: str, level: str = "INFO") -> None:
        """Something happened that a person wants to read.

        Args:
            t: frame at which.
            iteration: the last one before it.
            text: one line.
            level: "INFO" or "WARNING".
        """
        return

    def finish(self) -> None:
        """Handle the end of a run that no error broke off."""
        return


def overwrite(current: Mapping[str, NDArray[Any]], stored: Mapping[str, NDArray[Any]]) -> None:
    """Write stored arrays into a learner's arrays of the same names, all of them or none.

    Raises:
        ValueError: an array is missing or of another shape or type.
    """
    for name, array in current.items():
        new = stored.get(name)
        if new is None or new.shape != array.shape or new.dtype != array.dtype:
            raise ValueError(f"{name} is missing or of another shape or type")
    for name, array in current.items():
        array[...] = stored[name]


def weights_after(signals: BlockSignals, learner: Learner) -> NDArray[np.float64]:
    """Return the weights (J, I) at the end of the last iteration, frozen where it saved them."""
    return learner.modules[-1].phi if signals.saved else learner.phi
