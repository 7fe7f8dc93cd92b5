"""What of a run can be trusted, and what made it, in words."""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from replay.report.told import ModuleTold, RunTold

ALIKE = 0.8
"""Correlation from which two modules say the same."""

ACCIDENTS = 1.25
"""Slowness on new frames over that on old ones, from which something was learned by heart."""


@dataclass(frozen=True, slots=True)
class Fact:
    """Something that speaks for or against a run, or is only told.

    Attributes:
        kind: "good", "bad" or "told".
        command: that shows it.
    """

    kind: str
    text: str
    command: str = ""


@dataclass(frozen=True, slots=True)
class Proof:
    """Whether learning a run again can be expected to give the same, and what begins it anew."""

    holds: bool
    text: str
    again: str = ""


def command(*words: object) -> str:
    """A command of cdmisfa to copy."""
    return shlex.join(["cdmisfa", *map(str, words)])


def facts(told: RunTold, proof: Proof | None) -> list[Fact]:
    """What speaks for and against a run."""
    found = [Fact("bad", problem) for problem in told.problems]
    if proof is not None:
        kind = "good" if proof.holds else "bad"
        found.append(Fact(kind, proof.text, command("check", told.path)))
    fork = told.header.manifest.get("fork")
    if isinstance(fork, Mapping):
        parent = os.path.normpath(told.path / str(fork.get("parent")))
        text = "It goes on from another run: both side by side."
        found.append(Fact("told", text, command("compare", parent, told.path)))
    found += _of_modules(told)
    found += _of_gaps(told)
    return found


def _of_modules(told: RunTold) -> Iterator[Fact]:
    for module in told.modules:
        name = f"Module {module.module.index} on {module.module.stream}"
        t = module.heard.columns[0] if module.heard.columns else np.empty(0)
        saved = [s for s in told.outline.saved if s.module == module.module.index]
        after = int((t >= saved[0].t + told.outline.tau).sum()) if saved else 0
        if len(t) and not after:
            yield Fact(
                "told",
                f"{name} is shown only on frames that it learned from: its stream was not watched "
                "again after the save.",
            )
        if (apart := _accidents(told, module)) is not None and apart >= ACCIDENTS:
            yield Fact(
                "bad",
                f"{name}: its slowness on new frames is {apart:.2f} times that on frames it "
                "learned from: it may fit accidents.",
            )
    for k, first in enumerate(told.modules):
        alike = [(m, r) for m in told.modules[k + 1 :] if (r := _alike(first, m)) > ALIKE]
        if alike:
            others = ", ".join(f"{m.module.index} ({m.module.stream}) {r:.2f}" for m, r in alike)
            one = f"{first.module.index} ({first.module.stream})"
            yield Fact("bad", f"As module {one} says, so on its frames do, by |r|: {others}.")


def _accidents(told: RunTold, module: ModuleTold) -> float | None:
    """Slowness on new frames over that on old ones, at a module's save; None of the paper's."""
    rows = [s.iteration for s in told.outline.saved if s.module == module.module.index]
    at = np.searchsorted(told.outline.blocks.iterations, rows)
    if not len(at) or at[0] >= len(told):
        return None
    tested, fitted = (float(told.outline.lines[name][at[0]]) for name in ("tested", "fitted"))
    return tested / fitted if np.isfinite(tested) and fitted > 0 else None


def _alike(a: ModuleTold, b: ModuleTold) -> float:
    """Correlation of the first outputs of two modules on frames of the first's stream."""
    if not a.pictures.columns or len(a.pictures.columns[0]) < 8:
        return 0.0
    _, frames, y = a.pictures.columns
    other = b.module.transform(frames)[:, 0]
    if not np.std(y) > 0 or not np.std(other) > 0:
        return 0.0
    return float(abs(np.corrcoef(y, other)[0, 1]))


def _of_gaps(told: RunTold) -> Iterator[Fact]:
    starts, tau = told.outline.blocks.starts, told.outline.tau
    jumps = np.diff(starts) - tau
    if (missing := jumps[jumps > 0]).size:
        yield Fact(
            "told",
            f"{len(missing)} gaps: {int(missing.sum()):,} frames between blocks are of no block, "
            "because a stream lacked them.",
        )
    source = told.document.get("source") or told.header.manifest.get("source")
    alignment = source.get("alignment") if isinstance(source, Mapping) else None
    for name, counts in alignment.items() if isinstance(alignment, Mapping) else ():
        if isinstance(counts, Mapping) and (
            said := [f"{value:,} {key}" for key, value in counts.items() if _lost(key, value)]
        ):
            total = f"{counts.get('messages', 0):,} messages"
            yield Fact("told", f"{name}: {', '.join(said)} of {total}.")


def _lost(key: str, value: Any) -> bool:
    return key != "messages" and isinstance(value, int) and value > 0


MOST_FILES: Final = 100
"""Files of a source that are listed."""


def provenance(told: RunTold, proof: Proof | None) -> list[tuple[str, str]]:
    """What made a run, by names."""
    document, manifest = told.document, told.header.manifest
    source = document.get("source") or manifest.get("source")
    source = source if isinstance(source, Mapping) else {}
    found: list[tuple[str, Any]] = [
        ("algorithm", told.header.setting("learner", "algorithm")),
        ("seed", manifest.get("seed")),
        ("learned from", source.get("kind")),
    ]
    for key in ("files", "views"):
        files = source.get(key) or () if isinstance(source.get(key), Sequence) else ()
        if len(files) > MOST_FILES:
            found.append((key, f"the first {MOST_FILES} of {len(files):,}; run.json lists all"))
        for file in files[:MOST_FILES]:
            if isinstance(file, Mapping):
                name = str(file.get("file", file.get("name", "file")))
                known = next((k for k in ("sha256", "sample_sha256") if k in file), None)
                found.append((name, f"SHA-256 {file[known]}" if known else None))
    versions, machine = document.get("versions"), document.get("platform")
    found += [
        ("SHA-256 of the signals", told.result.get("signals_sha256")),
        ("arithmetic", f"version {told.header.arithmetic}"),
        ("versions", _listed(versions)),
        ("machine", _listed(machine)),
        ("command", proof.again if proof is not None else None),
    ]
    return [(name, str(value)) for name, value in found if value is not None and value != ""]


def _listed(table: Any) -> str | None:
    if not isinstance(table, Mapping):
        return None
    return ", ".join(f"{key} {value}" for key, value in table.items())
