"""A run in words, for the first page of its view."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.names import counted
from cdmisfa.core.signals import ACTIONS, STATES
from replay.runs.run import Outline
from replay.view.columns import MOST_STREAMS
from replay.view.labels import text_table

ENDED = "ended:"
"""Start of the event that says why a run ended."""

TOLD = ("nu", "tau", "sigma", "delta")
"""Settings of CD-MISFA that are told."""

TOLD_OF_PROGRESS = ("tau", "components", "window", "attention")
"""Settings of the progress learner that are told."""

NAMED = 4
"""Most streams whose names are given together."""


def summary_text(outline: Outline, name: str, events: Sequence[str] = ()) -> str:
    """Summary of a run as Markdown: modules or streams learned, why it ended, settings.

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
        names, visits, frames = outline.names(), outline.visits, max(outline.frames, 1)
        watched = [
            (names[s], f"{visits[s]} frames, {visits[s] / frames:.0%}")
            for s in outline.streams(MOST_STREAMS)
        ]
        lines += text_table(("stream", "watched"), watched)
    settings = [("seed", header.manifest.get("seed"))]
    keys = TOLD_OF_PROGRESS if header.by_progress else TOLD
    settings += [(key, header.setting("learner", key)) for key in keys]
    said = ", ".join(f"{key} {value}" for key, value in settings if value is not None)
    lines += [said, ""]
    return "\n".join(lines)


def _of_modules(outline: Outline) -> list[str]:
    """The modules of a run of CD-MISFA, and the one that was not saved."""
    streams, rows = outline.names(), []
    for save in outline.saved:
        eta = ", ".join(f"{value:.4f}" for value in save.eta)
        policy = policy_text(save.policy, streams)
        rows.append((save.module, streams[save.stream], save.iteration, eta, policy))
    head = "module", "stream", "iteration", "η [1/frame]", "policy"
    lines = text_table(head, rows) if rows else []
    unfinished = _unfinished(outline)
    return [*lines, unfinished, ""] if unfinished else lines


def _of_streams(outline: Outline, events: Sequence[str]) -> list[str]:
    """State of each stream of a run of the progress learner, in the words of the run's events."""
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
    """R and Q as Markdown tables, in thousandths.

    Args:
        names: of the streams.
        reward: (S, A, S) R from a stream, by an action, to a stream.
        value: (S, A) Q.
    """
    tables = [
        (f"R to {name}", ("from, to", *names), reward[:, action])
        for action, name in enumerate(ACTIONS)
    ]
    lines: list[str] = []
    for title, head, values in (*tables, ("Q", ("in", *ACTIONS), value)):
        rows = [
            (name, *(f"{1000 * v:.3f}" for v in row))
            for name, row in zip(names, values.tolist(), strict=True)
        ]
        lines += [f"**{title}** [1/1000]", "", *text_table(head, rows)]
    return "\n".join(lines)


def policy_text(policy: tuple[int, ...], streams: tuple[str, ...]) -> str:
    """A policy in words, as "stay on left"."""
    stays = [streams[s] for s, action in enumerate(policy) if action == 0]
    if len(stays) == len(streams):
        return "stay everywhere"
    if len(stays) > NAMED:
        return f"stay on {len(stays)} of {len(streams)} streams"
    return f"stay on {', '.join(stays)}" if stays else "switch everywhere"


def _unfinished(outline: Outline) -> str:
    """A sentence about the abstraction that was not saved."""
    last = outline.last
    if last is None or any(save.module == last.module for save in outline.saved):
        return ""
    most = int(last.novel_of.argmax())
    share = last.novel_of[most] / max(last.novel, 1)
    of_most = f", and {share:.0%} of these were of {outline.names()[most]}" if last.novel else ""
    return (
        f"Module {last.module} was not saved: {last.novel / last.blocks:.0%} of its "
        f"{last.blocks:,} blocks were novel{of_most}."
    )


def _opening(outline: Outline) -> str:
    learned = f"{counted(len(outline.saved), 'module')} learned"
    return (
        f"**{learned}** in {counted(outline.iterations, 'iteration', ',')} "
        f"({counted(outline.frames, 'frame', ',')} of {counted(len(outline.names()), 'stream')})."
    )
