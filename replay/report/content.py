"""What the page of a run shows: words, plots and pictures, in the order in which they are read."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from cdmisfa.core.signals import STATES
from replay.outputs import Pick
from replay.report.conditions import attempts, conditions_of, deciding
from replay.report.drawing import Plot, colour_class
from replay.report.panels import (
    FEW,
    Frames,
    bars,
    frames_of_module,
    frames_of_run,
    near_plots,
    numbers_plot,
    output_plot,
    rule_plot,
    saliency_picture,
    saved_frame,
    state_words,
    strip,
    thumbnail,
    timeline,
    values_text,
    weights_picture,
    world_plot,
)
from replay.report.told import ModuleTold, RunTold
from replay.report.trust import Proof, command, facts, provenance
from replay.runs.run import Save

CARDS, FIRST = 64, 12
"""Streams that have a card, the most watched, and those of them that are shown at once."""

MODULES = 12
"""Modules that are shown in full; others have a line in a table."""

LISTED = 24
"""Events that are shown without being asked for."""

NAMES = 4
"""Names that are told in one sentence."""

FOLLOWS = 0.5
"""Correlation from which on a module is said to follow something."""


def run_content(told: RunTold, proof: Proof | None) -> dict[str, Any]:
    """What the page of a run is made of; see page.html."""
    rules = conditions_of(told.outline, told.signals)
    counted = deciding(rules)
    frames: dict[str, Frames] = {}
    lanes = timeline(told, "timeline") if len(told) else None
    if lanes is not None:
        _put(frames, lanes, frames_of_run(told, counted, lanes))
    pointed = "" if lanes is None else lanes.frames
    return {
        "kind": "run",
        "title": told.name,
        "lead": _lead(told),
        "answers": _answers(told, proof),
        "problems": told.problems,
        "cards": _cards(told),
        "carded": FIRST,
        "more_streams": max(len(told.streams) - CARDS, 0),
        "progress": told.header.by_progress,
        "forked": told.header.forked_at is not None,
        "states": [(f"state{k}", state_words(k)) for k in _codes(told)],
        "timeline": lanes,
        "rules": [
            (rule, rule_plot(told, rule, pointed, by_stream=told.header.by_progress))
            for rule in rules
            if rule.drawn and np.isfinite(rule.values).any()
        ],
        "counted": counted,
        "attempts": attempts(told.outline, told.signals, rules),
        "modules": [_module(told, module, frames) for module in told.modules[:MODULES]],
        "others": [_line(told, module) for module in told.modules[MODULES:]],
        "held_out": _held_out(told),
        "facts": facts(told, proof),
        "events": list(_events(told)),
        "listed": LISTED,
        "provenance": provenance(told, proof),
        "frames": {key: asdict(value) for key, value in frames.items()},
        "view": command("view", told.path),
    }  # fmt: skip


def _codes(told: RunTold) -> list[int]:
    """Codes of the states that streams were in."""
    return sorted({code for *_, code in told.states if code >= 0})


def _put(frames: dict[str, Frames], plot: Plot, found: Frames | None) -> None:
    if found is None or not found.x:
        plot.frames = ""
    else:
        frames[plot.frames] = found


def ending(told: RunTold) -> str:
    """Why a run ended, in words."""
    said = [e.text.partition("ended:")[2].strip() for e in told.events if "ended:" in e.text[:7]]
    if told.result and said:
        return said[-1]
    ended = str(told.result.get("ended", "it was broken off before its end"))
    return ended.replace("_", " ")


def _lead(told: RunTold) -> str:
    n, saved = len(told.streams), len(told.outline.saved)
    learned = len({save.stream for save in told.outline.saved})
    what = f"{learned} of {n} stream{'s' * (n != 1)} learned"
    if saved != learned:
        what += f", {saved} modules"
    fork = told.header.manifest.get("fork")
    of = ""
    if isinstance(fork, Mapping):
        changed = fork.get("changed")
        pairs = changed.items() if isinstance(changed, Mapping) else ()
        said = [f"{key} {old} became {new}" for key, (old, new) in pairs]
        of = f" A fork of {fork.get('parent')} after {fork.get('at'):,} iterations: "
        of += f"{'; '.join(said) or 'nothing else was told'}."
    frames = f"{told.outline.frames:,} frames"
    return f"{what} in {len(told):,} iterations ({frames}). {_sentence(ending(told))}{of}"


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}."


def _answers(told: RunTold, proof: Proof | None) -> list[tuple[str, str]]:
    """The five questions that a run answers."""
    saved, names = told.outline.saved, told.streams
    what = [f"{names[s.stream]} (module {s.module})" for s in saved]
    when = [f"{s.t + told.outline.tau:,}" for s in saved]
    total = max(told.outline.frames, 1)
    ranked = sorted(range(len(names)), key=lambda s: -int(told.outline.visits[s]))
    looked = [f"{names[s]} {told.outline.visits[s] / total:.0%}" for s in ranked]
    trusted = "nobody asked whether it can be learned again"
    if proof is not None:
        trusted = proof.text
    against = [fact for fact in facts(told, None) if fact.kind == "bad"]
    if against:
        speak = "thing speaks" if len(against) == 1 else "things speak"
        trusted = f"{len(against)} {speak} against it, see below. {_sentence(trusted).rstrip('.')}."
    return [
        ("What did it learn?", _listed(what) or "nothing: no module was saved"),
        ("When?", f"at frame {_listed(when)} of {told.outline.end:,}" if when else "never"),
        ("Where did it look?", _listed(looked)),
        ("Why did it stop?", ending(told)),
        ("Can I trust it?", trusted),
    ]


def _listed(words: list[str]) -> str:
    more = len(words) - NAMES
    return ", ".join(words[:NAMES]) + (f" and {more} more" if more > 0 else "")


def _cards(told: RunTold) -> list[dict[str, Any]]:
    outline, total = told.outline, max(told.outline.frames, 1)
    outcomes = told.result.get("streams", ())
    found = {str(q.get("stream")): q for q in outcomes if isinstance(q, Mapping)}
    cards = []
    shown = outline.streams(CARDS)
    if len(shown) > FIRST:  # of many what was learned comes first
        shown.sort(key=lambda s: (s not in {save.stream for save in outline.saved}, s))
    for place, s in enumerate(shown):
        name, visits = told.streams[s], int(outline.visits[s])
        verdict, kind, why = _verdict(told, s, found.get(name))
        seen = told.last.get(s) if place < 2 * FIRST else None
        cards.append(
            {
                "name": name,
                "colour": colour_class(s),
                "picture": thumbnail(seen) if seen is not None and told.header.spec.images else "",
                "plot": None
                if seen is None or told.header.spec.images
                else numbers_plot(seen, f"The last {len(seen)} frames of {name}"),
                "verdict": verdict,
                "kind": kind,
                "why": why,
                "share": f"{visits / total:.1%}",
                "part": f"{100 * visits / total:.1f}",
                "frames": f"{visits:,}",
            }
        )
    return cards


def _verdict(told: RunTold, stream: int, outcome: Mapping[str, Any] | None) -> tuple[str, str, str]:
    """What became of a stream: in a word or two, its kind, and why."""
    saves = [save for save in told.outline.saved if save.stream == stream]
    code = told.outline.states[stream]
    if not told.header.by_progress or code < 0:
        if saves:
            return "learned", "learned", " and ".join(_of_save(save) for save in saves)
        return "not learned", "given_up", "no module was saved on it"
    state = STATES[code]
    if outcome is None:
        return state_words(code), state, " and ".join(_of_save(save) for save in saves)
    why = []
    if outcome.get("module"):
        why.append(f"module {outcome['module']}")
    if outcome.get("slowness") is not None:
        why.append(f"slowness {outcome['slowness']:.4f} on frames not learned from")
    if outcome.get("why"):
        why.append(str(outcome["why"]))
    if state == "learning":
        watched = int(told.outline.visits[stream])
        why.append("it ended before this was decided" if watched else "it was never watched")
        return "not decided", state, "; ".join(why)
    return state_words(code), state, "; ".join(why)


def _of_save(save: Save) -> str:
    return f"module {save.module}, slowness {save.eta[0]:.4f}"


def _module(told: RunTold, module: ModuleTold, frames: dict[str, Frames]) -> dict[str, Any]:
    frozen, own = module.module, module.own
    heard = bool(module.heard.columns)
    key = f"module{frozen.index}"
    plot = output_plot(told, module, key) if heard else None
    if plot is not None:
        _put(frames, plot, frames_of_module(told, module, plot))
    fits = module.fits(told.header.spec.truth) if told.header.spec.truth else []
    saved = saved_frame(told, module)
    t = module.heard.columns[0] if heard else np.empty(0)
    after = int((t >= saved).sum()) * module.heard.step
    near = near_plots(module) if heard else []
    return {
        "index": frozen.index,
        "name": frozen.stream,
        "colour": colour_class(frozen.stream_index),
        "iteration": f"{frozen.iteration:,}",
        "saved": f"{saved:,}",
        "count": f"{own.count:,}",
        "after": f"{min(after, own.count):,}" if after else "",
        "weights": _weights(told, module),
        "strips": _strips(told, module) if heard else [],
        "plot": plot,
        "outputs": _outputs(module, near),
        "world": world_plot(told, module, fits[0]) if fits else None,
        "fits": [(fit.function, f"{fit.r:.2f}", fit.r >= FOLLOWS) for fit in fits[:4]],
        "view": _look(told, f"iteration {frozen.iteration}"),
    }


def _outputs(module: ModuleTold, near: list[Plot]) -> list[dict[str, Any]]:
    """Each output: its slowness, whether it is slow, and what it is like from near."""
    frozen = module.module
    known = len(frozen.slow) == len(frozen.eta)
    return [
        {
            "number": j + 1,
            "slowness": f"{float(eta):.4f}",
            "slow": ("slow" if frozen.slow[j] else "not slow") if known else "",
            "plot": near[j] if j < len(near) else None,
        }
        for j, eta in enumerate(frozen.eta)
    ]


def _weights(told: RunTold, module: ModuleTold) -> dict[str, Any]:
    """Weights and saliency as pictures, or as bars."""
    weights, saliency = module.own.weights(), module.own.saliency()
    frozen = module.module
    found: dict[str, Any] = {"weights": "", "saliency": "", "bars": []}
    if weights is None or saliency is None:
        about = f"Weights of module {frozen.index} on its {frozen.phi.shape[1]} expanded inputs"
        found["bars"].append((bars(frozen.phi[0], about), about))
    elif told.header.spec.images:
        found["weights"] = weights_picture(weights)
        if module.own.count:
            found["saliency"] = saliency_picture(saliency, module.own.mean)
    else:
        shown = [(weights, f"Weights of module {frozen.index}, one for each number of a frame")]
        if module.own.count:
            text = f"What each number moves the output of module {frozen.index} by"
            shown.append((saliency, text))
        found["bars"] = [(bars(values, about), about) for values, about in shown]
    return found


def _strips(told: RunTold, module: ModuleTold) -> list[dict[str, Any]]:
    """Frames of least, middle and greatest output."""
    sheet = module.own.sheet()
    parts = (("least", sheet.least), ("middle", sheet.middle), ("greatest", sheet.greatest))
    return [
        {
            "title": title,
            "picture": strip(picks) if told.header.spec.images else "",
            "picks": [(f"{pick.y:+.2f}", f"{pick.t:,}", _values(told, pick)) for pick in picks],
        }
        for title, picks in parts
        if picks
    ]


def _values(told: RunTold, pick: Pick) -> str:
    if told.header.spec.images:
        return ""
    return values_text(np.asarray(pick.frame).ravel()[:FEW])


def _line(told: RunTold, module: ModuleTold) -> tuple[str, ...]:
    frozen = module.module
    fits = module.fits(told.header.spec.truth) if told.header.spec.truth else []
    follows = f"{fits[0].function}, |r| = {fits[0].r:.2f}" if fits else ""
    return (
        str(frozen.index), frozen.stream, f"{frozen.iteration:,}", f"{float(frozen.eta[0]):.4f}",
        follows,
    )  # fmt: skip


def _held_out(told: RunTold) -> dict[str, Any] | None:
    """Slowness on frames that were held out, beside that of batch SFA."""
    found = told.result.get("held_out")
    if not isinstance(found, Mapping) or not found.get("modules"):
        return None
    start, stop = found["frames"]
    rows = [
        (one["module"], one["stream"], k + 1, f"{own:.4f}", f"{batch:.4f}")
        for one in found["modules"]
        for k, (own, batch) in enumerate(zip(one["slowness"], one["of_batch"], strict=False))
        if own is not None and batch is not None
    ]
    return {"start": f"{start:,}", "last": f"{stop - 1:,}", "rows": rows}


def _events(told: RunTold) -> Iterator[dict[str, str]]:
    for event in told.events:
        yield {
            "iteration": f"{event.iteration:,}",
            "frame": f"{event.t:,}",
            "text": event.text,
            "kind": "bad" if event.level in ("WARNING", "ERROR", "FATAL") else "",
            "view": _look(told, str(min(event.t, max(told.outline.end - 1, told.start)))),
        }


def _look(told: RunTold, when: str) -> str:
    """The command that shows a moment."""
    return command("view", told.path, "--at", when)
