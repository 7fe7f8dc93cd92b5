"""What carries the result: the readings that the paper does not state, taken out in turn."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.paper import Table, learn_and_judge, study
from cdmisfa.experiments.trial import run_oscillatory_trial
from cdmisfa.studies.paper import icub, oscillatory
from cdmisfa.studies.paper.experiment import (
    Settings,
    Trial,
    groups,
    learned_order,
    module_row,
    of_all,
    paper_config,
)
from replay.open_sources import open_recording

Keys = dict[str, float]

ALL_TIME = 10**9
"""A window that never ends: a plain mean."""

SHARE: Keys = {"novel_share": 0.0}
VARIANCE: Keys = {"min_variance": 0.0}

READINGS: Mapping[str, Keys] = {
    "share of blocks before a save (0006)": SHARE,
    "least variance before a save (0006)": VARIANCE,
    "warm-up of the reward (0005)": {"warm_up": 0},
    "window of the slowness (0004)": {"slowness_window": ALL_TIME},
    "window of its change and of the share (0004)": {"eta_dot_window": 1},
    "window of the gate (0004)": {"gate_window": ALL_TIME},
    "start of epsilon at 1.2 instead of 1": {"epsilon_start": 1.0},
}
"""What the paper does not state of its experiments, and the keys that leave nothing of it.

The numbers are those of docs/project/decisions.md.
"""

CASES: Mapping[str, Keys] = {
    "nothing: as decided": {},
    **READINGS,
    "share and least variance: equation 3 alone": SHARE | VARIANCE,
    "all of these": {key: value for keys in READINGS.values() for key, value in keys.items()},
    # The ends of the range that the paper gives for delta.
    "delta = 0.0004": {"delta": 0.0004},
    "delta = 0.001": {"delta": 0.001},
}

COMPONENTS: Mapping[str, Keys] = {
    f"{K}, {name}": keys | ({"components": K} if K != 8 else {})  # the preset has 8
    for K in (8, 10, 12)
    for name, keys in {
        "both guards": {},
        "no share": SHARE,
        "no least variance": VARIANCE,
        "neither": SHARE | VARIANCE,
    }.items()
}
"""Whitening components of the iCub's abstraction, with and without the guards."""

CONDITIONS = [
    *({"scene": "oscillatory", "case": case, "keys": keys} for case, keys in CASES.items()),
    *({"scene": "icub", "case": case, "keys": keys} for case, keys in (CASES | COMPONENTS).items()),
]


def run(settings: Settings) -> dict[str, Any]:
    """Run one trial of the oscillatory or the iCub experiment with some keys set."""
    scene, seed = settings["scene"], settings["seed"]
    config = paper_config(scene, **settings["keys"])
    if scene == "oscillatory":
        most = oscillatory.MAX_ITERATIONS
        return module_row(run_oscillatory_trial(config, seed=seed, max_iterations=most).modules)
    with contextlib.closing(open_recording(settings["recording"])) as source:
        return learn_and_judge(source, config, seed, source.frames - icub.TEST_FRAMES)


def tables(trials: Sequence[Trial]) -> list[Table]:
    """Tabulate how many trials come out right: order and policies as the paper's."""
    trials_by_case = groups(trials, "scene", "case")

    def of_icub(case: str) -> list[str]:
        group = trials_by_case.get(("icub", case), [])
        third = sum(len(t.row["streams"]) > 2 for t in group)
        counts = (icub.in_order(group), icub.follow_both(group))
        return [*(of_all(count, len(group)) for count in counts), f"{third} of {len(group)}"]

    rows = []
    for case, keys in CASES.items():
        group = trials_by_case["oscillatory", case]
        right = sum(learned_order(t.row) == oscillatory.Oscillatory.optimal for t in group)
        changed = ", ".join(f"{key} {value:g}" for key, value in keys.items())
        rows.append([case, changed or "-", of_all(right, len(group)), *of_icub(case)])
    head = ("iCub: order and policies", f"both objects, |r| >= {icub.FOLLOWS}", "a third module")
    components = [[case, *of_icub(case)] for case in COMPONENTS]
    return [
        (("taken out, or set", "keys", "oscillatory: right", *head), rows),
        (("iCub, K whitening components", *head), components),
    ]


if __name__ == "__main__":
    study("ablation", CONDITIONS, run, tables)
