"""How cost grows with streams, frames and jobs."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable

import numpy as np

from benchmarks.report import interleaved, middle, ratio, save
from cdmisfa import kernels
from cdmisfa.agents.agent import NOVEL, OUTCOME, as_struct, new_agent, rules
from cdmisfa.agents.learner import CuriousLearner
from cdmisfa.core.config import LearnerConfig
from cdmisfa.core.processes import Submit, workers
from cdmisfa.experiments.sources import configure
from cdmisfa.experiments.store import compute
from cdmisfa.experiments.sweep import plan
from recorder.world.oscillatory import OscillatorySource

STREAMS = (10, 100, 1000, 10_000)


def agent_steps(n: int, blocks: int) -> Callable[[], int]:
    """A call of some iterations of an agent of n streams whose every block is novel."""
    config = LearnerConfig(outputs=1, tau=3)
    rng, out = np.random.default_rng(0), np.zeros(1, OUTCOME)
    out["known_by"] = NOVEL
    agent = as_struct(new_agent(config, n, 0), rules(config, n), out)
    y, draws = rng.standard_normal((3, 1)), rng.random((997, 3))
    xi = 1e-3 * (1 + rng.random((997, 3)))

    def call() -> int:
        for b in range(blocks):
            changes, uniforms = (a[b % 997] for a in (xi, draws))
            arrays = (kernels.pointer("xi", changes, (3,)), kernels.pointer("y", y, (3, 1)))
            draw = kernels.pointer("uniforms", uniforms, (3,))
            kernels.check(kernels.lib.think(agent.pointer, *arrays, 3 * b, draw), "the agent")
        return blocks

    return call


def learn_frames(frames: int) -> tuple[float, float]:
    """Learn that many frames; CPU microseconds a frame, and this process' peak memory in MB."""
    config = LearnerConfig(outputs=1, tau=100)
    source = OscillatorySource()
    learner = CuriousLearner(config, source.spec, 0)
    start = time.thread_time_ns()
    for _ in range(frames // config.tau):
        learner.step(source.take(learner.stream, config.tau))
    cost = (time.thread_time_ns() - start) / 1000 / frames
    return cost, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def apart(frames: int) -> tuple[float, float]:
    """`learn_frames` in a process of its own, so that the peak is this one's."""
    with workers(1) as submit:
        submit(learn_frames, 1000).result()  # imports
        cost: tuple[float, float] = submit(learn_frames, frames).result()
        return cost


def trials(submit: Submit, frames: int) -> Callable[[], int]:
    """A call that learns 4 times that many frames in the processes of `workers`."""

    def call() -> int:
        for future in [submit(learn_frames, frames) for _ in range(4)]:
            future.result()
        return 4

    return call


def sweeping(trials: int) -> dict[str, Callable[[], int]]:
    """Calls that plan a sweep's trials, that fill each one's configuration alone, and compute."""

    def planned() -> int:
        return len(plan("oscillatory", grid={}, seeds=range(trials)))

    def configured() -> int:
        return len([configure("oscillatory", seed=seed) for seed in range(trials)])

    (trial,) = plan("oscillatory", grid={}, seeds=[0])

    def computed() -> int:
        compute(trial)
        return 1

    return {"planned": planned, "configured": configured, "computed": computed}


def main(*, quick: bool = False) -> None:
    """Measure, and write results/scaling.json."""
    rounds = 3 if quick else 9
    streams = STREAMS[:2] if quick else STREAMS
    lengths = (1_000, 10_000) if quick else (10_000, 100_000)
    work = {str(n): agent_steps(n, 20_000 // n + 200) for n in streams}
    steps = interleaved(work, rounds)
    by_streams = [
        [n, middle(steps[str(n)], 2), f"{ratio(steps[str(n)], steps['10']):.1f}x"] for n in streams
    ]
    by_frames = []
    for frames in lengths:
        cost, peak = apart(frames)
        by_frames.append([frames, round(cost, 2), round(peak, 1)])
    with workers(1) as one, workers(2) as two:
        jobs = {"1": trials(one, 40 * lengths[0]), "2": trials(two, 40 * lengths[0])}
        walls = interleaved(jobs, 2 if quick else 3, time.perf_counter_ns)
    by_jobs = [
        [n, round(middle(t) / 1000), f"{ratio(walls['1'], t):.2f}x"] for n, t in walls.items()
    ]
    parts = interleaved(sweeping(20 if quick else 200), rounds)
    by_part = [
        [name, middle(parts[which]), f"{100 / ratio(parts['computed'], parts[which]):.2f} %"]
        for name, which in (
            ("computing it", "computed"),
            ("planning it", "planned"),
            ("with the preset read for it alone", "configured"),
        )
    ]
    save(
        "scaling",
        "Scaling",
        "First: one iteration of the agent for n streams. Second: CPU time and peak memory "
        "of a process that learns from the oscillatory streams in blocks of 100. Third: "
        "trials in processes, wall time. Fourth: overhead of a sweep for one trial.",
        [
            (["streams", "µs a step", "of 10 streams"], by_streams),
            (["frames", "µs a frame", "peak MB"], by_frames),
            (["jobs", f"ms a trial of {40 * lengths[0]} frames", "speed"], by_jobs),
            (["of a trial", "µs", "of computing it"], by_part),
        ],
    )
