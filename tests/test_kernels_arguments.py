"""Arguments of the kernels that do not fit are refused, and learners with such a state."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from cdmisfa import kernels
from cdmisfa.agents.agent import OUTCOME, as_struct, frozen_modules, new_agent, rules
from cdmisfa.agents.learner import CuriousLearner
from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.errors import UsageError
from cdmisfa.features.incsfa import IncrementalFeature
from cdmisfa.features.recursive import RecursiveFeature
from cdmisfa.kernels import frames as chunks
from recorder.world.oscillatory import OscillatorySource

TAU, INPUTS, STREAMS = 20, 9, 3
CONFIG = LearnerConfig(algorithm="1.0", tau=TAU, components=4, outputs=2, expansion="none")
FRAMES = np.random.default_rng(0).random((STREAMS * (TAU + 1), INPUTS))
HUGE = 1 << 50
# Arrays whose length is a size of the state: any length is one.
FREE = ("weights", "spectrum")
# An opcode 5, a length, and a header of 22 bytes before a payload of 8.
RECORD = np.frombuffer(b"\x05" + (30).to_bytes(8, "little") + bytes(30), np.uint8)

# Variants of an array; those in `LENGTHS` have another shape.
LENGTHS: Mapping[str, Callable[[np.ndarray], Any]] = {
    "empty": lambda a: a.reshape(-1)[:0].reshape((0,) * a.ndim),
    "shorter": lambda a: a[:-1].copy(),
    "longer": lambda a: np.concatenate([a, a]),
    "narrower": lambda a: a[..., :-1].copy(),
    "another axis": lambda a: a[None].copy(),
    "a number": lambda a: 1.0,
    "huge": lambda a: np.broadcast_to(a.reshape(-1)[:1], (HUGE,) * a.ndim or (HUGE,)),
}
VARIANTS: Mapping[str, Callable[[np.ndarray], Any]] = {
    **LENGTHS,
    "float32": lambda a: np.ones(a.shape, np.float32),
    "text": lambda a: np.full(a.shape, "x"),
    "complex": lambda a: np.ones(a.shape, np.complex128),
    "every second": lambda a: np.repeat(a, 2, axis=0)[::2],
    "Fortran order": lambda a: np.asfortranarray(a),
    "not aligned": lambda a: np.ndarray(a.shape, a.dtype, bytearray(a.nbytes + 1), 1),
    "read-only": lambda a: np.frombuffer(a.tobytes(), a.dtype).reshape(a.shape),
    "not finite": lambda a: np.full(a.shape, np.nan) if a.dtype.kind == "f" else a,
    "infinite": lambda a: np.full(a.shape, np.inf) if a.dtype.kind == "f" else a,
    "negative": lambda a: np.full(a.shape, -5).astype(a.dtype) if a.dtype.kind in "fi" else a,
}

Call = Callable[..., Any]


def of_functions() -> Iterator[tuple[str, Call, dict[str, np.ndarray]]]:
    """Functions of arrays."""
    phi, offset, square = np.ones((2, INPUTS)), np.ones(2), np.ones((3, 3))
    yield "outputs", kernels.outputs, {"phi": phi, "offset": offset, "frames": FRAMES}
    yield "mean_output", kernels.mean_output, {"phi": phi, "mean": FRAMES[0]}
    yield "multiply", kernels.multiply, {"a": square, "b": square}
    yield "slowness", kernels.instantaneous_slowness, {"y": FRAMES}
    yield "sin", kernels.sin, {"x": offset}
    yield "cos", kernels.cos, {"x": offset}
    yield "frames_of", kernels.frames_of, {"frames": FRAMES}
    yield "walk_records", chunks.walk_records, {"data": RECORD}
    messages = chunks.walk_records(RECORD)[0]

    def gather(**arrays: Any) -> Any:
        parts = [arrays[name] for name in ("places", "marks", "distances")]
        copied = chunks.layout(8, *parts, 8)
        return chunks.gather(arrays["data"], arrays["messages"], 0, (0, 1), copied, arrays["out"])

    places, marks = np.array([1]), np.zeros(1, np.uint8)
    given = {"data": RECORD, "messages": messages, "out": np.zeros((1, 8), np.uint8)}
    yield "gather", gather, given | {"places": places, "marks": marks, "distances": 8 * places}


def of_states() -> Iterator[tuple[str, Call, dict[str, np.ndarray]]]:
    """States that kernels change in place; a state of any other shapes is refused."""
    incremental = IncrementalFeature(CONFIG, INPUTS, np.random.default_rng(0))

    def incsfa(**arrays: Any) -> None:
        state = incremental.state._replace(**arrays)
        kernels.incsfa_update(kernels.incsfa(state, 0.05, 100.0), FRAMES, True)

    yield "incsfa", incsfa, incremental.state._asdict()

    def recursive(**arrays: Any) -> None:
        kernels.recursive_update(kernels.recursive_state(arrays, 100), FRAMES, False)

    feature = RecursiveFeature(INPUTS, 4, 2)
    feature.update(FRAMES)
    yield "recursive", recursive, feature.state._asdict()
    agent = new_agent(CONFIG, STREAMS, 0)
    frozen = frozen_modules((), agent, INPUTS)._replace(
        phi=np.ones((2, INPUTS)),
        offset=np.ones(2),
        band_mean=np.ones((1, 2)),
        band_sd=np.ones((1, 2)),
        centres=np.ones((1, *agent.centres.shape)),
        counts=np.ones((1, *agent.counts.shape)),
    )
    out = np.zeros(1, OUTCOME)

    def iterate(**arrays: Any) -> None:
        stack = {name: arrays.pop(f"frozen_{name}") for name in frozen._fields}
        draws, outcome = arrays.pop("uniforms"), arrays.pop("out")
        struct = as_struct(agent._replace(**arrays), rules(CONFIG, STREAMS), outcome)
        block, saved = kernels.frames_of(FRAMES[:TAU]), frozen._replace(**stack).struct
        kernel = IncrementalFeature(CONFIG, INPUTS, np.random.default_rng(0)).kernel
        kernels.iterate(struct, saved, kernel, block, block, 0, draws)
        kernels.action_values(struct)
        x = kernels.frames_of(FRAMES)
        kernels.iterations(struct, saved, kernel, x, x, draws[None], -1.0, None)

    stacked = {f"frozen_{name}": array for name, array in frozen._asdict().items()}
    yield "agent", iterate, agent._asdict() | stacked | {"uniforms": np.ones(3) / 2, "out": out}


def call_all() -> None:
    """Call each function with each variant of each array, and print what comes of it."""
    for calls, states in ((of_functions(), False), (of_states(), True)):
        for name, call, arrays in calls:
            call(**{n: a.copy() for n, a in arrays.items()})
            for argument, array in arrays.items():
                for variant, change in VARIANTS.items():
                    print(f"{name}: {argument} {variant}", end=" ", flush=True)
                    try:
                        copies = {n: a.copy() for n, a in arrays.items()}
                        call(**copies | {argument: change(array)})
                        fits = np.size(change(array)) == array.size or argument in FREE
                        print("BAD" if states and variant in LENGTHS and not fits else "ok")
                    except Exception as error:
                        print(type(error).__name__, flush=True)


def test_no_argument_of_a_kernel_crashes_the_process() -> None:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    code = "import test_kernels_arguments as t; t.call_all(); print('end')"
    command = [sys.executable, "-W", "ignore", "-c", code]
    result = subprocess.run(command, capture_output=True, text=True, env=environment)
    lines = result.stdout.splitlines()
    assert (result.returncode, lines[-1]) == (0, "end"), (lines[-1:], result.stderr[-2000:])
    assert [line for line in lines if line.endswith("BAD")] == []
    assert len(lines) > 700


def test_a_block_without_frames_has_no_slowness() -> None:
    with pytest.raises(UsageError, match="frames is 0: give at least 1"):
        kernels.instantaneous_slowness(np.empty((0, 2)))


def test_an_agent_is_refused_if_its_policy_is_of_other_streams() -> None:
    agent = new_agent(CONFIG, STREAMS, 0)
    for policy in (np.zeros(0, np.int64), np.zeros(2, np.int64), np.zeros(4000, np.int64)):
        changed = pickle.loads(pickle.dumps(agent._replace(policy=policy)))
        with pytest.raises(UsageError):
            as_struct(changed, rules(CONFIG, STREAMS), np.zeros(1, OUTCOME))


def test_a_learner_is_not_restored_from_arrays_of_other_lengths() -> None:
    config, spec = LearnerConfig(), OscillatorySource().spec
    state = CuriousLearner(config, spec, 0).state
    for name, array in state.arrays.items():
        changed = dict(state.arrays) | {name: np.concatenate([array, array])}
        if array.size:
            with pytest.raises(ValueError, match=name):
                CuriousLearner(config, spec, 0).restore(replace(state, arrays=changed))
