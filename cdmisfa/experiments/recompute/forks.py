"""Another future of a run: its learner goes on from some iteration, told something else."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cdmisfa.agents.learners import LEARNERS
from cdmisfa.core.config import as_table, build, differences, parse_settings
from cdmisfa.core.errors import UsageError
from cdmisfa.core.learning import Keyframe, arithmetic_of
from cdmisfa.experiments.recompute.again import Again, Era, source_of, told_anew
from cdmisfa.experiments.recompute.check import learner_after
from cdmisfa.experiments.resume import FORK, Fork, command_of, read_command
from cdmisfa.experiments.runs import RunResult, run
from cdmisfa.experiments.sources import versions_used
from recorder.log.files import folder_here
from replay.runs.folders import run_log
from replay.runs.log import read_header

KEPT = ("algorithm", "expansion", "tau")
"""Keys of a learner on which what it learned depends, whatever the shapes of its memory."""


def fork_run(
    parent: Path,
    at: int,
    out: Path,
    *,
    settings: Sequence[str] = (),
    seed: int | None = None,
    source: Sequence[str] = (),
    limits: Mapping[str, int] | None = None,
    **how: Any,
) -> RunResult:
    """Go on from some iteration of a run with other settings, in a folder of its own.

    Its log begins with the parent's first iterations as they are.

    Args:
        parent: the run, its folder or its log.
        at: iterations kept of it.
        out: folder of the fork.
        settings: `learner.key=value` words; keys that what was learned depends on stay.
        seed: of the random choices from there on; the world stays the parent's.
        source: words that name its source, where it is not what the run says.
        limits: `max_iterations` and `max_modules`, by default the parent's.
        how: see `run`.

    Raises:
        UsageError: there is no such run, iteration or source, or a setting that cannot change.
        RunExhaustedError: a recording ended first; what was learned is saved.
    """
    log, out = run_log(Path(parent)), folder_here(out)
    if os.path.realpath(log.parent) == os.path.realpath(out):
        raise UsageError(f"{out} is the run itself: choose another folder")
    header = read_header(log)
    with Again(log, 0, source) as again:
        now = arithmetic_of(again.learner)
    if header.arithmetic != now:
        raise UsageError(
            f"{log} was learned with arithmetic {header.arithmetic}, this version computes with "
            f"{now}: learn it anew, and fork that"
        )
    learner, t = learner_after(log, at, source)
    manifest = header.manifest
    before, seed_before = manifest["config"]["learner"], int(manifest["seed"])
    seed = seed_before if seed is None else seed
    era = Era(at, _config(before, settings), seed, reseeded=seed != seed_before)
    try:
        told = told_anew(learner, era, header.spec)
    except (ValueError, UsageError) as error:
        raise UsageError(
            f"{' '.join(settings)}: what was learned does not fit it ({error}): fork with keys "
            "that keep its shape"
        ) from error
    table = as_table(era.config)
    changed = {f"learner.{key}": [old, new] for key, old, new in differences(before, table)}
    if era.reseeded:
        changed["seed"] = [seed_before, seed]
    kept = {key: manifest[key] for key in ("config", "seed", FORK) if key in manifest}
    ancestry = {
        "parent": os.path.relpath(log.parent, out),
        "at": at,
        "changed": changed,
        "before": kept,
    }
    sections = {key: value for key, value in manifest["config"].items() if key != "learner"}
    words, options = _command(log.parent, source)
    options |= {
        "settings": (*options.get("settings", ()), *_world(sections), *settings),
        "seed": era.seed,
        **(limits or {}),
    }
    with contextlib.closing(source_of(log.parent, source)) as frames:
        keyframe = Keyframe(at, t, told.state, versions_used(era.config, frames))
        return run(
            frames,
            era.config,
            out,
            seed=era.seed,
            sections=sections,
            max_iterations=options.get("max_iterations"),
            max_modules=options.get("max_modules"),
            fork=Fork(log, keyframe, ancestry),
            command=command_of(words, options, out) if words else None,
            **how,
        )


def _config(before: Mapping[str, Any], settings: Sequence[str]) -> Any:
    """The configuration of a fork's learner."""
    words = parse_settings(settings)
    other = next((section for section in words if section != "learner"), None)
    if other is not None:
        raise UsageError(f"{other}.* is the parent's and stays: a fork changes learner.* alone")
    kind = LEARNERS[before["algorithm"]].configuration
    config = build(kind, "learner", before, words.get("learner", {}))
    for key, old, new in differences(as_table(build(kind, "learner", before)), as_table(config)):
        if key in KEPT:
            raise UsageError(
                f"learner.{key} is {old} and stays: what was learned depends on it, so {new} is "
                "for a run of its own"
            )
    return config


def _command(parent: Path, source: Sequence[str]) -> tuple[tuple[str, ...], dict[str, Any]]:
    """The command that began the parent, of a fork of it."""
    try:
        words, options = read_command(parent)
    except UsageError:
        return tuple(source), {}
    return tuple(source) or words, options


def _world(sections: Mapping[str, Any]) -> list[str]:
    """The setting that keeps the world where only the learner's seed changes."""
    seed = sections.get("scene", {}).get("seed")
    return [] if seed is None else [f"scene.seed={seed}"]
