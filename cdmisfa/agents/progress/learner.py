"""`ProgressLearner`: learn the slow features of any streams, with one candidate for each stream.

The candidate of a stream is tested on a block before it learns from it. A slow feature that holds
on frames not learned from yet, and has settled, is saved as a module. A stream whose feature a
module gives already is explained by that module. A stream without slow features is rejected. The
learner attends to a stream until it is decided, and ends when every stream is.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cdmisfa import kernels
from cdmisfa.agents.inputs import rows_of, signals_of_block
from cdmisfa.agents.progress import decisions
from cdmisfa.agents.progress.attention import ERROR_BLOCKS, RULES, Situation, interest
from cdmisfa.agents.progress.candidate import Candidate, Candidates
from cdmisfa.agents.progress.config import ProgressConfig
from cdmisfa.agents.progress.kinds import FrameKinds
from cdmisfa.core.arrays import FloatArray
from cdmisfa.core.blocks import Block, SourceSpec
from cdmisfa.core.expansion import expand
from cdmisfa.core.learning import LearnerState, overwrite
from cdmisfa.core.outcomes import NO_PROGRESS, outcome_text
from cdmisfa.core.signals import STATES, BlockSignals
from cdmisfa.features.recursive import STORED_PER_COMPONENT
from cdmisfa.modules import PRINCIPAL, SLOW, Module

# Smallest test window in blocks, also if `learner.test_frames` holds fewer. Set by hand: the change
# of an output is a mean over blocks, and fewer blocks make it too noisy to compare. It matters from
# 100 frames a block on.
MIN_TEST_BLOCKS = 20

# Exponential window over which the output of a decided stream's module is averaged, in test
# windows: 20 blocks with the default configuration. Set by hand. Smaller values notice a change
# sooner and learn unchanged streams again more often.
MONITOR_WINDOWS = 0.4

# Version of the decision rules. Raise it if the rules decide differently for the same frames: runs
# of another version are then neither resumed nor verified.
DECISION_VERSION = 5

# Counters of the learner: iterations, the next stream, consecutive blocks of that stream, and
# consecutive iterations in which every stream was decided.
COUNTS = np.dtype([("iteration", "i8"), ("stream", "i8"), ("stay", "i8"), ("idle", "i8")])


class ProgressLearner:
    """Learner with one candidate for each stream, which ends when every stream is decided.

    Args:
        config: the configuration.
        spec: the streams and frames of the source.
        seed: seed of the random generator.

    Attributes:
        modules: the saved modules.
        events: events of the last iteration, one line each.
        rule: the attention rule; assign another `Rule` to replace that of the configuration.
    """

    configuration = ProgressConfig
    preset = "cameras"

    def __init__(self, config: ProgressConfig, spec: SourceSpec, seed: int) -> None:
        self.config, self.spec = config, spec
        self.modules: list[Module] = []
        self.events: tuple[str, ...] = ()
        self._kinds = FrameKinds(spec, config)
        self._n_outputs, most = self._kinds.outputs, self._kinds.most_inputs
        self._test_window = max(MIN_TEST_BLOCKS, -(-config.test_frames // config.tau))
        self._monitor_window = int(MONITOR_WINDOWS * self._test_window)
        self._rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed)))
        self._counts = np.zeros(1, COUNTS)
        self._counts["stream"] = int(self._rng.random() * len(spec.streams))
        self._streams = decisions.new_streams(len(spec.streams))
        stored = max(STORED_PER_COMPONENT * config.components, config.wide)
        size = 8 * most * (stored + self._n_outputs + 4)
        self._candidates = Candidates(self._new_candidate, size)
        self.rule = RULES[config.attention]
        self._kinds.stack(self.modules)

    @property
    def tau(self) -> int:
        """Number of frames in each block."""
        return self.config.tau

    @property
    def stream(self) -> int:
        """Index of the stream of the next block."""
        return int(self._counts["stream"][0])

    def watch(self, stream: int) -> None:
        """Take the next block from `stream` instead of the stream that the rule chose."""
        counts = self._counts[0]
        if stream != counts["stream"]:
            counts["stream"], counts["stay"] = stream, 0

    @property
    def arithmetic(self) -> int:
        """Version of the kernels and of the decision rules; see `arithmetic_of`."""
        return kernels.ARITHMETIC + DECISION_VERSION

    @property
    def iteration(self) -> int:
        """Number of iterations done."""
        return int(self._counts["iteration"][0])

    @property
    def phi(self) -> FloatArray:
        """(J, I) weights of the candidate of the next stream, a copy."""
        candidate = self._candidates.get(self.stream)
        if candidate is None:
            return np.zeros((self._n_outputs, self._kinds.inputs(self.stream).size))
        return candidate.sfa.phi

    @property
    def over(self) -> str:
        """Reason to end: "all_decided" if none was being learned for `learner.watch` blocks."""
        return (
            "all_decided"
            if not self._learning.any() and self._counts["idle"][0] > self.config.watch
            else ""
        )

    @property
    def max_modules(self) -> None:
        """None: the learner ends when every stream is decided."""
        return None

    @property
    def state(self) -> LearnerState:
        """A copy of the learner's state."""
        arrays = self._candidates.arrays
        arrays |= {name: array.copy() for name, array in self._tables.items()}
        return LearnerState(arrays, tuple(self.modules), self._rng.bit_generator.state)

    def restore(self, state: LearnerState) -> None:
        """Restore the state of a learner with the same configuration, spec and seed.

        Raises:
            ValueError: an array is missing or has a different shape or type.
        """
        overwrite(self._tables, state.arrays)
        self._candidates.restore(state.arrays)
        self.modules = list(state.modules)
        self._kinds.stack(self.modules)
        self._rng.bit_generator.state = dict(state.policy_rng)

    def step(self, block: Block) -> BlockSignals:
        """Do one iteration: test on a block, learn from it, and choose the next stream.

        Args:
            block: `tau` frames of the stream `stream`.

        Raises:
            ValueError: the block has a different stream, length, frame shape or type.
            CdmisfaError: the block holds a value that is not finite.
        """
        stream, count = block.stream, len(self.modules)
        rows, inputs = rows_of(block, self.spec, self.stream, self.tau), self._kinds.inputs(stream)
        frames = expand(inputs.expansion, rows)
        row, counts = self._streams[stream], self._counts[0]
        undecided = int(row["state"]) == decisions.LEARNING
        candidate = self._candidates.get_or_create(stream, self._learning, self._streams["last"])
        y_frozen = self._kinds.module_outputs(stream, frames)
        error = candidate.error
        candidate.learn(frames, gap=int(row["next"]) != block.t)
        if decisions.is_promising(candidate, self.config):
            candidate.sfa.widen()
        row["next"], row["last"] = block.t + len(block), counts["iteration"]
        row["visits"] += 1
        counts["iteration"] += 1
        if int(row["module"]) >= 0:
            decisions.monitor_output(row, y_frozen[int(row["module"]), :, 0], self._monitor_window)
        self.events = self._decide(stream, candidate, frames) + self._retry_rejected()
        counts["idle"] = 0 if self._learning.any() else counts["idle"] + 1
        interests, explored = self._choose(self._rng.random(2))
        tested, gained = candidate.tested, error - candidate.error
        slowness = [kernels.instantaneous_slowness(y) for y in y_frozen]
        y = self._kinds.spread(candidate.y, inputs)
        shape = (count, self._n_outputs)
        etas = [
            self._kinds.spread(module.eta, self._kinds.inputs(module.stream_index))
            for module in self.modules[:count]
        ]
        signals: dict[str, Any] = {
            "novel": undecided and candidate.varies,
            "known_by": int(row["module"]) + 1 if candidate.varies else -1,
            "saved": len(self.modules) > count,
            "novel_blocks": candidate.blocks,
            "y": y,
            "y_frozen": y_frozen,
            "eta": self._kinds.spread(tested, inputs),
            "eta_inst": kernels.instantaneous_slowness(y),
            "eta_inst_frozen": np.array(slowness).reshape(shape),
            "band_mean": np.array(etas).reshape(shape),
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
            "regret": candidate.improvement,
        }
        if candidate.tests:
            signals["variance"] = self._kinds.spread(candidate.variance, inputs)
        sizes = {"outputs": self._n_outputs, "modules": count}
        return signals_of_block(block, self.spec, self.iteration - 1, **sizes, **signals)

    def summary(self) -> dict[str, Any]:
        """Return the outcome of each stream, as JSON values."""
        return {
            "final_policy": self._policy.tolist(),
            "epsilon": self.config.explore,
            "streams": decisions.outcomes(
                self.spec.streams, self._streams, self._candidates, self.config.test_frames
            ),
        }

    @property
    def _tables(self) -> dict[str, NDArray[Any]]:
        """The arrays of the state except those of the candidates, by name; not copies."""
        return {"streams": self._streams, "counts": self._counts}

    @property
    def _learning(self) -> NDArray[np.bool_]:
        """(S,) True where a stream is being learned."""
        return np.asarray(self._streams["state"] == decisions.LEARNING)

    @property
    def _policy(self) -> NDArray[np.int64]:
        """(S,) 0 (stay) where a stream is being learned, else 1 (switch)."""
        return np.where(self._learning, 0, 1)

    def _new_candidate(self, stream: int) -> Candidate:
        c, size = self.config, self._kinds.inputs(stream).size
        more = {"principal": c.principal, "wide": c.wide}
        return Candidate(size, c.components, c.outputs, c.window, self._test_window, **more)

    def _decide(self, stream: int, candidate: Candidate, frames: NDArray[Any]) -> tuple[str, ...]:
        """Decide about a stream after a block of it, and return the events."""
        row = self._streams[stream]
        state, module = int(row["state"]), int(row["module"])
        most_blocks = decisions.MAX_STALLED_WINDOWS * self._test_window
        if decisions.is_learned(candidate, self.config):
            del self._candidates[stream]
            return self._assign_module(stream, candidate, frames)
        if state == decisions.LEARNING:
            reason = decisions.rejection_reason(candidate, self.config)
            if not reason and decisions.has_vanished(candidate, self.config):
                del self._candidates[stream]
                if row["visits"] - row["decided"] < most_blocks:
                    return self._event(stream, "is learned again: its feature stopped changing")
                reason = NO_PROGRESS
            if reason == NO_PROGRESS and module >= 0:
                # The previous module stays: the new candidate found nothing better.
                return self._assign_module(stream, candidate, frames, module)
            if reason:
                code, eta = decisions.REASONS.index(reason), float(candidate.tested[0])
                decisions.record_decision(row, decisions.REJECTED, -1, eta, code)
                text = outcome_text(STATES[decisions.REJECTED], None, row["decided"], eta, reason)
                return self._event(stream, f"is {text}")
        elif state == decisions.REJECTED:
            final = decisions.REASONS[int(row["why"])] == NO_PROGRESS
            if not final and decisions.is_promising(candidate, self.config):
                self._learn_again(stream, -1)
                return self._event(stream, "is learned again: it has a slow feature after all")
        elif decisions.output_changed(row, self._monitor_window):
            self._learn_again(stream, module)
            return self._event(stream, f"is not explained by module {module + 1} any longer")
        if state != decisions.LEARNING and candidate.blocks >= most_blocks:
            del self._candidates[stream]
        return ()

    def _assign_module(
        self, stream: int, candidate: Candidate, frames: NDArray[Any], index: int | None = None
    ) -> tuple[str, ...]:
        """Assign a stream to a module, save a new module if none fits, and return the events.

        Args:
            stream: index of the stream.
            candidate: candidate of the stream.
            frames: (n, I) the last block of the stream.
            index: index of the module, if it is decided already.
        """
        row = self._streams[stream]
        state, before = int(row["state"]), int(row["module"])
        if index is None:
            modules = {i: self.modules[i] for i in self._kinds.modules_for(stream)}
            index = decisions.explaining_module(candidate, modules, before, frames)
        new = index is None
        if index is None:
            self.modules.append(self._module(stream, candidate))
            self._kinds.stack(self.modules)
            index = len(self.modules) - 1
        module = self.modules[index]
        given = candidate.sfa.compare(module.phi[0], frames)
        decisions.start_monitoring(row, given.variance, given.slowness)
        if index == before and state != decisions.LEARNING:
            return ()
        eta = float(candidate.tested[0]) if new else given.slowness
        learned = module.stream_index == stream
        state = decisions.LEARNED if learned else decisions.EXPLAINED
        decisions.record_decision(row, state, index, eta)
        if index == before:
            return self._event(stream, f"is still explained by module {index + 1}")
        text = outcome_text(STATES[state], index + 1, int(row["decided"]), eta)
        if new and self._kinds.slow > 1:
            text += f"; {int(module.slow.sum())} of {module.kinds.count(SLOW)} outputs slow"
        return self._event(stream, f"{'has changed and is' if before >= 0 else 'is'} {text}")

    def _learn_again(self, stream: int, module: int) -> None:
        """Set a decided stream back to being learned, with a new candidate."""
        self._candidates.pop(stream, None)
        decisions.record_decision(self._streams[stream], decisions.LEARNING, module, math.nan)

    def _event(self, stream: int, text: str) -> tuple[str, ...]:
        return (f"stream {self.spec.streams[stream]} {text}",)

    def _retry_rejected(self) -> tuple[str, ...]:
        """Try rejected streams again before the learner ends, and return the events."""
        streams = self._streams
        if self._learning.any():
            return ()
        again = (streams["state"] == decisions.REJECTED) & (
            streams["looks"] < self.config.looks - 1
        )
        for stream in np.flatnonzero(again).tolist():
            streams["looks"][stream] += 1
            self._learn_again(stream, -1)
        names = ", ".join(self.spec.streams[s] for s in np.flatnonzero(again))
        return (f"looking again at rejected streams: {names}",) if names else ()

    def _module(self, stream: int, candidate: Candidate) -> Module:
        inputs = self._kinds.inputs(stream)
        slow = decisions.slow_outputs(candidate, self.config)
        count = min(self.config.outputs, inputs.size)
        slow[count:] = 0
        return Module(
            index=len(self.modules) + 1,
            stream=self.spec.streams[stream],
            stream_index=stream,
            iteration=self.iteration - 1,
            phi=candidate.sfa.phi,
            mean=candidate.sfa.mean.copy(),
            band_mean=candidate.tested,
            band_sd=np.full(len(candidate.tested), np.nan),
            eta=candidate.tested,
            policy=self._policy,
            expansion=inputs.expansion,
            scale=inputs.scale,
            slow=slow,
            kinds=count * (SLOW,) + (len(slow) - count) * (PRINCIPAL,),
            frame_shape=self.spec.kind(stream)[0],
        )

    def _choose(self, draws: FloatArray) -> tuple[FloatArray, bool]:
        """Choose the next stream.

        Returns:
            The interest of each stream (S,), and whether the stream was drawn at random.
        """
        counts, learning = self._counts[0], self._learning
        candidates = np.zeros(len(learning), dtype=bool)
        candidates[list(self._candidates)] = True
        if (learning & candidates).sum() >= self._candidates.capacity:
            learning &= candidates
        errors = {s: c.recent_errors(ERROR_BLOCKS) for s, c in self._candidates.items()}
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
