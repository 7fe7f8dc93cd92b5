"""The measurements, plots and images on the page of one run: the variables of run.html."""

from __future__ import annotations

import itertools
import os
import shlex
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cdmisfa.core.signals import STATE_WORDS, STATES
from replay.palette import shade
from replay.report import figures
from replay.report.run_data import ModuleData, RunData
from replay.report.saving_rules import Measurement, attempts, measurements_of

# Streams that have a card, the most watched, and those that are visible at once.
CARDS, OPEN_CARDS = 64, 12

# Modules that have a section with images and plots; the table lists all.
SECTIONS = 12

# Files of a source that are listed; run.json lists all.
MOST_FILES = 100


def cli_command(*words: object) -> str:
    """Return a command of cdmisfa to copy into a shell."""
    return shlex.join(["cdmisfa", *map(str, words)])


def run_content(run: RunData, reproducible: str, again: str) -> dict[str, Any]:
    """Return the variables of run.html; see `report_of_run`."""
    outline, rules = run.outline, measurements_of(run.outline)
    frames: dict[str, dict[str, Any]] = {}
    ended = str(run.result.get("ended", "interrupted")).replace("_", " ")
    for event in run.events if run.result else ():
        if event.text.startswith("ended: "):
            ended = event.text.removeprefix("ended: ")
    pointed = "timeline" if run.watched.columns else ""
    attention_plot = figures.timeline(outline, pointed) if outline.iterations else None
    if attention_plot is not None and pointed:
        t, values = run.watched.columns
        texts = _watched_texts(run, rules, t)
        frames[pointed] = figures.frames_to_point_at(
            attention_plot, t, values, texts, images=run.spec.images
        )
    attended = zip(outline.visits.tolist(), run.spec.streams, strict=True)
    codes = np.unique(outline.changes[:, 2]).tolist()
    return {
        "kind": "run",
        "title": run.path.resolve().name,
        "lead": _lead(run),
        "run": run,
        "outline": outline,
        "reproducible": reproducible,
        "ended": ended,
        "attention": sorted(attended, key=lambda row: -row[0]),
        "cards": _cards(run),
        "open_cards": OPEN_CARDS,
        "timeline": attention_plot,
        "states": [(f"state{code}", STATE_WORDS[code]) for code in codes if code >= 0],
        "rules": [(rule, figures.rule_plot(outline, rule, pointed)) for rule in rules],
        "attempts": attempts(outline, rules),
        "modules": [_module(run, module, frames) for module in run.modules],
        "sections": SECTIONS,
        "held_out": run.result.get("held_out"),
        "origin": _origin(run, again),
        "view": cli_command("view", run.path),
        "frames": frames,
    }


def _lead(run: RunData) -> str:
    learned = len({save.stream for save in run.outline.saved})
    lead = (
        f"{learned} of {len(run.spec.streams)} streams learned, {run.outline.iterations:,} "
        f"iterations, {run.outline.frames:,} frames"
    )
    if isinstance(passes := run.result.get("passes"), int) and passes > 1:
        lead += f", {passes} passes over the log"
    fork = run.header.manifest.get("fork")
    if isinstance(fork, Mapping):
        lead += f". Fork of {fork.get('parent')} after {fork.get('at')} iterations"
        changed = fork.get("changed")
        for key, values in changed.items() if isinstance(changed, Mapping) else ():
            lead += f"; {key}: {' → '.join(map(str, values))}"
    return lead


def _watched_texts(run: RunData, rules: Sequence[Measurement], t: Any) -> list[str]:
    """Return the stream and the rules that held at each of (n,) frames."""
    blocks = run.outline.blocks
    deciding = [(rule.name, rule.holds) for rule in rules if rule.decides]
    texts = []
    for frame, row in zip(t.tolist(), blocks.places(t).tolist(), strict=True):
        text = f"frame {frame:,}, iteration {blocks.iterations[row]:,}: "
        text += run.spec.streams[blocks.streams[row]]
        for word, truth in (("rules that hold", True), ("not", False)):
            if names := [name for name, holds in deciding if holds[row] == truth]:
                text += f"; {word}: {', '.join(names)}"
        texts.append(text)
    return texts


def _cards(run: RunData) -> list[dict[str, Any]]:
    """Return a card of each of the most watched streams; of many, those learned come first."""
    outline = run.outline
    stated = [one for one in run.result.get("streams", ()) if isinstance(one, Mapping)]
    outcomes = {one["stream"]: one for one in stated if "stream" in one}
    learned = {save.stream for save in outline.saved}
    streams = outline.streams(CARDS)
    if len(streams) > OPEN_CARDS:
        streams.sort(key=lambda s: (s not in learned, s))
    cards = []
    for place, s in enumerate(streams):
        name, code = run.spec.streams[s], outline.states[s]
        outcome = outcomes.get(name, {})
        state = STATES[code] if code >= 0 else "learned" if s in learned else ""
        words = STATE_WORDS[code] if code >= 0 else state or "not learned"
        saves = [save for save in outline.saved if save.stream == s]
        notes = [f"module {save.module}, slowness {save.eta[0]:.4f} cycles/frame" for save in saves]
        if not notes and outcome.get("module"):
            notes.append(f"module {outcome['module']}")
        if outcome.get("why"):
            notes.append(str(outcome["why"]))
        image, plot, last = "", None, run.last.get(s) if place < 2 * OPEN_CARDS else None
        if last is not None and run.spec.of(s).images:
            image = figures.data_uri(figures.reduced(last, figures.THUMBNAIL))
        elif last is not None:
            plot = figures.numbers_plot(last, f"Last {len(last)} frames of {name}")
        cards.append(
            {
                "name": name,
                "colour": figures.colour_class(s),
                "image": image,
                "plot": plot,
                "state": state,
                "words": words,
                "notes": "; ".join(notes),
                "frames": int(outline.visits[s]),
                "share": int(outline.visits[s]) / max(outline.frames, 1),
            }
        )
    return cards


def _module(run: RunData, module: ModuleData, frames: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return the measurements of a module, and for its section its images and plots."""
    frozen, outline, images = module.frozen, run.outline, module.images
    save = next((save for save in outline.saved if save.module == frozen.index), None)
    saved = outline.end if save is None else save.t + outline.tau
    truth_fits = module.truth_fits()
    others = [(module.correlation(m), m.frozen.index) for m in run.modules if m is not module]
    section: dict[str, Any] = {
        "frozen": frozen,
        "colour": figures.colour_class(frozen.stream_index),
        "saved": saved,
        "frames": module.stream.count,
        "fits": truth_fits,
        "overfitting": _overfitting(run, frozen.iteration),
        "alike": max(others, default=(0.0, 0)),
        "after": module.after,
        "compared": len(module.frames.columns[0]) if module.frames.columns else 0,
        "plot": None,
        "quantity": run.spec.truth[truth_fits[0].column] if truth_fits else "",
        "truth": figures.truth_plot(module, truth_fits[0]) if truth_fits else None,
        "recent": figures.recent_plots(module),
        "view": cli_command("view", run.path, "--at", f"iteration {frozen.iteration}"),
        **_weights(module, images=images),
        "extremes": [],
    }
    if not module.outputs.columns:
        return section
    key = f"module{frozen.index}"
    section["plot"] = plot = figures.output_plot(run, module, saved, key)
    if frozen.index <= SECTIONS:
        t, values, y = module.frames.columns
        texts = [f"frame {k:,}: output {v:+.2f}" for k, v in zip(t.tolist(), y, strict=True)]
        frames[key] = figures.frames_to_point_at(plot, t, values, texts, images=images)
    for title, picks in module.stream.sheet().items():
        if picks:
            small = [figures.reduced(pick.frame, figures.FRAME) for pick in picks] if images else []
            image = figures.data_uri(figures.sheet(small, len(small), 2)) if images else ""
            texts = ["" if images else figures.numbers(pick.frame) for pick in picks]
            rows = [(pick.y, pick.t, text) for pick, text in zip(picks, texts, strict=True)]
            section["extremes"].append({"title": title, "image": image, "picks": rows})
    return section


def _overfitting(run: RunData, iteration: int) -> float | None:
    """Return slowness on new frames over that on old ones; None of the paper's learners."""
    row = int(np.searchsorted(run.outline.blocks.iterations, iteration))
    if row >= run.outline.iterations:
        return None
    tested, fitted = (float(run.outline.lines[name][row]) for name in ("tested", "fitted"))
    return tested / fitted if np.isfinite(tested) and fitted > 0 else None


def _weights(module: ModuleData, *, images: bool) -> dict[str, Any]:
    """Return the weights of the first output and, of images, its saliency."""
    stream, frozen = module.stream, module.frozen
    weights, saliency = stream.weights(), stream.saliency()
    if images and weights is not None and saliency is not None:
        return {
            "bars": None,
            # Blue below 0, white at 0, orange above.
            "weights": figures.data_uri(shade(figures.reduced(weights, figures.WEIGHTS))),
            "saliency": figures.saliency_image(saliency, stream.mean) if stream.count else "",
        }
    kind = "expanded inputs" if weights is None else "values of a frame"
    about = f"Weights of output 1 of module {frozen.index} on the {frozen.phi.shape[1]} {kind}"
    return {"bars": figures.bars(frozen.phi[0], about), "weights": "", "saliency": ""}


def _origin(run: RunData, again: str) -> list[tuple[str, Any]]:
    """Return where a run came from and the commands that check it, as rows of a table."""
    document, manifest = run.document, run.header.manifest
    source = document.get("source") or manifest.get("source")
    source = source if isinstance(source, Mapping) else {}
    check = cli_command("check", run.path)
    rows: list[tuple[str, Any]] = [("check", check), ("learn again", again)]
    fork = manifest.get("fork")
    if isinstance(fork, Mapping):
        parent = os.path.normpath(run.path / str(fork.get("parent")))
        rows.append(("compare with the parent run", cli_command("compare", parent, run.path)))
    rows += [
        ("algorithm", run.header.setting("learner", "algorithm")),
        ("seed", manifest.get("seed")),
        ("source", source.get("kind")),
    ]
    lists = [files for files in map(source.get, ("files", "views")) if isinstance(files, list)]
    files = [file for file in itertools.chain(*lists) if isinstance(file, Mapping)]
    for file in files[:MOST_FILES]:
        digest = file.get("sha256") or file.get("sample_sha256")
        rows.append((str(file.get("file", file.get("name"))), digest and f"SHA-256 {digest}"))
    if len(files) > MOST_FILES:
        rows.append(("further files", f"{len(files) - MOST_FILES:,}, listed in run.json"))
    jumps = np.diff(run.outline.blocks.starts) - run.outline.tau
    if (gaps := jumps[jumps > 0]).size:
        rows.append(("gaps", f"{len(gaps)} gaps, {int(gaps.sum()):,} missing frames"))
    alignment = source.get("alignment")
    for name, counts in alignment.items() if isinstance(alignment, Mapping) else ():
        rows.append((f"messages of {name}", _pairs(counts)))
    return [
        *rows,
        ("SHA-256 of the signals", run.result.get("signals_sha256")),
        ("version of the arithmetic", run.header.arithmetic),
        ("versions of packages", _pairs(document.get("versions"))),
        ("machine", _pairs(document.get("platform"))),
    ]


def _pairs(table: Any) -> str:
    pairs = table.items() if isinstance(table, Mapping) else ()
    return ", ".join(f"{key} {value}" for key, value in pairs)
