"""A run in words, for the first page of its view."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.signals import ACTIONS, STATES
from replay.runs.run import Outline
from replay.view.columns import MOST_STREAMS

ENDED = "ended:"
"""How the event begins that says why a run ended."""

TOLD = ("nu", "tau", "sigma", "delta")
"""Settings of CD-MISFA that are told."""

TOLD_OF_PROGRESS = ("tau", "components", "window", "attention")
"""Settings of the progress learner that are told."""

NAMED = 4
"""Most streams whose names are given together."""


def summary_text(outline: Outline, name: str, events: Sequence[str] = ()) -> str:
    """What was learned, when, and where the learner stayed for it, as Markdown.

    Args:
        outline: the run in short.
        name: of the run.
        events: what happened in it, in words.
    """
    header = outline.header
    lines = [f"## {name}", _opening(outline), ""]
    lines += _of_streams(outline, events) if header.by_progress else _of_modules(outline)
    reasons = [text.removeprefix(ENDED).strip() for text in events if text.startswith(ENDED)]
    lines += [f"It ended: {reason}.\n" for reason in reasons[-1:] if reason]
    if not header.by_progress:
        lines += ["| stream | watched |", "|---|---|"]
        for s in outline.streams(MOST_STREAMS):
            share = outline.visits[s] / max(outline.frames, 1)
            lines.append(f"| {outline.names()[s]} | {outline.visits[s]} frames, {share:.0%} |")
        lines.append("")
    settings = [("seed", header.manifest.get("seed"))]
    keys = TOLD_OF_PROGRESS if header.by_progress else TOLD
    settings += [(key, header.setting("learner", key)) for key in keys]
    said = ", ".join(f"{key} {value}" for key, value in settings if value is not None)
    lines += [said, ""]
    if header.missing:
        lines.append(f"Signals of version {header.schema}, without {', '.join(header.missing)}.")
    return "\n".join(lines)


def _of_modules(outline: Outline) -> list[str]:
    """The modules of a run of CD-MISFA, and the one that was not saved."""
    spec, lines = outline.header.spec, []
    if outline.saved:
        lines += [
            "| module | stream | iteration | η [1/frame] | policy |",
            "|---|---|---|---|---|",
        ]
        for save in outline.saved:
            eta = ", ".join(f"{value:.4f}" for value in save.eta)
            lines.append(
                f"| {save.module} | {spec.streams[save.stream]} | {save.iteration} | {eta} "
                f"| {policy_text(save.policy, spec.streams)} |"
            )
        lines.append("")
    unfinished = _unfinished(outline)
    return [*lines, unfinished, ""] if unfinished else lines


def _of_streams(outline: Outline, events: Sequence[str]) -> list[str]:
    """What became of each stream in a run of the progress learner, as the run itself said it."""
    names = outline.names()
    said: dict[str, str] = {}
    for text in events:
        about = [name for name in names if text.startswith(f"stream {name} ")]
        if about:
            name = max(about, key=len)
            said[name] = text.removeprefix(f"stream {name} ")
    counts = Counter(outline.states)
    found = [(counts[code], state.replace("_", " ")) for code, state in enumerate(STATES)]
    lines = [", ".join(f"{count} {state}" for count, state in found if count), ""]
    for s in outline.streams(MOST_STREAMS):
        learning = outline.states[s] == STATES.index("learning")
        became = "being learned" if learning else said.get(names[s], "").removeprefix("is ")
        lines.append(f"- **{names[s]}**: {became}")
    more = len(names) - MOST_STREAMS
    return [*lines, "", *([f"And {more} streams that were watched less.", ""] if more > 0 else [])]


def decision_text(
    names: Sequence[str], reward: NDArray[np.float64], value: NDArray[np.float64]
) -> str:
    """What is expected of staying and switching as Markdown tables, in thousandths.

    Args:
        names: of the streams.
        reward: (S, A, S) R from a stream, by an action, to a stream.
        value: (S, A) Q.
    """
    head, rule = " | ".join(names), "|".join(["---"] * (len(names) + 1))
    lines = []
    for action, row in enumerate(ACTIONS):
        lines += [f"**R to {row}** [1/1000]", "", f"| from, to | {head} |", f"|{rule}|"]
        for name, rewards in zip(names, reward[:, action].tolist(), strict=True):
            lines.append(f"| {name} | {' | '.join(f'{1000 * r:.3f}' for r in rewards)} |")
        lines.append("")
    lines += ["**Q** [1/1000]", "", f"| in | {' | '.join(ACTIONS)} |", "|---|---|---|"]
    for name, (stay, switch) in zip(names, value.tolist(), strict=True):
        lines.append(f"| {name} | {1000 * stay:.3f} | {1000 * switch:.3f} |")
    return "\n".join(lines)


def policy_text(policy: tuple[int, ...], streams: tuple[str, ...]) -> str:
    """Where a policy stays, as "stay on left"; the rest switches."""
    stays = [streams[s] for s, action in enumerate(policy) if action == 0]
    if len(stays) == len(streams):
        return "stay everywhere"
    if len(stays) > NAMED:
        return f"stay on {len(stays)} of {len(streams)} streams"
    return f"stay on {', '.join(stays)}" if stays else "switch everywhere"


def _unfinished(outline: Outline) -> str:
    """What became of the abstraction that was not saved."""
    last = outline.last
    if last is None or any(save.module == last.module for save in outline.saved):
        return ""
    most = int(last.visits.argmax())
    return (
        f"Module {last.module} was not saved: {last.novel / last.blocks:.0%} of its "
        f"{last.blocks:,} blocks were novel, and {last.visits[most] / last.blocks:.0%} of them "
        f"were of {outline.names()[most]}."
    )


def _opening(outline: Outline) -> str:
    learned = f"{len(outline.saved)} module{'' if len(outline.saved) == 1 else 's'} learned"
    return (
        f"**{learned}** in {outline.iterations:,} iterations "
        f"({outline.frames:,} frames of {len(outline.names())} streams)."
    )
