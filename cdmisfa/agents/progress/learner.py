"""`ProgressLearner`: every slow feature of any streams, with one candidate a stream.

Each candidate is tested on a block before it learns from it. A feature that is slow on frames not
yet learned from, and settled, becomes a module; a stream whose feature a module gives already is
known; a stream in which nothing is slow is rejected. The learner stays with a stream until that is
decided, and it is over when no stream is being learned.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa import kernels
from cdmisfa.agents.inputs import count_inputs, rows_of, signals_of_block
from cdmisfa.agents.progress import judging
from cdmisfa.agents.progress.attention import RECENT, RULES, ProgressConfig, Situation, interest
from cdmisfa.agents.progress.candidate import Candidate, Candidates
from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.blocks import PIXEL, Block, SourceSpec
from cdmisfa.core.expansion import expand, expanded_size
from cdmisfa.core.learning import LearnerState, overwrite
from cdmisfa.core.signals import BlockSignals
from cdmisfa.modules import Module

# Fewest blocks of a window of tests, however long a block is.
FEWEST_BLOCKS = 20

# Windows of tests over which the output of a decided stream's module is averaged.
WATCHED = 0.4

# To be raised when the rules decide otherwise than before: runs of another version are neither
# continued nor checked.
DECIDING = 4

COUNTS = np.dtype([("iteration", "i8"), ("stream", "i8"), ("stay", "i8"), ("idle", "i8")])


class ProgressLearner:
    """A learner with one candidate a stream, attention to undecided streams, and an end.

    Args:
        config: its configuration.
        spec: the source it learns from.
        seed: seed of its random generator.

    Attributes:
        modules: the saved modules.
        events: what happened in the last iteration, one line each.
        rule: chooses the next stream; that of the configuration unless another is assigned.
    """

    configuration = ProgressConfig
    preset = "cameras"

    def __init__(self, config: ProgressConfig, spec: SourceSpec, seed: int) -> None:
        self.config, self.spec = config, spec
        self.modules: list[Module] = []
        self.events: tuple[str, ...] = ()
        # Products beyond the components that are whitened would drive out what is slow.
        few = expanded_size("quadratic", math.prod(spec.frame_shape)) <= config.components
        self._expansion = config.expansion or ("quadratic" if few else "none")
        self._n_inputs = count_inputs(self._expansion, spec)
        self._n_outputs = min(config.outputs, self._n_inputs)
        self._scale = PIXEL if spec.dtype == "uint8" else 1.0
        self._window = max(FEWEST_BLOCKS, -(-config.test_frames // config.tau))
        self._watched = int(WATCHED * self._window)
        self._rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed)))
        self._counts = np.zeros(1, COUNTS)
        self._counts["stream"] = int(self._rng.random() * len(spec.streams))
        self._streams = judging.new_streams(len(spec.streams))
        size = 8 * self._n_inputs * (2 * config.components + self._n_outputs + 4)
        self._candidates = Candidates(self._new_candidate, size)
        self.rule = RULES[config.attention]
        self._freeze()

    @property
    def tau(self) -> int:
        """Frames the learner wants in each block."""
        return self.config.tau

    @property
    def stream(self) -> int:
        """Stream the learner wants to watch next."""
        return int(self._counts["stream"][0])

    def watch(self, stream: int) -> None:
        """Have it watch another stream next than it chose."""
        counts = self._counts[0]
        if stream != counts["stream"]:
            counts["stream"], counts["stay"] = stream, 0

    @property
    def arithmetic(self) -> int:
        """Version of how it computes; see `arithmetic_of`."""
        return kernels.ARITHMETIC + DECIDING

    @property
    def iteration(self) -> int:
        """Iterations so far."""
        return int(self._counts["iteration"][0])

    @property
    def phi(self) -> FloatArray:
        """Weights of the candidate of the stream to watch next, (J, I), a copy."""
        candidate = self._candidates.get(self.stream)
        if candidate is None:
            return np.zeros((self._n_outputs, self._n_inputs))
        return candidate.sfa.phi

    @property
    def over(self) -> str:
        """Whether no stream is being learned, nor was for `learner.watch` blocks; see `Learner`."""
        return (
            "all_decided"
            if not self._learning.any() and self._counts["idle"][0] > self.config.watch
            else ""
        )

    @property
    def max_modules(self) -> None:
        """It ends by itself."""
        return None

    @property
    def state(self) -> LearnerState:
        """The learner's state, a copy."""
        arrays = self._candidates.arrays
        arrays |= {name: array.copy() for name, array in self._tables.items()}
        return LearnerState(arrays, tuple(self.modules), self._rng.bit_generator.state)

    def restore(self, state: LearnerState) -> None:
        """Go to a state of a learner with the same configuration, spec and seed.

        Raises:
            ValueError: an array is missing or of another shape or type.
        """
        overwrite(self._tables, state.arrays)
        self._candidates.restore(state.arrays)
        self.modules = list(state.modules)
        self._freeze()
        self._rng.bit_generator.state = dict(state.policy_rng)

    def step(self, block: Block) -> BlockSignals:
        """Do one iteration: test on tau frames, learn from them, and choose the next stream.

        Args:
            block: tau frames of the stream the learner asked for.

        Raises:
            ValueError: the block is of another stream, length, frame shape or type.
            CdmisfaError: it holds a value that is no finite number.
        """
        frames = expand(self._expansion, rows_of(block, self.spec, self.stream, self.tau))
        stream, count = block.stream, len(self.modules)
        row, counts = self._streams[stream], self._counts[0]
        novel = int(row["state"]) == judging.LEARNING
        candidate = self._candidates.opened(stream, self._learning, self._streams["last"])
        y_frozen = kernels.outputs(self._phi, self._offset, frames)
        error = candidate.error
        candidate.learn(frames, gap=int(row["next"]) != block.t)
        row["next"], row["last"] = block.t + len(block), counts["iteration"]
        row["visits"] += 1
        counts["iteration"] += 1
        if int(row["module"]) >= 0:
            judging.take_output(
                row, y_frozen[:, int(row["module"]) * self._n_outputs], self._watched
            )
        self.events = self._judge(stream, candidate, frames) + self._look_again()
        counts["idle"] = 0 if self._learning.any() else counts["idle"] + 1
        interests, explored = self._choose(self._rng.random(2))
        tested, gained = candidate.tested, error - candidate.error
        frozen = y_frozen.reshape(len(block), count, self._n_outputs).transpose(1, 0, 2)
        slowness = [kernels.instantaneous_slowness(y) for y in frozen]
        shape = (count, self._n_outputs)
        signals: dict[str, Any] = {
            "novel": novel and candidate.alive,
            "known_by": int(row["module"]) + 1 if candidate.alive else -1,
            "saved": len(self.modules) > count,
            "novel_blocks": candidate.blocks,
            "y": candidate.y,
            "y_frozen": np.ascontiguousarray(frozen),
            "eta": tested,
            "eta_inst": kernels.instantaneous_slowness(candidate.y),
            "eta_inst_frozen": np.array(slowness).reshape(shape),
            "band_mean": np.array([module.eta for module in self.modules[:count]]).reshape(shape),
            "curiosity": gained,
            "reward": gained,
            "R": np.empty((0, 2, 0)),
            "policy": self._policy,
            "epsilon": self.config.explore,
            "explored": explored,
            "action": int(self.stream != stream),
            "next_stream": self.stream,
            "change": candidate.change,
            "tested": float(tested[0]),
            "fitted": candidate.fitted,
            "learning_error": candidate.error,
            "interest": interests,
            "state": self._streams["state"].copy(),
            "typical": candidate.typical,
            "regret": candidate.regret,
        }
        if candidate.tests:
            signals["variance"] = candidate.variance
        sizes = {"outputs": len(tested), "modules": count}
        return signals_of_block(block, self.spec, self.iteration - 1, **sizes, **signals)

    def summary(self) -> dict[str, Any]:
        """Return the outcome of each stream, as JSON values."""
        return {
            "final_policy": self._policy.tolist(),
            "epsilon": self.config.explore,
            "streams": judging.outcomes(
                self.spec.streams, self._streams, self._candidates, self.config.test_frames
            ),
        }

    @property
    def _tables(self) -> dict[str, NDArray[Any]]:
        """Everything that changes in it but for its candidates, by name; no copies."""
        return {"streams": self._streams, "counts": self._counts}

    @property
    def _learning(self) -> NDArray[np.bool_]:
        """(S,) which streams are being learned."""
        return np.asarray(self._streams["state"] == judging.LEARNING)

    @property
    def _policy(self) -> NDArray[np.int64]:
        """(S,): 0 stay with a stream, for it is being learned; 1 switch."""
        return np.where(self._learning, 0, 1)

    def _new_candidate(self) -> Candidate:
        c = self.config
        return Candidate(self._n_inputs, c.components, c.outputs, c.window, self._window)

    def _judge(self, stream: int, candidate: Candidate, frames: NDArray[Any]) -> tuple[str, ...]:
        """Decide on a stream, and return the events."""
        row = self._streams[stream]
        state, module = int(row["state"]), int(row["module"])
        if judging.mastered(candidate, self.config):
            del self._candidates[stream]
            return self._settle(stream, candidate, frames)
        if state == judging.LEARNING:
            why = judging.hopeless(candidate, self.config)
            if not why and judging.stale(candidate, self.config):
                del self._candidates[stream]
                if row["visits"] - row["decided"] < judging.PATIENCE * self._window:
                    return self._event(stream, "starts again: its slow feature came to rest")
                why = judging.NO_PROGRESS
            if why == judging.NO_PROGRESS and module >= 0:  # it gives what can be found there
                return self._settle(stream, candidate, frames, module)
            if why:
                code, eta = judging.REASONS.index(why), float(candidate.tested[0])
                judging.decide(row, judging.GIVEN_UP, -1, eta, code)
                return self._event(stream, f"is given up after {row['decided']} blocks: {why}")
        elif state == judging.GIVEN_UP:
            if judging.REASONS[int(row["why"])] != judging.NO_PROGRESS and judging.promising(
                candidate, self.config
            ):
                self._learn_again(stream, -1)
                return self._event(stream, "is learned after all: something in it is slow")
        elif judging.differs(row, self._watched):
            self._learn_again(stream, module)
            return self._event(stream, f"no longer fits module {module + 1}")
        if state != judging.LEARNING and candidate.blocks >= judging.PATIENCE * self._window:
            del self._candidates[stream]
        return ()

    def _settle(
        self, stream: int, candidate: Candidate, frames: NDArray[Any], index: int | None = None
    ) -> tuple[str, ...]:
        """Decide by which module a stream is learned or known; a new one where none gives it."""
        row = self._streams[stream]
        state, before = int(row["state"]), int(row["module"])
        if index is None:
            index = judging.known_by(candidate, self.modules, before, frames)
        new = index is None
        if index is None:
            self.modules.append(self._module(stream, candidate))
            self._freeze()
            index = len(self.modules) - 1
        module = self.modules[index]
        given = candidate.sfa.compare(module.phi[0], frames)
        judging.begin_watching(row, given.variance, given.slowness)
        if index == before and state != judging.LEARNING:
            return ()
        eta = float(candidate.tested[0]) if new else given.slowness
        learned = module.stream_index == stream
        judging.decide(row, judging.LEARNED if learned else judging.KNOWN, index, eta)
        if index == before:
            return self._event(stream, f"still shows what module {index + 1} gives")
        by = "learned by" if learned else f"known by {module.stream}'s"
        what = f"{'has changed and is' if before >= 0 else 'is'} {by} module {index + 1}"
        text = f"{what} after {row['decided']} blocks, slowness {eta:.4f}"
        if new and self._n_outputs > 1:
            text += f", {int(module.slow.sum())} of {self._n_outputs} outputs slow"
        return self._event(stream, text)

    def _learn_again(self, stream: int, module: int) -> None:
        """Begin another candidate for a stream that had been decided."""
        self._candidates.pop(stream, None)
        judging.decide(self._streams[stream], judging.LEARNING, module, math.nan)

    def _event(self, stream: int, text: str) -> tuple[str, ...]:
        return (f"stream {self.spec.streams[stream]} {text}",)

    def _look_again(self) -> tuple[str, ...]:
        """Begin rejected streams again before all is over, and return the events."""
        streams = self._streams
        if self._learning.any():
            return ()
        again = (streams["state"] == judging.GIVEN_UP) & (streams["looks"] < self.config.looks - 1)
        for stream in np.flatnonzero(again).tolist():
            streams["looks"][stream] += 1
            self._learn_again(stream, -1)
        names = ", ".join(self.spec.streams[s] for s in np.flatnonzero(again))
        return (f"looking again at rejected streams: {names}",) if names else ()

    def _module(self, stream: int, candidate: Candidate) -> Module:
        return Module(
            index=len(self.modules) + 1,
            stream=self.spec.streams[stream],
            stream_index=stream,
            iteration=self.iteration - 1,
            phi=candidate.sfa.phi,
            mean=candidate.sfa.mean.copy(),
            band_mean=candidate.tested,
            band_sd=np.full(self._n_outputs, np.nan),
            eta=candidate.tested,
            policy=self._policy,
            expansion=self._expansion,
            scale=self._scale,
            slow=judging.slow_outputs(candidate, self.config),
            frame_shape=self.spec.frame_shape,
        )

    def _freeze(self) -> None:
        """Stack the modules' rows, so that one pass over a block serves all of them."""
        self._phi = np.array([m.phi for m in self.modules]).reshape(-1, self._n_inputs)
        offsets = [kernels.mean_output(m.phi, m.mean) for m in self.modules]
        self._offset = np.array(offsets).reshape(-1)

    def _choose(self, draws: FloatArray) -> tuple[FloatArray, bool]:
        """Choose the next stream; return the interest of each, and whether one was drawn."""
        counts, learning = self._counts[0], self._learning
        candidates = np.zeros(len(learning), dtype=bool)
        candidates[list(self._candidates)] = True
        if (learning & candidates).sum() >= self._candidates.most:
            learning &= candidates
        errors = {s: c.recent_errors(RECENT) for s, c in self._candidates.items()}
        situation = Situation(
            stream=self.stream,
            learning=learning,
            changed=learning & (self._streams["module"] >= 0),
            errors=errors,
            visits=self._streams["visits"],
            draws=draws,
            explore=self.config.explore,
        )
        counts["stay"] += 1
        explored = False
        if counts["stay"] >= self.config.visit or not learning[self.stream]:
            counts["stay"] = 0
            counts["stream"], explored = self.rule(situation)
        return interest(situation), explored
