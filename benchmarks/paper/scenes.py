"""Where which learner works: the iCub's scene with one thing added at a time, and with all."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.paper import Table, learn_and_judge, study
from cdmisfa.core.config import load_preset
from cdmisfa.experiments.sources import Layers, configure
from cdmisfa.studies.paper import icub
from cdmisfa.studies.paper.experiment import Settings, Trial, groups, mean_text, of_all

ADDED: Mapping[str, tuple[str, ...]] = {
    "plain": (),
    "edge of the table, in a room": ("room",),
    "textures": ("texture",),
    "shadows": ("shadow",),
    "noise, blur and vignette": ("blur", "vignette", "noise"),
    "overlapping views": (),
    "all but overlap, and the arms": (
        *("room", "texture", "shadow", "arms", "blur", "vignette", "noise"),
    ),
}
"""The scenes, and the keys of the preset `icub-real` that each adds to the plain one."""

TURNED = "scene.eyes.yaw=30,0,-30"
"""Overlapping views share 19 of 49 degrees; 56 % of the right one's images show object 2, too."""

LEARNERS = ("2.0", "progress")

CONDITIONS = [{"learner": learner, "added": scene} for learner in LEARNERS for scene in ADDED]


def run(settings: Settings) -> dict[str, Any]:
    """Run one trial, live: the seed is that of the learner and of what moves."""
    real, added = load_preset("icub-real")["scene"], settings["added"]
    words = [f"learner.algorithm={settings['learner']}"]
    words += [f"scene.{key}={real[key]}" for key in ADDED[added]]
    words += [TURNED] if added == "overlapping views" else []
    config = configure("icub", Layers.read(words=words), settings["seed"])
    with contextlib.closing(config.open_scene()) as source:
        end = icub.ITERATIONS * config.learner.tau
        return learn_and_judge(source, config.learner, settings["seed"], end)


def tables(trials: Sequence[Trial]) -> list[Table]:
    """Tabulate which objects are learned where; the progress learner ends when it has decided."""
    cells, rows = groups(trials, "added", "learner"), []
    for scene in ADDED:
        row = [scene]
        for learner in LEARNERS:
            group = cells[scene, learner]
            alone = [sum(icub.best(t.row, k) >= icub.FOLLOWS for t in group) for k in (0, 1)]
            row += [of_all(icub.follow_both(group), len(group)), f"{alone[0]}, {alone[1]}"]
        ended = [t.row for t in group if t.row["iterations"] < icub.ITERATIONS]
        away = sum(1 not in row["streams"] for row in ended)
        row += [of_all(away, len(group)), mean_text([row["iterations"] for row in ended], 0)]
        rows.append(row)
    head = [f"{name}: {what}" for name in LEARNERS for what in ("both objects", "object 1, 3")]
    return [(("scene", *head, "center given up", "blocks until decided"), rows)]


if __name__ == "__main__":
    study("scenes", CONDITIONS, run, tables)
